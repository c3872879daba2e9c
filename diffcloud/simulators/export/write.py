"""Write the files of each export target."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from diffcloud import __version__
from diffcloud.arcsim.write import write_scene
from diffcloud.errors import DiffCloudError
from diffcloud.estimation.record import RecordingFit
from diffcloud.estimation.result import FittedMotion, whole_material
from diffcloud.io.files import read_json, together, write_json, write_npz, write_text
from diffcloud.io.obj import write_cloth, write_surface
from diffcloud.scene.scenarios import Scenario
from diffcloud.simulators import mujoco
from diffcloud.simulators.explicit import neo_hookean_gain
from diffcloud.simulators.export.cloth import WORTH_SAYING, ExportedCloth, fitted_cloth, start_strain
from diffcloud.simulators.export.isaac import layer
from diffcloud.simulators.export.targets import TARGETS, target_named
from diffcloud.simulators.problem import Problem

_MOST_POISSON = 0.49
"""Largest Poisson's ratio for MuJoCo and Isaac Sim, which treat a membrane as a solid (below 0.5)."""


def described(one: RecordingFit, scenario: Scenario, values: Mapping[str, float]) -> dict[str, Any]:
    """Return the entries of `cloth.json` about a fit.

    Args:
        one: the recording whose motion is exported.
        values: multipliers of all parameters.
    """
    return {
        "recording": one.name,
        "rms_mm": one.rms_mm,
        "parameters": scenario.in_si(values),
        "pose": {name: entry.model_dump() for name, entry in one.nuisance.items()},
        "material": whole_material(scenario, values).model_dump(),
    }


def write_samples(
    one: RecordingFit,
    motion: FittedMotion,
    scenario: Scenario,
    drawn: Sequence[Mapping[str, float]],
    target: str,
    folder: Path,
    about: Mapping[str, Any],
) -> set[str]:
    """Export the same cloth with sampled parameters, in folders `sample_0000` and so on.

    Args:
        drawn: multipliers of all parameters, for each sample.
        about: additional entries of each `cloth.json`.

    Returns:
        Paths of the files relative to the folder.

    Raises:
        SceneError: see `write_export`.
    """
    written = set[str]()
    for number, values in enumerate(drawn):
        sample, place = fitted_cloth(one, motion, scenario, values), folder / f"sample_{number:04d}"
        names, _ = write_export(sample, target, place, {"sample": number, **about, **described(one, scenario, values)})
        written |= {f"{place.name}/{name}" for name in names}
    return written


def write_export(cloth: ExportedCloth, target: str, folder: Path, about: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """Write the files of the target, and `cloth.json`, which describes them.

    Args:
        about: additional entries of `cloth.json`.

    Returns:
        File names, and sentences about what the files lack of the cloth.

    Raises:
        ConfigError: there is no such target.
        SceneError: ARCSim's files cannot represent the scene.
    """
    chosen = target_named(target)
    left_out = [*cloth.left_out, *(cloth.simplified if chosen.simplified else ())]
    problem = cloth.problem
    with together():
        names, more = chosen.write(cloth, folder, left_out)
        left_out += more
        told = {
            "made_by": f"diffcloud {__version__}",
            "written_for": chosen.about,
            "units": "m, kg, s; z points up",
            **about,
            "isotropic_sheet": {
                "density_kg_m2": problem.sheet.density,
                "stretching_n_m": problem.sheet.stretching,
                "poisson": problem.sheet.poisson,
                "bending_n_m": problem.sheet.bending,
                "damping_s": problem.sheet.damping,
            },
            "table_m": problem.table,
            "gravity_m_s2": problem.gravity,
            "held_nodes": [int(node) for node in problem.held],
            "files": names,
            "left_out": left_out,
        }
        write_json(folder / "cloth.json", told)
    return [*names, "cloth.json"], left_out


def exported_files(folder: Path) -> set[str]:
    """List the exported files in a folder and its samples, which a new export may overwrite."""
    names = set[str]()
    for record in [folder / "cloth.json", *folder.glob("sample_[0-9][0-9][0-9][0-9]/cloth.json")]:
        try:
            told = read_json(record)
        except DiffCloudError:
            continue
        listed = told.get("files") if isinstance(told, dict) and "written_for" in told else None
        if isinstance(listed, list) and all(isinstance(name, str) for name in listed):
            names |= {(record.parent.relative_to(folder) / name).as_posix() for name in [*listed, record.name]}
    return names


def for_mujoco(problem: Problem) -> tuple[Problem, mujoco.Settings]:
    """Return the problem with damping that MuJoCo's explicit steps allow, and MuJoCo's settings."""
    settings, sheet = mujoco.stable(_as_solid(problem))
    return replace(problem, sheet=sheet), settings


def mujoco_files(cloth: ExportedCloth, folder: Path, left_out: list[str]) -> tuple[list[str], list[str]]:
    problem, settings = for_mujoco(cloth.problem)
    more = []
    if problem.sheet.damping < 0.99 * cloth.problem.sheet.damping:
        more.append(
            f"The damping is {problem.sheet.damping:.2g} s; the fit's {cloth.problem.sheet.damping:.2g} s would need "
            "steps below 20 µs."
        )
    if problem.bodies:
        more.append("MuJoCo replaces each body that the cloth meets by its convex hull.")
    if problem.shaped:
        more.append("The exported hinges are flat at rest; in the fit, they rest in the shape in which the cloth starts.")
    more += [*_less_contraction(cloth.problem), *_unstrained(cloth.problem)]
    header = f"{_head(cloth, 'mujoco')} {' '.join([*left_out, *more])}".replace("--", "-")
    write_text(folder / "cloth.xml", mujoco.model_file(problem, settings, header=header))
    return ["cloth.xml", *_script("run_mujoco.py", problem, folder)], more


def newton_files(cloth: ExportedCloth, folder: Path, left_out: list[str]) -> tuple[list[str], list[str]]:
    gain = neo_hookean_gain(cloth.problem, cloth.motion)
    more = [
        "Newton's membrane is neo-Hookean and too soft at large strains. To compensate, the stretching stiffness is "
        f"exported {gain:.3g} times as large, which brings its forces in the fitted motion closest to the sheet's.",
        *_one_friction(cloth.problem),
        *_unstrained(cloth.problem),
    ]
    return _script("run_newton.py", cloth.problem, folder, membrane_gain=gain), more


def _one_friction(problem: Problem) -> list[str]:
    among, itself = problem.frictions
    if itself == among or not problem.self_contact:
        return []
    return [f"There is one coefficient of friction, {among:.3g}; in the fit, the cloth has {itself:.3g} with itself."]


def _as_solid(problem: Problem) -> Problem:
    return replace(problem, sheet=replace(problem.sheet, poisson=min(problem.sheet.poisson, _MOST_POISSON)))


def _less_contraction(problem: Problem) -> list[str]:
    poisson = problem.sheet.poisson
    told = f"Poisson's ratio is {_MOST_POISSON:g}, the largest that can be exported; in the fit it is {poisson:.3g}."
    return [told] if poisson > _MOST_POISSON else []


def _unstrained(problem: Problem) -> list[str]:
    strain = start_strain(problem.mesh)
    told = f"The exported cloth is unstrained at the start; in the fit it is strained there by up to {strain:.0%}."
    return [told] if strain > WORTH_SAYING else []


def _script(name: str, problem: Problem, folder: Path, **changes: float) -> list[str]:
    arrays: dict[str, Any] = {key: np.asarray(value) for key, value in (problem.arrays() | changes).items()}
    write_npz(folder / "cloth.npz", **arrays)
    write_text(folder / name, (files("diffcloud.simulators.scripts") / name).read_text(encoding="utf-8"))
    return ["cloth.npz", name]


def isaac_files(cloth: ExportedCloth, folder: Path, left_out: list[str]) -> tuple[list[str], list[str]]:
    more = [
        *_one_friction(cloth.problem),
        *_less_contraction(cloth.problem),
        *_unstrained(cloth.problem),
        "This file has not been run in Isaac Sim: attributes and units are those of its published schema. That PhysX "
        "multiplies the bending stiffness by the cube of the thickness is taken from its documentation.",
    ]
    write_text(folder / "cloth.usda", layer(_as_solid(cloth.problem), _head(cloth, "isaac"), [*left_out, *more]))
    return ["cloth.usda"], more


def arcsim_files(cloth: ExportedCloth, folder: Path, left_out: list[str]) -> tuple[list[str], list[str]]:
    path = write_scene(cloth.scene, folder, "cloth")
    obstacles = [f"meshes/cloth/obstacle{number}.obj" for number in range(len(cloth.scene.surrounding.obstacles))]
    more = ["Firmly held nodes, smooth contact and second-order steps are diffcloud's own; ARCSim uses its own methods."]
    return [path.relative_to(folder).as_posix(), "meshes/cloth/cloth.obj", "materials/cloth.json", *obstacles], more


def obj_files(cloth: ExportedCloth, folder: Path, left_out: list[str]) -> tuple[list[str], list[str]]:
    problem = cloth.problem
    write_cloth(folder / "cloth.obj", problem.mesh, problem.mesh.nodes)
    names = ["cloth.obj"]
    for number, body in enumerate(problem.bodies):
        write_surface(folder / f"body{number}.obj", body)
        names.append(f"body{number}.obj")
    header = ["t_s", *(f"node{node}_{axis}" for node in problem.held for axis in "xyz")]
    places = problem.held_at(problem.times).reshape(len(problem.times), -1)
    rows = [[f"{number:.9g}" for number in row] for row in np.column_stack([problem.times, places]).tolist()]
    write_text(folder / "held.csv", "\n".join(",".join(row) for row in [header, *rows]) + "\n")
    return [*names, "held.csv"], []


def _head(cloth: ExportedCloth, target: str) -> str:
    return (
        f"{cloth.problem.name}: a cloth fitted to a recording, written by diffcloud {__version__} for "
        f"{TARGETS[target].about}. Units: m, kg, s; z points up."
    )
