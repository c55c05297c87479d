"""Beam alignment from positions: a base station learns which beams serve a position from few measured ones.

The student is a regression of what each beam gathers on random features of the position; the beams that are
expected to gather most along each line of antennas are used. The synthetic labels come from a channel
knowledge map, which is wrong where the positions that it knows have other walls. Choices where the source is
silent: the scene, the student, 5 folds.
"""

from functools import partial
from typing import Final, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from dtprob.models.prediction_powered.multioutput import Labelled, Unlabelled, regress
from dtprob.models.prediction_powered.schemes import SCHEMES
from dtprob.models.prediction_powered.training import assign_folds
from dtprob.reproduce.beam_maps import MAPS, Map, waves
from dtprob.reproduce.beams import BeamPaths, Site
from dtprob.reproduce.beams_codebook import Arrays, chosen, labels, rates
from dtprob.reproduce.figure import Quantity
from dtprob.reproduce.progress import Progress

RUNS: Final = 20
FOLDS: Final = 5
FEATURES: Final = 200
TESTED: Final = 5000
_PENALTY: Final = 1e-3
_SCALE: Final = 0.2

RATE: Final = Quantity("rate", "bit/s/Hz")


class Case(NamedTuple):
    """What is studied.

    Attributes:
        arrays: of both ends.
        n: labelled positions.
        map: name of the channel knowledge map.
    """

    arrays: Arrays
    n: int
    map: str = "inverse_distance"


class Campaign(NamedTuple):
    """What the cells of a figure share.

    Attributes:
        key: typed JAX key.
        runs: per cell.
        progress: of the figure.
        paths: of all positions.
    """

    key: PRNGKeyArray
    runs: int
    progress: Progress
    paths: BeamPaths

    def cell(self, case: Case) -> Float[np.ndarray, "run scheme 2"]:
        """Runs of `study` for one case, each kept as it is done."""
        sizes = f"{case.arrays.antennas} and {case.arrays.user} antennas, {case.n} labels"
        name = f"{sizes}, {case.map} map, {len(self.paths.position)} positions, run"

        def made(own: PRNGKeyArray) -> dict[str, np.ndarray]:
            return {"found": study(own, self.paths, case)}

        keys = jax.random.split(self.key, self.runs)
        parts = [self.progress.part(f"{name} {i}", partial(made, own)) for i, own in enumerate(keys)]
        return np.stack([part["found"] for part in parts])

    @property
    def notes(self) -> tuple[str, str]:
        """Facts of the figure."""
        site, count = Site(), len(self.paths.position)
        where = f"{count} positions of the scene {site.scene} at {site.frequency / 1e9:g} GHz"
        student = f"student of {FEATURES} random Fourier features"
        return (
            f"{where}, rates at {min(TESTED, count)} of those without a label",
            f"{student}, {FOLDS} folds",
        )


def study(key: PRNGKeyArray, paths: BeamPaths, case: Case) -> Float[np.ndarray, "scheme 2"]:
    """One run: mean rate at positions without a label, in bit/s/Hz, and lambda, for every scheme.

    Args:
        key: typed JAX key; the labelled positions of a smaller n are among those of a larger one.
        paths: of all positions.
        case: what is studied.
    """
    keys = jax.random.split(key, 3)
    order = np.asarray(jax.random.permutation(keys[0], len(paths.position)))
    x = features(keys[1], paths.position)
    mine, rest = order[: case.n], order[case.n :]
    known, sought, tested = _take(paths, mine), paths.position[rest], rest[:TESTED]
    truth, masks = labels(known, case.arrays), _masks(keys[2], case.n)
    made = {training: synthetic(known, sought, mask, case) for training, mask in masks.items()}
    unlabelled = Unlabelled.of(x[rest], made["all"][1])
    whole = Labelled(x[mine], truth, truth)
    sources = {"none": (whole, unlabelled)}
    for training, (own, other) in made.items():
        kept = ~masks["split"][0] if training == "split" else np.ones(case.n, bool)
        labelled = Labelled(whole.x[kept], truth[kept], own[kept])
        sources[training] = labelled, unlabelled if training == "all" else unlabelled.predicted(other)
    found: list[tuple[float, float]] = []
    for scheme in SCHEMES.values():
        fit = regress(*sources[scheme.training], scheme, penalty=_PENALTY)
        beams = chosen(x[tested] @ fit.coefficient, case.arrays)
        found.append((float(rates(_take(paths, tested), beams, case.arrays).mean()), fit.lam))
    return np.array(found)


def _masks(key: PRNGKeyArray, n: int) -> dict[str, Bool[np.ndarray, "predictor labelled"]]:
    """For each way of training, on which labelled samples each predictor is trained."""
    keys = jax.random.split(key)
    half = np.asarray(jax.random.permutation(keys[0], n)) < n // 2
    fold = assign_folds(keys[1], n, FOLDS)
    return {
        "all": np.ones((1, n), bool),
        "split": half[None],
        "cross": fold != np.arange(FOLDS)[:, None],
    }


def synthetic(
    known: BeamPaths,
    sought: Float[np.ndarray, "unlabelled 2"],
    masks: Bool[np.ndarray, "predictor labelled"],
    case: Case,
) -> tuple[Float[np.ndarray, "labelled entry"], Float[np.ndarray, "unlabelled entry"]]:
    """Labels from maps: of labelled positions by the first map without them, of the others by all on average.

    Args:
        known: paths of the labelled positions.
        sought: the other positions.
        masks: on which labelled positions each map is made.
        case: what is studied.
    """
    ask: Map = MAPS[case.map]
    own = np.zeros((len(known.position), case.arrays.entries))
    total = np.zeros((len(sought), case.arrays.entries))
    for mask in masks:
        trained = _take(known, np.flatnonzero(mask))
        asked = np.arange(len(mask)) if mask.all() else np.flatnonzero(~mask)
        own[asked] = ask(trained, known.position[asked], case.arrays)
        total += ask(trained, sought, case.arrays) / len(masks)
    return own, total


def features(
    key: PRNGKeyArray, position: Float[np.ndarray, "position 2"]
) -> Float[np.ndarray, "position feature"]:
    """What the student sees: a constant, and waves over the position."""
    return np.concatenate([np.ones((len(position), 1)), waves(key, position, FEATURES - 1, _SCALE)], axis=1)


def _take(paths: BeamPaths, index: Int[np.ndarray, " chosen"]) -> BeamPaths:
    return BeamPaths(*(part[index] for part in paths))
