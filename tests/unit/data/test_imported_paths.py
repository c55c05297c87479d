"""Paths of other ray tracers: files written as their formats are described, read back as path sets."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.constants import speed_of_light
from scipy.io import savemat

from dtprob.data.deepmimo import MATRICES, from_dictionary, read_scenario
from dtprob.data.wireless_insite import read_p2m
from dtprob.errors import InputError
from dtprob.raytracing.field import frequency_response, path_gain, steering, synthesize

CARRIER = 3.5e9
TX = np.array([0.0, 0.0, 10.0])
RX = np.array([[30.0, 5.0, 1.5], [40.0, -8.0, 1.5]])
WALL = 20.0
"""A mirror at y = 20 m reflects to both receivers."""


def geometry():
    """Points of the direct and of the reflected path of each receiver."""
    image = TX * [1, -1, 1] + [0, 2 * WALL, 0]
    found = []
    for rx in RX:
        at = (WALL - rx[1]) / (image[1] - rx[1])
        found.append([np.stack([TX, rx]), np.stack([TX, rx + at * (image - rx), rx])])
    return found


def coefficients():
    """Free space, and half of the amplitude after the mirror, with the phase of the delay."""
    value = []
    for link in geometry():
        lengths = [np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1)) for points in link]
        value.append(
            [
                strength
                * speed_of_light
                / CARRIER
                / (4 * np.pi * d)
                * np.exp(-2j * np.pi * CARRIER * d / speed_of_light)
                for d, strength in zip(lengths, (1.0, -0.5), strict=True)
            ]
        )
    return np.asarray(value)


def delays():
    return np.array(
        [
            [np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1)) / speed_of_light for points in link]
            for link in geometry()
        ]
    )


def angles(vector):
    """Zenith angle and azimuth in degrees."""
    unit = vector / np.linalg.norm(vector)
    return np.degrees(np.arccos(unit[2])), np.degrees(np.arctan2(unit[1], unit[0]))


def expected_channel(tones, array):
    """Summed by hand: plane waves at a receiving array, phases of delays from the geometry."""
    total = np.zeros((len(RX), len(array), len(tones)), complex)
    for link, (points, values, late) in enumerate(zip(geometry(), coefficients(), delays(), strict=True)):
        for one, value, delay in zip(points, values, late, strict=True):
            away = one[-2] - one[-1]
            phase = 2 * np.pi * CARRIER / speed_of_light * array @ (away / np.linalg.norm(away))
            total[link] += value * np.outer(np.exp(1j * phase), np.exp(-2j * np.pi * tones * delay))
    return total


def check(paths):
    tones = np.array([-20e6, 0.0, 35e6])
    array = np.array([[0.0, 0.0, 0.0], [0.02, 0.03, -0.01]])
    gain = path_gain(paths, jnp.full(1, 4.0), jnp.full(1, 0.2))  # materials change nothing
    response = frequency_response(paths, jnp.asarray(tones))
    rx = steering(jnp.asarray(array), paths.arrival, paths.frequency, -1.0)
    found = np.asarray(synthesize(gain, response, rx))[:, 0, :, 0]
    wanted = expected_channel(tones, array)
    np.testing.assert_allclose(found, wanted, atol=2e-3 * np.abs(wanted).max())
    np.testing.assert_allclose(paths.rx_position, RX)
    np.testing.assert_allclose(paths.tx_position, [TX, TX])


def dataset():
    power, phase = 20 * np.log10(np.abs(coefficients())), np.degrees(np.angle(coefficients()))
    arrive = np.array([[angles(p[-2] - p[-1]) for p in link] for link in geometry()])
    leave = np.array([[angles(p[1] - p[0]) for p in link] for link in geometry()])
    empty = np.full((2, 1), np.nan)  # a path that no receiver has
    rows = {
        "power": power,
        "phase": phase,
        "delay": delays(),
        "aoa_el": arrive[..., 0],
        "aoa_az": arrive[..., 1],
        "aod_el": leave[..., 0],
        "aod_az": leave[..., 1],
    }
    padded = {name: np.concatenate([value, empty], axis=1) for name, value in rows.items()}
    return {"rx_pos": RX, "tx_pos": TX[None], "rt_params": {"frequency": CARRIER}, **padded}


def write_scenario(folder, pair, kind):
    for key in MATRICES:
        file = folder / f"{key}_{pair}.{kind}"
        if kind == "mat":
            savemat(file, {key: dataset()[key]})
        else:
            np.savez_compressed(file, **{key: dataset()[key]})
    parameters = {"version": "4.0.0", "rt_params": {"frequency": CARRIER, "raytracer_name": "other"}}
    (folder / "params.json").write_text(json.dumps(parameters))


@pytest.mark.parametrize("kind", ["npz", "mat"])
def test_a_deepmimo_scenario_gives_its_channel(tmp_path, kind):
    write_scenario(tmp_path, "t001_tx000_r002", kind)
    check(read_scenario(tmp_path))


def test_a_scenario_that_deepmimo_wrote_gives_sionnas_channel():
    """Converted by DeepMIMO 4.0.5 from sionna-rt 2.2.0, three links of a street at 6 GHz; the channel is sionna-rt's."""
    paths = read_scenario(Path(__file__).parent / "deepmimo_street")
    response = frequency_response(paths, jnp.array([0.0, 1e6]))
    found = synthesize(path_gain(paths, paths.permittivity, paths.conductivity), response)[:, 0, 0, 0]
    wanted = np.array(
        [
            [1.4038732e-04 - 1.2640e-04j, 1.4679557e-05 - 1.8411e-04j],
            [-1.2576701e-04 - 1.9623e-04j, -2.1274740e-04 - 1.0096e-04j],
            [9.6132120e-05 - 1.4851e-04j, -6.8521491e-05 - 1.6185e-04j],
        ]
    )
    np.testing.assert_allclose(found, wanted, atol=1e-3 * np.abs(wanted).max())


def test_a_deepmimo_dictionary_gives_its_channel():
    paths = from_dictionary(dataset())
    check(paths)
    assert np.asarray(paths.mask).tolist() == [[True, True, False]] * 2


def test_wrong_deepmimo_input_is_named(tmp_path):
    with pytest.raises(InputError, match=r"params\.json"):
        read_scenario(tmp_path)
    write_scenario(tmp_path, "t001_tx000_r002", "npz")
    write_scenario(tmp_path, "t001_tx001_r002", "npz")
    with pytest.raises(InputError, match="one pair"):
        read_scenario(tmp_path)
    with pytest.raises(InputError, match="Did you mean 't001_tx00"):
        read_scenario(tmp_path, "t001_tx005_r002")
    check(read_scenario(tmp_path, "t001_tx001_r002"))
    with pytest.raises(InputError, match="'delay'"):
        from_dictionary({name: value for name, value in dataset().items() if name != "delay"})
    with pytest.raises(InputError, match="DeepMIMO phase: expected shape"):
        from_dictionary(dataset() | {"phase": np.zeros((2, 9))})
    with pytest.raises(InputError, match="a path or more"):
        from_dictionary(dataset() | {"power": np.full((2, 3), np.nan)})
    (tmp_path / "params.json").write_text("{}")
    with pytest.raises(InputError, match=r"rt_params\.frequency"):
        read_scenario(tmp_path, "t001_tx001_r002")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rt_params": {"frequency": CARRIER / 1e9}}, r"a frequency in Hz, such as 3\.5e9, got"),
        ({"delay": 1e9 * dataset()["delay"]}, "delays of the imported paths: .* Check the units"),
        ({"delay": 1e6 * dataset()["delay"]}, "delays of the imported paths: .* Check the units"),
        ({"rx_pos": 1e2 * RX}, "delays of the imported paths: .* Check the units"),
        ({"rx_pos": RX.T}, r"rx_pos: expected shape \(receiver, 3\), got \(3, 2\)"),
        ({"power": 10 ** (dataset()["power"] / 10)}, "gains of the imported paths: expected 0 dB or less"),
        ({"aod_az": np.deg2rad(dataset()["aod_az"])}, "direction of departure .* Check the units of angles"),
        ({"aoa_az": dataset()["aoa_az"] + 180}, "direction of arrival .* Check the units of angles"),
    ],
)
def test_other_units_and_axes_of_imported_paths_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        from_dictionary(dataset() | change)


def p2m(transmit_power=0.0):
    """The text of a .paths.p2m file, with a third receiver that nothing reaches."""
    lines = [f"# {text}" for text in ("<paths>", "receiver, number of paths", "power phase delay ...")]
    lines.append("3")
    for number, (points, values, late) in enumerate(
        zip(geometry(), coefficients(), delays(), strict=True), 1
    ):
        lines += [f"{number} {len(points)}", "-60.0 0.0 1.0e-07 1.0e-08"]
        for index, (one, value, delay) in enumerate(zip(points, values, late, strict=True), 1):
            row = [
                index,
                len(one) - 2,
                20 * np.log10(abs(value)) + transmit_power,
                np.degrees(np.angle(value)),
            ]
            row += [delay, *angles(one[-2] - one[-1]), *angles(one[1] - one[0])]
            lines.append(" ".join(f"{entry:.12g}" for entry in row))
            lines.append("Tx-R-Rx" if len(one) == 3 else "Tx-Rx")
            lines += [" ".join(f"{entry:.9f}" for entry in point) for point in one]
    return [*lines, "3 0"]


@pytest.mark.parametrize("transmit_power", [0.0, 30.0])
def test_a_p2m_file_gives_its_channel(tmp_path, transmit_power):
    file = tmp_path / "street.paths.t001_01.r002.p2m"
    file.write_text("\n".join(p2m(transmit_power)) + "\n")
    check(read_p2m(file, CARRIER, transmit_power))


@pytest.mark.parametrize(
    ("line", "text", "message"),
    [
        (3, "three", "line 4: expected the number of receivers, got 'three'"),
        (3, "nan", "line 4: expected the number of receivers, got 'nan'"),
        (4, "1 inf", "line 5: expected a receiver and its number of paths, got '1 inf'"),
        (6, "1 nan -60 0 1e-7 90 0 90 0", "line 7: expected nine finite numbers"),
        (6, "1 0 -60", "line 7: expected the nine numbers of a path"),
        (7, "Tx-Q-Rx", "line 8: expected a chain of 0 interactions"),
        (7, "Tx-R-Rx", "line 8: expected a chain of 0 interactions"),
        (8, "1.0 2.0", "line 9: expected the coordinates of a point"),
        (9, " ".join(f"{entry:.9f}" for entry in TX), "line 10: expected points that differ"),
    ],
)
def test_a_damaged_p2m_line_is_named(tmp_path, line, text, message):
    lines = p2m()
    lines[line] = text
    file = tmp_path / "street.paths.t001_01.r002.p2m"
    file.write_text("\n".join(lines))
    with pytest.raises(InputError, match=message):
        read_p2m(file, CARRIER)


def test_comments_of_a_p2m_file_may_be_of_any_encoding(tmp_path):
    """Windows writes the sign of a degree in one byte, and a mark before the first line."""
    file = tmp_path / "street.paths.t001_01.r002.p2m"
    file.write_bytes(b"\xef\xbb\xbf# angles in \xb0\n" + "\n".join(p2m()).encode())
    check(read_p2m(file, CARRIER))
    with pytest.raises(InputError, match=r"a frequency in Hz, such as 3\.5e9, got 0\."):
        read_p2m(file, 0.0)


def test_a_p2m_file_that_ends_early_or_is_missing_is_named(tmp_path):
    file = tmp_path / "street.paths.t001_01.r002.p2m"
    file.write_text("\n".join(p2m()[:-4]))
    with pytest.raises(InputError, match="the end of the file"):
        read_p2m(file, CARRIER)
    with pytest.raises(InputError, match="no such file"):
        read_p2m(tmp_path / "other.p2m", CARRIER)
    file.write_text("1\n1 0\n")
    with pytest.raises(InputError, match="a receiver with a path"):
        read_p2m(file, CARRIER)
