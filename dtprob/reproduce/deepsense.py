"""Beam alignment from measured positions: few labelled sweeps, many positions, a cheap biased predictor.

The student is a regression of each beam's share of the received power on random features of the position. The
predictor knows one pattern, the mean of the sweeps it was shown around their best beams, and points it by a
straight line from the direction of the position; it is wrong wherever the street is not so simple. Passages
of the car, not sweeps, are split: into those for learning and those for the test, and the former into folds.
"""

from typing import Final, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from dtprob.data.deepsense import BEAMS, SCENARIOS, Sweeps, read_sweeps
from dtprob.models.prediction_powered.multioutput import Labelled, Unlabelled, regress
from dtprob.models.prediction_powered.schemes import SCHEMES
from dtprob.reproduce.figure import Figure, Panel, Quantity, Series
from dtprob.reproduce.progress import Progress

RUNS: Final = 50
LABELLED: Final = (20, 50, 100, 200, 500)
FOLDS: Final = 5
FEATURES: Final = 60
_PENALTY: Final = 3e-3
_SCALE: Final = 0.5
_TESTED: Final = 0.3


def run(key: PRNGKeyArray, runs: int, progress: Progress) -> Figure:
    """The figure; see the module."""
    panels: list[Panel] = []
    notes: list[str] = []
    keys = jax.random.split(key, runs)
    for scenario in SCENARIOS:
        sweeps = read_sweeps(scenario)
        name = f"scenario {scenario}, {runs} runs"
        part = progress.part(name, lambda sweeps=sweeps: {"found": studies(keys, sweeps, LABELLED)})
        loss, lam = part["found"][..., 0], part["found"][..., 1]
        curves = [Series.of_runs(scheme, LABELLED, loss[:, :, i]) for i, scheme in enumerate(SCHEMES)]
        axis, height = Quantity("labelled sweeps", is_log=True), Quantity("loss against the best beam", "dB")
        panels.append(Panel(f"scenario {scenario}", axis, height, tuple(curves)))
        notes.append(f"scenario {scenario}: {_findings(loss, lam)}")
    where = "DeepSense 6G, 60 GHz, 64 beams, positions by satellite"
    how = f"{FEATURES} random Fourier features, {FOLDS} folds by passage, {_TESTED:.0%} of passages for the test"
    return Figure("deepsense", where, tuple(panels), runs, (how, *notes))


def _findings(loss: Float[np.ndarray, "run point scheme"], lam: Float[np.ndarray, "run point scheme"]) -> str:
    names = list(SCHEMES)
    tuned, erm = names.index("tuned_cppi"), names.index("erm")
    saved = loss[:, :, erm] - loss[:, :, tuned]
    error = saved.std(axis=0, ddof=1) / np.sqrt(len(saved)) if len(saved) > 1 else np.zeros(len(LABELLED))
    parts = zip(LABELLED, saved.mean(axis=0), error, lam[:, :, tuned].mean(axis=0), strict=True)
    shown = ", ".join(f"{gain:.2f} +- {err:.2f} at {n} (lambda {own:.2f})" for n, gain, err, own in parts)
    return f"dB that tuned_cppi saves against erm, mean and standard error: {shown}"


def studies(
    keys: PRNGKeyArray, sweeps: Sweeps, labelled: tuple[int, ...]
) -> Float[np.ndarray, "run point scheme 2"]:
    """`study` for several keys and numbers of labels."""
    return np.array([[study(key, sweeps, n) for n in labelled] for key in keys])


def study(key: PRNGKeyArray, sweeps: Sweeps, n: int) -> Float[np.ndarray, "scheme 2"]:
    """One run: loss at the passages kept for the test, in dB, and lambda, for every scheme.

    Args:
        key: typed JAX key; the labelled sweeps of a smaller n are among those of a larger one.
        sweeps: of one scenario.
        n: labelled sweeps.
    """
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    passages = random.permutation(np.unique(sweeps.sequence))
    kept = passages[: round(_TESTED * len(passages))]
    tested = np.isin(sweeps.sequence, kept)
    order = random.permutation(np.flatnonzero(~tested))
    place, x = _features(random, sweeps.position)
    share = sweeps.power / sweeps.power.sum(axis=1, keepdims=True)
    mine, rest = order[:n], order[n:]
    fold = _folds(random, sweeps.sequence[mine])
    masks = {
        "all": np.ones((1, n), bool),
        "split": (fold % 2 == 0)[None],
        "cross": fold != np.unique(fold)[:, None],
    }
    truth = share[mine]
    unlabelled = Unlabelled.of(x[rest], np.zeros((len(rest), BEAMS)))
    sources = {"none": (Labelled(x[mine], truth, truth), unlabelled)}
    for training, mask in masks.items():
        own, other = _synthetic(place[mine], truth, place[rest], mask)
        used = ~mask[0] if training == "split" else np.ones(n, bool)
        labelled = Labelled(x[mine][used], truth[used], own[used])
        sources[training] = labelled, unlabelled.predicted(other)
    found: list[tuple[float, float]] = []
    for scheme in SCHEMES.values():
        fit = regress(*sources[scheme.training], scheme, penalty=_PENALTY)
        beam = np.argmax(x[tested] @ fit.coefficient, axis=1)
        found.append((_loss(sweeps.power[tested], beam), fit.lam))
    return np.array(found)


def _loss(power: Float[np.ndarray, "sweep beam"], beam: Int[np.ndarray, " sweep"]) -> float:
    """Power of the best beams over that of the chosen ones, both on average, in dB."""
    received = np.take_along_axis(power, beam[:, None], axis=1)
    return float(10 * np.log10(power.max(axis=1).mean() / received.mean()))


def _folds(random: np.random.Generator, sequence: Int[np.ndarray, " sample"]) -> Int[np.ndarray, " sample"]:
    """A fold for each sample, the same for all of a passage."""
    passages, which = np.unique(sequence, return_inverse=True)
    return random.permutation(np.arange(len(passages)) % FOLDS)[which]


class Direction(NamedTuple):
    """Fits of the predictor.

    Attributes:
        line: intercept and slope of the best beam over the sine of the direction.
        pattern: mean share of the power by distance from the best beam.
    """

    line: Float[np.ndarray, "2"]
    pattern: Float[np.ndarray, " offset"]

    @classmethod
    def fitted(
        cls, place: Float[np.ndarray, "sample 2"], share: Float[np.ndarray, "sample beam"]
    ) -> "Direction":
        """From positions and shares."""
        best = np.argmax(share, axis=1)
        design = np.column_stack([np.ones(len(place)), place[:, 0]])
        line = np.linalg.lstsq(design, best, rcond=None)[0]
        offset = np.arange(BEAMS) - best[:, None] + BEAMS - 1
        count = np.bincount(offset.ravel(), minlength=2 * BEAMS - 1)
        total = np.bincount(offset.ravel(), share.ravel(), minlength=2 * BEAMS - 1)
        return cls(line, total / np.maximum(count, 1))

    def predict(self, place: Float[np.ndarray, "sample 2"]) -> Float[np.ndarray, "sample beam"]:
        """Shares at positions."""
        best = np.clip(np.round(self.line[0] + self.line[1] * place[:, 0]), 0, BEAMS - 1).astype(int)
        return self.pattern[np.arange(BEAMS) - best[:, None] + BEAMS - 1]


def _synthetic(
    place: Float[np.ndarray, "labelled 2"],
    share: Float[np.ndarray, "labelled beam"],
    sought: Float[np.ndarray, "unlabelled 2"],
    masks: Bool[np.ndarray, "predictor labelled"],
) -> tuple[Float[np.ndarray, "labelled beam"], Float[np.ndarray, "unlabelled beam"]]:
    """Labels of labelled sweeps by the first predictor without them, of the others by all on average."""
    fits = [Direction.fitted(place[mask], share[mask]) for mask in masks]
    own = np.stack([fit.predict(place) for fit in fits])
    first = np.argmin(masks, axis=0)
    return own[first, np.arange(len(place))], np.mean([fit.predict(sought) for fit in fits], axis=0)


def _features(
    random: np.random.Generator, position: Float[np.ndarray, "sweep 2"]
) -> tuple[Float[np.ndarray, "sweep 2"], Float[np.ndarray, "sweep feature"]]:
    """Sine of the direction off the street's side and logarithm of the distance; what the student sees."""
    ahead = position.mean(axis=0) / np.linalg.norm(position.mean(axis=0))
    distance = np.maximum(np.linalg.norm(position, axis=1), 1.0)
    sine = (position @ np.array([-ahead[1], ahead[0]])) / distance
    place = np.column_stack([sine, np.log(distance)])
    frequency = random.standard_normal((2, FEATURES - 1)) / _SCALE
    phase = random.uniform(0, 2 * np.pi, FEATURES - 1)
    waves = np.sqrt(2 / FEATURES) * np.cos(2 * place @ frequency + phase)
    return place, np.column_stack([np.ones(len(place)), waves])
