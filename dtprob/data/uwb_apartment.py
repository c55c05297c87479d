"""Measured ultra-wideband impulse responses in a furnished flat, brought to the form that models read.

Data set: M. Kolakowski, "UWB channel impulse responses registered in a furnished apartment", doi
10.5281/zenodo.4742391, CC BY 4.0: two DW1000 radios at 36 pairs of places, 108 to 383 packets each, 128
complex taps of 1.0016 ns around the first path, 3993.6 MHz carrier, 499.2 MHz bandwidth.

What the data are like (the figures come from ``channels`` and ``align_link`` and are tested):

- Every packet has a phase and a gain of its own (the receiver fills its accumulator up to a fixed level, so
  the gain says nothing of the channel), and starts a random fraction of a tap off. The chip's own
  first-path index tells the delay to about 0.1 ns (robust standard deviation); on links 9, 27 and 29 it
  jumps by 2 to 4 ns between packets.
- Once aligned, a packet differs from its link's mean by -20 dB of its energy in the median link. On links 44
  (-7 dB), 48, 27, 42 and 51 (-11 to -14 dB), all without a free direct path, the channel itself moved.
- Averages of 13 to 48 successive packets differ by -25 dB in the median link (-11 to -41 dB), averages of as
  many interleaved packets by -35 dB: the channel drifts slowly while a link is measured. The repeats here
  are successive packets, so ``noise_power`` holds noise and drift together, which is the floor a static
  model can reach.
- The response is that of radio and room together: within 2 dB from 150 to 230 MHz off the carrier, 5 to 6
  dB lower around the carrier. The carrier's own bin is empty (-25 dB: the radio blocks DC) and is left out.
- The receiver's first path is the pulse's leading edge; the pulse peaks about 1.5 ns later on links with a
  free direct path.
- Nothing is known of heights, antenna patterns and absolute gain. The level the chip reports saturates below
  about 3 m.
"""

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, final

import numpy as np
from jaxtyping import Bool, Complex, Float
from scipy.constants import speed_of_light

from dtprob.data.alignment import Alignment, align, weighted_mean
from dtprob.data.kinds import ChannelData
from dtprob.data.location import measured_data
from dtprob.errors import InputError

NAME = "uwb_apartment"
RESPONSES = "uwb_apartment_cir.npz"
_REACH_TAPS = 8.0


@final
@dataclass(frozen=True)
class Radio:
    """What the radio does, as the data set states it.

    Attributes:
        carrier: Hz.
        bandwidth: Hz.
        tap: spacing of the taps, s.
    """

    carrier: float
    bandwidth: float
    tap: float


@final
@dataclass(frozen=True, eq=False)
class Link:
    """All packets between one anchor (transmitter) and one tag (receiver).

    Attributes:
        number: the link's number in the data set.
        anchor, tag: m, position on the floor plan.
        label: "LOS", "NLOS", or "NDP NLOS" where the direct path is absent.
        ranged_distance: m, median of the distances that the radios measured by time of flight.
        received_power: W, median of what the receiver reported.
        impulse_response: raw taps of every packet, in the receiver's units.
        first_path_index: the receiver's estimate of where the first path lies, in taps.
    """

    number: int
    anchor: Float[np.ndarray, "2"]
    tag: Float[np.ndarray, "2"]
    label: str
    ranged_distance: float
    received_power: float
    impulse_response: Complex[np.ndarray, "packet tap"]
    first_path_index: Float[np.ndarray, " packet"]

    @property
    def distance(self) -> float:
        """Distance on the floor plan, m."""
        return float(np.hypot(*(self.anchor - self.tag)))

    @property
    def line_of_sight(self) -> bool:
        """Whether nothing stands in between."""
        return self.label == "LOS"


def read_radio(folder: Path | None = None) -> Radio:
    """Carrier, bandwidth and tap spacing.

    Args:
        folder: the data set's folder; by default where ``measured_data`` finds it.
    """
    stated = json.loads(((folder or measured_data(NAME)) / "radio.json").read_text())
    return Radio(stated["center_frequency_hz"], stated["bandwidth_hz"], stated["tap_s"])


def read_links(folder: Path | None = None) -> tuple[Link, ...]:
    """All links with their packets in the order of measurement.

    Args:
        folder: the data set's folder; by default where ``measured_data`` finds it.
    """
    folder = folder or measured_data(NAME)
    with np.load(folder / RESPONSES, allow_pickle=False) as archive:
        pairs = archive["cir_iq"].astype(float)
        number, first_path = archive["link_id"], archive["first_path_index"].astype(float)
    taps = pairs[..., 0] + 1j * pairs[..., 1]
    with (folder / "links.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return tuple(
        Link(
            number=int(row["link_id"]),
            anchor=np.array([float(row["anchor_x"]), float(row["anchor_y"])]),
            tag=np.array([float(row["tag_x"]), float(row["tag_y"])]),
            label=row["label"],
            ranged_distance=float(row["median_range_m"]),
            received_power=1e-3 * 10.0 ** (float(row["median_rsl_dbm"]) / 10.0),
            impulse_response=taps[number == int(row["link_id"])],
            first_path_index=first_path[number == int(row["link_id"])],
        )
        for row in rows
    )


def subcarriers(radio: Radio, taps: int) -> Float[np.ndarray, " subcarrier"]:
    """Frequencies of a transform over ``taps`` taps, Hz from the carrier, ascending.

    They lie within the band, without the carrier itself, which the radio blocks.
    """
    frequency = np.fft.fftshift(np.fft.fftfreq(taps, radio.tap))
    return frequency[_in_band(frequency, radio)]


def _in_band(frequency: Float[np.ndarray, " bin"], radio: Radio) -> Bool[np.ndarray, " bin"]:
    return (np.abs(frequency) <= radio.bandwidth / 2.0) & (frequency != 0.0)


def align_link(link: Link, radio: Radio) -> Alignment:
    """Bring a link's packets to a common phase, gain and delay, within the band.

    Delay zero is the first path, as the receiver saw it in the median packet.

    Args:
        link: the packets.
        radio: the radio's parameters.
    """
    taps = link.impulse_response.shape[1]
    frequency = subcarriers(radio, taps)
    inside = _in_band(np.fft.fftshift(np.fft.fftfreq(taps, radio.tap)), radio)
    spectrum = np.fft.fftshift(np.fft.fft(link.impulse_response, axis=1), axes=1)[:, inside]
    found = align(spectrum, frequency, reach=_REACH_TAPS * radio.tap)
    first_path = float(np.median(link.first_path_index * radio.tap - found.delay))
    shift = np.exp(2j * np.pi * frequency * first_path)
    return found._replace(
        response=found.response * shift, aligned=found.aligned * shift, delay=found.delay + first_path
    )


def channels(
    folder: Path | None = None,
    *,
    links: Sequence[int] | None = None,
    averages: int = 8,
    level: Literal["unit", "reported"] = "unit",
) -> ChannelData:
    """The mean response of every link, in several independent averages so that the noise can be seen.

    The snapshots of a link are averages over successive packets, all with the same ``repeat`` label. The
    mean power of every link is 1, its phase arbitrary (``phase = "per_packet"``), and its first path lies
    at the time of flight that the radios measured. Positions get height 0, since none is known.
    ``noise_power`` is the variance of one snapshot, from the differences between snapshots: receiver noise
    and slow drift.

    Args:
        folder: the data set's folder; by default where ``measured_data`` finds it.
        links: numbers of the links to take; all by default.
        averages: number of snapshots, 2 or more.
        level: "unit" for a mean power of 1, "reported" for the received power that the radio reports, in W.

    Raises:
        InputError: a link that is not there, fewer than 2 averages or more than packets, or no such level.
    """
    radio = read_radio(folder)
    chosen = _chosen(read_links(folder), links, averages, level)
    frequency = subcarriers(radio, chosen[0].impulse_response.shape[1])
    responses = np.stack([_averages(link, radio, frequency, averages) for link in chosen])
    if level == "reported":
        responses *= np.sqrt([link.received_power for link in chosen])[:, None, None]
    spread = np.abs(responses - responses.mean(axis=1, keepdims=True)) ** 2
    return ChannelData(
        channel=responses[:, :, None, None, :],
        subcarrier_frequency=frequency,
        rx_position=np.array([[*link.tag, 0.0] for link in chosen]),
        tx_position=np.array([[*link.anchor, 0.0] for link in chosen]),
        noise_power=spread.sum(axis=1).mean(axis=1) / (averages - 1),
        repeat=np.zeros(averages, dtype=int),
    )


def _chosen(known: Sequence[Link], links: Sequence[int] | None, averages: int, level: str) -> list[Link]:
    if level not in {"unit", "reported"}:
        raise InputError(f"{NAME} level", "unit or reported", repr(level), "Correct the value")
    if type(averages) is not int or averages < 2:
        raise InputError(f"{NAME} averages", "2 or more", repr(averages), "Correct the value")
    numbers = [link.number for link in known]
    asked = numbers if links is None else links
    missing = [one for one in asked if one not in numbers] if np.ndim(asked) == 1 else asked
    if missing or not asked:
        expected = f"a list of numbers among {', '.join(map(str, sorted(numbers)))}"
        raise InputError(f"{NAME} links", expected, str(missing), "Name links that exist")
    if len(set(asked)) < len(asked):
        raise InputError(f"{NAME} links", "different numbers", str(list(asked)), "Name each link once")
    of_number = {link.number: link for link in known}
    chosen = [of_number[number] for number in asked]
    fewest = min(chosen, key=lambda link: len(link.impulse_response))
    if averages > len(fewest.impulse_response):
        expected = f"at most {len(fewest.impulse_response)}, the packets of link {fewest.number}"
        raise InputError(f"{NAME} averages", expected, str(averages), "Take fewer averages")
    return chosen


def _averages(
    link: Link, radio: Radio, frequency: Float[np.ndarray, " subcarrier"], averages: int
) -> Complex[np.ndarray, "snapshot subcarrier"]:
    found = align_link(link, radio)
    blocks = np.array_split(np.arange(len(found.gain)), averages)
    means = np.stack([weighted_mean(found.aligned[block], found.gain[block]) for block in blocks])
    means = means / np.sqrt(np.mean(np.abs(means.mean(axis=0)) ** 2))
    flight = link.ranged_distance / speed_of_light
    return means * np.exp(-2j * np.pi * frequency * flight)
