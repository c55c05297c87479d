"""Paths that a twin has not but another trace of it has: kept apart in the twin's own path set.

A fuller solver finds paths that the twin cut off; a link whose transmitter stands where another is recorded has
other paths altogether. Such paths ride along masked, so that no model sums them, until an effect raises their share.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from dtprob.errors import InputError, unknown_name
from dtprob.raytracing import field
from dtprob.raytracing.paths import DIMENSIONS, PathSet

_SAME_DELAY = 1e-12  # s
_PER_PATH = tuple(name for name, dims in DIMENSIONS.items() if dims[:2] == ("link", "path"))


def strongest(paths: PathSet, count: int) -> PathSet:
    """The path set with at most so many paths per link, the strongest with the materials of the scene.

    Args:
        paths: a path set without paths of other traces.
        count: paths of each link.

    Raises:
        InputError: a count below 1.
    """
    if count < 1:
        raise InputError("strongest", "1 path per link or more", str(count), "Raise it")
    order = np.argsort(-_power(paths), axis=1, kind="stable")[:, :count]
    return _arranged(paths, order)


def with_beyond(
    paths: PathSet, name: str, other: PathSet, count: int, *, known: PathSet | None = None
) -> PathSet:
    """The path set with the strongest paths of another trace kept apart under a name; those it has itself are left out.

    Args:
        paths: the twin's.
        name: what the other trace has that the twin has not.
        other: the other trace of the same links through the same objects.
        count: at most so many paths per link.
        known: all that the twin's trace found, where `paths` is a part of it.

    Raises:
        InputError: other links, other objects, or a name that is there already.
    """
    if other.n_link != paths.n_link or other.object_names != paths.object_names:
        got = f"{other.n_link} links, {other.n_object} objects"
        expected = f"the {paths.n_link} links and {paths.n_object} objects of the twin"
        raise InputError(f"trace {name!r} beyond the twin", expected, got, "Trace the same scene")
    if name in paths.beyond_names:
        raise InputError("names of other traces", "each once", f"{name!r} twice", "Rename one")
    new = np.asarray(other.mask) & ~_known(paths if known is None else known, other)
    kept = strongest(eqx.tree_at(lambda p: p.mask, other, jnp.asarray(new)), count)
    code = np.where(np.asarray(kept.mask), len(paths.beyond_names) + 1, 0)
    own = np.zeros((paths.n_link, paths.n_path), int) if paths.beyond is None else np.asarray(paths.beyond)
    joined: dict[str, Any] = {
        n: jnp.concatenate(_deep(n, getattr(paths, n), getattr(kept, n)), axis=1)
        for n in _PER_PATH
        if n not in {"beyond", "mask"}
    }
    joined["mask"] = jnp.concatenate([paths.mask, jnp.zeros_like(kept.mask)], axis=1)
    joined["beyond"] = jnp.asarray(np.concatenate([own, code], axis=1))
    return dataclasses.replace(paths, **joined, beyond_names=(*paths.beyond_names, name))


def only(paths: PathSet, name: str) -> Bool[Array, "link path"]:
    """Which paths only one other trace has.

    Args:
        paths: a path set that has such paths.
        name: of the trace.

    Raises:
        InputError: there is no such trace.
    """
    if name not in paths.beyond_names or paths.beyond is None:
        raise unknown_name("paths beyond the twin", name, paths.beyond_names, "trace")
    return paths.beyond == paths.beyond_names.index(name) + 1


def with_all(paths: PathSet) -> PathSet:
    """The path set with the paths of other traces unmasked beside its own."""
    if paths.beyond is None:
        return paths
    return eqx.tree_at(lambda p: p.mask, paths, paths.mask | (paths.beyond > 0))


def _power(paths: PathSet) -> Float[np.ndarray, "link path"]:
    """Power of each path with the materials of the scene; 0 where there is none."""
    gain = np.asarray(field.path_gain(paths, paths.permittivity, paths.conductivity))
    return np.abs(gain) ** 2


def _arranged(paths: PathSet, order: Int[np.ndarray, "link chosen"]) -> PathSet:
    def pick(value: Array) -> Array:
        index = order.reshape(*order.shape, *[1] * (value.ndim - 2))
        return jnp.asarray(np.take_along_axis(np.asarray(value), index, axis=1))

    names = [name for name in _PER_PATH if getattr(paths, name) is not None]
    return eqx.tree_at(
        lambda p: [getattr(p, n) for n in names], paths, [pick(getattr(paths, n)) for n in names]
    )


def _deep(name: str, first: Array, second: Array) -> list[Array]:
    """Two arrays over paths with as many steps in both."""
    if "depth" not in DIMENSIONS[name]:
        return [first, second]
    depth = max(first.shape[2], second.shape[2])

    def padded(value: Array) -> Array:
        missing = depth - value.shape[2]
        return jnp.pad(value, [(0, 0), (0, 0), (0, missing), *[(0, 0)] * (value.ndim - 3)])

    return [padded(first), padded(second)]


def _known(paths: PathSet, other: PathSet) -> Bool[np.ndarray, "link path"]:
    """Which paths of the other trace the twin has: by the same objects, and as late within 1 ps."""
    found = np.zeros(other.mask.shape, bool)
    there, own_delay, delay = (np.asarray(x) for x in (paths.mask, paths.delay, other.delay))
    for link in range(other.n_link):
        own: dict[tuple[int, ...], list[float]] = {}
        for path in np.flatnonzero(there[link]):
            own.setdefault(_course(paths, link, int(path)), []).append(own_delay[link, path])
        for path in range(other.n_path):
            alike = np.asarray(own.get(_course(other, link, path), []))
            found[link, path] = np.any(np.abs(alike - delay[link, path]) <= _SAME_DELAY)
    return found


def _course(paths: PathSet, link: int, path: int) -> tuple[int, ...]:
    """What a path meets, and how."""
    code = np.asarray(paths.interaction)[link, path]
    met = np.asarray(paths.object)[link, path][code != 0]
    return (*code[code != 0].tolist(), *met.tolist())
