"""How often the recommended measurement tells a true explanation from its rival, and at what cost.

    python benchmarks/next_measurement.py [--trials 300] [--seed 0] [--write]

Power was measured in streets from 60 to 220 m around a base station; its law of distance is fitted and each street has a
level of its own. Two explanations look alike there: a second slope beyond 150 m, and a loss in proportion to the distance.
Streets from 40 to 1,000 m could be measured, at a cost that grows with the way there. The recommended ones are measured,
without knowing the truth, and the explanation with the larger evidence on all data is taken. Beside it stand the verdict
without new data, as many measurements in streets drawn at random, and the cost of repeating the whole campaign until the
same odds are expected.

Everything is linear and Gaussian, so evidences are exact. --write keeps the figures in results/next_measurement.json.
"""

import argparse
import json
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from record import record

from dtprob.gap.next_measurement.design import Design, Prediction, joined, rank, recommend

STREETS, ROWS = 24, 12
STREET_DB, ERROR_DB = 2.0, 3.0
NEAR, FAR = (60.0, 220.0), np.linspace(40.0, 1000.0, 13)
BREAK = 150.0
PRIOR = np.diag([20.0, 10.0, 6.0]) ** 2  # level (dB), exponent times ten, the rival's own size
TRUE_LOSS_DB = (8.0, 16.0)
RIVALS = ("second_slope", "distance_loss")
NEEDED = 4.0

type Rows = Float[np.ndarray, " row"]


class Campaign(NamedTuple):
    """Distances of streets' rows, (street, row), and the power there."""

    distance: Float[np.ndarray, "street row"]
    power: Float[np.ndarray, "street row"]


def main() -> None:
    """Run the study and print its figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    found = [trial(np.random.default_rng([options.seed, k]), k % 2) for k in range(options.trials)]
    table = np.array(found)
    figures = {
        "trials": options.trials,
        "right": {
            "without new data": float(table[:, 0].mean()),
            "recommended": float(table[:, 1].mean()),
            "streets at random": float(table[:, 2].mean()),
        },
        "cost": {
            "median of the recommended": float(np.median(table[:, 3])),
            "median share of repeating everything": float(np.median(table[:, 3] / table[:, 4])),
        },
    }
    print(json.dumps(figures, indent=1))
    if options.write:
        what = "a second slope against a loss in proportion to the distance"
        record("next_measurement", what, ("numpy",), figures)


def trial(rng: np.random.Generator, truth: int) -> tuple[float, float, float, float, float]:
    """Whether the verdict is right without data, with the recommended and with random ones; cost, and that of repeats."""
    size = float(rng.uniform(*TRUE_LOSS_DB))
    coefficients = np.array([-35.0, -3.0, -size])
    near = measured(rng, rng.uniform(*NEAR, STREETS), truth, coefficients)
    fits = [posterior([near], rival) for rival in range(2)]
    designs = [design(float(place), fits) for place in FAR]
    best = recommend(designs, needed=NEEDED)
    places = np.atleast_1d(best.where["distance"])
    again = joined([design(float(np.mean(row)), fits, cost=1.0) for row in near.distance])
    repeats = rank([again], needed=NEEDED)[0]
    others = [np.tile(places, best.repeats), np.tile(rng.choice(FAR, len(places)), best.repeats)]
    right = [decided([near], truth)]
    right += [decided([near, measured(rng, at, truth, coefficients)], truth) for at in others]
    return (*right, best.cost, repeats.cost)  # pyright: ignore[reportReturnType]


def measured(rng: np.random.Generator, centres: Rows, truth: int, coefficients: Rows) -> Campaign:
    """Power in streets of 60 m."""
    distance = np.maximum(centres[:, None] + np.linspace(-30, 30, ROWS), 10.0)
    mean = terms(distance.reshape(-1), truth) @ coefficients
    levels = STREET_DB * rng.standard_normal((len(centres), 1))
    return Campaign(
        distance, mean.reshape(distance.shape) + levels + ERROR_DB * rng.standard_normal(distance.shape)
    )


def terms(distance: Rows, rival: int) -> Float[np.ndarray, "row 3"]:
    """Level, 10 log10 of the distance, and the rival's own term, 1 at 300 m."""
    own = np.log2(np.maximum(distance / BREAK, 1.0)) if rival == 0 else distance / 300.0
    return np.column_stack([np.ones_like(distance), 10 * np.log10(distance), own])


def whitening() -> Float[np.ndarray, "row row"]:
    """What makes the rows of a street independent."""
    return np.linalg.inv(np.linalg.cholesky(ERROR_DB**2 * np.eye(ROWS) + STREET_DB**2))


def posterior(campaigns: Sequence[Campaign], rival: int) -> tuple[Rows, np.ndarray, float]:
    """Mean and covariance of a rival's coefficients, and its log evidence up to what all share."""
    white = whitening()
    rows = np.concatenate([white @ row for c in campaigns for row in c.power])
    matrix = np.concatenate([white @ terms(d, rival) for c in campaigns for d in c.distance])
    centre = np.array([-35.0, -3.0, 0.0])
    left = rows - matrix @ centre
    precision = matrix.T @ matrix + np.linalg.inv(PRIOR)
    covariance = np.linalg.inv(precision)
    mean = covariance @ matrix.T @ left
    spread = np.linalg.slogdet(precision)[1] + np.linalg.slogdet(PRIOR)[1]
    return mean + centre, covariance, float(-0.5 * (left @ left - mean @ precision @ mean + spread))


def design(place: float, fits: Sequence[tuple[Rows, np.ndarray, float]], cost: float | None = None) -> Design:
    """A street at a distance; the way there costs as much as the measurement for each 500 m."""
    distance = np.maximum(place + np.linspace(-30, 30, ROWS), 10.0)
    white = whitening()
    predictions = []
    for rival, (mean, covariance, _) in enumerate(fits):
        matrix = white @ terms(distance, rival)
        predictions.append(Prediction(matrix @ mean, matrix, covariance))
    return Design({"distance": place}, 1 + place / 500 if cost is None else cost, tuple(predictions))


def decided(campaigns: Sequence[Campaign], truth: int) -> float:
    """Whether the true rival has the larger evidence."""
    evidences = [posterior(campaigns, rival)[2] for rival in range(2)]
    return float(int(np.argmax(evidences)) == truth)


if __name__ == "__main__":
    main()
