"""Which measurement tells rival explanations apart: expected log Bayes factors of designs, and what they cost.

Each rival predicts the rows of a design with a mean and, since its parameters and the nuisances are known to some extent
only, a covariance. The expected log Bayes factor of a true rival over a false one is the divergence of their predictions,
exact for linear Gaussian models; a design is as good as its worst pair of rivals.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import permutations
from typing import Any, Final, NamedTuple

import numpy as np
from jaxtyping import Float

NEEDED: Final = 3.0
"""Nats of expected evidence that count as telling rivals apart: odds of twenty to one."""
MOST: Final = 1024
"""Repeats after which a design counts as not resolving."""
_PLACES: Final = 4
"""Designs that a plan joins at most."""
_POOL: Final = 48
"""Designs, the best ones alone, from which plans are made."""


class Prediction(NamedTuple):
    """What one rival says of a design's rows, in units of their noise.

    Attributes:
        mean: of each row, from an origin that all rivals share.
        tangents: by which it moves with each uncertain parameter.
        covariance: of these parameters, as the data so far leave them.
        own: tangents of what the design has for itself, of unit variance; None where it has nothing.
    """

    mean: Float[np.ndarray, " row"]
    tangents: Float[np.ndarray, "row parameter"]
    covariance: Float[np.ndarray, "parameter parameter"]
    own: Float[np.ndarray, "row own"] | None = None


class Design(NamedTuple):
    """A measurement that could be made.

    Attributes:
        where: its coordinates, for the user; `design` among them names the set to which it belongs.
        cost: of making it once.
        predictions: one for each rival.
    """

    where: Mapping[str, Any]
    cost: float
    predictions: tuple[Prediction, ...]


class Ranked(NamedTuple):
    """How far a design leads.

    Attributes:
        where: its coordinates.
        repeats: how often it is to be made.
        nats: worst expected log Bayes factor of a true rival over another after that.
        cost: of all repeats.
        resolves: whether that is enough.
    """

    where: Mapping[str, Any]
    repeats: int
    nats: float
    cost: float
    resolves: bool


class _Law(NamedTuple):
    """A rival's prediction, N(mean, I + U U').

    Attributes:
        mean: of each row.
        tangents: U, of parameters of unit variance.
        directions: singular vectors of U (row, k).
        sizes: of which U U' has these eigenvalues (k,).
    """

    mean: Float[np.ndarray, " row"]
    tangents: Float[np.ndarray, "row parameter"]
    directions: Float[np.ndarray, "row k"]
    sizes: Float[np.ndarray, " k"]


class _Pair(NamedTuple):
    """Two rivals' predictions along the other's directions, all of which grows in proportion with repeats.

    Attributes:
        distance: square of what lies between their means.
        along: squares of that along each direction (k,).
        cross: squares of the true one's tangents along each (k,).
        own: eigenvalues of the true one's covariance.
        other: of the other's (k,).
    """

    distance: float
    along: Float[np.ndarray, " k"]
    cross: Float[np.ndarray, " k"]
    own: Float[np.ndarray, " j"]
    other: Float[np.ndarray, " k"]


type _Roots = Mapping[int, Float[np.ndarray, "n n"]]
"""Square roots of rivals' covariances, by the identity of each: all designs share them."""


def expected_evidence(truth: Prediction, rival: Prediction, repeats: int = 1) -> float:
    """Expected log Bayes factor (nats) of the true rival over another, from a design made some times over.

    Args:
        truth: prediction of the true one.
        rival: of the other.
        repeats: how often each row is measured, with noise of its own.
    """
    return _divergence(next(_pairs([truth, rival], _roots([truth, rival]))), repeats)


def resolution(predictions: Sequence[Prediction], repeats: int = 1) -> float:
    """The least expected log Bayes factor over all ordered pairs of rivals."""
    return min(_divergence(pair, repeats) for pair in _pairs(predictions, _roots(predictions)))


def rank(designs: Sequence[Design], needed: float = NEEDED, most: int = MOST) -> list[Ranked]:
    """Designs by what it costs until they tell all rivals apart; those that never do come last, by what they reach.

    Args:
        designs: the candidates.
        needed: nats that are enough.
        most: repeats beyond which no design is followed.
    """
    roots = _roots_of(designs)
    found = [_repeated(design, needed, most, roots) for design in designs]
    return sorted(found, key=_price)


def recommend(designs: Sequence[Design], needed: float = NEEDED, most: int = MOST) -> Ranked:
    """The cheapest plan that is found: one design or several, all repeated alike, joined one by one while that is cheaper.

    Several places together can tell what each alone cannot, as a slope from a level. Those of a plan belong to one set, and
    each is in it once: repeats are counted apart.

    Args:
        designs: the candidates; the rivals' predictions have the same parameters in each.
        needed: nats that are enough.
        most: repeats beyond which no plan is followed.
    """
    roots, sets = _roots_of(designs), dict.fromkeys(map(_set_of, designs))
    plans = [_plan([one for one in designs if _set_of(one) == kind], needed, most, roots) for kind in sets]
    return min(plans, key=_price)


def _plan(designs: Sequence[Design], needed: float, most: int, roots: _Roots) -> Ranked:
    """The cheapest plan that is found of designs of one set."""
    order = {id(one): number for number, one in enumerate(designs)}
    alone = sorted(
        ((_repeated(one, needed, most, roots), one) for one in designs), key=lambda two: _price(two[0])
    )
    best, others = alone[0][0], [one for _, one in alone[1:_POOL]]
    chosen = [alone[0][1]]
    while others and len(chosen) < _PLACES:
        found = [_repeated(joined([*chosen, other]), needed, most, roots) for other in others]
        number = min(range(len(others)), key=lambda k: _price(found[k]))
        if _price(found[number]) >= _price(best):
            break
        chosen.append(others.pop(number))
        best = found[number]
    return best._replace(where=_merged([one.where for one in sorted(chosen, key=lambda one: order[id(one)])]))


def _set_of(one: Design) -> tuple[Any, frozenset[str]]:
    """Designs with the same are told together."""
    return one.where.get("design"), frozenset(one.where)


def joined(designs: Sequence[Design]) -> Design:
    """Several designs as one that makes them all; rivals' predictions have the same parameters in each.

    Args:
        designs: one or more.
    """
    rivals = zip(*(design.predictions for design in designs), strict=True)
    predictions = tuple(
        Prediction(
            np.concatenate([part.mean for part in parts]),
            np.concatenate([part.tangents for part in parts]),
            parts[0].covariance,
            _apart(designs, parts),
        )
        for parts in rivals
    )
    where = _merged([design.where for design in designs])
    return Design(where, sum(design.cost for design in designs), predictions)


def _apart(designs: Sequence[Design], parts: Sequence[Prediction]) -> Float[np.ndarray, "row own"] | None:
    """What each of several designs has for itself, side by side; a design that is made twice has one of it."""
    pairs = list(zip(designs, parts, strict=True))
    mine = {id(design): part.own for design, part in pairs if part.own is not None}
    if not mine:
        return None
    rows = [
        [own if key == id(design) else np.zeros((len(part.mean), own.shape[1])) for key, own in mine.items()]
        for design, part in pairs
    ]
    return np.block(rows)


def _merged(places: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Coordinates of several designs of one set: one value where all agree, else a list in their order."""
    merged: dict[str, Any] = {}
    for axis in places[0]:
        values = [place[axis] for place in places]
        merged[axis] = values[0] if all(value == values[0] for value in values) else values
    return merged


def _price(one: Ranked) -> tuple[bool, float]:
    """By what designs are ordered."""
    return (not one.resolves, one.cost if one.resolves else -one.nats)


def _repeated(design: Design, needed: float, most: int, roots: _Roots) -> Ranked:
    """The fewest repeats that are enough; evidence never falls with them."""
    pairs = list(_pairs(design.predictions, roots))

    def reached(repeats: int) -> float:
        return min(_divergence(pair, repeats) for pair in pairs)

    if reached(most) < needed:
        return Ranked(design.where, most, reached(most), most * design.cost, resolves=False)
    low, high = 0, 1
    while reached(high) < needed:
        low, high = high, min(2 * high, most)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if reached(middle) >= needed else (middle, high)
    return Ranked(design.where, high, reached(high), high * design.cost, resolves=True)


def _roots_of(designs: Sequence[Design]) -> _Roots:
    return _roots([one for design in designs for one in design.predictions])


def _roots(predictions: Sequence[Prediction]) -> _Roots:
    covariances = {id(one.covariance): one.covariance for one in predictions}
    return {key: _root(covariance) for key, covariance in covariances.items()}


def _root(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def _pairs(predictions: Sequence[Prediction], roots: _Roots) -> Iterator[_Pair]:
    laws = [_law(one, roots) for one in predictions]
    return (_pair(truth, rival) for truth, rival in permutations(laws, 2))


def _law(one: Prediction, roots: _Roots) -> _Law:
    shared = one.tangents @ roots[id(one.covariance)]
    tangents = shared if one.own is None else np.hstack([shared, one.own])
    directions, sizes, _ = np.linalg.svd(tangents, full_matrices=False)
    return _Law(one.mean, tangents, directions, sizes**2)


def _pair(truth: _Law, rival: _Law) -> _Pair:
    difference = truth.mean - rival.mean
    return _Pair(
        float(difference @ difference),
        (rival.directions.T @ difference) ** 2,
        ((rival.directions.T @ truth.tangents) ** 2).sum(1),
        truth.sizes,
        rival.sizes,
    )


def _divergence(pair: _Pair, repeats: int) -> float:
    """Of N(m, I + U U') from N(m', I + V V'), with U, V and the means repeated, by Woodbury's identity."""
    n = repeats
    own, other = n * pair.own, n * pair.other
    shrink = other / (1 + other)
    distance = n * (pair.distance - shrink @ pair.along)
    spread = own.sum() - shrink.sum() - n * shrink @ pair.cross
    return max(0.0, 0.5 * float(distance + spread + np.log1p(other).sum() - np.log1p(own).sum()))
