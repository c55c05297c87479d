"""The loss of `bench_field.py` on stored paths in Dr.Jit: the formulas of `dtprob.raytracing`, differentiated by it.

Directions, normals and lengths are constants here as there, and the measurement is reduced to the same statistics. What
is left for every step is the slab's coefficients, the field along each path and a quadratic form in the gains.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from dtprob.raytracing.calibration import Statistics
from dtprob.raytracing.paths import SPECULAR, PathSet
from dtprob.raytracing.sionna_patch import stable_square_root


def libraries() -> tuple[Any, Any]:
    """Dr.Jit and Mitsuba, whose types say too little to be checked."""
    import drjit  # noqa: PLC0415
    import mitsuba  # noqa: PLC0415

    return drjit, mitsuba


def stored_in_drjit(
    paths: PathSet,
    statistics: Statistics,
    start: Float[np.ndarray, "2 material"],
    scale: float,
    *,
    frozen: bool,
) -> Callable[[], tuple[float, np.ndarray]]:
    """Value and gradient in permittivity and conductivity of each material.

    Args:
        paths: reflected and direct paths.
        statistics: of the measurement against them, one snapshot.
        start: permittivity and conductivity of each material.
        scale: factor of the loss, the mean of |H - y|^2.
        frozen: keep the compiled program of a step (`drjit.freeze`) instead of building it anew.
    """
    dr, mi = libraries()

    walls, ends = _constants(paths)
    loss_of, constants = mean_square(paths, statistics, scale)

    def evaluate(permittivity: Any, conductivity: Any) -> tuple[Any, Any, Any]:
        dr.enable_grad(permittivity, conductivity)
        loss = loss_of(_gain(paths, walls, ends, (permittivity, conductivity)))
        dr.backward(loss)
        return loss, dr.grad(permittivity), dr.grad(conductivity)

    kept = [*walls, *ends, *constants]
    run = dr.freeze(evaluate, state_fn=lambda *_: kept) if frozen else evaluate

    def step() -> tuple[float, np.ndarray]:
        loss, *slopes = run(*(mi.Float(values.astype(np.float32)) for values in start))
        return float(np.asarray(loss).reshape(-1)[0]), np.stack([np.asarray(slope) for slope in slopes])

    return step


def mean_square(
    paths: PathSet, statistics: Statistics, scale: float
) -> tuple[Callable[[Any], Any], list[Any]]:
    """The mean of |H - y|^2 times a factor, of the gains of the paths that exist, link by link; and its arrays."""
    dr, mi = libraries()

    at = np.nonzero(np.asarray(paths.mask))
    count = np.bincount(at[0], minlength=paths.n_link)
    pairs = [_pairs(begin, n) for begin, n in zip(np.cumsum(count) - count, count, strict=True)]
    i, j = (np.concatenate(part) for part in zip(*pairs, strict=True))
    gram = np.asarray(statistics.gram)[at[0][i], at[1][i], at[1][j]]
    product = np.asarray(statistics.product)[at[0], 0, at[1]]
    energy = float(np.sum(np.asarray(statistics.energy)))
    over = scale / (statistics.size * paths.n_link)
    g, b = (mi.Complex2f(mi.Float(np.real(part)), mi.Float(np.imag(part))) for part in (gram, product))
    row, column = mi.UInt32(i), mi.UInt32(j)

    def loss(c: Any) -> Any:
        left, right = (
            mi.Complex2f(*(dr.gather(mi.Float, part, k) for part in (c.real, c.imag))) for k in (row, column)
        )
        fit = dr.sum((dr.conj(left) * g * right).real) - 2 * dr.sum((dr.conj(c) * b).real)
        return over * (energy + fit)

    return loss, [g, b, row, column]


def _pairs(begin: Any, count: Any) -> tuple[np.ndarray, np.ndarray]:
    """All pairs of the paths of a link."""
    each = begin + np.arange(count)
    return np.repeat(each, count), np.tile(each, count)


def _constants(paths: PathSet) -> tuple[list[dict[str, Any]], tuple[Any, Any]]:
    """What the walls are to every path, step by step, and the field vectors at both ends."""
    _, mi = libraries()

    def vector(value: np.ndarray) -> Any:
        return mi.Vector3f(*(mi.Float(np.ascontiguousarray(part, np.float32)) for part in value.T))

    at = np.nonzero(np.asarray(paths.mask))
    k = np.asarray(paths.departure)[at]
    walls = []
    for depth in range(paths.depth):
        n = np.asarray(paths.normal)[at][:, depth]
        hit = np.asarray(paths.interaction)[at][:, depth] == SPECULAR
        material = np.asarray(paths.object_material)[np.asarray(paths.object)[at][:, depth]]
        across = np.cross(k, n)
        cosine = np.abs(np.sum(k * n, axis=1))
        walls.append(
            {
                "hit": mi.Bool(hit),
                "normal": vector(n),
                "across": vector(across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)),
                "cosine": mi.Float(np.maximum(cosine, 1e-4).astype(np.float32)),
                "thickness": mi.Float(np.asarray(paths.thickness)[np.asarray(paths.object)[at][:, depth]]),
                "material": mi.UInt32(material),
            }
        )
        k = np.where(hit[:, None], k - 2 * np.sum(k * n, axis=1, keepdims=True) * n, k)
    scale = paths.wavelength / (4 * np.pi) / np.asarray(paths.length)[at]
    ends = vector(np.asarray(paths.tx_field)[at]), vector(np.asarray(paths.rx_field)[at] * scale[:, None])
    return walls, ends


def _gain(
    paths: PathSet, walls: list[dict[str, Any]], ends: tuple[Any, Any], materials: tuple[Any, Any]
) -> Any:
    """Complex gains of the paths."""
    dr, mi = libraries()

    first, last = ends
    permittivity, conductivity = materials
    real, imaginary = first, mi.Vector3f(0.0)
    for wall in walls:
        eps = dr.gather(mi.Float, permittivity, wall["material"])
        loss = dr.gather(mi.Float, conductivity, wall["material"]) / (
            2 * np.pi * paths.frequency * 8.8541878128e-12
        )
        te, tm = _slab(wall["cosine"], mi.Complex2f(eps, -loss), wall["thickness"] / paths.wavelength)
        # reflected: (r_te + r_tm)(E.w) w - r_tm R E
        n, w = wall["normal"], wall["across"]
        turned = [part - 2 * dr.dot(part, n) * n for part in (real, imaginary)]
        along = (te + tm) * mi.Complex2f(dr.dot(real, w), dr.dot(imaginary, w))
        after = (
            along.real * w - (tm.real * turned[0] - tm.imag * turned[1]),
            along.imag * w - (tm.real * turned[1] + tm.imag * turned[0]),
        )
        real, imaginary = (
            dr.select(wall["hit"], new, old) for new, old in zip(after, (real, imaginary), strict=True)
        )
    return mi.Complex2f(dr.dot(last, real), dr.dot(last, imaginary))


def _slab(cosine: Any, eta: Any, turns: Any) -> tuple[Any, Any]:
    """Reflection of both polarisations."""
    dr, _ = libraries()

    root = stable_square_root(eta - (1 - cosine * cosine))
    twice = dr.exp(type(eta)(0.0, -4 * np.pi) * turns * root)
    found = []
    for b in (root, root / eta):
        r = (cosine - b) / (cosine + b)
        found.append(r * (1 - twice) / (1 - r * r * twice))
    return found[0], found[1]
