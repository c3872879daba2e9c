"""Default cloth and fit settings of the command `fit` and the library, each with its reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from diffcloud.errors import ConfigError, EpisodeError
from diffcloud.estimation.settings import FitSettings
from diffcloud.identification.hanging import HANG_FIELDS, find_hanging, hanging_size, hangs, prepared
from diffcloud.identification.meshes import MESH_FIELDS, find_mesh
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios import Scenario
from diffcloud.scene.scenarios.layout import FIELDS, Found, Layout, find_layout, found_size, node_counts, refuse_no_track
from diffcloud.sim.grasp import GRIP_M

_DENSITY = 0.16
_MATERIAL = {"stretching_n_m": 60.0, "bending_n_m": 5e-6, "poisson": 0.2, "damping_s": 0.002}
_AROUND = {"friction": 0.4, "compression": 0.5}
_UNCERTAIN = {"friction": 2.0, "compression": 3.0, "shear": 1.2, "damping": 2.5}
_BOUNDS = {"stretching": (0.03, 30.0), "bending": (0.03, 30.0), "density": (0.2, 5.0)}
"""Search ranges as multiples of the nominal material."""
_HANGING_UNCERTAIN = {
    "compression": 3.0,
    "shear": 1.2,
    "damping": 2.5,
    "added_mass": 1.5,
    "linear_drag": 3.0,
    "air_density": 2.0,
}
"""The air's are wide: the sheet swings through it, and theory for a flat plate is a guess."""
_HANGING_NODES, _MESH_NODES = 7, 300
_STEPS = 8
_GRIP_KNOWN = 1.5


def found_cloth(
    episodes: Sequence[Episode],
    size: tuple[float, float] | None = None,
    density: float | None = None,
    mesh: Path | None = None,
) -> dict[str, Found]:
    """Return the scenario fields that all recordings of one cloth share, each with its reason.

    Args:
        size: side lengths of a rectangle [m]. Default: estimated from the first frames.
        density: measured mass per area [kg/m²].
        mesh: OBJ file of a cloth of another shape [m].

    Raises:
        EpisodeError: the recordings begin differently, or a first frame shows no cloth at rest.
        ConfigError: both size and mesh are given.
    """
    if mesh is not None and size is not None:
        raise ConfigError("--mesh states the shape of the cloth, and --size the sides of a rectangle. Give one of them.")
    hanging = [hangs(episode) for episode in episodes]
    if any(hanging) and not all(hanging):
        raise EpisodeError(
            "In some recordings the cloth hangs at the start, in others it lies flat. Fit those that hang and those "
            "that lie in two commands, with two folders for --out."
        )
    told = "as weighed" if density is not None else "usual for a knit; fitted"
    material = {"density_kg_m2": density or _DENSITY, **_MATERIAL}
    if mesh is not None:
        if any(hanging):
            raise EpisodeError(
                "The cloth hangs at the start, and --mesh takes one that lies on a table. Begin the recording on a table, "
                "or state the start in a scene file (`base: mesh`, `start: hang`) and pass it with --scene."
            )
        return _found_mesh(mesh, material, told)
    reason = "as stated"
    if size is None:
        sides = np.array([hanging_size(episode) if all(hanging) else found_size(episode) for episode in episodes])
        size = tuple(np.round(np.median(sides, axis=0), 3).tolist())
        reason = "rectangle around the first frames" + (
            f"; recordings differ by up to {np.ptp(sides, axis=0).max():.3f} m" if len(sides) > 1 else ""
        )
    if all(hanging):
        nodes = [max(round((_HANGING_NODES - 1) * side / max(size)) + 1, 4) for side in size]
        return {
            "base": Found("hang", "a rectangular cloth that hangs from the gripper"),
            "size_m": Found(list(size), reason),
            "nodes": Found(nodes, f"{_HANGING_NODES} along the longer side: a hanging cloth bends little"),
            "grip_m": Found(GRIP_M, "size of the grasp at a corner; measure your gripper's [m]"),
            "air": Found("still", "air moves with a hanging cloth; none for simulators without air"),
            "material": Found(material, f"nominal material; density {told}"),
            "compression": Found(_AROUND["compression"], "usual; fitted too, within `uncertain`"),
            "uncertain": Found(_HANGING_UNCERTAIN, "priors of what is fitted too: factors of one standard deviation"),
        }
    return {
        "base": Found("lift", "a rectangular cloth on a table"),
        "size_m": Found(list(size), reason),
        "nodes": Found(list(node_counts(size)), "13 along the longer side, and at least 5 along the other"),
        "grip": Found(
            "pad", "fingers level; or upright_pad (pinched from above), or pivot (a point that lets the cloth turn)"
        ),
        **_flat(material, told),
    }


def _found_mesh(mesh: Path, material: Mapping[str, float], told: str) -> dict[str, Found]:
    """Return the fields of a cloth of any shape."""
    if not mesh.is_file():
        raise ConfigError(f"--mesh takes an OBJ file, and there is none at {mesh}.")
    return {
        "base": Found("mesh", "a cloth in the shape of a triangle mesh"),
        "mesh": Found(str(mesh.resolve()), "as stated; its edges have their lengths at rest"),
        "nodes": Found(_MESH_NODES, "a mesh of more than 500 nodes is simplified to about this number"),
        "grip": Found("pad", "fingers level; or pivot (a point that lets the cloth turn)"),
        **_flat(material, told),
    }


def _flat(material: Mapping[str, float], told: str) -> dict[str, Found]:
    """Return the fields that all cloths on a table share."""
    return {
        "grip_m": Found(GRIP_M, "side of the pad, or of the square that a pivot stands for; measure your gripper's [m]"),
        "grip_known_within": Found(_GRIP_KNOWN, "factor within which grip_m is known; 1.05 if you have measured it"),
        "material": Found(material, f"nominal material; density {told}"),
        **{name: Found(value, "usual; fitted too, within `uncertain`") for name, value in _AROUND.items()},
        "uncertain": Found(_UNCERTAIN, "priors of what is fitted too: factors of one standard deviation"),
        "steps_per_frame": Found(_STEPS, "finer steps move a lifted cloth by less than the noise"),
    }


def starts_hanging(cloth: Mapping[str, Any]) -> bool:
    """Return whether the cloth of these fields hangs at the start."""
    return cloth["base"] == "hang" or cloth.get("start") == "hang"


def missing_fields(cloth: Mapping[str, Any], layout: Mapping[str, Any] | None = None) -> list[str]:
    """Return the names of fields that a cloth, or the layout of a recording of it, must state and does not."""
    base = cloth.get("base")
    if layout is None:
        own = {"hang": ("size_m",), "mesh": ("mesh", "grip")}.get(str(base), ("size_m", "grip", "steps_per_frame"))
        return [name for name in ("base", *own, "nodes", "material", "grip_m") if name not in cloth]
    needed: tuple[str, ...] = HANG_FIELDS if base == "hang" else FIELDS
    if base == "mesh":
        needed = MESH_FIELDS
    elif base != "hang" and "grippers" not in layout:
        needed = (*needed, "grasped")
    return [name for name in needed if name not in layout]


def found_layout(episode: Episode, cloth: Mapping[str, Any]) -> Layout:
    """Return the scenario fields of one recording, and warnings.

    Args:
        episode: recording in metres, z up, with the tracks of its grippers.
        cloth: values of the fields of `found_cloth`.

    Raises:
        EpisodeError: the recording does not show the cloth at rest, flat or hanging. The message has the reason.
    """
    refuse_no_track(episode)
    stamps = ""
    if starts_hanging(cloth):
        episode, stamps = prepared(episode)
    if cloth["base"] in ("mesh", "hang"):
        layout = (find_mesh if cloth["base"] == "mesh" else find_hanging)(episode, cloth)
        return replace(layout, warnings=(*filter(None, [stamps]), *layout.warnings))
    width, height = cloth["size_m"]
    return find_layout(episode, (float(width), float(height)), 0.0 if cloth["grip"] == "pivot" else float(cloth["grip_m"]))


def known_grip(size: float) -> dict[str, float]:
    """Return the scenario fields of a grasp with exactly known size [m]."""
    return {"grip_m": size, "grip_known_within": 1.0}


def with_density(cloth: Mapping[str, Any], density: float, deviation: float) -> dict[str, Any]:
    """Return the cloth with a measured density and its standard deviation [kg/m²], which the fit takes into account."""
    material = {**_material(cloth), "density_kg_m2": density}
    return {**cloth, "material": material, "uncertain": {**cloth.get("uncertain", {}), "density": 1 + deviation / density}}


def _material(cloth: Mapping[str, Any]) -> dict[str, Any]:
    material = cloth.get("material")
    if not isinstance(material, dict) or material.get("density_kg_m2") is None:
        raise ConfigError("--density goes with a material of stated density_kg_m2 in cloth.yaml.")
    return material


def fit_settings(
    parameters: Sequence[str] | None,
    scenario: Scenario,
    weighed: tuple[float, float] | None,
    base: FitSettings | None = None,
) -> FitSettings:
    """Return the settings of a fit.

    Args:
        parameters: parameters to estimate. Default: stretching, bending, and the density if it was not measured.
        scenario: scenario of a cloth as `found_cloth` returns it.
        weighed: density and its standard deviation [kg/m²].
        base: other settings. Its parameters, bounds and fixed values take precedence.
    """
    names = ["stretching", "bending", *(["density"] if weighed is None else [])]
    if parameters is not None:
        names = list(parameters)
    fixed = {}
    if weighed is not None and not weighed[1]:
        fixed = {"density": weighed[0]}
    bounds = {name: [part * scenario.nominal(name) for part in _BOUNDS[name]] for name in names if name in _BOUNDS}
    found: dict[str, Any] = {"parameters": names, "fixed": fixed, "bounds": bounds}
    if base is None:
        return FitSettings.model_validate(found)
    stated = base.model_dump(exclude_unset=True)
    more = {name: {**found[name], **stated.get(name, {})} for name in ("fixed", "bounds")}
    return FitSettings.model_validate({**found, **stated, **more})
