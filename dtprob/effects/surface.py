"""What walls are made of and how rough they are."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dtprob.effects.common import (
    SIDES,
    Data,
    Family,
    Sites,
    half_normal,
    has_phase,
    meets,
    normal,
    offers,
    phasor,
    touched_objects,
)
from dtprob.effects.effect import Effect, Parameter, Rewrite
from dtprob.effects.elements import gain_of_field
from dtprob.effects.unfolding import mirror
from dtprob.raytracing.paths import REFRACTION, SPECULAR, PathSet


def material_mismatch(sites: Sites, data: Data) -> list[Effect]:
    """One object, or everything of one known material, is of another than the twin takes it for."""
    if not offers(sites, "permittivity", "conductivity"):
        return []

    def shift(indices: Sequence[int]) -> dict[str, Rewrite]:
        def permittivity(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
            return value + _only(value, indices) * (value - 1.0) * jnp.expm1(p["log_contrast"])

        def conductivity(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
            return value + _only(value, indices) * value * jnp.expm1(p["log_conductivity"])

        return {"permittivity": permittivity, "conductivity": conductivity}

    single = [((index,), name, name) for index, name in touched_objects(data)]
    return [
        Effect(
            "material_mismatch",
            shift(indices),
            (normal("log_contrast", 0.4), normal("log_conductivity", 1.0)),
            instance=instance,
            physics=f"Permittivity and conductivity of {text} differ from those of its material.",
            source="eps' - 1 = (eps - 1) exp(a), sigma' = sigma exp(b); the coefficients follow.",
        )
        for indices, instance, text in [*single, *_classes(sites, data)]
    ]


def _classes(sites: Sites, data: Data) -> list[tuple[tuple[int, ...], str, str]]:
    """Objects, instance and text of each material of several objects, unless the model fits materials."""
    paths: PathSet | None = data.get("paths")
    if paths is None or "material_permittivity" in sites:
        return []
    members: dict[str, list[int]] = {}
    for index, _ in touched_objects(data):
        name = paths.material_names[int(np.asarray(paths.object_material)[index])]
        members.setdefault(name, []).append(index)
    several = {name: tuple(found) for name, found in members.items() if len(found) > 1}
    return [(found, f"all_{name}", f"everything of {name}") for name, found in several.items()]


def thickness_mismatch(sites: Sites, data: Data) -> list[Effect]:
    """One wall is thicker or thinner than the twin takes it for."""
    if not offers(sites, "thickness") or data.get("law") == "half_space":
        return []

    def shift(index: int) -> Rewrite:
        def thickness(value: Any, p: Mapping[str, Any], _: Mapping[str, Any]) -> Any:
            return value + _only(value, [index]) * value * jnp.expm1(p["log_thickness"])

        return thickness

    return [
        Effect(
            "thickness_mismatch",
            {"thickness": shift(index)},
            (normal("log_thickness", 0.2),),
            instance=name,
            physics=f"Thickness of {name}, which its slab coefficients swing with.",
            source="d' = d exp(c).",
        )
        for index, name in touched_objects(data)
    ]


def reflection_loss(sites: Sites, data: Data) -> list[Effect]:
    """Every reflection from an object has an extra loss and phase."""
    return _per_object(
        "reflection_loss",
        sites,
        data,
        SPECULAR,
        change=_each_time(SPECULAR),
        parameters=(normal("loss", 0.3, "Np"), normal("phase", 0.3, "rad")),
        physics="Each reflection from {} is weaker and turned, at any angle: coating, texture.",
        source="a exp(n (-l + j phi)), n reflections.",
    )


def rough_surface(sites: Sites, data: Data) -> list[Effect]:
    """An object is rough, which weakens steep reflections more than grazing ones."""

    def change(index: int) -> Rewrite:
        def weaken(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
            paths = context["paths"]
            seen = jnp.where(meets(paths, index, (SPECULAR,)), _cosines(paths) ** 2, 0.0)
            return value * jnp.exp(-p["roughness"] * jnp.sum(seen, axis=-1))

        return weaken

    return _per_object(
        "rough_surface",
        sites,
        data,
        SPECULAR,
        change=change,
        parameters=(half_normal("roughness", 0.3),),
        physics="Rayleigh roughness 8 (pi h / lambda)^2 of {}, h its rms height.",
        source="exp(-8 (pi h cos(theta) / lambda)^2): W. Ament, Proc. IRE 41 (1953).",
    )


def penetration(sites: Sites, data: Data) -> list[Effect]:
    """Every passage through an object has an extra loss and phase."""
    return _per_object(
        "penetration",
        sites,
        data,
        REFRACTION,
        change=_each_time(REFRACTION),
        parameters=(normal("loss", 0.3, "Np"), normal("phase", 0.3, "rad")),
        physics="Each passage through {} is weaker and turned: layers, insulation, furniture.",
        source="a exp(n (-l + j phi)), n passages; ITU-R P.2040.",
    )


def polarization_mismatch(sites: Sites, data: Data) -> list[Effect]:
    """The polarisation of the antennas at one end is rotated or elliptic."""
    if not offers(sites, "path_gain", "permittivity", "conductivity") or data.get("paths") is None:
        return []
    return [
        Effect(
            "polarization_mismatch",
            {"path_gain": _polarized(side)},
            (normal("rotation", 0.2, "rad"), normal("ellipticity", 0.1, "rad")),
            instance=side,
            physics=f"The field of the {side} antennas is turned about the path and gets a quadrature part.",
            source="F' = cos r (cos e F + j sin e k x F) + sin r k x F; the gain is linear in F.",
            requires=("paths", "permittivity", "conductivity"),
        )
        for side in SIDES
    ]


def _polarized(side: str) -> Rewrite:
    """Adds the gain that the change of one end's field vector gives."""

    def rotate(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
        paths: PathSet = context["paths"]
        direction, element = (
            (paths.arrival, paths.rx_field) if side == "rx" else (paths.departure, paths.tx_field)
        )
        along = jnp.cos(p["rotation"]) * jnp.cos(p["ellipticity"]) - 1.0
        crossed = jnp.sin(p["rotation"]) + 1j * jnp.cos(p["rotation"]) * jnp.sin(p["ellipticity"])
        change = along * element + crossed * jnp.cross(direction, element)
        return value + gain_of_field(side, change, context)

    return rotate


def _each_time(code: int) -> Callable[[int], Rewrite]:
    """For an object, the loss and phase that every interaction of one kind with it adds to a path."""

    def change(index: int) -> Rewrite:
        def weaken(value: Any, p: Mapping[str, Any], context: Mapping[str, Any]) -> Any:
            count = jnp.sum(meets(context["paths"], index, (code,)), axis=-1)
            return value * jnp.exp(-p["loss"] * count) * phasor(p["phase"] * count)

        return weaken

    return change


def _only(value: Float[Array, " object"], indices: Sequence[int]) -> Array:
    return jnp.isin(jnp.arange(value.shape[0]), jnp.asarray(indices))


def _per_object(
    family: str,
    sites: Sites,
    data: Data,
    code: int,
    *,
    change: Callable[[int], Rewrite],
    parameters: tuple[Parameter, ...],
    physics: str,
    source: str,
) -> list[Effect]:
    """One effect on the path gain for each object that paths meet by one kind of interaction."""
    if not offers(sites, "path_gain") or data.get("paths") is None:
        return []
    paths: PathSet = data["paths"]
    kept = parameters if has_phase(sites) else tuple(p for p in parameters if p.name != "phase")
    rewrite = change if has_phase(sites) else lambda index: _without_phase(change(index))
    return [
        Effect(
            family,
            {"path_gain": rewrite(index)},
            kept,
            instance=name,
            physics=physics.format(name),
            source=source,
            requires=("paths",),
        )
        for index, name in touched_objects(data)
        if np.any(np.asarray(meets(paths, index, (code,))))
    ]


def _without_phase(rewrite: Rewrite) -> Rewrite:
    return lambda value, p, context: rewrite(value, {"phase": 0.0, **p}, context)


def _cosines(paths: PathSet) -> Float[Array, "link path depth"]:
    """Cosine of the angle of incidence at every step."""
    direction, cosines = jnp.asarray(paths.departure), []
    for step in range(paths.depth):
        normal_ = jnp.asarray(paths.normal)[:, :, step]
        cosines.append(jnp.abs(jnp.sum(direction * normal_, -1)))
        direction = mirror(direction, normal_, jnp.asarray(paths.interaction)[:, :, step] == SPECULAR)
    return jnp.stack(cosines, axis=-1) if cosines else jnp.zeros((*direction.shape[:2], 0))


FAMILIES: Final[dict[str, Family]] = {
    "material_mismatch": material_mismatch,
    "thickness_mismatch": thickness_mismatch,
    "reflection_loss": reflection_loss,
    "rough_surface": rough_surface,
    "penetration": penetration,
    "polarization_mismatch": polarization_mismatch,
}
