"""Independent forms of what the room computes: a box traced by hand, and fields by the textbook."""

import itertools

import jax.numpy as jnp
import numpy as np
from scipy.constants import epsilon_0, speed_of_light

from dtprob.raytracing.geometry import unfold
from dtprob.raytracing.paths import REFRACTION, SPECULAR, PathSet, validate
from dtprob.raytracing.pattern import field_vector

LOW, HIGH = np.array([0.0, 0.0, 0.0]), np.array([8.0, 5.0, 3.0])
PARTITION = 4.0
NAMES = ("west", "east", "south", "north", "floor", "ceiling", "partition")
TX = np.array([[1.07, 1.21, 1.53]] * 3)
RX = np.array([[6.51, 3.13, 1.17], [3.29, 4.07, 2.23], [5.37, 1.21, 1.53]])


def plane(number):
    """A point and a normal of the box's walls and of the partition at x = 4."""
    axis = number // 2 if number < 6 else 0
    normal = np.eye(3)[axis]
    level = PARTITION if number == 6 else (LOW, HIGH)[number % 2][axis]
    return level * normal, normal


def box_paths(
    *, frequency=3.5e9, tx=TX, rx=RX, pattern="iso", polarization=0.3, conductivity=0.05
) -> PathSet:
    """Line of sight and reflections on the walls up to second order, through a partition on the way."""
    rows = [list(_paths_of(a, b)) for a, b in zip(tx, rx, strict=True)]
    n_link, n_path, depth = len(tx), max(map(len, rows)), 5
    code = np.zeros((n_link, n_path, depth), int)
    index, mask = np.zeros_like(code), np.zeros((n_link, n_path), bool)
    for link, row in enumerate(rows):
        for path, steps in enumerate(row):
            mask[link, path] = True
            for step, (kind, number) in enumerate(steps):
                code[link, path, step], index[link, path, step] = kind, number
    point, normal = (
        np.array([[[plane(i)[k] for i in path] for path in row] for row in index]) for k in (0, 1)
    )
    ends = [np.repeat(np.asarray(p)[:, None], n_path, 1).reshape(-1, 3) for p in (tx, rx)]
    flat = (array.reshape(-1, depth, *array.shape[3:]) for array in (code, normal, point))
    exact = unfold(*ends, *flat)
    length = exact.length.reshape(n_link, n_path)
    departure, arrival = (v.reshape(n_link, n_path, 3) for v in (exact.departure, exact.arrival))
    fields = (
        field_vector(jnp.asarray(k), pattern=pattern, polarization=polarization)
        for k in (departure, -arrival)
    )
    delay = length / speed_of_light
    return validate(
        PathSet(
            delay=jnp.asarray(delay),
            carrier_phasor=jnp.asarray(np.exp(-2j * np.pi * np.mod(frequency * delay, 1))),
            departure=jnp.asarray(departure),
            arrival=jnp.asarray(arrival),
            mask=jnp.asarray(mask),
            interaction=jnp.asarray(code),
            object=jnp.asarray(index),
            vertex=jnp.asarray(exact.vertex.reshape(n_link, n_path, depth, 3)),
            normal=jnp.asarray(normal),
            length=jnp.asarray(length),
            **dict(zip(("tx_field", "rx_field"), fields, strict=True)),
            rx_position=jnp.asarray(rx),
            tx_position=jnp.asarray(tx),
            object_material=jnp.asarray([0, 0, 0, 0, 1, 1, 2]),
            permittivity=jnp.asarray([4.0, 4.5, 3.1, 5.2, 5.3, 2.0, 2.7]),
            conductivity=jnp.asarray([conductivity] * 7),
            thickness=jnp.asarray([0.1, 0.12, 0.2, 0.05, 0.3, 0.02, 0.03]),
            frequency=frequency,
            object_names=NAMES,
            material_names=("wall", "slab", "board"),
            provenance=(("solver", "by hand"),),
        )
    )


def _paths_of(tx, rx):
    """The steps of every path from tx to rx, as (code, object) pairs in order."""
    chains = [(), *((i,) for i in range(6)), *((i, j) for i, j in itertools.permutations(range(6), 2))]
    for chain in chains:
        points = _vertices(tx, rx, chain)
        if points is None:
            continue
        steps = []
        for number, (a, b) in enumerate(itertools.pairwise(points)):
            if (a[0] - PARTITION) * (b[0] - PARTITION) < 0:
                steps.append((REFRACTION, 6))
            if number < len(chain):
                steps.append((SPECULAR, chain[number]))
        yield steps


def _vertices(tx, rx, chain):
    """Ends and points of reflection of a chain of walls, or None where a point lies outside its wall."""
    images = [tx]
    for number in chain:
        point, normal = plane(number)
        images.append(images[-1] - 2 * np.dot(images[-1] - point, normal) * normal)
    points, target = [rx], rx
    for number, image in zip(reversed(chain), reversed(images), strict=False):
        point, normal = plane(number)
        slope = np.dot(image - target, normal)
        if abs(slope) < 1e-9:
            return None
        fraction = np.dot(point - target, normal) / slope
        if not 0 < fraction < 1:
            return None
        target = target + fraction * (image - target)
        points.append(target)
    inside = all(np.all((p > LOW - 1e-9) & (p < HIGH + 1e-9)) for p in points)
    return [tx, *reversed(points)] if inside else None


def slab(cosine, wall, frequency, law="slab"):
    """Coefficients r_te, r_tm, t_te, t_tm as ITU-R P.2040 prints them, in complex arithmetic."""
    permittivity, conductivity, thickness = wall
    eta = permittivity - 1j * conductivity / (2 * np.pi * frequency * epsilon_0)
    a = np.sqrt(eta - (1 - cosine**2))
    te, tm = (cosine - a) / (cosine + a), (eta * cosine - a) / (eta * cosine + a)
    q = 2 * np.pi * thickness * frequency / speed_of_light * a
    once = np.exp(-1j * q)
    if law == "half_space":
        return te, tm, (1 - te**2) * once, (1 - tm**2) * once
    bottom_te, bottom_tm = 1 - te**2 * once**2, 1 - tm**2 * once**2
    reflected = te * (1 - once**2) / bottom_te, tm * (1 - once**2) / bottom_tm
    return *reflected, (1 - te**2) * once / bottom_te, (1 - tm**2) * once / bottom_tm


def gain(paths, place, vertex, walls, *, vertical=False, law="slab"):
    """The gain of one path from its vertices, by a basis across and in the plane of incidence at each wall.

    `walls` is permittivity, conductivity and thickness, each of all objects; `vertical` takes isotropic
    vertical antennas in the directions of the vertices, in place of those of the path set.
    """
    link, path = place
    code = np.asarray(paths.interaction[link, path])
    count = np.count_nonzero(code)
    ends = np.asarray(paths.tx_position[link]), np.asarray(paths.rx_position[link])
    legs = np.diff(np.vstack([ends[0], np.asarray(vertex)[:count], ends[1]]), axis=0)
    length = np.linalg.norm(legs, axis=1)
    k = legs / length[:, None]
    if vertical:
        sending, receiving = theta_hat(k[0]), theta_hat(-k[-1])
    else:
        sending, receiving = (np.asarray(f[link, path]) for f in (paths.tx_field, paths.rx_field))
    field = np.asarray(sending, complex)
    for step in range(count):
        n, item = np.asarray(paths.normal[link, path, step]), int(paths.object[link, path, step])
        across = np.cross(k[step], n)
        if np.linalg.norm(across) < 1e-9:  # normal incidence: any direction in the wall does
            across = np.cross(k[step], [0.3, 0.5, 0.8])
        across = across / np.linalg.norm(across)
        before, after = np.cross(k[step], across), np.cross(k[step + 1], across)
        material = [float(values[item]) for values in walls]
        r_te, r_tm, t_te, t_tm = slab(abs(k[step] @ n), material, paths.frequency, law)
        te, tm = (r_te, r_tm) if code[step] == SPECULAR else (t_te, t_tm)
        field = te * (field @ across) * across + tm * (field @ before) * after
    return speed_of_light / paths.frequency / (4 * np.pi * length.sum()) * np.conj(receiving) @ field


def theta_hat(k):
    """The unit vector towards larger zenith angles."""
    rho = np.hypot(k[0], k[1])
    return np.array([k[2] * k[0] / rho, k[2] * k[1] / rho, -rho])


def gains(paths, walls, law="slab"):
    """`gain` of all paths, 0 where there is none."""
    result = np.zeros((paths.n_link, paths.n_path), complex)
    for link, path in np.argwhere(np.asarray(paths.mask)):
        result[link, path] = gain(paths, (link, path), paths.vertex[link, path], walls, law=law)
    return result
