"""What effects take the sites of a model to be: a user's own model may call something else by the same name."""

from __future__ import annotations

from typing import Final, Protocol


class SiteLike(Protocol):
    """What a family looks at in a declared site."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the site's value."""
        ...

    @property
    def axes(self) -> tuple[str, ...]:
        """Name of each dimension."""
        ...

    @property
    def kind(self) -> str:
        """Latent, deterministic or observed."""
        ...

    @property
    def distribution(self) -> str | None:
        """Name of the distribution's class."""
        ...

    @property
    def is_complex(self) -> bool:
        """Whether the value is complex."""
        ...

    @property
    def is_circular(self) -> bool:
        """Whether the values are angles."""
        ...


CHANNEL_AXES: Final = ("link", "snapshot", "rx_antenna", "tx_antenna", "subcarrier")
"""Axes of `noiseless_channel` and `noise_power`."""
_AXES: Final = {
    "permittivity": ("object",),
    "conductivity": ("object",),
    "thickness": ("object",),
    "path_share": ("link", "path"),
    "path_gain": ("link", "path"),
    "path_delay": ("link", "path"),
    "departure": ("link", "path", "direction"),
    "arrival": ("link", "path", "direction"),
    "path_phase": ("link", "snapshot", "path"),
    "tx_response": ("link", "path", "tx_antenna"),
    "rx_response": ("link", "path", "rx_antenna"),
    "receiver_gain": ("link",),
    "receiver_delay": ("link",),
    "frequency_response": ("subcarrier",),
    "noiseless_channel": CHANNEL_AXES,
    "noise_power": CHANNEL_AXES,
    "arrival_logits": ("episode", "slot", "cluster", "arrival_outcome"),
    "reception_logits": ("episode", "slot", "delivery_count"),
    "device_advantage": ("episode", "slot", "device"),
    "success_logits": ("episode", "slot", "device", "success_outcome"),
    "predicted_label": ("sample",),
    "label_deviation": ("sample",),
}
"""Axes of the sites that effects rewrite or look at."""
_COMPLEX: Final = frozenset({"path_gain", "tx_response", "rx_response", "frequency_response"})
"""Those that are complex amplitudes."""


def means(site: SiteLike, name: str) -> bool:
    """Whether a site of this name is what effects take it to be, as far as its axes and type tell.

    A path gain in dB, or one of readings instead of paths, is another quantity than an amplitude of each path.
    """
    return site.axes == _AXES.get(name, site.axes) and (site.is_complex or name not in _COMPLEX)
