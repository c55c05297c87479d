"""Why a watched network is another than it was: the gap between its log after a change and what was learned before."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dtprob.effects import catalogue
from dtprob.gap.diagnose import diagnose
from dtprob.gap.which.trials import Say
from dtprob.inference import LATENTS_ONLY, Exact, Laplace
from dtprob.models.declaration import declare
from dtprob.models.multi_access import multi_access, records
from dtprob.workflow.loop.knowledge import log_of
from dtprob.workflow.loop.settings import TwinCase
from dtprob.workflow.loop.state import State

_FEWEST = 4
"""Windows that a diagnosis needs."""


def diagnosed(case: TwinCase, state: State, key: jax.Array, say: Say) -> dict[str, Any]:
    """The verdict on the rows since the change, against the rows before it that the twin was learned from.

    Args:
        case: the settings.
        state: with the row of the change.
        key: typed JAX key.
        say: receives one line at each stage.

    Returns:
        `verdict`, and the likeliest `causes` with their probability and size; or why there is none.
    """
    if min(state.slots - state.changed, state.changed - state.since) < _FEWEST * case.loop.window:
        return {"verdict": "UNDETERMINED", "because": "too few slots before or after the change"}
    before, after = (
        _arguments(case, state, *rows) for rows in ((state.since, state.changed), (state.changed, None))
    )
    first, second = jax.random.split(key)
    reference = Exact()(first, multi_access, before, options=LATENTS_ONLY)
    sites = declare(multi_access, after).sites
    use = case.effects.use
    offered = catalogue(sites, after, use=use if isinstance(use, str) else list(use))
    left_out = set(case.effects.exclude)
    effects = tuple(e for e in offered if not {e.family, e.name} & left_out)
    found = diagnose(
        multi_access, after, effects, key=second, engine=Laplace(), reference=reference, say=say
    ).to_report()
    causes = [{name: cause[name] for name in ("effects", "probability", "size")} for cause in found["causes"]]
    return {"verdict": found["verdict"], "causes": causes}


def _arguments(case: TwinCase, state: State, first: int, last: int | None) -> dict[str, Any]:
    """The model's arguments from some of the rows."""
    kernel, loop = case.kernel, case.loop
    made = records(
        log_of(state.rows, first, last),
        clusters=kernel.clusters.members,
        capacity=kernel.capacity,
        window=loop.window,
    )
    arrays = {name: jnp.asarray(v) if isinstance(v, np.ndarray) else v for name, v in made.items()}
    own = {name: case.model.options[name] for name in ("traffic",) if name in case.model.options}
    return {**arrays, **own, "concentration": case.concentration}
