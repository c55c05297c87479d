"""The summary table: one row for each entry, angles as angles."""

import numpy as np
import pytest

from dtprob.errors import InputError
from dtprob.inference import Posterior, summary

RANDOM = np.random.default_rng(0)


def posterior():
    return Posterior(
        draws={
            "level": RANDOM.normal(3.0, 2.0, (4, 500)),
            "phase": np.angle(np.exp(1j * RANDOM.normal(np.pi, 0.2, (4, 500, 2)))),
            "gain": RANDOM.normal(size=(4, 500)) + 2j,
        },
        latent=("level", "phase"),
        circular=("phase",),
    )


def test_rows_and_columns():
    table = summary(posterior())
    assert list(table.index) == ["level", "phase[0]", "phase[1]"]
    level = table.loc["level"]
    assert (level["kind"], level["mean"], level["sd"]) == (
        "linear",
        pytest.approx(3, abs=0.2),
        pytest.approx(2, 0.1),
    )
    assert level["low"] == pytest.approx(3 - 1.645 * 2, abs=0.3)
    assert level["ess"] > 1000
    assert level["rhat"] < 1.01


def test_angles_across_the_cut():
    row = summary(posterior()).loc["phase[0]"]
    assert row["kind"] == "circular"
    assert abs(row["mean"]) > 3.1
    assert row["sd"] == pytest.approx(0.2, rel=0.1)
    assert row["resultant_length"] == pytest.approx(np.exp(-0.02), abs=0.005)
    assert np.mod(row["high"] - row["low"], 2 * np.pi) == pytest.approx(2 * 1.645 * 0.2, rel=0.1)
    assert row["rhat"] < 1.02


def test_a_stuck_chain_shows():
    stuck = np.concatenate([RANDOM.normal(3.0, 0.02, (2, 300)), RANDOM.normal(-3.0, 0.02, (2, 300))])
    table = summary(Posterior(draws={"z": stuck}, latent=("z",), circular=("z",)))
    # Ranks make two equal groups the halves of a standard normal: means +-sqrt(2 / pi), variance 1 - 2 / pi.
    # Four chains, split, are 8, so far-apart groups have sqrt(1 + 8 / 7 * (2 / pi) / (1 - 2 / pi)) and no more.
    assert table.loc["z", "rhat"] == pytest.approx(1.7326, abs=0.02)


def test_complex_sites_in_parts_and_unknown_sites():
    assert list(summary(posterior(), ["gain"]).index) == ["gain.real", "gain.imag"]
    with pytest.raises(InputError, match="Did you mean 'phase'"):
        summary(posterior(), ["phases"])
    with pytest.raises(InputError, match="a probability between 0 and 1, got 90"):
        summary(posterior(), probability=90)


def test_one_chain_and_one_draw_have_no_quality():
    table = summary(Posterior(draws={"x": np.ones((1, 1))}))
    assert np.isnan(table.loc["x", "ess"])
    assert np.isnan(summary(Posterior(draws={"x": RANDOM.normal(size=(1, 50))})).loc["x", "rhat"])
