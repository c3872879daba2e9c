"""Small scene files: two sheets over a table, and a sheet over a box that moves or can be moved."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from diffcloud.io.obj import write_cloth, write_surface
from diffcloud.mesh import ClothMesh, SurfaceMesh, box_surface, grid_cloth, rectangle_surface, sphere_surface
from tests.sim.contact.scenes import together

Data = dict[str, Any]

MATERIAL = {"density": 0.2, "stretching": [[60, 1, 60, 15]] * 6, "bending": [[1e-4] * 5] * 3}
HEAVY = MATERIAL | {"density": 0.5}


def lifted(mesh: ClothMesh, height: float) -> ClothMesh:
    return replace(mesh, nodes=np.add(mesh.nodes, (0.0, 0.0, height)))


def sheets() -> ClothMesh:
    """Two sheets of 3 x 3 nodes, 3 and 6 mm over the ground, the upper one with a dent."""
    upper = lifted(grid_cloth(3, 3, 0.1, 0.1), 0.006)
    upper.nodes[4, 2] += 0.004
    return together(lifted(grid_cloth(3, 3, 0.1, 0.1), 0.003), upper)


MESHES: dict[str, ClothMesh | SurfaceMesh] = {
    "sheets": sheets(),
    "wide": together(lifted(grid_cloth(3, 3, 0.12, 0.12), 0.003), lifted(grid_cloth(3, 3, 0.1, 0.1), 0.006)),
    "sheet": grid_cloth(5, 5, 0.2, 0.2),
    "table": rectangle_surface([0, 0], [1, 1], 0.0),
    "higher_table": rectangle_surface([0, 0], [1, 1], 0.001),
    "box": box_surface([-0.043, -0.037, -0.02], [0.047, 0.041, 0.0]),
    "ball": sphere_surface([0.003, 0.002, -0.03], 0.029, 1),
}


def write_files(folder: Path) -> Path:
    """Meshes and materials that the scenes below name; gives the folder."""
    for name, mesh in MESHES.items():
        (write_cloth if isinstance(mesh, ClothMesh) else write_surface)(folder / "meshes" / f"{name}.obj", mesh)
    (folder / "materials").mkdir(exist_ok=True)
    for name, material in (("fabric", MATERIAL), ("heavy", HEAVY)):
        (folder / "materials" / f"{name}.json").write_text(json.dumps(material))
    (folder / "conf").mkdir(exist_ok=True)
    return folder


def write_file(folder: Path, data: Data) -> Path:
    path = folder / "conf" / "scene.json"
    path.write_text(json.dumps(data))
    return path


def sheets_over_table() -> Data:
    """The upper sheet is dragged over the lower one, which lies on a table."""
    return {
        "frame_time": 0.01,
        "cloths": [{"mesh": "meshes/sheets.obj", "materials": [{"data": "materials/fabric.json"}]}],
        "motions": [[{"time": 0}, {"time": 0.2, "transform": {"translate": [0.05, 0, 0.01]}}]],
        "handles": [{"nodes": [9], "motion": 0}, {"nodes": [15, 17], "end_time": 0.05}],
        "obstacles": [{"mesh": "meshes/table.obj", "movable": 0}],
        "disable": ["remeshing"],
        "gravity": [0, 0, -9.81],
        "magic": {"repulsion_thickness": 5e-3, "collision_stiffness": 1e5},
    }


def sheet_over_box(**obstacle: Any) -> Data:
    """A free sheet without weight, 4 mm over the top of a box."""
    return {
        "frame_time": 0.01,
        "cloths": [
            {
                "mesh": "meshes/sheet.obj",
                "materials": [{"data": "materials/fabric.json"}],
                "transform": {"translate": [0, 0, 0.004]},
            }
        ],
        "obstacles": [{"mesh": "meshes/box.obj", **obstacle}],
        "disable": ["remeshing"],
        "magic": {"repulsion_thickness": 3e-3, "collision_stiffness": 1e6},
        "wind": {"density": 0},
    }


def over_moving_box() -> Data:
    """The box rises by 4 cm in 0.2 s."""
    rise = [{"time": 0}, {"time": 0.2, "transform": {"translate": [0, 0, 0.04]}}]
    return {**sheet_over_box(motion=0), "motions": [rise]}


def over_movable_box() -> Data:
    """The box flies upwards."""
    return sheet_over_box(diffcloud={"velocity": [0, 0, 0.3]})


def changed(data: Data, path: str, value: Any) -> Data:
    """A copy in which the field at a dotted path has a value; blocks on the way are made."""
    result = place = copy.deepcopy(data)
    *blocks, last = (int(part) if part.isdecimal() else part for part in path.split("."))
    for part in blocks:
        place = place[part] if isinstance(part, int) else place.setdefault(part, {})
    place[last] = value
    return result
