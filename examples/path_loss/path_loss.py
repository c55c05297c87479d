"""A model of the user's own: power from three named sites falls with distance, and each street has a level of its own."""

import jax
import jax.numpy as jnp
import numpyro
import numpyro.distributions as dist

from dtprob.models.declaration import model

SITES = {"harbour": (150.0, 120.0, 25.0), "station": (620.0, 180.0, 30.0), "tower": (400.0, 420.0, 45.0)}  # m
ROWS = ("sample",)


@model(axes=dict.fromkeys(("distance", "expected_power", "error_deviation"), ROWS), cluster="segment")
def path_loss(
    east: jax.Array,
    north: jax.Array,
    time: jax.Array,
    site: jax.Array,
    segment: jax.Array,
    *,
    segments: int,
    street_db: float,
    power: jax.Array | None = None,
) -> None:
    """Power in dBm of the site that serves each row; time is for effects only."""
    del time
    level = numpyro.sample("level", dist.Normal(-35.0, 20.0))
    exponent = numpyro.sample("exponent", dist.Normal(3.0, 1.0))
    error = numpyro.sample("error", dist.LogNormal(jnp.log(3.0), 0.7))
    with numpyro.plate("segment", segments):
        street = numpyro.sample("street_level", dist.Normal(0.0, 1.0))
    x, y, z = jnp.asarray(list(SITES.values())).T[:, site]
    distance = jnp.sqrt((east - x) ** 2 + (north - y) ** 2 + z**2)
    distance = numpyro.deterministic("distance", distance)
    mean = numpyro.deterministic("expected_power", level - 10 * exponent * jnp.log10(distance))
    deviation = numpyro.deterministic("error_deviation", jnp.broadcast_to(error, jnp.shape(east)))
    with numpyro.plate("sample", len(east)):
        numpyro.sample("power", dist.Normal(mean + street_db * street[segment], deviation), obs=power)
