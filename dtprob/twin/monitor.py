"""Watching a physical twin: has it left what was learned of it, since when, and in which factor."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, final

import numpy as np
from jaxtyping import Bool, Float

from dtprob.errors import InputError, unknown_name
from dtprob.models.arguments import Data, Model
from dtprob.twin import statistics
from dtprob.twin.likelihood import Likelihoods, check_apart, window_likelihoods

type Statistic = Literal["disagreement", "surprise", "evidence"]

STATISTICS: tuple[Statistic, ...] = ("disagreement", "surprise", "evidence")


@final
@dataclass(frozen=True)
class Watch:
    """What a monitor says of windows in their order.

    Attributes:
        statistic: of each window, all factors together.
        p_value: of each window against the normal ones; 1 of a window that is not whole, see `Monitor`.
        alarm: where the statistic of a whole window exceeds the calibrated threshold.
        evidence: log e-value for a change of each factor in each window; without draws of what a change may bring none.
        detector: log of the sequential detector over all factors.
        run_length: mean windows to a false alarm that the sequential detector is set to; see `Monitor`.
    """

    statistic: Float[np.ndarray, " window"]
    p_value: Float[np.ndarray, " window"]
    alarm: Bool[np.ndarray, " window"]
    evidence: Mapping[str, Float[np.ndarray, " window"]]
    detector: Float[np.ndarray, " window"]
    run_length: float

    @property
    def detected(self) -> int | None:
        """The window in which the sequential detector raises the alarm; None while it does not."""
        crossed = np.flatnonzero(self.detector >= np.log(self.run_length))
        return int(crossed[0]) if crossed.size else None

    @property
    def factors(self) -> dict[str, float]:
        """Probability of each factor to be the one that changed, up to the alarm or the end."""
        until = None if self.detected is None else self.detected + 1
        return statistics.blame({name: each[:until] for name, each in self.evidence.items()})

    @property
    def changed(self) -> str | None:
        """The factor that most likely changed; None without an alarm."""
        return None if self.detected is None else max(self.factors, key=lambda name: self.factors[name])


@final
@dataclass(frozen=True)
class Monitor:
    """A model with what was learned of it, watching windows of new data.

    The run length holds for windows that each come from the draws' own mixture, a new draw for each window. A twin has one
    parameter, near the draws at best: where few data told them and this one lies far out, each window is a little more
    likely under a change, and false alarms come sooner. More data of the learning phase bring both together. The rate
    of `alarm` has no such condition: it is calibrated on held-out windows. A shorter window, as at an episode's end, is not
    exchangeable with whole ones: it does not count for the threshold and raises no alarm. The sequential detector, which
    has no threshold to calibrate, counts its evidence too.

    Attributes:
        model: a NumPyro model whose clusters are the windows.
        draws: of its latent sites from any sampler, (draw, *event); one draw is the frequentist rival.
        changed: draws of what a change may bring, as from the prior; needed for evidence and detection.
        statistic: what single windows are judged by: "disagreement" of the ensemble, "surprise" (minus the log
            predictive), or "evidence" for a change.
        apart: axes whose entries are factors of their own, as "cluster".
        whole: arguments of the model, of one shape (window, ...), false where a reading is missing or does not count;
            those that the data do not have are left out.
        normal: the statistic of held-out normal windows, from `calibrated`.
        readings: of a whole window, from `calibrated`; 0 where the data have none of `whole`.
        rate: probability of a false alarm per window.
        run_length: mean windows to a false alarm of the sequential detector.

    Raises:
        InputError: an unknown statistic, evidence without `changed`, text in the place of `apart`, a rate outside of (0,
            1), or a run length below 1.
    """

    model: Model
    draws: Mapping[str, Any]
    changed: Mapping[str, Any] | None = None
    statistic: Statistic = "surprise"
    apart: tuple[str, ...] = ()
    whole: tuple[str, ...] = ("valid", "preceded")
    normal: Float[np.ndarray, " window"] | None = None
    readings: int = 0
    rate: float = 0.05
    run_length: float = 1000.0

    def __post_init__(self) -> None:
        """Refuse settings that cannot work."""
        if self.statistic not in STATISTICS:
            raise unknown_name("statistic of a monitor", self.statistic, STATISTICS, "statistic")
        if self.statistic == "evidence" and self.changed is None:
            remedy = "Sample the model's prior"
            raise InputError("monitor by evidence", "draws of what a change may bring", "none", remedy)
        check_apart(self.apart)
        statistics.check_rate(self.rate)
        if not self.run_length >= 1:
            got, remedy = f"{self.run_length:g}", "Give a larger number"
            raise InputError("run length of a monitor", "1 window or more", got, remedy)

    def calibrated(self, data: Data) -> Monitor:
        """The monitor with its threshold set by normal windows that it has not learned from.

        Args:
            data: the model's arguments by name.

        Raises:
            InputError: too few whole windows for the rate of false alarms.
        """
        value, _ = self._judged(data)
        present = self._present(data, len(value))
        value = value[present.all(axis=1)]
        statistics.threshold(value, self.rate)
        return replace(self, normal=value, readings=present.shape[1])

    def watch(self, data: Data) -> Watch:
        """Judge windows in their order.

        Args:
            data: the model's arguments by name.

        Raises:
            InputError: the monitor is not calibrated, or by windows of another length.
        """
        if self.normal is None:
            raise InputError(
                "monitor", "one that is calibrated", "none", "Call calibrated with normal data first"
            )
        value, evidence = self._judged(data)
        path = statistics.detector(statistics.mixed(evidence)) if evidence else np.full(len(value), -np.inf)
        present = self._present(data, len(value))
        if present.shape[1] != self.readings:
            expected, got = f"{self.readings} readings, as when calibrated", str(present.shape[1])
            raise InputError("windows to watch", expected, got, "Give windows of the same length")
        counts = present.all(axis=1)
        return Watch(
            statistic=value,
            p_value=np.where(counts, statistics.p_value(value, self.normal), 1.0),
            alarm=counts & (value > statistics.threshold(self.normal, self.rate)),
            evidence=evidence,
            detector=path,
            run_length=self.run_length,
        )

    def _present(self, data: Data, windows: int) -> Bool[np.ndarray, "window reading"]:
        """Which readings of each window count."""
        given = [np.asarray(data[name], bool) for name in self.whole if data.get(name) is not None]
        if not given:
            return np.ones((windows, 0), bool)
        return np.all(given, axis=0).reshape(windows, -1)

    def _judged(self, data: Data) -> tuple[Float[np.ndarray, " window"], dict[str, np.ndarray]]:
        """The statistic over all factors, and each factor's evidence."""
        normal = window_likelihoods(self.model, data, self.draws, apart=self.apart)
        evidence: dict[str, np.ndarray] = {}
        if self.changed is not None:
            other = window_likelihoods(self.model, data, self.changed, apart=self.apart)
            evidence = {name: statistics.log_evidence(other[name], normal[name]) for name in normal}
        if self.statistic == "evidence":
            return statistics.mixed(evidence), evidence
        judge = statistics.disagreement if self.statistic == "disagreement" else statistics.surprise
        return judge(_total(normal)), evidence


def _total(likelihoods: Likelihoods) -> Float[np.ndarray, "draw window"]:
    return np.sum(list(likelihoods.values()), axis=0)
