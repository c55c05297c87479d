"""What a declared model says of itself: its sites, its axes, its arguments.

A model is a plain NumPyro function. Nothing has to be registered: running it once under a trace tells which sites it
samples, computes and observes. The decorator `model` only adds names for axes that no plate names.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, cast

import equinox as eqx
import jax
import numpy as np
import numpyro
from numpyro.distributions import constraints

from dtprob.errors import InputError
from dtprob.models.arguments import Data, Model, left_out, model_name, select_arguments, split_static, whole
from dtprob.models.axes import axes_of, lent
from dtprob.models.execution import explained, trace_model
from dtprob.wrapping import unwrapped

type Kind = Literal["latent", "deterministic", "observed"]
type Needs = Literal["observation", "weight", "nothing"]

_METADATA = "__dtprob__"


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
    with explained(function):
        jax.eval_shape(run, arrays, jax.random.key(0))
    found = _with_lent_axes(found)
    declaration = Declaration(
        model_name(function), found, cluster or notes.cluster or _first_plate(found), tuple(factors)
    )
    weighs = needs == "weight" and factors and not left_out(function, data)
    if needs != "nothing" and not weighs:
        _refuse_unobserved(declaration)
    _check_measures(declaration, notes)
    return declaration


def _check_measures(declaration: Declaration, notes: Metadata) -> None:
    """Look whether what the author counts in is of what is observed.

    Raises:
        InputError: it is not.
    """
    for name, measure in notes.measures.items():
        if measure.site not in declaration.observed:
            known = ", ".join(declaration.observed)
            remedy = "Name the observed site of whose entries it tells"
            raise InputError(f"measure {name}", f"an observed site among {known}", repr(measure.site), remedy)


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
