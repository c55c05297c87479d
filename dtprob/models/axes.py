"""Names of the axes of sites: of plates, or as the author of a model gave them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from dtprob.errors import InputError

_UNNAMED: Final = "_dim_"


def unnamed_axes(site: str, count: int) -> tuple[str, ...]:
    """Names of the axes of a site, or of any array, that nothing names."""
    return tuple(f"{site}{_UNNAMED}{i}" for i in range(count))


def is_unnamed(axis: str) -> bool:
    """Whether an axis got its name from its site alone, since nothing in the model names it."""
    return _UNNAMED in axis


def axes_of(
    name: str,
    shape: tuple[int, ...],
    frames: Sequence[Any],
    event_dim: int,
    declared: tuple[str, ...] | None,
) -> tuple[str, ...]:
    """Names of the axes of a site of a shape.

    Args:
        name: of the site.
        shape: of its value.
        frames: the plates that it lies in.
        event_dim: how many of the last axes no plate is of.
        declared: as the author names them.

    Raises:
        InputError: the author names more axes or fewer.
    """
    if declared is not None:
        if len(declared) != len(shape):
            raise InputError(
                f"axes of site {name!r}",
                f"{len(shape)} names for shape {shape}",
                f"{len(declared)}: {', '.join(declared)}",
                "Name every dimension, first to last.",
            )
        return declared
    axes = list(unnamed_axes(name, len(shape)))
    for frame in frames:
        position = len(shape) - event_dim + frame.dim
        if 0 <= position < len(shape) and shape[position] == frame.size:
            axes[position] = frame.name
    return tuple(axes)


def lent(
    shape: tuple[int, ...], axes: tuple[str, ...], observed: Sequence[tuple[tuple[int, ...], tuple[str, ...]]]
) -> tuple[str, ...]:
    """Axes of a site, those that nothing names called as the axes of observed sites that they go with.

    These are the last ones of what the site is broadcast to; or the first ones of the site itself where it has more, as the
    logits of classes have. Where observed sites do not agree, the axes stay unnamed.

    Args:
        shape: of the site.
        axes: of the site.
        observed: shapes and axes of the observed sites.
    """
    found = list(axes)
    fits = [names[len(names) - len(shape) :] for wide, names in observed if _is_part(shape, wide)]
    if not fits:
        fits = [names for wide, names in observed if _leads(wide, shape)]
    for i, axis in enumerate(axes):
        names = {one[i] for one in fits if i < len(one)}
        if is_unnamed(axis) and shape[i] > 1 and len(names) == 1 and not names & {*axes}:
            found[i] = names.pop()
    return tuple(found)


def _is_part(shape: tuple[int, ...], wide: tuple[int, ...]) -> bool:
    """Whether a shape of some size is broadcast to another one."""
    ends = wide[len(wide) - len(shape) :]
    return 0 < len(shape) <= len(wide) and all(n in (1, m) for n, m in zip(shape, ends, strict=True))


def _leads(wide: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    """Whether a longer shape begins with an observed one, of whose sizes none comes again, as in a square matrix."""
    return _is_part(shape[: len(wide)], wide) and not set(wide) & set(shape[len(wide) :])
