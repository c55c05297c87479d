"""Fitting by the engine's name."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, cast

import jax

from dtprob.errors import InputError, unknown_name
from dtprob.inference.auto import Auto
from dtprob.inference.blackjax_nuts import BlackJAXNUTS
from dtprob.inference.engine import DEFAULT, AbstractEngine, RunOptions
from dtprob.inference.ensemble import Ensemble
from dtprob.inference.exact import Exact
from dtprob.inference.hmc import HMC
from dtprob.inference.laplace import Laplace
from dtprob.inference.nuts import NUTS
from dtprob.inference.point import Point
from dtprob.inference.posterior import Posterior
from dtprob.inference.smc import SMC
from dtprob.inference.svi import SVI
from dtprob.inference.von_mises_em import VonMisesEM
from dtprob.models.arguments import Model
from dtprob.models.indices import check_indices
from dtprob.models.support import check_support

ENGINES: Mapping[str, type[AbstractEngine]] = {
    engine.name: engine
    for engine in (
        Auto,
        NUTS,
        BlackJAXNUTS,
        HMC,
        SMC,
        SVI,
        VonMisesEM,
        Laplace,
        Exact,
        Ensemble,
        Point,
    )
}


def resolve(engine: str | AbstractEngine, **settings: Any) -> AbstractEngine:
    """An engine from its name and settings; an engine is returned as it is, with the settings replaced.

    Args:
        engine: a name among `ENGINES`, or an engine.
        settings: fields of the engine.

    Raises:
        InputError: no engine, or no setting, of that name; the error names the nearest one.
    """
    if isinstance(engine, str):
        if engine not in ENGINES:
            raise unknown_name("engine", engine, ENGINES, "engine")
        kind = ENGINES[engine]
    elif isinstance(engine, AbstractEngine):
        kind = type(engine)
    else:
        got = f"an object of type {type(engine).__name__}"
        raise InputError("engine", "a name or an engine", got, "Give one of " + ", ".join(ENGINES))
    known = [field.name for field in dataclasses.fields(cast("Any", kind))]
    for name in settings:
        if name not in known:
            raise unknown_name(f"settings of engine {kind.name}", name, known, "setting")
    return (
        kind(**settings) if isinstance(engine, str) else dataclasses.replace(cast("Any", engine), **settings)
    )


def fit(
    model: Model,
    data: Mapping[str, Any],
    *,
    engine: str | AbstractEngine = "nuts",
    key: jax.Array,
    options: RunOptions = DEFAULT,
    **settings: Any,
) -> Posterior:
    """Infer a model's latent sites from data.

    Args:
        model: a NumPyro model.
        data: its arguments by name, the observed ones present.
        engine: a name among `ENGINES`, or an engine.
        key: typed JAX key.
        options: progress, checkpoints, what to keep.
        settings: the engine's own, such as `draws`.

    Raises:
        InputError: see `resolve` and `AbstractEngine`; an index in data beyond an array's end; or an observed value
            that its distribution cannot take.
    """
    used = resolve(engine, **settings)
    check_indices(model, data)
    check_support(model, data)
    return used(key, model, data, options=options)
