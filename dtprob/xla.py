"""A compiler fault of one version of jaxlib, and the flag that avoids it.

On CPUs, jaxlib 0.12.0.1 miscompiles some products with a matrix of equal constants followed by a sum over
the long axis, silently and by as much as the value itself, in single and double precision. The fault lies
in its fusions for the YNNPACK library; without these fusions compiled and plain results agree. The flag has
to be in XLA_FLAGS before jax first computes, so programs set it (the command line does); importing
dtprob never does, but what infers warns where it is missing.
"""

import os
import warnings
from functools import cache

FAULTY = frozenset({"0.12.0.1"})
"""Versions of jaxlib that have the fault."""
FLAG = "--xla_cpu_experimental_ynn_fusion_type="
"""Leaves the faulty fusions out. Other versions may not know it, and then XLA ends the process."""


def version() -> str:
    """The version of jaxlib, found without importing it."""
    from importlib.metadata import version  # noqa: PLC0415  (takes 20 ms, which help can do without)

    return version("jaxlib")


def avoid_miscompilation() -> None:
    """Add the flag to XLA_FLAGS where this version of jaxlib needs it; call it before jax is imported."""
    flags = os.environ.get("XLA_FLAGS", "")
    if version() in FAULTY and FLAG.rstrip("=") not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {FLAG}".strip()


@cache
def warn_of_miscompilation() -> None:
    """Say, once, that what is computed here may be wrong, where this version of jaxlib has the fault and no flag is set."""
    if version() not in FAULTY or FLAG.rstrip("=") in os.environ.get("XLA_FLAGS", ""):
        return
    import jax  # noqa: PLC0415  (heavy)

    if jax.default_backend() == "cpu":
        what = f"jaxlib {version()} miscompiles some products on CPUs, so results may be wrong"
        remedy = (
            f"Run `export XLA_FLAGS={FLAG}` before Python, or dtprob.configure() right after `import dtprob`"
        )
        warnings.warn(f"{what}. {remedy}.", RuntimeWarning, stacklevel=3)


def miscompiles() -> bool:
    """Whether a compiled result differs from the plain one here, tried on the smallest known example."""
    import jax  # noqa: PLC0415  (heavy, and the flag has to come first)
    import jax.numpy as jnp  # noqa: PLC0415

    def mean_of_product(matrix: jax.Array) -> jax.Array:
        return (matrix @ jnp.full((9, 8), 0.5)[:, 1:].T).mean(1)

    matrix = jax.random.normal(jax.random.key(0), (500, 7))
    plain, compiled = mean_of_product(matrix), jax.jit(mean_of_product)(matrix)
    return bool(jnp.max(jnp.abs(plain - compiled)) > 1e-3)
