"""The contract of an inference engine, and the options that every run understands."""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import numpy as np

from dtprob import errors
from dtprob.errors import InputError
from dtprob.inference.posterior import Posterior
from dtprob.models.arguments import Model

type Answer = Literal["exact", "approximation", "point"]
type Serves = Literal["continuous", "circular", "tables"]


@dataclass(frozen=True)
class RunOptions:
    """What a run does besides inferring; no option changes a draw.

    Attributes:
        progress: tell the progress on standard error, as a bar on a terminal and as plain lines elsewhere.
        status_file: a JSON file that always holds the latest progress.
        checkpoint: a file that holds the state of the run, replaced after a chunk of draws or a step, at most once
            a second and for at most a twentieth of the time; kept by the engines that iterate, while the others
            finish in one piece.
        resume: continue from `checkpoint` where it exists.
        chunk: steps of Markov chains between two checkpoints or progress reports; by default 100, and more where
            these take less than half a second.
        deterministics: keep the model's deterministic sites among the draws.
        pointwise: keep the log likelihood of every observation for every draw.
        max_entries: a deterministic site or log likelihood with more entries than this over all draws is left
            out; the posterior's provenance names it.
    """

    progress: bool = False
    status_file: Path | None = None
    checkpoint: Path | None = None
    resume: bool = False
    chunk: int | None = None
    deterministics: bool = True
    pointwise: bool = True
    max_entries: int = 20_000_000

    def __post_init__(self) -> None:
        """Names of files as paths; settings that cannot work are refused."""
        for name in ("status_file", "checkpoint"):
            if (file := getattr(self, name)) is not None:
                object.__setattr__(self, name, Path(file))
        if self.chunk is not None and self.chunk < 1:
            raise InputError("chunk of a run", "1 or more draws", str(self.chunk), "Give a positive number")
        if self.resume and self.checkpoint is None:
            raise InputError("resume", "a checkpoint file", "none", "Give the file of the interrupted run")


DEFAULT = RunOptions()
LATENTS_ONLY = RunOptions(deterministics=False, pointwise=False)
"""Keeps draws of what is unknown, and nothing that has an entry for each observation."""


class AbstractEngine(abc.ABC):
    """Something that turns a model and data into a posterior.

    A concrete engine is a frozen dataclass whose fields are its settings; what cannot work is refused when it is made.
    Calling it twice with the same key, model and data gives the same draws.

    Attributes:
        name: the engine's name in `ENGINES`, on the command line and in provenance.
        answer: "exact" when its draws come from the posterior, "approximation" when from a stand-in, "point"
            when there is a single value.
        serves: "continuous" for any model with continuous latent sites, "circular" where it needs circular
            ones, "tables" where every latent site is a `LogDirichlet` table.
    """

    name: ClassVar[str]
    answer: ClassVar[Answer]
    serves: ClassVar[Serves] = "continuous"

    @abc.abstractmethod
    def __call__(
        self, key: jax.Array, model: Model, data: Mapping[str, Any], *, options: RunOptions = DEFAULT
    ) -> Posterior:
        """Infer.

        Args:
            key: typed JAX key.
            model: a NumPyro model.
            data: its arguments by name, the observed ones present.
            options: progress, checkpoints, what to keep.

        Returns:
            draws of every latent site, laid out (chain, draw, *event).

        Raises:
            InputError: the data do not fit the model, or the engine cannot serve the model.
        """


def check_counts(engine: AbstractEngine, least: Mapping[str, int]) -> None:
    """Check an engine's settings that are counts.

    Args:
        engine: the engine.
        least: for each setting, the smallest number that works.

    Raises:
        InputError: a setting is smaller, or no whole number.
    """
    for name, bound in least.items():
        value, what = getattr(engine, name), f"{name} of engine {engine.name}"
        if not isinstance(value, int | np.integer):
            raise InputError(what, "a whole number", repr(value), f"Write {name} as digits alone")
        if value < bound:
            raise InputError(what, f"{bound} or more", str(value), f"Give a larger {name}")


def check_choice(engine: AbstractEngine, setting: str, choices: Sequence[str]) -> None:
    """Check a setting of an engine that is one of a few words.

    Args:
        engine: the engine.
        setting: its name.
        choices: the words.

    Raises:
        InputError: it is another one.
    """
    errors.check_choice(f"{setting} of engine {engine.name}", getattr(engine, setting), choices)


def check_initial(initial: Any) -> None:
    """Check that values to start from are given by the names of sites, where there are any.

    Raises:
        InputError: anything else.
    """
    if initial is not None and not isinstance(initial, Mapping):
        remedy = "Write initial = { SITE = VALUE }"
        raise InputError(
            "initial values of an engine", "a value for each site by name", repr(initial), remedy
        )


def check_key(key: jax.Array) -> jax.Array:
    """The key itself, when it is a single typed JAX key.

    Raises:
        InputError: anything else, such as an integer seed or an untyped key.
    """
    is_typed = isinstance(key, jax.Array) and jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
    if not is_typed or key.shape != ():
        got = f"{type(key).__name__} of shape {getattr(key, 'shape', ())}"
        raise InputError("key", "one typed JAX key", got, "Make it with jax.random.key(seed)")
    return key
