"""JAX as dtprob's computations want it."""

import warnings

from dtprob.xla import avoid_miscompilation, miscompiles


def configure() -> None:
    """Double precision, and on CPUs a compiler without the fault of jaxlib 0.12.0.1, as the command line has them.

    Call it right after `import dtprob`, before the first array is made and before any part of dtprob is imported, as some
    of these compute while they are: what was computed before stays as it was, and a compiler that has been started cannot
    be changed. It is for programs and notebooks; importing dtprob changes nothing.
    """
    avoid_miscompilation()
    import jax  # noqa: PLC0415  (the flag has to come first)

    jax.config.update("jax_enable_x64", True)
    if miscompiles():
        what = (
            "JAX has been started before dtprob.configure(), with a compiler that miscompiles some products"
        )
        warnings.warn(
            f"{what}. Call it right after `import dtprob`, before any part of dtprob is imported.",
            RuntimeWarning,
            stacklevel=2,
        )
