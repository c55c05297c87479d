"""The exact posterior where tables of probabilities meet counts, or where the posterior is normal.

Which counts a log amounts to is found from the model itself. The log likelihood of tables with counts n is
sum n_ij log p_ij; its gradient where one outcome of a row has all the probability is the counts of the others. Whether
the likelihood is of this form at all is checked at random tables, and a model where it is not is refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, cast, final

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from numpyro import handlers
from numpyro.infer.util import compute_log_probs

from dtprob.errors import InputError
from dtprob.inference.assemble import assemble
from dtprob.inference.build import build_target
from dtprob.inference.engine import (
    DEFAULT,
    AbstractEngine,
    Answer,
    RunOptions,
    Serves,
    check_counts,
    check_key,
)
from dtprob.inference.gaussian import gaussian_posterior
from dtprob.inference.laplace import gaussian_facts
from dtprob.inference.posterior import Posterior, Values
from dtprob.inference.target import Inputs, Target
from dtprob.models.arguments import Model
from dtprob.models.declaration import Site
from dtprob.models.dirichlet import LogRatios, LogSimplices, log_draws, log_shares
from dtprob.models.execution import trace_model

type Tables = dict[str, Float[Array, "*row outcome"]]

_NEVER = -200.0
"""Log-probability that rounds to zero and stays finite."""
_POINTS = 4


@final
@dataclass(frozen=True)
class DirichletTables:
    """Independent tables of probabilities with Dirichlet laws; a sampler of their logarithms.

    Attributes:
        concentration: for each site, of each outcome; 0 where it cannot happen.
    """

    concentration: Mapping[str, np.ndarray]

    def sample(self, key: PRNGKeyArray, n: int) -> Values:
        """`n` independent draws, {site: (n, *row, outcome)} of log-probabilities."""
        keys = jax.random.split(key, len(self.concentration))
        return {
            name: np.asarray(log_draws(k, jnp.asarray(a), np.asarray(a) > 0, (n,)))
            for k, (name, a) in zip(keys, self.concentration.items(), strict=True)
        }

    def updated(self, counts: Mapping[str, np.ndarray]) -> DirichletTables:
        """The law after counts of outcomes were observed.

        Args:
            counts: for each site, how often each outcome happened; those that cannot happen do not count.
        """
        return DirichletTables(
            {name: np.where(a > 0, a + counts[name], 0.0) for name, a in self.concentration.items()}
        )


@dataclass(frozen=True)
class Exact(AbstractEngine):
    """Independent draws from a posterior in closed form: Dirichlet tables under counts, or a normal posterior.

    The posterior's `extra` has `log_evidence` and, for each table, `counts.<site>`, or of a normal posterior
    `precision` and `mode` (over the coordinates) and `mode.<site>`. Any other model is refused with a reason.

    Attributes:
        draws: how many draws.
    """

    name: ClassVar[str] = "exact"
    answer: ClassVar[Answer] = "exact"
    serves: ClassVar[Serves] = "tables"

    draws: int = 1000

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        check_counts(self, {"draws": 1})

    def __call__(
        self, key: jax.Array, model: Model, data: Mapping[str, Any], *, options: RunOptions = DEFAULT
    ) -> Posterior:
        """Infer; see `AbstractEngine`."""
        check_key(key)
        target, inputs = build_target(model, data)
        if not has_tables(target):
            normal = gaussian_posterior(target, inputs, key)
            noise = jax.random.normal(key, (self.draws, target.dimension))
            return assemble(
                target,
                inputs,
                (normal.mode + noise @ normal.factor.T)[None],
                engine=self,
                key=key,
                options=options,
                extra=gaussian_facts(target, inputs, normal),
            )
        found = conjugate(target, inputs, key)
        law = DirichletTables({n: np.asarray(a) for n, a in found.prior.items()}).updated(found.counts)
        tables = law.sample(key, self.draws)
        free = {name: LogRatios(found.allowed[name]).inv(tables[name]) for name in target.coordinates}
        flat = jnp.concatenate([jnp.reshape(u, (self.draws, -1)) for u in free.values()], axis=-1)
        positions = (flat - inputs.location) / inputs.scale
        evidence = found.constant + sum(
            float(_normaliser(law.concentration[n], m) - _normaliser(np.asarray(found.prior[n]), m))
            for n, m in found.allowed.items()
        )
        counted = {f"counts.{name}": value for name, value in found.counts.items()}
        return assemble(
            target,
            inputs,
            positions[None],
            engine=self,
            key=key,
            options=options,
            extra={"log_evidence": evidence, **counted},
        )


def has_tables(target: Target) -> bool:
    """Whether some latent site is a Dirichlet table in log space."""
    return any(site.distribution == "LogDirichlet" for site in target.declaration.latent.values())


class Conjugate(NamedTuple):
    """A model as tables under counts.

    Attributes:
        prior: concentration of each table, 0 where an outcome cannot happen.
        counts: how often each outcome happened.
        allowed: which outcomes can happen.
        constant: what the log likelihood has beyond sum n log p.
    """

    prior: Mapping[str, np.ndarray]
    counts: Mapping[str, np.ndarray]
    allowed: Mapping[str, np.ndarray]
    constant: float


def conjugate(target: Target, inputs: Inputs, key: PRNGKeyArray) -> Conjugate:
    """The counts and concentrations of a model on data.

    Args:
        target: the model on data.
        inputs: its arrays.
        key: for the tables at which the form of the likelihood is checked.

    Raises:
        InputError: a latent site that is no table, a prior that depends on another site, or a likelihood that is not a
            product of powers of the tables' entries.
    """
    what = _what(target)
    for name, site in target.declaration.latent.items():
        if site.distribution != "LogDirichlet":
            got = f"{name!r} ({site.distribution})"
            remedy = "Use another engine, such as nuts or laplace"
            raise InputError(what, "latent sites that are Dirichlet tables in log space", got, remedy)
    allowed = {name: _allowed(target.declaration.latent[name]) for name in target.coordinates}
    points = _points(allowed, key)
    prior = _priors(what, target, inputs, points, allowed)
    first, last = (_corner(allowed, reverse=flag) for flag in (False, True))
    gradient = target.compiled(_gradient)
    near, far = gradient(first, inputs), gradient(last, inputs)
    counts: dict[str, np.ndarray] = {}
    for name, mask in allowed.items():
        counted = np.where(np.asarray(first[name]) == 0.0, far[name], near[name])
        lonely = mask.sum(axis=-1, keepdims=True) == 1
        counts[name] = np.where(mask & ~lonely, counted, 0.0)
    return Conjugate(prior, counts, allowed, _constant(target, inputs, counts, points))


def _allowed(site: Site) -> Bool[np.ndarray, "*row outcome"]:
    """Which outcomes of a table can happen."""
    return cast("LogSimplices", site.support).allowed


def _what(target: Target) -> str:
    return f"model {target.declaration.name} for engine exact"


def _concentrations(target: Target, tables: Tables, inputs: Inputs) -> dict[str, Array]:
    """The prior's concentration of each table, where the tables have these values."""
    trace = trace_model(target.model, target.data(inputs), jax.random.key(0), tables)
    return {name: trace[name]["fn"].concentration for name in tables}


def _priors(
    what: str,
    target: Target,
    inputs: Inputs,
    points: list[Tables],
    allowed: Mapping[str, Bool[np.ndarray, "..."]],
) -> dict[str, np.ndarray]:
    """Concentrations, 0 where an outcome cannot happen; compared at two points, which others would vary with."""
    one, other = (target.compiled(_concentrations)(tables, inputs) for tables in points[:2])
    for name in allowed:
        if not np.array_equal(one[name], other[name]):
            remedy = "Use another engine, such as nuts"
            raise InputError(what, "concentrations that are known", f"one that varies at {name!r}", remedy)
    return {name: np.where(mask, np.asarray(one[name]), 0.0) for name, mask in allowed.items()}


def _points(allowed: Mapping[str, Bool[np.ndarray, "..."]], key: PRNGKeyArray) -> list[Tables]:
    """Tables drawn uniformly; in NumPy, for JAX would compile a program for each shape."""
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel())
    points: list[Tables] = []
    for _ in range(_POINTS):
        weights = {n: np.where(mask, random.exponential(size=mask.shape), 0.0) for n, mask in allowed.items()}
        points.append({name: jnp.asarray(log_shares(each, allowed[name])) for name, each in weights.items()})
    return points


def _corner(allowed: Mapping[str, Bool[np.ndarray, "..."]], *, reverse: bool) -> Tables:
    """Tables in which the first, or the last, possible outcome of each row has all the probability."""
    tables: Tables = {}
    for name, mask in allowed.items():
        chosen = mask.shape[-1] - 1 - np.argmax(mask[..., ::-1], -1) if reverse else np.argmax(mask, -1)
        is_chosen = np.arange(mask.shape[-1]) == chosen[..., None]
        tables[name] = jnp.asarray(np.where(is_chosen, 0.0, np.where(mask, _NEVER, -np.inf)))
    return tables


def _log_likelihood(target: Target, tables: Tables, inputs: Inputs) -> Float[Array, ""]:
    seeded = handlers.seed(target.model, jax.random.key(0))
    fixed = handlers.substitute(seeded, data=tables)
    log_probs, _ = compute_log_probs(fixed, (), target.data(inputs), {}, sum_log_prob=True)
    observed = [value for name, value in log_probs.items() if name not in tables]
    return sum((jnp.sum(value) for value in observed), start=jnp.zeros(()))


def _gradient(target: Target, tables: Tables, inputs: Inputs) -> Tables:
    return jax.grad(lambda t: _log_likelihood(target, t, inputs))(tables)


def _constant(
    target: Target, inputs: Inputs, counts: Mapping[str, np.ndarray], points: list[Tables]
) -> float:
    """The likelihood's constant, after a check at some points that it is one."""
    rest: list[float] = []
    size = 1.0
    for tables in points:
        value = float(target.compiled(_log_likelihood)(tables, inputs))
        powers = sum(float(np.sum(n * np.where(n > 0, tables[name], 0.0))) for name, n in counts.items())
        rest.append(value - powers)
        size = max(size, abs(value))
    tolerance = 1e3 * float(jnp.finfo(jnp.zeros(()).dtype).eps) * size
    smallest = min(float(n.min(initial=0.0)) for n in counts.values())
    if not np.all(np.isfinite(rest)) or np.ptp(rest) > tolerance or smallest < -tolerance:
        what, got = _what(target), f"one whose remainder varies by {np.ptp(rest):.3g} nats"
        remedy = "Use another engine, such as nuts or laplace"
        raise InputError(what, "a likelihood that is a product of powers of the tables' entries", got, remedy)
    return float(np.mean(rest))


def _normaliser(concentration: np.ndarray, allowed: np.ndarray) -> float:
    """Log of the Dirichlet normalising integrals of all rows."""
    parts = jnp.where(allowed, gammaln(np.where(allowed, concentration, 1.0)), 0.0)
    return float(jnp.sum(parts) - jnp.sum(gammaln(concentration.sum(axis=-1))))
