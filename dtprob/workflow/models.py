"""The models that a CASE can name. One that takes `paths` needs a [scene]."""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from dtprob.data import ChannelData, Labels, NetworkLog, PowerData
from dtprob.models.arguments import Model


@dataclass(frozen=True)
class Entry:
    """A model of dtprob.

    Attributes:
        function: where it is, "module:function".
        data: the kind of data it explains.
        derived: arguments that are computed from the others, each by a function of them, "module:function".
        arrange: for data that are no arguments as they are, the function "module:function" from the data, and
            options by name, to the arguments; its options can stand in [model.options] beside the model's.
        reduce: for a model that sees statistics of the data and not the data, the function "module:function" from the
            data and the arguments so far, by name, to the arguments that they become.
        diagnosed_by: for a model whose density is none of the data, the model that a diagnosis takes instead.
    """

    function: str
    data: type
    derived: Mapping[str, str] = field(default_factory=dict)
    arrange: str | None = None
    reduce: str | None = None
    diagnosed_by: str | None = None

    def load(self) -> Model:
        """The model itself."""
        return _load(self.function)

    def derive(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """The arguments that are computed from the others."""
        return {name: _load(function)(arguments) for name, function in self.derived.items()}

    def reduced(self, known: Mapping[str, Any]) -> dict[str, Any]:
        """The arguments that stand for the data where the model sees statistics of them."""
        return {} if self.reduce is None else _load(self.reduce)(known)

    def arranger(self) -> Callable[..., dict[str, Any]] | None:
        """The function from data to arguments, if there is one."""
        return None if self.arrange is None else _load(self.arrange)


def _load(function: str) -> Callable[..., Any]:
    module, name = function.split(":")
    return getattr(importlib.import_module(module), name)


NAMES: Mapping[type, str] = {
    ChannelData: "channel, subcarrier_frequency, rx_position, tx_position",
    PowerData: "power, rx_position, tx_position",
    NetworkLog: "episode, slot, buffer_0, action_0, ack_0, arrival_0, ...",
    Labels: "x_0, x_1, ..., y and, if there is one, prediction",
}
"""What arrays of each kind are called in a file, for a user who calls them otherwise."""

MODELS: Mapping[str, Entry] = {
    "phase_error_channel": Entry("dtprob.models.channel:phase_error_channel", ChannelData),
    "ray_traced_channel": Entry("dtprob.models.channel:ray_traced_channel", ChannelData),
    "compressed_channel": Entry(
        "dtprob.models.compressed_channel:compressed_channel",
        ChannelData,
        reduce="dtprob.models.compressed_channel:compress_measured",
    ),
    "received_power": Entry(
        "dtprob.models.received_power:received_power",
        PowerData,
        arrange="dtprob.models.received_power:link_power",
    ),
    "ultra_wideband_channel": Entry(
        "dtprob.models.ultra_wideband:ultra_wideband_channel",
        ChannelData,
        {name: f"dtprob.models.ultra_wideband:{name}" for name in ("rough_delay", "link_power")},
    ),
    "ultra_wideband_profile": Entry(
        "dtprob.models.ultra_wideband:ultra_wideband_profile",
        ChannelData,
        arrange="dtprob.models.ultra_wideband:delay_profile",
    ),
    "label_twin": Entry(
        "dtprob.models.label_twin:label_twin", Labels, arrange="dtprob.models.label_twin:labelled_rows"
    ),
    "multi_access": Entry(
        "dtprob.models.multi_access:multi_access", NetworkLog, arrange="dtprob.models.multi_access:records"
    ),
    "prediction_powered": Entry(
        "dtprob.models.prediction_powered.generalised:prediction_powered",
        Labels,
        arrange="dtprob.models.prediction_powered.label_data:label_data",
        diagnosed_by="label_twin",
    ),
}
"""The models that a CASE can name."""
