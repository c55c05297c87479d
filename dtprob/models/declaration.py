"""What a declared model says of itself: its sites, its axes, its arguments.

A model is a plain NumPyro function. Nothing has to be registered: running it once under a trace tells which sites it
samples, computes and observes. The decorator `model` only adds names for axes that no plate names.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import numpyro
from numpyro import handlers
from numpyro.distributions import constraints, distribution
from numpyro.primitives import Messenger

from dtprob.errors import InputError, raised_at
from dtprob.models.arguments import Data, Model, left_out, model_name, select_arguments, split_static, whole
from dtprob.models.axes import axes_of, lent
from dtprob.wrapping import unwrapped

# ArviZ registers NumPyro to be loaded later. Where it was imported first, Python runs numpyro.distributions twice, and the
# second copy lacks the submodule in which numpyro.factor looks.
numpyro.distributions.__dict__["distribution"] = distribution

type Kind = Literal["latent", "deterministic", "observed"]
type Needs = Literal["observation", "weight", "nothing"]

NOT_TRACED = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
    jax.errors.NonConcreteBooleanIndexError,
)
"""What JAX raises where a program asks for values that it does not know yet."""
_METADATA = "__dtprob__"
_MISFIT: Final = "ncompatible shapes for broadcasting"
_BY_NAME: Final = "does not support string indexing"
"""In what JAX says of them."""
_NO_ROW: Final = "size of plate should be positive"
"""In what NumPyro says of one."""


@dataclass(frozen=True)
class Measure:
    """A number that a model's users speak of, such as packets per slot: what is predicted beside what was seen.

    Attributes:
        site: an observed site, of whose entries it tells.
        numbers: (values of all sites, data) -> predicted and seen, each of the site's shape or broadcasting to it.
    """

    site: str
    numbers: Callable[[Mapping[str, Any], Data], tuple[Any, Any]]


@dataclass(frozen=True)
class Metadata:
    """What a model's author says beyond the function: axis names per site, the cluster axis, and measures by name."""

    axes: Mapping[str, tuple[str, ...]]
    cluster: str | None
    measures: Mapping[str, Measure] = field(default_factory=dict)


@dataclass(frozen=True)
class Site:
    """One named site of a model.

    Attributes:
        name: the site's name.
        kind: "latent", "deterministic" or "observed".
        shape: shape of the site's value.
        axes: one name per dimension of the value.
        plates: the names of the plates that the site lies in.
        support: the distribution's support; None for a deterministic site.
        distribution: the name of the distribution's class; None for a deterministic site.
        argument: for an observed site, the model's argument that holds its value.
    """

    name: str
    kind: Kind
    shape: tuple[int, ...]
    axes: tuple[str, ...]
    plates: tuple[str, ...]
    is_complex: bool = False
    support: constraints.Constraint[Any] | None = None
    distribution: str | None = None
    argument: str | None = None

    @property
    def is_circular(self) -> bool:
        """Whether the site's values are angles in (-pi, pi]."""
        return base_constraint(self.support) is constraints.circular

    @property
    def size(self) -> int:
        """Number of entries of the site's value."""
        return int(np.prod(self.shape, dtype=int))


@dataclass(frozen=True)
class Declaration:
    """The sites and axes of a model on given data, in the order of execution.

    Attributes:
        name: of the model.
        sites: by name.
        cluster: the axis whose values are independent of one another.
        factors: names of terms that `numpyro.factor` adds to the log density.
    """

    name: str
    sites: Mapping[str, Site]
    cluster: str | None
    factors: tuple[str, ...] = ()

    def of_kind(self, kind: Kind) -> dict[str, Site]:
        """The sites of one kind, by name."""
        return {name: site for name, site in self.sites.items() if site.kind == kind}

    @property
    def latent(self) -> dict[str, Site]:
        """The sites that inference finds."""
        return self.of_kind("latent")

    @property
    def deterministic(self) -> dict[str, Site]:
        """The named intermediates, on which effects act."""
        return self.of_kind("deterministic")

    @property
    def observed(self) -> dict[str, Site]:
        """The sites with data."""
        return self.of_kind("observed")


def base_constraint(support: constraints.Constraint[Any] | None) -> constraints.Constraint[Any] | None:
    """The constraint of a single entry, without the wrappers of independent dimensions."""
    while support is not None and hasattr(support, "base_constraint"):
        support = cast("constraints.Constraint[Any]", getattr(support, "base_constraint"))  # noqa: B009
    return support


def model(
    *,
    axes: Mapping[str, Sequence[str]] | None = None,
    cluster: str | None = None,
    measures: Mapping[str, Measure] | None = None,
) -> Callable[[Model], Model]:
    """Decorator that names what plates cannot: the axes of deterministic and event dimensions.

    Args:
        axes: for a site, the names of all its dimensions, first to last.
        cluster: the axis whose entries are independent of one another (a plate's name); by default the first observed axis.
        measures: in whose terms a diagnosis tells how large a gap is, beside the errors of observed sites: the root mean
            square, over clusters, of the mean difference between predicted and seen.
    """
    named = {name: tuple(names) for name, names in (axes or {}).items()}
    metadata = Metadata(named, cluster, dict(measures or {}))

    def mark(function: Model) -> Model:
        setattr(function, _METADATA, metadata)
        return function

    return mark


def metadata(function: Model) -> Metadata:
    """The metadata of a model, empty where its author gave none."""
    return getattr(whole(function), _METADATA, Metadata({}, None))


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


def declare(
    function: Model, data: Data, *, cluster: str | None = None, needs: Needs = "observation"
) -> Declaration:
    """Run the model once, abstractly, and tell its sites and axes.

    Args:
        function: a NumPyro model; its arguments are the data's entries by name.
        data: arrays and settings by argument name; the observed ones present.
        cluster: overrides the model's own cluster axis.
        needs: "weight" allows a model that observes nothing, but weighs its data by `numpyro.factor`, as a likelihood that
            is summed by hand over hidden states, if all its arguments are given; "nothing" one without its data.

    Raises:
        InputError: the data do not match the model's arguments, or the model observes nothing.
    """
    data = select_arguments(function, data)
    notes = metadata(function)
    found: dict[str, Site] = {}
    factors: list[str] = []

    def run(arrays: dict[str, Any], key: jax.Array) -> None:
        full = eqx.combine(arrays, static)
        trace = trace_model(function, full, key)
        factors.extend(name for name, message in trace.items() if is_factor(message))
        for name, message in trace.items():
            site = _site(message, notes, full)
            if site is not None:
                found[name] = site

    arrays, static = split_static(data)
    names = _Names()
    try:
        with names:
            jax.eval_shape(run, arrays, jax.random.key(0))
    except NotImplementedError as error:
        if "control flow" in str(error):
            what, inside = f"model {model_name(function)}", "Move the plate into the function that is scanned"
            raise InputError(what, "no scan within a plate", "one", inside) from error
        what, got = f"model {model_name(function)}", f"one that cannot at {names.last!r}"
        remedies = (
            "Give every parameter a proper prior; a wide one will do",
            "Leave CircularReparam out: angles are moved around the circle without it",
        )
        remedy = remedies[(names.last or "").endswith("_unwrapped")]
        raise InputError(what, "distributions that can be drawn from", got, remedy) from error
    except NOT_TRACED as error:
        where = f" ({place})" if (place := raised_at(error)) else ""
        what, got = f"model {model_name(function)}{where}", str(error).split("\n", maxsplit=1)[0]
        remedy = (
            "Use jnp.where or lax.cond for `if`, jnp for np, jnp.asarray(TABLE)[column] for a table of NumPy, a mask "
            "(column == value) for column[column == value], and give sizes as plain numbers"
        )
        raise InputError(what, "operations on arrays that JAX can trace", got, remedy) from error
    found = _with_lent_axes(found)
    declaration = Declaration(
        model_name(function), found, cluster or notes.cluster or _first_plate(found), tuple(factors)
    )
    weighs = needs == "weight" and factors and not left_out(function, data)
    if needs != "nothing" and not weighs:
        _refuse_unobserved(declaration)
    for name, measure in notes.measures.items():
        if measure.site not in declaration.observed:
            known = ", ".join(declaration.observed)
            remedy = "Name the observed site of whose entries it tells"
            raise InputError(f"measure {name}", f"an observed site among {known}", repr(measure.site), remedy)
    return declaration


def _refuse_unobserved(declaration: Declaration) -> None:
    """Look for what data say.

    Raises:
        InputError: the model observes nothing.
    """
    if not declaration.observed:
        raise InputError(
            f"model {declaration.name}",
            "an observed site",
            "none",
            "Pass the observed data, and give it to numpyro.sample as obs; a numpyro.factor counts as a prior.",
        )


def _with_lent_axes(sites: Mapping[str, Site]) -> dict[str, Site]:
    """Sites, intermediates that are computed outside of plates with the axes of what is observed."""
    observed = [(s.shape, s.axes) for s in sites.values() if s.kind == "observed"]
    return {
        name: replace(site, axes=lent(site.shape, site.axes, observed))
        if site.kind == "deterministic"
        else site
        for name, site in sites.items()
    }


def is_factor(message: Mapping[str, Any]) -> bool:
    """Whether a site of a trace is a term that `numpyro.factor` adds to the log density."""
    return message["type"] == "sample" and isinstance(unwrapped(message["fn"])[0], numpyro.distributions.Unit)


def _first_plate(sites: Mapping[str, Site]) -> str | None:
    for site in sites.values():
        if site.kind == "observed" and site.plates:
            return site.axes[0] if site.axes and site.axes[0] in site.plates else site.plates[0]
    return None


def _site(message: Mapping[str, Any], notes: Metadata, data: Data) -> Site | None:
    if message["type"] == "deterministic":
        kind: Kind = "deterministic"
    elif message["type"] == "sample" and isinstance(message["fn"], numpyro.distributions.Distribution):
        kind = "observed" if message["is_observed"] else "latent"
        if is_factor(message):
            return None
    else:
        return None
    value = message["value"]
    frames = message["cond_indep_stack"]
    name = message["name"]
    fn = message["fn"] if kind != "deterministic" else None
    event_dim = fn.event_dim if fn is not None else 0
    shape = tuple(np.shape(value))
    if kind == "observed":
        if not eqx.is_array_like(value):
            raise InputError(f"observed site {name!r}", "numbers", "text", "Write each value as a number")
        _check_shape(name, shape, fn)
    return Site(
        name=name,
        kind=kind,
        shape=shape,
        axes=axes_of(name, shape, frames, event_dim, notes.axes.get(name)),
        plates=tuple(frame.name for frame in frames),
        is_complex=bool(np.issubdtype(jax.numpy.result_type(value), np.complexfloating)),
        support=fn.support if fn is not None else None,
        distribution=type(innermost(fn)).__name__ if fn is not None else None,
        argument=_argument(name, value, data) if kind == "observed" else None,
    )


def _check_shape(name: str, shape: tuple[int, ...], fn: Any) -> None:
    """Observed values have to have the shape of their distribution, or to be more of it.

    Raises:
        InputError: NumPyro would pair each value with every distribution, or with none.
    """
    wanted = tuple(fn.shape())
    try:
        whole = np.broadcast_shapes(wanted, shape)
    except ValueError:
        whole = None
    if whole != shape:
        raise InputError(
            f"observed site {name!r}",
            f"values of shape {wanted}",
            str(shape),
            "Reshape the data or the model",
        )


def innermost(fn: Any) -> Any:
    """The distribution without what changes its shape, weight or support."""
    while hasattr(fn, "base_dist"):
        fn = fn.base_dist
    return fn


def _argument(name: str, value: Any, data: Data) -> str | None:
    if name in data:
        return name
    for argument, entry in data.items():
        if entry is value:
            return argument
    return None
