"""Groups of objects that share a material in a calibration."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Int

from dtprob.errors import InputError, unknown_name
from dtprob.raytracing.paths import NONE, PathSet


def object_groups(paths: PathSet, together: Sequence[Sequence[str]]) -> Int[np.ndarray, " object"]:
    """The argument `groups` of a calibration from names: each list shares one material, other objects keep their class's.

    Args:
        paths: of the twin.
        together: names of the objects of each group.

    Raises:
        InputError: the scene has no object of a name, or one is in two groups.
    """
    label: list[str | int] = [paths.material_names[i] for i in np.asarray(paths.object_material)]
    seen: set[str] = set()
    for number, names in enumerate(together):
        for name in names:
            if name not in paths.object_names:
                raise unknown_name("object of a group", name, paths.object_names, "object")
            if name in seen:
                raise InputError("groups", "an object in one group at most", f"'{name}' in two", "Choose one")
            seen.add(name)
            label[paths.object_names.index(name)] = number
    order = {one: number for number, one in enumerate(dict.fromkeys(label))}
    return np.asarray([order[one] for one in label])


def check_groups(paths: PathSet, groups: np.ndarray) -> None:
    """Raise InputError where groups do not number the objects of a path set without gaps."""
    whole = groups.shape == (paths.n_object,) and np.issubdtype(groups.dtype, np.integer)
    if not whole or set(np.unique(groups).tolist()) != set(range(int(groups.max(initial=0)) + 1)):
        expected = f"a number from 0 on for each of the {paths.n_object} objects, none left out"
        got = np.array2string(groups, threshold=8)
        raise InputError("groups", expected, got, "Number the groups without gaps")


def untouched(paths: PathSet, groups: Int[np.ndarray, " object"]) -> Bool[np.ndarray, " object"]:
    """Objects of whose group no path of the set meets one, so that no channel tells of their material."""
    met = np.asarray(paths.mask)[:, :, None] & (np.asarray(paths.interaction) != NONE)
    return ~np.isin(groups, groups[np.unique(np.asarray(paths.object)[met])])
