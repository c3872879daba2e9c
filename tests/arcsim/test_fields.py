"""Every field of a scene file, one at a time: what it changes in the scene, and that the motion becomes another."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, get_args, get_origin

import numpy as np
import pytest
import torch
from pydantic import BaseModel

from diffcloud.arcsim.schema import SceneFile
from diffcloud.errors import SceneError
from diffcloud.io.schema import Checked
from diffcloud.scene import Scene, load_scene
from diffcloud.scene.scenarios import load_scenario
from diffcloud.sim.grasp import Grasp
from diffcloud.sim.moved import moved_surfaces
from diffcloud.sim.simulate import rollout
from diffcloud.sim.surrounding import ReferenceContact
from tests.arcsim.files import (
    Data,
    changed,
    over_movable_box,
    over_moving_box,
    sheet_over_box,
    sheets_over_table,
    write_file,
    write_files,
)

STEPS = 12
NEGLIGIBLE = 1e-9
"""[m]"""


@dataclass(frozen=True)
class Effect:
    """A field's path with a value, and what of the scene then has which value."""

    path: str
    value: Any
    probe: Callable[[Scene], Any]
    expected: Any
    base: Callable[[], Data] = sheets_over_table
    moves: bool = True
    """Whether the first steps are other ones."""


def handle_of(number: int, name: str) -> Callable[[Scene], Any]:
    return lambda scene: getattr(scene.handles.handles[number], name)


def key(name: str) -> Callable[[Scene], Any]:
    return lambda scene: getattr(scene.handles.handles[0].motion.keyframes[1], name)


def around(name: str) -> Callable[[Scene], Any]:
    return lambda scene: getattr(scene.surrounding, name)


def contact(name: str) -> Callable[[Scene], Any]:
    return lambda scene: getattr(scene.surrounding.contact, name)


def body(name: str) -> Callable[[Scene], Any]:
    return lambda scene: getattr(scene.surrounding.bodies[0], name)


def moving(name: str) -> Callable[[Scene], Any]:
    return lambda scene: getattr(scene.surrounding.moving[0], name)


def weakly_repelled() -> Data:
    """So that impacts happen."""
    return changed(sheets_over_table(), "magic.collision_stiffness", 1.0)


def pivoted() -> Data:
    return changed(sheets_over_table(), "diffcloud.grip", "pivot")


def falling_with_box() -> Data:
    return sheet_over_box() | {"gravity": [0, 0, -9.81]}


def table_normal(scene: Scene) -> Any:
    return scene.surrounding.obstacles[0].plane()[0]


def first_node(scene: Scene) -> Any:
    return scene.mesh.nodes[0]


def first_corner(scene: Scene) -> Any:
    return scene.surrounding.obstacles[0].nodes[0]


EFFECTS = [
    Effect("frame_time", 0.02, lambda scene: scene.frame_time, 0.02),
    Effect("frame_steps", 2, lambda scene: scene.time_step, 0.005),
    Effect("end_time", 0.2, lambda scene: scene.default_frames, 20, moves=False),
    Effect("end_frame", 3, lambda scene: scene.default_frames, 3, moves=False),
    Effect("cloths.0.mesh", "meshes/wide.obj", lambda scene: np.ptp(scene.mesh.verts[:9, 0]), 0.12),
    Effect("cloths.0.transform.translate", [0.01, 0, 0], first_node, [-0.04, -0.05, 0.003]),
    Effect("cloths.0.transform.scale", 1.5, first_node, [-0.075, -0.075, 0.0045]),
    Effect("cloths.0.transform.rotate", [90, 0, 0, 1], first_node, [0.05, -0.05, 0.003]),
    Effect("cloths.0.materials.0.data", "materials/heavy.json", lambda scene: scene.material.density, 0.5),
    Effect("cloths.0.materials.0.density_mult", 2, lambda scene: scene.material.density, 0.4),
    Effect("cloths.0.materials.0.stretching_mult", 2, lambda scene: scene.material.stretching[0, 0], 120),
    Effect("cloths.0.materials.0.bending_mult", 2, lambda scene: scene.material.bending[0, 0], 2e-4),
    Effect("cloths.0.materials.0.thicken", 2, lambda scene: scene.material.bending[0, 0], 2e-4),
    Effect("cloths.0.materials.0.damping", 0.01, lambda scene: scene.material.damping, 0.01),
    Effect("motions.0.1.time", 0.4, key("time"), 0.4),
    Effect("motions.0.1.transform.translate", [0, 0, 0.1], key("translation"), (0, 0, 0.1)),
    Effect("motions.0.1.transform.scale", 0.5, key("scale"), 0.5),
    Effect("motions.0.1.transform.rotate", [180, 0, 0, 1], key("quaternion"), (0, 0, 0, 1)),
    Effect("motions.0.1.velocity.translate", [0, 0, 1], key("velocity"), (0, 0, 1, 0, 0, 0, 0, 0)),
    Effect("motions.0.1.velocity.scale", 2, key("velocity"), (0, 0, 0, 2, 0, 0, 0, 0)),
    Effect("handles.0.nodes", [10], handle_of(0, "node"), 10),
    Effect("handles.1.motion", 0, lambda scene: scene.handles.moving, [True, True, True]),
    Effect("handles.0.start_time", 0.03, handle_of(0, "start"), 0.03),
    Effect("handles.0.end_time", 0.03, handle_of(0, "end"), 0.03),
    Effect("handles.1.fade_time", 0.1, handle_of(2, "fade"), 0.1),
    Effect("obstacles.0.mesh", "meshes/higher_table.obj", first_corner, [-1, -1, 0.001]),
    Effect("obstacles.0.transform.translate", [0, 0, 0.001], first_corner, [-1, -1, 0.001]),
    Effect("obstacles.0.transform.scale", 0.01, first_corner, [-0.01, -0.01, 0]),
    Effect(
        "obstacles.0.transform.rotate",
        [0.5, 0, 1, 0],
        table_normal,
        [0.008726535, 0, 0.999961923],
    ),
    Effect("obstacles.0.movable", 0, lambda scene: len(scene.surrounding.bodies), 0, falling_with_box),
    Effect("obstacles.0.motion", None, lambda scene: len(scene.surrounding.moving), 0, over_moving_box),
    Effect("obstacles.0.start_time", 0.01, moving("start"), 0.01, over_moving_box),
    Effect("obstacles.0.end_time", 0.05, moving("end"), 0.05, over_moving_box),
    Effect("obstacles.0.diffcloud.density", 50, body("density"), 50, over_movable_box),
    Effect("obstacles.0.diffcloud.mass", 0.01, body("mass"), 0.01, over_movable_box),
    Effect("obstacles.0.diffcloud.velocity", [0.1, 0, 0.2], body("velocity"), (0.1, 0, 0.2), over_movable_box),
    Effect("obstacles.0.diffcloud.angular_velocity", [3, 0, 0], body("angular_velocity"), (3, 0, 0), over_movable_box),
    Effect("gravity", [0, 0, -3], around("gravity"), (0, 0, -3)),
    Effect("wind.density", 2, around("air_density"), 2),
    Effect("wind.velocity", [0, 0, 2], around("wind"), (0, 0, 2)),
    Effect("wind.drag", 0.5, around("air_drag"), 0.5),
    Effect("friction", 0.1, around("self_friction"), 0.1),
    Effect("obs_friction", 0.1, around("friction"), 0.1),
    Effect("disable", ["remeshing", "proximity"], around("proximity"), False),
    Effect("magic.handle_stiffness", 100, lambda scene: scene.handles.stiffness, 100),
    Effect("magic.collision_stiffness", 1e4, contact("stiffness"), 1e4),
    Effect("magic.repulsion_thickness", 4e-3, contact("repulsion_thickness"), 4e-3),
    Effect("magic.projection_thickness", 2e-3, contact("projection_thickness"), 2e-3, weakly_repelled),
    Effect("diffcloud.hard_handles", True, lambda scene: scene.handles.hard, True),
    Effect("diffcloud.integrator", "implicit", lambda scene: scene.integrator, "implicit"),
    Effect("diffcloud.shaped", True, lambda scene: scene.shaped, True),
    Effect("diffcloud.contact", "planes", around("reference_contact"), None),
    Effect("diffcloud.contact", "published", around("reference_contact"), ReferenceContact.as_published()),
    Effect("diffcloud.compression", 0.1, lambda scene: scene.material.compression, 0.1),
    Effect("diffcloud.added_mass", 0.1, around("added_mass"), 0.1),
    Effect("diffcloud.linear_drag", 0.5, around("linear_drag"), 0.5),
    Effect("diffcloud.grip", "pivot", lambda scene: scene.handles.grasp, Grasp("pivot", 0.02)),
    Effect("diffcloud.grip_m", 0.03, lambda scene: scene.handles.grasp, Grasp("pivot", 0.03), pivoted),
    Effect("diffcloud.damping", 0.01, lambda scene: scene.material.damping, 0.01),
]
REFUSED = [
    ("handles.0.type", "glue", "handles.0.type"),
    ("motions.0.1.velocity.rotate", [10, 0, 0, 1], "velocity with rotation"),
    ("magic.rib_stiffening", 2, "only 1 is supported"),
]
"""Fields with one value only, another one, and what the error says."""
WITHOUT_EFFECT = [("cloths.0.remeshing", {"refine_angle": 0.3}), ("magic.edge_flip_threshold", 0.1)]
"""Of remeshing, which must be disabled."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("scene"))


def trajectory(scene: Scene) -> torch.Tensor:
    """Everything that moves in the first steps, one node after the other."""
    system, _ = scene.build()
    run = rollout(system, STEPS)
    moved, _ = moved_surfaces(system, run)
    return torch.cat([run.positions[0], torch.from_numpy(moved[0])], dim=1)


@pytest.fixture(scope="module")
def unchanged(folder):
    """A function from a base to its scene and motion."""

    @cache
    def made(base: Callable[[], Data]) -> tuple[Scene, torch.Tensor]:
        scene = load_scene(write_file(folder, base()))
        return scene, trajectory(scene)

    return made


@pytest.mark.parametrize("effect", EFFECTS, ids=lambda effect: effect.path)
def test_a_field_changes_the_scene_and_its_motion(folder, unchanged, effect):
    before, course = unchanged(effect.base)
    scene = load_scene(write_file(folder, changed(effect.base(), effect.path, effect.value)))
    try:
        same = effect.probe(before) == pytest.approx(effect.expected)
    except TypeError:  # nothing where there will be numbers
        same = False
    assert not same
    assert effect.probe(scene) == pytest.approx(effect.expected)
    if effect.moves:
        other = trajectory(scene)
        assert other.isfinite().all()
        assert other.shape != course.shape or float((other - course).abs().max()) > NEGLIGIBLE


@pytest.mark.parametrize(("path", "value", "message"), REFUSED)
def test_fields_with_one_value(folder, path, value, message):
    with pytest.raises(SceneError, match=message):
        load_scene(write_file(folder, changed(sheets_over_table(), path, value)))


@pytest.mark.parametrize(("path", "value"), WITHOUT_EFFECT)
def test_fields_without_effect(folder, unchanged, path, value):
    scene = load_scene(write_file(folder, changed(sheets_over_table(), path, value)))
    assert torch.equal(trajectory(scene), unchanged(sheets_over_table)[1])


def paths(annotation: Any, place: str = "") -> Iterator[str]:
    """Dotted paths of all fields below a type, with * for the items of a list."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        for name, field in annotation.model_fields.items():
            nested = list(paths(field.annotation, f"{place}{name}."))
            yield from nested or [f"{place}{name}"]
    else:
        step = "*." if get_origin(annotation) is list else ""
        for part in get_args(annotation):
            yield from paths(part, place + step)


def test_every_field_of_the_schema_is_tried():
    tried = [effect.path for effect in EFFECTS] + [row[0] for row in REFUSED] + [row[0] for row in WITHOUT_EFFECT]
    named = {".".join("*" if part.isdecimal() else part for part in path.split(".")) for path in tried}
    assert named == set(paths(SceneFile))


def test_every_block_of_the_schema_is_reached():
    """So that the walk above cannot miss one."""
    words = {word for path in paths(SceneFile) for word in path.split(".")}
    blocks = [block for block in Checked.__subclasses__() if block.__module__ == SceneFile.__module__]
    assert len(blocks) > 10
    assert all(block.model_fields.keys() <= words for block in blocks)


def test_there_is_one_default_integrator(tmp_path):
    """That of scenarios and of scenes in Python; ARCSim's files have ARCSim's steps."""
    lift = load_scenario("lift").scene
    made = Scene(lift.mesh, lift.material, lift.handles, frame_time=0.1)
    assert made.integrator == lift.integrator == "implicit"
    assert made.build()[0].setup.integrator == "implicit"
    assert load_scene(write_file(write_files(tmp_path), sheet_over_box(movable=0))).integrator == "arcsim"
