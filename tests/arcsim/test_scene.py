"""Scene files: every field honoured or refused by name; a written scene loads to the same System."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import torch

from diffcloud.arcsim.load import load_scene
from diffcloud.arcsim.write import write_scene
from diffcloud.errors import MeshError, SceneError
from diffcloud.io.obj import write_cloth, write_surface
from diffcloud.mesh import SurfaceMesh, grid_cloth
from diffcloud.scene import load_scenario

MATERIAL = {"density": 0.3, "stretching": [[30, 1, 40, 20]] * 6, "bending": [[1e-5] * 5] * 3}


@pytest.fixture
def folder(tmp_path):
    write_cloth(tmp_path / "meshes" / "cloth.obj", grid_cloth(3, 3, 0.4, 0.4))
    plane = np.array([[-1.0, -1, -0.1], [1, -1, -0.1], [1, 1, -0.1], [-1, 1, -0.1]])
    write_surface(tmp_path / "meshes" / "plane.obj", SurfaceMesh(plane, np.array([[0, 1, 2], [0, 2, 3]])))
    (tmp_path / "materials").mkdir()
    (tmp_path / "materials" / "m.json").write_text(json.dumps(MATERIAL))
    (tmp_path / "conf").mkdir()
    return tmp_path


def scene_data(**changes):
    data = {
        "frame_time": 0.04,
        "frame_steps": 2,
        "end_time": 1.01,
        "cloths": [
            {
                "mesh": "meshes/cloth.obj",
                "materials": [{"data": "materials/m.json", "thicken": 2, "stretching_mult": 3, "damping": 0.01}],
                "remeshing": {"refine_angle": 0.3},
            }
        ],
        "motions": [
            [{"time": 0}, {"time": 1, "transform": {"translate": [0, 0, 1], "scale": 0.5, "rotate": [30, 0, 0, 1]}}]
        ],
        "handles": [{"nodes": [0, 2], "end_time": 2}, {"nodes": [8], "motion": 0, "start_time": 0.1, "fade_time": 0.2}],
        "obstacles": [{"mesh": "meshes/plane.obj", "movable": 0, "transform": {"translate": [0, 0, -0.05]}}],
        "disable": ["remeshing"],
        "gravity": [0, 0, -30],
        "wind": {"density": 1.2, "velocity": [1, 0, 0], "drag": 0.1},
        "friction": 0.5,
        "obs_friction": 0.2,
        "magic": {"repulsion_thickness": 5e-3, "collision_stiffness": 1e6, "handle_stiffness": 500},
    }
    data.update(changes)
    return data


def write(folder, data):
    path = folder / "conf" / "scene.json"
    path.write_text(json.dumps(data))
    return path


def test_every_field_reaches_the_system(folder):
    scene = load_scene(write(folder, scene_data()))
    system, state = scene.build()
    assert system.time_step == 0.02
    assert scene.default_frames == 26
    assert scene.material.density == pytest.approx(0.6)
    assert scene.material.stretching[0, 0] == pytest.approx(30 * 2 * 3)
    assert scene.material.bending[0, 0] == pytest.approx(2e-5)
    assert float(system.properties.damping) == 0.01
    assert float(system.properties.air_density) == 1.2
    assert float(system.properties.air_drag) == 0.1
    assert float(system.properties.self_friction) == 0.5
    assert float(system.properties.friction) == 0.2
    assert (system.scene.terms.air.wind == [1, 0, 0]).all()
    assert (system.scene.terms.gravity.acceleration == [0, 0, -30]).all()
    assert system.handles.nodes == [0, 2, 8]
    assert system.handles.stiffness == 500
    assert system.handles.handles[2].start == 0.1
    assert system.handles.handles[2].fade == 0.2
    assert system.scene.collides
    assert not len(system.scene.plane_offsets)  # planes are met as meshes
    planes, _ = replace(scene, surrounding=replace(scene.surrounding, reference_contact=None)).build()
    assert planes.scene.plane_offsets.tolist() == pytest.approx([-0.15])
    assert planes.scene.projection.thickness == pytest.approx(5e-4)
    assert float(system.properties.node_mass.sum()) == pytest.approx(0.6 * 0.16)
    linear, translation = system.handles.handles[2].motion.at(np.array([1.0]))
    assert translation.tolist() == [[0, 0, 1]]
    assert np.linalg.det(linear[0]) == pytest.approx(0.125)
    assert state.positions.shape == (1, 9, 3)


def test_reloading_materials_keeps_multipliers_in_the_masses_only(folder):
    """What the published experiments do (their quirk)."""
    scene = load_scene(write(folder, scene_data()), reload_materials=True)
    system, _ = scene.build()
    assert scene.material.stretching[0, 0] == 30
    assert float(system.properties.node_mass.sum()) == pytest.approx(0.6 * 0.16)


def assert_same(a, b, path="system"):
    """Deep equality of named tuples and dataclasses of tensors and arrays."""
    assert type(a) is type(b), path
    if isinstance(a, torch.Tensor):
        assert torch.equal(a, b), path
    elif isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b, err_msg=path)
    elif is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name), f"{path}.{field.name}")
    elif isinstance(a, tuple | list):
        assert len(a) == len(b), path
        for index, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{path}[{index}]")
    elif isinstance(a, float):
        assert a == pytest.approx(b, rel=1e-12, abs=1e-12), path
    else:
        assert a == b, path


@pytest.mark.parametrize("source", ["file", "lift", "fold", "band_stretch", "vest_hang", "recorded_lift"])
def test_a_written_scene_loads_to_the_same_system(folder, tmp_path, source):
    scene = load_scene(write(folder, scene_data())) if source == "file" else load_scenario(source).scene
    again = load_scene(write_scene(scene, tmp_path / "written"))
    (first, _), (second, _) = again.build(), scene.build()
    assert_same(first.scene, second.scene, "scene")
    assert_same(first.properties, second.properties, "properties")
    assert_same(first.handles, second.handles, "handles")
    assert (again.frame_time, again.frame_steps, again.end_time) == (scene.frame_time, scene.frame_steps, scene.end_time)


def test_grippers_that_move_alike_stay_two(tmp_path):
    """Their names are not kept."""
    scene = load_scenario("shake").scene
    again = load_scene(write_scene(scene, tmp_path / "written"))
    names = [[handle.gripper for handle in one.handles.handles] for one in (scene, again)]
    assert len(set(names[0])) == len(set(names[1])) == len(set(zip(*names, strict=True))) == 2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"colour": 3}, "colour: unknown or unsupported field"),
        ({"magic": {"repulsion": 1}}, "magic.repulsion: unknown or unsupported"),
        ({"disable": []}, "remeshing is not supported"),
        ({"disable": ["remeshing", "physics"]}, "'physics' is not supported"),
        ({"disable": ["remeshing", "everything"]}, "disable.1"),
        ({"obstacles": [{"mesh": "meshes/plane.obj"}]}, r"obstacles.0 is movable .*must be closed.*set its `movable` to 0"),
        ({"handles": [{"nodes": [9]}]}, r"node 9 does not exist, the cloth has nodes 0\.\.8"),
        ({"handles": [{"nodes": [0], "motion": 4}]}, "handles.0.motion: 4, but the scene has 1"),
        ({"handles": [{"nodes": [0], "type": "glue"}]}, "handles.0.type"),
        (
            {"motions": [[{"time": 0}, {"time": 0.1, "transform": {"scale": 0}}]]},
            r"handles.1.motion: motion 0 has shrunk the cloth .* takes hold, at 0\.1 s",
        ),
        ({"frame_time": -1}, "frame_time.*greater than 0"),
        ({"gravity": [0, 0]}, "gravity"),
        ({"cloths": []}, "cloths"),
        ({"motions": [[{"time": 1}, {"time": 0}]]}, "increasing times"),
    ],
)
def test_unknown_unsupported_and_wrong_fields_are_refused_by_name(folder, changes, message):
    with pytest.raises(SceneError, match=message):
        load_scene(write(folder, scene_data(**changes)))


def test_unsupported_material_fields_and_tables(folder):
    data = scene_data()
    data["cloths"][0]["materials"][0]["yield_curv"] = 3
    with pytest.raises(SceneError, match=r"cloths.0.materials.0.yield_curv"):
        load_scene(write(folder, data))
    (folder / "materials" / "m.json").write_text(json.dumps({**MATERIAL, "bending": [[1, 2], [3]]}))
    with pytest.raises(SceneError, match="rectangular"):
        load_scene(write(folder, scene_data()))
    (folder / "materials" / "m.json").write_text(json.dumps({**MATERIAL, "reuse": 1}))
    with pytest.raises(SceneError, match=r"a material has the fields"):
        load_scene(write(folder, scene_data()))


def test_paths_must_stay_inside(folder):
    outside = folder.parent / "outside.json"
    outside.write_text(json.dumps(MATERIAL))
    data = scene_data()
    data["cloths"][0]["materials"][0]["data"] = "../outside.json"
    with pytest.raises(SceneError, match="leaves the scene's folder"):
        load_scene(write(folder, data))
    data = scene_data()
    data["cloths"][0]["mesh"] = "meshes/none.obj"
    with pytest.raises(SceneError, match="no folder above it holds"):
        load_scene(write(folder, data))


def test_comments_are_read_over_and_text_with_slashes_is_kept(folder):
    """As ARCSim's reader does, in scenes and in materials."""
    plain, written = scene_data(), folder / "conf" / "commented.json"
    plain["cloths"][0]["mesh"] = "meshes//cloth.obj"
    plain["cloths"][0]["materials"][0]["data"] = "materials/#m/*.json"
    (folder / "materials" / "#m").mkdir()
    text = json.dumps(MATERIAL, indent=1).replace(",\n", ', // "stiff", {\n')
    (folder / "materials" / "#m" / "*.json").write_text("/* by hand\n // twice */\n" + text + "# end")
    written.write_text('// a "scene" */\n' + json.dumps(plain, indent=1).replace(",\n", ", /* , */ // }\n"))
    (folder / "conf" / "plain.json").write_text(json.dumps(plain))
    commented, expected = load_scene(written), load_scene(folder / "conf" / "plain.json")
    for field in fields(expected.mesh):
        np.testing.assert_array_equal(getattr(commented.mesh, field.name), getattr(expected.mesh, field.name))
    assert commented.material.density == expected.material.density
    written.write_text('{"a": 1 /* no end }')
    with pytest.raises(SceneError, match=r"is not readable JSON: .*line 1 column 9"):
        load_scene(written)


def test_damaged_scene_files(folder):
    path = folder / "conf" / "scene.json"
    path.write_text("{]")
    with pytest.raises(SceneError, match="not readable JSON"):
        load_scene(path)
    with pytest.raises(SceneError, match="No such file"):
        load_scene(folder / "conf" / "none.json")
    (folder / "meshes" / "cloth.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    with pytest.raises(MeshError, match="no area"):
        load_scene(write(folder, scene_data()))
