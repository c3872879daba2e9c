"""Obstacles of scene files: which of them move, how, and what is refused; the published scenes as they are."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from diffcloud.arcsim.load import load_scene
from diffcloud.arcsim.schema import BodyBlock, ExtensionBlock
from diffcloud.arcsim.write import write_scene
from diffcloud.errors import MeshError, SceneError
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.moved import moved_surfaces
from diffcloud.sim.simulate import rollout
from diffcloud.sim.surrounding import ContactSettings, ReferenceContact, Surrounding
from tests.arcsim.files import (
    MESHES,
    changed,
    over_movable_box,
    over_moving_box,
    sheet_over_box,
    sheets_over_table,
    write_file,
    write_files,
)
from tests.arcsim.test_scene import assert_same
from tests.docs.examples import ROOT


@pytest.fixture
def folder(tmp_path):
    return write_files(tmp_path)


def test_what_moves_decides_the_integrator(folder):
    """ARCSim's default is movable; an obstacle with a motion is not."""
    standing = load_scene(write_file(folder, sheets_over_table()))
    pushed = load_scene(write_file(folder, sheet_over_box()))
    driven = load_scene(write_file(folder, over_moving_box()))
    for scene, integrator, counts in (
        (standing, "arcsim", (1, 0, 0)),
        (driven, "implicit", (0, 1, 0)),
        (pushed, "implicit", (0, 0, 1)),
    ):
        around = scene.surrounding
        assert scene.integrator == integrator
        assert (around.reference_contact is None) == (integrator == "implicit")
        assert (len(around.obstacles), len(around.moving), len(around.bodies)) == counts


def test_a_body_weighs_as_much_as_its_volume_of_water(folder):
    """However fine its mesh: ARCSim's 0.01 kg per node would be 0.08 kg here."""
    scene = load_scene(write_file(folder, sheet_over_box(transform={"scale": 2})))
    volume = 0.09 * 0.078 * 0.02 * 8
    assert scene.nominal("body_mass") == pytest.approx(1000 * volume)


def test_a_motion_acts_on_the_transformed_mesh_between_its_times(folder):
    data = over_moving_box()
    data["motions"] = [[{"time": 0}, {"time": 1, "transform": {"translate": [0, 0, 1], "rotate": [90, 0, 0, 1]}}]]
    data["obstacles"][0] |= {"transform": {"translate": [1, 0, 0], "scale": 2}, "start_time": 0.1, "end_time": 0.3}
    scene = load_scene(write_file(folder, data))
    system, _ = scene.build()
    run = rollout(system, 40)
    moved, faces = moved_surfaces(system, run)
    placed = MESHES["box"].nodes * 2 + [1, 0, 0]
    for step, time in ((0, 0.1), (5, 0.1), (20, 0.2), (30, 0.3), (40, 0.3)):
        part = 3 * time**2 - 2 * time**3  # a cubic from rest to rest
        # the quaternion is interpolated, then normalised
        half = np.arctan2(part * np.sin(np.pi / 4), 1 - part + part * np.cos(np.pi / 4))
        cosine, sine = np.cos(2 * half), np.sin(2 * half)
        turned = placed @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]).T
        np.testing.assert_allclose(moved[0, step], np.add(turned, [0, 0, part]), atol=1e-12)
    np.testing.assert_array_equal(faces, MESHES["box"].faces)


def test_a_body_turns_and_flies_as_it_was_sent(folder):
    """No weight, nothing near: the centre keeps its velocity, and a ball its turning."""
    own = {"velocity": [0, 0.5, 0], "angular_velocity": [0, 0, 2]}
    data = sheet_over_box(mesh="meshes/ball.obj", transform={"translate": [0, 0, -1]}, diffcloud=own)
    system, _ = load_scene(write_file(folder, data)).build()
    run = rollout(system, 50)
    moved, _ = moved_surfaces(system, run)
    nodes = np.add(MESHES["ball"].nodes, [0, 0, -1])
    centre = run.bodies.centre[0, 0, 0].numpy()
    cosine, sine = np.cos(1.0), np.sin(1.0)  # after 0.5 s
    expected = (nodes - centre) @ np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]).T + centre + [0, 0.25, 0]
    np.testing.assert_allclose(moved[0, -1], expected, atol=1e-4)  # of first order in the time step
    np.testing.assert_allclose(moved[0, 0], nodes, atol=1e-12)


MOTION = [[{"time": 0}, {"time": 1, "transform": {"scale": 0}}], [{"time": 0}]]


@pytest.mark.parametrize(
    ("obstacle", "message"),
    [
        ({"movable": 1, "motion": 1}, "obstacles.0.movable: it has a `motion`.*set `movable` to 0 or leave `motion` out"),
        ({"motion": 2}, "obstacles.0.motion: 2, but the scene has 2 motions"),
        ({"motion": -1}, "obstacles.0.motion"),
        ({"motion": 0}, "obstacles.0.motion: motion 0 shrinks the obstacle to a point"),
        ({"motion": 1, "start_time": 2, "end_time": 1}, "obstacles.0.end_time: 1.0 comes before start_time 2.0"),
        ({"start_time": 1}, "obstacles.0.start_time: of an obstacle with a `motion`"),
        ({"movable": 0, "end_time": 1}, "obstacles.0.end_time: of an obstacle with a `motion`"),
        ({"movable": 0, "diffcloud": {"mass": 1}}, "obstacles.0.diffcloud: of movable obstacles only"),
        ({"motion": 1, "diffcloud": {"mass": 1}}, "obstacles.0.diffcloud: of movable obstacles only"),
        ({"diffcloud": {"mass": 1, "density": 2}}, "obstacles.0.diffcloud: give either `density` or `mass`"),
        ({"diffcloud": {"mass": 0}}, "obstacles.0.diffcloud.mass.*greater than 0"),
        ({"diffcloud": {"spin": [0, 0, 1]}}, "obstacles.0.diffcloud.spin: unknown or unsupported field"),
        ({"mesh": "meshes/table.obj"}, "obstacles.0 is movable .*must be closed.*set its `movable` to 0"),
        ({"mesh": "meshes/box.obj", "transform": {"scale": 0}}, "obstacles.0 is movable .*volume 0"),
    ],
)
def test_obstacles_that_contradict_themselves_are_refused(folder, obstacle, message):
    with pytest.raises(SceneError, match=message):
        load_scene(write_file(folder, {**sheet_over_box(**obstacle), "motions": MOTION}))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (over_moving_box(), r"obstacles.0.motion: .*set `diffcloud.integrator` to \"implicit\" or leave it out"),
        (over_movable_box(), r"obstacles.0.movable: .*set `diffcloud.integrator` to .*or set `movable` .*to 0"),
    ],
)
def test_the_arcsim_integrator_moves_no_obstacles(folder, data, message):
    with pytest.raises(SceneError, match=message):
        load_scene(write_file(folder, changed(data, "diffcloud.integrator", "arcsim")))


@pytest.mark.parametrize("mass", [{}, {"mass": 0.02}, {"density": 200.0}])
def test_a_written_scene_has_the_same_obstacles(folder, tmp_path, mass):
    own = {"velocity": [0, 0.1, 0.2], "angular_velocity": [1, 2, 3], **mass}
    data = over_moving_box()
    data["obstacles"] = [
        {"mesh": "meshes/ball.obj", "transform": {"translate": [0.2, 0, 0]}, "diffcloud": own},
        {"mesh": "meshes/table.obj", "movable": 0, "transform": {"translate": [0, 0, -1]}},
        {
            "mesh": "meshes/box.obj",
            "motion": 0,
            "start_time": 0.01,
            "end_time": 0.1,
            "transform": {"scale": 2},
        },
    ]
    data["handles"] = [{"nodes": [0], "motion": 0}]
    scene = load_scene(write_file(folder, data))
    again = load_scene(write_scene(scene, tmp_path / "written"))
    assert again.integrator == "implicit"
    assert_same(again.surrounding, scene.surrounding, "surrounding")
    assert_same(again.handles, scene.handles, "handles")
    (first, _), (second, _) = again.build(), scene.build()
    assert_same(first.scene, second.scene, "scene")
    assert torch.equal(first.properties.body_mass, second.properties.body_mass)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"order": 1}, "order"),
        ({"surrounding": Surrounding(self_contact=False)}, "self_contact"),
        ({"surrounding": Surrounding(contact=ContactSettings(sticking_speed=1e-4))}, "sticking_speed"),
        ({"surrounding": Surrounding(forces={"wind_box": {}})}, "forces"),
        ({"surrounding": Surrounding(reference_contact=ReferenceContact(residue=1e-3))}, "reference_contact"),
        ({"surrounding": Surrounding(lagged_air=True), "integrator": "arcsim"}, "lagged_air"),
        (
            {"handles": Handles((Handle(0, Motion((Keyframe(0.0),))), Handle(1, Motion((Keyframe(1.0),)))))},
            "a gripper with several motions",
        ),
    ],
)
def test_what_a_file_cannot_say_is_not_written(folder, tmp_path, changes, named):
    scene = replace(load_scene(write_file(folder, over_moving_box())), **changes)
    with pytest.raises(SceneError, match=f"no place for .*{named}"):
        write_scene(scene, tmp_path / "written")
    assert not (tmp_path / "written").exists()


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("motions.0.1.time", 0, "motions.0: .*increasing times"),
        ("obstacles.0.mesh", "meshes/none.obj", "No such mesh: .*none.obj"),
        ("cloths.0.mesh", "meshes/none.obj", "no folder above it holds 'meshes/none.obj'"),
        ("cloths.0.materials.0.data", "materials/none.json", "none.json"),
    ],
)
def test_missing_files_and_wrong_motions_are_named(folder, path, value, message):
    with pytest.raises((SceneError, MeshError), match=message):
        load_scene(write_file(folder, changed(sheets_over_table(), path, value)))


def test_the_page_of_scene_files_names_our_fields_and_shows_what_loads(folder):
    page = (ROOT / "docs" / "scenarios.md").read_text(encoding="utf-8")
    for block in (BodyBlock, ExtensionBlock):
        assert [name for name in block.model_fields if f"`{name}`" not in page] == []
    (shown,) = re.findall(r"```json\n(.*?)```", page, re.DOTALL)
    (body,) = load_scene(write_file(folder, sheet_over_box() | json.loads("{" + shown + "}"))).surrounding.bodies
    assert (body.mass, body.velocity) == (0.05, (0, 0, -1))


def test_all_published_scenes_load_and_run(release: Path):
    found = sorted((release / "conf").rglob("*.json"))
    assert len(found) >= 6
    for path in found:
        scene = load_scene(path)
        assert scene.integrator == "arcsim", path
        system, _ = scene.build()
        with torch.no_grad():
            run = rollout(system, 3 * scene.frame_steps)
        assert run.positions.isfinite().all(), path
        assert (run.positions[0, -1] - run.positions[0, 0]).abs().max() > 1e-4, path
