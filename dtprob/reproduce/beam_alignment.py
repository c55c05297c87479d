"""Beam alignment from positions: a base station learns which beam serves a position from few measured ones.

The student is a regression of each beam's share of the received power on random features of the position; the
beams with the largest expected shares along rows and columns are used. The synthetic labels come from a
channel knowledge map, which interpolates the strongest paths of the nearest labelled positions and is wrong
where these belong to other walls. Choices where the source is silent: the scene, the student, 5 folds.
"""

from functools import partial
from typing import Final, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray
from scipy.spatial import KDTree

from dtprob.models.prediction_powered.multioutput import Labelled, Unlabelled, regress
from dtprob.models.prediction_powered.schemes import SCHEMES, Scheme
from dtprob.models.prediction_powered.training import assign_folds
from dtprob.reproduce.beams import BeamPaths, Site, trace_positions
from dtprob.reproduce.beams_codebook import OVERSAMPLING, VERTICAL, Beams, rates, shares
from dtprob.reproduce.figure import Quantity
from dtprob.reproduce.progress import Progress

RUNS: Final = 20
POSITIONS: Final = 38_038
FOLDS: Final = 5
FEATURES: Final = 200
TESTED: Final = 5000
_NEIGHBOURS: Final = 3
_MAPPED_PATHS: Final = 3
_PENALTY: Final = 1e-3
_SCALES: Final = np.array([0.2, 0.2, 0.3])
_ROWS: Final = 4096

RATE: Final = Quantity("rate", "bit/s/Hz")


def positions(progress: Progress) -> BeamPaths:
    """The traced positions, traced once for all figures in a folder."""
    site = Site()
    name = f"beam_paths_{site.scene}_{POSITIONS}"
    return BeamPaths(**progress.kept(name, lambda: trace_positions(site, POSITIONS)._asdict()))


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

    def cell(self, rows: int, n: int) -> Float[np.ndarray, "run scheme 2"]:
        """Runs of `study` for one array and one number of labels, each kept as it is done."""
        name = f"{VERTICAL * rows} antennas, {n} labels, {len(self.paths.position)} positions, run"

        def made(own: PRNGKeyArray) -> dict[str, np.ndarray]:
            return {"found": study(own, self.paths, rows, n)}

        keys = jax.random.split(self.key, self.runs)
        parts = [self.progress.part(f"{name} {i}", partial(made, own)) for i, own in enumerate(keys)]
        return np.stack([part["found"] for part in parts])

    @property
    def notes(self) -> tuple[str, str]:
        """Facts of the figure."""
        site, count = Site(), len(self.paths.position)
        where = f"{count} positions of the scene {site.scene} at {site.frequency / 1e9:g} GHz"
        how = f"{FEATURES} random Fourier features, map of {_NEIGHBOURS} neighbours and {_MAPPED_PATHS} paths"
        return (
            f"{where}, rates at up to {TESTED} of those without a label",
            f"{how}, {FOLDS} folds",
        )


def study(key: PRNGKeyArray, paths: BeamPaths, rows: int, n: int) -> Float[np.ndarray, "scheme 2"]:
    """One run: mean rate at positions without a label, in bit/s/Hz, and lambda, for every scheme.

    Args:
        key: typed JAX key; the labelled positions of a smaller n are among those of a larger one.
        paths: of all positions.
        rows: elements of a row of the array.
        n: labelled positions.
    """
    keys = jax.random.split(key, 3)
    order = np.asarray(jax.random.permutation(keys[0], len(paths.position)))
    x = features(keys[1], paths.position)
    labelled, rest = order[:n], order[n:]
    known, sought = _take(paths, labelled), paths.position[rest]
    data = Labelled(x[labelled], (truth := labels(known, rows)), truth)
    tested = rest[:TESTED]
    found: list[tuple[float, float]] = []
    masks = _masks(keys[2], n)
    synthetic = {kind: _synthetic(known, sought, mask, rows) for kind, mask in masks.items()}
    for scheme in SCHEMES.values():
        own, other = _data(scheme, data, synthetic, masks, x[rest])
        fit = regress(own, other, scheme, penalty=_PENALTY)
        beams = chosen(x[tested] @ fit.coefficient, rows)
        found.append((float(rates(_take(paths, tested), beams, rows).mean()), fit.lam))
    return np.array(found)


type _Synthetic = tuple[Float[np.ndarray, "labelled entry"], Float[np.ndarray, "unlabelled entry"]]
type _Masks = dict[str, Bool[np.ndarray, "predictor labelled"]]


def _masks(key: PRNGKeyArray, n: int) -> _Masks:
    """For each way of training, on which labelled samples each predictor is trained."""
    keys = jax.random.split(key)
    half = np.asarray(jax.random.permutation(keys[0], n)) < n // 2
    fold = assign_folds(keys[1], n, FOLDS)
    return {
        "all": np.ones((1, n), bool),
        "split": half[None],
        "cross": fold != np.arange(FOLDS)[:, None],
    }


def _data(
    scheme: Scheme,
    data: Labelled,
    synthetic: dict[str, _Synthetic],
    masks: _Masks,
    x: Float[np.ndarray, "unlabelled feature"],
) -> tuple[Labelled, Unlabelled]:
    """What a scheme is fitted to."""
    if scheme.training == "none":
        return data, Unlabelled(x, np.zeros((len(x), data.y.shape[1])))
    own, other = synthetic[scheme.training]
    kept = ~masks["split"][0] if scheme.training == "split" else np.ones(len(data.x), bool)
    return Labelled(data.x[kept], data.y[kept], own[kept]), Unlabelled(x, other)


def _synthetic(
    known: BeamPaths,
    sought: Float[np.ndarray, "unlabelled 2"],
    masks: Bool[np.ndarray, "predictor labelled"],
    rows: int,
) -> _Synthetic:
    """Labels from maps: of labelled positions by the first map without them, of the others by all on average."""
    own = np.zeros((len(known.position), _entries(rows)))
    total = np.zeros((len(sought), _entries(rows)))
    for mask in masks:
        trained = _take(known, np.flatnonzero(mask))
        asked = np.arange(len(mask)) if mask.all() else np.flatnonzero(~mask)
        own[asked] = labels(knowledge_map(trained, known.position[asked]), rows)
        for start in range(0, len(sought), _ROWS):
            here = slice(start, start + _ROWS)
            total[here] += labels(knowledge_map(trained, sought[here]), rows) / len(masks)
    return own, total


def knowledge_map(known: BeamPaths, sought: Float[np.ndarray, "sought 2"]) -> BeamPaths:
    """The strongest paths interpolated from the nearest positions, by inverse distances; phases are lost."""
    count = min(_NEIGHBOURS, len(known.position))
    nearest = np.arange(1, count + 1)
    distance, index = KDTree(known.position).query(sought, k=nearest)  # pyright: ignore[reportArgumentType]
    closeness = 1 / np.maximum(distance, 1e-6)
    share = (closeness / closeness.sum(axis=1, keepdims=True))[..., None]
    amplitude = np.abs(known.gain[:, :_MAPPED_PATHS])[index]
    there = share * (amplitude > 0)
    whole = np.where(there.sum(axis=1) > 0, there.sum(axis=1), 1.0)

    def mean(cosine: Float[np.ndarray, "known path"]) -> Float[np.ndarray, "sought path"]:
        return np.sum(there * cosine[:, :_MAPPED_PATHS][index], axis=1) / whole

    power = np.sum(share * amplitude**2, axis=1)
    return BeamPaths(sought, np.sqrt(power), mean(known.horizontal), mean(known.vertical))


def labels(paths: BeamPaths, rows: int) -> Float[np.ndarray, "position entry"]:
    """The shares of the power that the beams of a row, then those of a column, gather on average over phases."""
    power = np.abs(paths.gain) ** 2
    return np.concatenate(
        [shares(power, paths.horizontal, rows), shares(power, paths.vertical, VERTICAL)], axis=1
    )


def chosen(expected: Float[np.ndarray, "position entry"], rows: int) -> Beams:
    """The beams with the largest expected shares."""
    split = OVERSAMPLING * rows
    return Beams(np.argmax(expected[:, :split], axis=1), np.argmax(expected[:, split:], axis=1))


def features(
    key: PRNGKeyArray, position: Float[np.ndarray, "position 2"]
) -> Float[np.ndarray, "position feature"]:
    """Random Fourier features of the direction and the logarithm of the distance from the base station."""
    step = position - np.array(Site().position[:2])
    distance = np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1.0)
    polar = np.concatenate([step / distance, np.log(distance)], axis=1) / _SCALES
    keys = jax.random.split(key)
    frequency = np.asarray(jax.random.normal(keys[0], (3, FEATURES - 1)))
    phase = np.asarray(jax.random.uniform(keys[1], (FEATURES - 1,), maxval=2 * np.pi))
    waves = np.sqrt(2 / FEATURES) * np.cos(polar @ frequency + phase)
    return np.concatenate([np.ones((len(position), 1)), waves], axis=1)


def _entries(rows: int) -> int:
    return OVERSAMPLING * (rows + VERTICAL)


def _take(paths: BeamPaths, index: Int[np.ndarray, " chosen"]) -> BeamPaths:
    return BeamPaths(*(part[index] for part in paths))
