"""How a calibration is run."""

from dataclasses import dataclass
from typing import Final, Literal

from dtprob.errors import InputError, unknown_name
from dtprob.raytracing.slab import LAWS, Law

Scheme = Literal["aware", "aware_reference", "oblivious", "uniform"]
SCHEMES: Final[tuple[Scheme, ...]] = ("aware", "aware_reference", "oblivious", "uniform")
_ITERATIONS: Final = {"aware": 900, "aware_reference": 900, "oblivious": 200, "uniform": 800}


@dataclass(frozen=True)
class Settings:
    """Settings of `calibrate`; the numbers are those of the reference where it has them.

    Attributes:
        scheme: "aware" of phase errors, with exact coordinate updates in the E-step; "aware_reference", with the
            paper's E-step; "oblivious", which takes traced phases for true; "uniform", which fits powers only.
        iterations: steps of the optimiser; by default 900 of the aware schemes, 800 uniform, 200 oblivious.
        rate: step of Adam in the logarithms of contrast (permittivity - 1) and conductivity.
        clip: largest norm of a gradient.
        permittivity: where every material starts.
        conductivity: where every material starts, S/m.
        concentration: where that of the phase errors starts; 0 is a uniform phase. "aware" searches from each of several
            and keeps the answer of the lowest free energy: one start alone may end far away where paths are hardly
            resolved or materials many. Other schemes take the first.
        fixed_concentration: keep it there, at one value.
        estimate_noise: let the noise power follow the residuals; the given one is then where it starts. Not for
            "uniform", which has none.
        global_phase: every snapshot has a phase of its own, common to its paths; "uniform" looks at no phase anyway.
        restart_every: after how many iterations the E-step starts afresh; in between it goes on with one sweep.
        sweeps: of coordinate updates after a fresh start.
        law: what a wall is, "slab" or "half_space".
    """

    scheme: Scheme = "aware"
    iterations: int | None = None
    rate: float = 0.15
    clip: float = 1.0
    permittivity: float = 3.0
    conductivity: float = 0.1
    concentration: float | tuple[float, ...] = (1.0, 100.0, 1e8)
    fixed_concentration: bool = False
    estimate_noise: bool = False
    global_phase: bool = False
    restart_every: int = 50
    sweeps: int = 20
    law: Law = "slab"

    def __post_init__(self) -> None:
        if self.scheme not in SCHEMES:
            raise unknown_name("scheme of a calibration", self.scheme, SCHEMES, "scheme")
        if self.law not in LAWS:
            raise unknown_name("law of a wall", self.law, LAWS, "law")
        if self.scheme == "uniform" and self.estimate_noise:
            remedy = "Leave estimate_noise out, or choose another scheme"
            raise InputError("estimate_noise", "a scheme with noise", "the scheme 'uniform'", remedy)
        counts = {"iterations": self.steps, "restart_every": self.restart_every, "sweeps": self.sweeps}
        for name, value in counts.items():
            if value < 1:
                raise InputError(f"{name} of a calibration", "1 or more", str(value), f"Give a larger {name}")
        given = self._concentrations
        low = not given or any(not value >= 0 for value in given)
        if not self.permittivity > 1 or not self.conductivity > 0 or low:
            got = f"{self.permittivity}, {self.conductivity}, {self.concentration}"
            expected = "a permittivity above 1, a conductivity above 0 and a concentration of 0 or more"
            raise InputError("start of a calibration", expected, got, "Start inside the range")
        if self.fixed_concentration and len(given) > 1:
            expected, got = "one value that is kept", f"{len(given)} to start from"
            raise InputError("concentration of a calibration", expected, got, "Give concentration=...")

    @property
    def _concentrations(self) -> tuple[float, ...]:
        given = self.concentration
        return given if isinstance(given, tuple) else (given,)

    @property
    def starts(self) -> tuple[float, ...]:
        """Concentrations from which the scheme searches."""
        return self._concentrations if self.scheme == "aware" else self._concentrations[:1]

    @property
    def steps(self) -> int:
        """Number of iterations."""
        return _ITERATIONS[self.scheme] if self.iterations is None else self.iterations
