"""Running a declared model: its NumPyro trace, in numbers or abstractly, and what a run that fails says."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Any, Final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpyro
from numpyro import handlers
from numpyro.distributions import distribution
from numpyro.primitives import Messenger

from dtprob.errors import InputError, raised_at
from dtprob.models.arguments import Data, Model, model_name, split_static

# ArviZ registers NumPyro to be loaded later. Where it was imported first, Python runs numpyro.distributions twice, and the
# second copy lacks the submodule in which numpyro.factor looks.
numpyro.distributions.__dict__["distribution"] = distribution

NOT_TRACED = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.NonConcreteBooleanIndexError,
)
"""What JAX raises where a program asks for values that it does not know yet."""
_MISFIT: Final = "ncompatible shapes for broadcasting"
_BY_NAME: Final = "does not support string indexing"
"""In what JAX says of them."""
_NO_ROW: Final = "size of plate should be positive"
"""In what NumPyro says of one."""


def trace_model(
    function: Model, data: Data, key: jax.Array, substitute: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """One execution of the model: the NumPyro trace, latent sites drawn from the prior unless substituted.

    Raises:
        InputError: arrays whose shapes do not fit, as those of data longer than their plate; a plate without rows; or a
            table whose columns are called by name.
    """
    seeded = handlers.seed(function, key)
    values = {name: jnp.asarray(value) for name, value in (substitute or {}).items()}  # a scan indexes them
    traced = handlers.trace(handlers.substitute(seeded, data=values))
    try:
        return traced.get_trace(**data)
    except (TypeError, ValueError) as error:
        if _BY_NAME in str(error):
            raise _by_name(function, error) from error
        if _MISFIT not in str(error):
            raise
        raise _misfit(function, error, traced.trace) from error
    except AssertionError as error:
        if _NO_ROW not in str(error):
            raise
        what, remedy = f"model {model_name(function)}", "Give the data at least one row"
        raise InputError(what, "plates of one or more", "one of size 0", remedy) from error


def look_at_trace(function: Model, data: Data, look: Callable[[str, dict[str, Any]], None]) -> None:
    """Show every message of the model's trace, by its name, in one abstract run: nothing is computed.

    Args:
        function: a NumPyro model.
        data: its arguments by name.
        look: is called with each name and message; what they hold are tracers.
    """
    arrays, static = split_static(data)

    def run(arrays: dict[str, Any], key: jax.Array) -> None:
        for name, message in trace_model(function, eqx.combine(arrays, static), key).items():
            look(name, message)

    jax.eval_shape(run, arrays, jax.random.key(0))


def _by_name(function: Model, error: Exception) -> InputError:
    """Of a table whose columns the model calls by name, while models get arrays."""
    where = f" ({place})" if (place := raised_at(error)) else ""
    remedy = "Hand the table over as a dictionary of its columns, {'TABLE': dict(TABLE)}, or each column as an argument"
    return InputError(
        f"model {model_name(function)}{where}", "arrays indexed by numbers", "one indexed by a name", remedy
    )


def _misfit(function: Model, error: Exception, trace: Mapping[str, Mapping[str, Any]]) -> InputError:
    """Of shapes that do not fit, with the place in the user's code and the plates that the model had come to."""
    plates = [
        f"{name} of {message['args'][0]}" for name, message in trace.items() if message["type"] == "plate"
    ]
    sizes = f"; it has come to {', '.join(plates)}" if plates else ""
    where = f" ({place})" if (place := raised_at(error)) else ""
    got = str(error).split("\n", maxsplit=1)[0].rstrip(".")
    remedy = f"Give each plate the size of its data{sizes}"
    return InputError(f"model {model_name(function)}{where}", "arrays whose shapes fit", got, remedy)


class _Names(Messenger):
    """Remembers the last site that a run came to."""

    last: str | None = None

    def process_message(self, msg: dict[str, Any]) -> None:
        self.last = msg.get("name") or self.last


@contextmanager
def explained(function: Model) -> Generator[None]:
    """Within it a run of the model says in one line what it cannot do.

    Raises:
        InputError: a plate around a scan, a distribution that cannot be drawn from, or values that are not known yet.
    """
    names, what = _Names(), f"model {model_name(function)}"
    try:
        with names:
            yield
    except NotImplementedError as error:
        if "control flow" in str(error):
            inside = "Move the plate into the function that is scanned"
            raise InputError(what, "no scan within a plate", "one", inside) from error
        got = f"one that cannot at {names.last!r}"
        remedies = (
            "Give every parameter a proper prior; a wide one will do",
            "Leave CircularReparam out: angles are moved around the circle without it",
        )
        remedy = remedies[(names.last or "").endswith("_unwrapped")]
        raise InputError(what, "distributions that can be drawn from", got, remedy) from error
    except NOT_TRACED as error:
        where = f" ({place})" if (place := raised_at(error)) else ""
        got = str(error).split("\n", maxsplit=1)[0]
        remedy = (
            "Use jnp.where or lax.cond for `if`, jnp for np, jnp.asarray(TABLE)[column] for a table of NumPy, a mask "
            "(column == value) for column[column == value], and give sizes as plain numbers"
        )
        raise InputError(f"{what}{where}", "operations on arrays that JAX can trace", got, remedy) from error
