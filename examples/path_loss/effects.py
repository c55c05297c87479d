"""What may be wrong: effects of the user's own, a few lines each."""

import jax.numpy as jnp
import numpyro.distributions as dist
from path_loss import SITES

from dtprob.effects import Effect, Parameter


def added(family, shape, instance=None, physics=""):
    """The expected power changes by some decibels times a shape over the rows of the table."""
    return Effect(
        family,
        {"expected_power": lambda value, p, table: value + p["size"] * shape(table)},
        (Parameter("size", dist.Normal(0.0, 6.0), unit="dB"),),
        instance=instance,
        physics=physics,
        requires=("site", "time", "distance"),
    )


def at_site(number, name):
    """One site sends more or less than its data sheet says."""
    return added(
        "site_gain", lambda table: 1.0 * (table["site"] == number), name, f"The site {name} has another gain."
    )


effects = [
    *(at_site(number, name) for number, name in enumerate(SITES)),
    added(
        "gain_drift", lambda table: table["time"] / 90 - 0.5, physics="The receiver's gain drifts with time."
    ),
    added(
        "second_slope",
        lambda table: -10 * jnp.log10(jnp.maximum(table["distance"] / 150, 1)),
        physics="Power falls faster beyond 150 m.",
    ),
    Effect(
        "noise_with_distance",
        {"error_deviation": lambda value, p, table: value * (table["distance"] / 150) ** p["exponent"]},
        (Parameter("exponent", dist.Normal(0.0, 0.7)),),
        physics="Weak signals are read less well.",
        requires=("distance",),
    ),
]
