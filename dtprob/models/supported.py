"""What a model may not hold: unknowns without a prior, or without a density that has a gradient."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Any

from numpyro.distributions import Delta, biject_to, constraints

from dtprob.errors import InputError
from dtprob.models.arguments import Data, Model, model_name
from dtprob.models.declaration import Declaration, base_constraint
from dtprob.models.execution import look_at_trace
from dtprob.wrapping import unwrapped


@contextmanager
def differentiated_forwards() -> Generator[None]:
    """Say what to do where a function of a model has derivatives backwards only.

    Raises:
        InputError: one has.
    """
    try:
        yield
    except TypeError as error:
        if "custom_vjp" not in str(error):
            raise
        raise InputError(
            "model",
            "functions that can be differentiated forwards, too",
            "one with a custom_vjp, such as jax.experimental.ode.odeint",
            "Integrate by Runge-Kutta steps in jax.lax.scan, or by diffrax with its DirectAdjoint",
        ) from error


def check_supported(model: Model, data: Data) -> None:
    """Look at all that a model samples.

    Raises:
        InputError: there is something that has no density with a gradient.
    """

    def look(name: str, message: Mapping[str, Any]) -> None:
        refuse_unsupported(model, name, message)
        _refuse_scaled(model, name, message)

    look_at_trace(model, data, look)


def _refuse_scaled(model: Model, name: str, message: Mapping[str, Any]) -> None:
    """A density that counts more or less than once has other scores, and no replicates."""
    if message["type"] == "sample" and message["scale"] is not None:
        what, got = f"model {model_name(model)}", f"the scaled site {name!r} (numpyro.handlers.scale)"
        remedy = "Leave the scale out, repeat the rows that count more, or fit this model without a diagnosis"
        raise InputError(what, "sites that count once", got, remedy)


def refuse_unsupported(model: Model, name: str, message: Mapping[str, Any]) -> None:
    """Look at one message of a model's trace.

    Raises:
        InputError: it is a parameter, a plate that subsamples, or a latent site that is discrete or complex.
    """
    what = f"model {model_name(model)}"
    if message["type"] == "param":
        learned = name.endswith("_centered")
        remedy = (
            "Give LocScaleReparam centered=0" if learned else "Declare it with numpyro.sample and a prior"
        )
        raise InputError(what, "latent sites with priors", f"the parameter site {name!r}", remedy)
    if message["type"] == "plate":
        size, subsample = message["args"]
        if subsample is not None and subsample != size:
            got = f"plate {name!r} that takes {subsample} of {size}"
            raise InputError(what, "plates without subsampling", got, "Give the plate its full size")
    if message["type"] == "sample" and not message["is_observed"]:
        _refuse_latent(what, name, message["fn"])


def refuse_obs_mask(declaration: Declaration) -> None:
    """Look for sites that NumPyro splits by `obs_mask`: what was observed has a latent twin without any density.

    Raises:
        InputError: there is one.
    """
    for name in declaration.observed:
        whole = name.removesuffix("_observed")
        if (
            whole != name
            and f"{whole}_unobserved" in declaration.latent
            and whole in declaration.deterministic
        ):
            remedy = "Put `with numpyro.handlers.mask(mask=...)` around the site instead"
            raise InputError(f"observed site {whole!r}", "no obs_mask", "one", remedy)


def _refuse_latent(what: str, name: str, fn: Any) -> None:
    support = base_constraint(fn.support)
    if isinstance(unwrapped(fn)[0], Delta):
        remedy = f"Write numpyro.deterministic({name!r}, VALUE)"
        raise InputError(what, "unknowns with a density", f"the latent site {name!r} (Delta)", remedy)
    kind = f"{name!r} ({type(fn).__name__})"
    if support is None or support.is_discrete:
        remedy = (
            "Sum it out, since the density must have a gradient: observe a MixtureSameFamily or MixtureGeneral, or for "
            "counts a ZeroInflatedDistribution (numpyro.factor is enough for fit, not for diagnose)"
        )
        raise InputError(what, "continuous latent sites", f"the discrete latent site {kind}", remedy)
    if support is constraints.complex:
        remedy = "Sample its real and imaginary parts as two sites"
        raise InputError(what, "real latent sites", f"the complex latent site {kind}", remedy)
    if support is not constraints.circular:
        try:
            biject_to(fn.support)
        except NotImplementedError:
            remedy = "Sample a real or positive site and compute it from that"
            if support is constraints.sphere:
                remedy = f"Reparametrise it: numpyro.handlers.reparam(model, config={{{name!r}: ProjectedNormalReparam()}})"
            got = f"the latent site {kind}"
            raise InputError(what, "supports that NumPyro maps to the reals", got, remedy) from None
