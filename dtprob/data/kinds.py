"""The kinds of data that people bring, as frozen types that are checked when they are made.

All quantities are in SI units; the arrays are NumPy arrays in double precision and read-only.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self, final

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from dtprob.data.arrays import ArraySpec, check_arrays, check_finite
from dtprob.data.network_rows import check_rows
from dtprob.data.tones import check_tones
from dtprob.errors import InputError

_POSITIONS = {
    "rx_position": ArraySpec((("link", 3),), required=True),
    "tx_position": ArraySpec((("link", 3),), required=True),
    "rx_array": ArraySpec((("rx_antenna", 3),)),
    "tx_array": ArraySpec((("tx_antenna", 3),)),
    "noise_power": ArraySpec(((), ("link",)), lower=0.0, positive=True),
}

CHANNEL_ARRAYS: Mapping[str, ArraySpec] = {
    "channel": ArraySpec(
        (("link", "snapshot", "rx_antenna", "tx_antenna", "subcarrier"),), "complex", required=True
    ),
    "subcarrier_frequency": ArraySpec((("subcarrier",),), required=True),
    "snapshot_time": ArraySpec((("snapshot",),)),
    **_POSITIONS,
    "repeat": ArraySpec((("snapshot",),), "integer"),
}

POWER_ARRAYS: Mapping[str, ArraySpec] = {
    "power": ArraySpec((("link", "rx_antenna", "tx_antenna"),), required=True, lower=0.0),
    **_POSITIONS,
}

NETWORK_ARRAYS: Mapping[str, ArraySpec] = {
    "episode": ArraySpec((("row",),), "integer", required=True),
    "slot": ArraySpec((("row",),), "integer", required=True),
    "buffer": ArraySpec((("row", "device"),), "integer", required=True, lower=0),
    "action": ArraySpec((("row", "device"),), "integer", required=True, lower=0),
    "ack": ArraySpec((("row", "device"),), "integer", required=True, lower=0),
    "arrival": ArraySpec((("row", "device"),), "integer", required=True, lower=0),
}

LABEL_ARRAYS: Mapping[str, ArraySpec] = {
    "x": ArraySpec((("sample", "feature"),), required=True),
    "y": ArraySpec((("sample",),), required=True),
    "labelled": ArraySpec((("sample",),), "integer", required=True),
    "prediction": ArraySpec((("sample",),)),
    "weight": ArraySpec((("sample",),), lower=0.0),
    "context": ArraySpec((("sample",),), "integer", lower=0),
    "cluster": ArraySpec((("sample",),), "integer"),
}


class _Checked:
    """Checks the fields of a frozen dataclass against a table of arrays when an instance is made."""

    def _check(self, specs: Mapping[str, ArraySpec]) -> None:
        given = {field.name: getattr(self, field.name) for field in fields(self)}  # pyright: ignore[reportArgumentType]
        for name, array in check_arrays(given, specs).items():
            object.__setattr__(self, name, array)

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that are there, by name."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}  # pyright: ignore[reportArgumentType]
        return {name: value for name, value in given.items() if value is not None}


class _OfLinks(_Checked):
    """Data with a row per link in some of the arrays."""

    def take(self, links: Int[np.ndarray, " chosen"]) -> Self:
        """The data of some links, in the order given.

        Args:
            links: indices of links.
        """
        specs = {**CHANNEL_ARRAYS, **POWER_ARRAYS}
        rows = {
            name: array[links]
            for name, array in self.arrays().items()
            if any(shape[:1] == ("link",) and len(shape) == np.ndim(array) for shape in specs[name].shapes)
        }
        return replace(self, **rows)  # pyright: ignore[reportArgumentType, reportReturnType]


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class ChannelData(_OfLinks):
    """Measured or simulated channel frequency responses.

    Attributes:
        channel: complex response, one per link, snapshot, antenna pair and subcarrier.
        subcarrier_frequency: Hz, from the carrier.
        rx_position, tx_position: m, centre of each end's array.
        snapshot_time: s.
        rx_array, tx_array: m, element positions from the array's centre; None for a single antenna.
        noise_power: noise variance per coefficient of ``channel``, in the units of |channel|^2.
        repeat: equal labels mark snapshots that measure the same thing again.

    Raises:
        InputError: arrays that do not fit together, NaN or infinity, a noise power that is not positive, subcarriers all at
            one frequency or within 1 kHz (frequencies in MHz, or numbered).
    """

    channel: Complex[np.ndarray, "link snapshot rx_antenna tx_antenna subcarrier"]
    subcarrier_frequency: Float[np.ndarray, " subcarrier"]
    rx_position: Float[np.ndarray, "link 3"]
    tx_position: Float[np.ndarray, "link 3"]
    snapshot_time: Float[np.ndarray, " snapshot"] | None = None
    rx_array: Float[np.ndarray, "rx_antenna 3"] | None = None
    tx_array: Float[np.ndarray, "tx_antenna 3"] | None = None
    noise_power: Float[np.ndarray, "*link"] | None = None
    repeat: Int[np.ndarray, " snapshot"] | None = None

    def __post_init__(self) -> None:
        self._check(CHANNEL_ARRAYS)
        check_tones(self.subcarrier_frequency)
        _check_array(self.rx_array, "rx_array", self.channel.shape[2])
        _check_array(self.tx_array, "tx_array", self.channel.shape[3])


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class PowerData(_OfLinks):
    """Received powers without phase: RSRP, coverage maps, beam sweeps.

    Attributes:
        power: linear received power per link and antenna (or beam) pair.
        rx_position, tx_position: m.
        rx_array, tx_array: m, element positions from the array's centre; None for a single antenna.
        noise_power: noise power in the units of ``power``.

    Raises:
        InputError: arrays that do not fit together, NaN or infinity, a negative power.
    """

    power: Float[np.ndarray, "link rx_antenna tx_antenna"]
    rx_position: Float[np.ndarray, "link 3"]
    tx_position: Float[np.ndarray, "link 3"]
    rx_array: Float[np.ndarray, "rx_antenna 3"] | None = None
    tx_array: Float[np.ndarray, "tx_antenna 3"] | None = None
    noise_power: Float[np.ndarray, "*link"] | None = None

    def __post_init__(self) -> None:
        self._check(POWER_ARRAYS)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class NetworkLog(_Checked):
    """What the devices of a slotted network did: one row per slot, sorted by episode and slot.

    Attributes:
        episode, slot: which slot of which episode a row is.
        buffer: packets waiting at the start of the slot.
        action: 1 where the device transmitted.
        ack: 1 where its packet was delivered in this slot.
        arrival: 1 where a packet was generated at the end of the slot.

    Raises:
        InputError: arrays that do not fit together, an action, ack or arrival other than 0 and 1, or rows that
            cannot be or cannot follow one another; see `dtprob.data.network_rows.check_rows`.
    """

    episode: Int[np.ndarray, " row"]
    slot: Int[np.ndarray, " row"]
    buffer: Int[np.ndarray, "row device"]
    action: Int[np.ndarray, "row device"]
    ack: Int[np.ndarray, "row device"]
    arrival: Int[np.ndarray, "row device"]

    def __post_init__(self) -> None:
        self._check(NETWORK_ARRAYS)
        order = np.lexsort((self.slot, self.episode))
        for field in fields(self):
            array = getattr(self, field.name)[order]
            array.setflags(write=False)
            object.__setattr__(self, field.name, array)
        check_rows(self, order)


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class Labels(_Checked):
    """Samples of which some carry a label, and a predictor's guess for all of them if there is one.

    Attributes:
        x: features.
        y: label, 0 where there is none.
        labelled: where ``y`` is a label.
        prediction: the predictor's label.
        weight: how much a sample counts in what is estimated.
        context: which context a sample belongs to, 0, 1, ...
        cluster: which samples may depend on each other, such as those of a route; any whole number.

    Raises:
        InputError: arrays that do not fit together, NaN or infinity, a weight or context below 0, no label at
            all.
    """

    x: Float[np.ndarray, "sample feature"]
    y: Float[np.ndarray, " sample"]
    labelled: Bool[np.ndarray, " sample"]
    prediction: Float[np.ndarray, " sample"] | None = None
    weight: Float[np.ndarray, " sample"] | None = None
    context: Int[np.ndarray, " sample"] | None = None
    cluster: Int[np.ndarray, " sample"] | None = None

    def __post_init__(self) -> None:
        self._check(LABEL_ARRAYS)
        labelled = self.labelled.astype(bool)
        labelled.setflags(write=False)
        object.__setattr__(self, "labelled", labelled)
        if not labelled.any():
            raise InputError("y", "at least one label", "none", "Give y for some of the samples")


@final
@dataclass(frozen=True, eq=False)
class Table:
    """Columns or arrays by name, for a model of the user's own.

    Attributes:
        columns: finite numbers or text, each of its own shape.

    Raises:
        InputError: a NaN or infinity, or values that are neither numbers nor text.
    """

    columns: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        checked: dict[str, np.ndarray] = {}
        for name, value in self.columns.items():
            array = np.asarray(value)
            if array.dtype.kind not in "biufcU":
                got = f"values of type {array.dtype}"
                raise InputError(name, "numbers or text", got, f"Store {name} as numbers or text")
            if array.dtype.kind in "fc":
                check_finite(name, array)
            checked[name] = array
        object.__setattr__(self, "columns", checked)

    def arrays(self) -> dict[str, np.ndarray]:
        """The columns by name."""
        return dict(self.columns)


type Data = ChannelData | PowerData | NetworkLog | Labels | Table


def _check_array(array: Any, name: str, antennas: int) -> None:
    if array is None and antennas > 1:
        expected = f"the positions of {antennas} elements, shape ({antennas}, 3)"
        raise InputError(name, expected, "nothing", f"Add {name}, in metres from the array's centre")
