"""Scene files: every field honoured or refused by name; a written scene loads to the same System."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import torch

from diffcloud.errors import ConfigError, MeshError, SceneError
from diffcloud.io.obj import write_cloth, write_surface
from diffcloud.mesh import SurfaceMesh, grid_cloth
from diffcloud.scene import SCENARIO_NAMES, load_scenario, load_scene, write_scene
from diffcloud.scene.scenarios import built_in, make_scenario
from tests.sim.contact.penetration import find_penetrations, minimal_distance

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
    assert float(system.properties.friction_cloth) == 0.5
    assert float(system.properties.friction_obstacle) == 0.2
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


class TestScenarios:
    def test_names(self):
        assert SCENARIO_NAMES[:5] == ("lift", "fold", "band_stretch", "vest_hang", "shake")
        assert SCENARIO_NAMES[5:7] == ("recorded_lift", "recorded_fold")
        assert SCENARIO_NAMES[7:] == ("release_lift", "release_fold", "release_hang", "release_band")
        with pytest.raises(ConfigError, match=r"Unknown scenario 'lfit'. Did you mean 'lift'.* Allowed: .*lift"):
            load_scenario("lfit")
        with pytest.raises(ConfigError, match="needs --scene"):
            load_scenario("release_lift")
        with pytest.raises(ConfigError, match="goes with release"):
            load_scenario("lift", "x.json")

    @pytest.mark.parametrize("name", ["lift", "fold"])
    def test_built_ins_hold_what_the_paper_says(self, name):
        scenario = load_scenario(name)
        assert len(scenario.scene.mesh.nodes) == 49
        assert scenario.frames == 25
        assert scenario.scene.frame_time == pytest.approx(0.1)
        assert scenario.scene.frame_steps >= 4
        assert scenario.points == 3500
        assert scenario.scene.surrounding.gravity == (0, 0, -9.81)

    @pytest.mark.parametrize(
        ("name", "frames", "loss_frame", "points", "learning_rate"),
        [("band_stretch", 25, 24, 5500, 0.4), ("vest_hang", 15, 10, 3500, 0.3)],
    )
    def test_simulated_built_ins_hold_what_the_paper_says(self, name, frames, loss_frame, points, learning_rate):
        scenario = load_scenario(name)
        assert (scenario.frames, scenario.loss_frames) == (frames, (loss_frame,))
        assert (scenario.points, scenario.learning_rate) == (points, learning_rate)
        assert scenario.threshold == pytest.approx(5e-4 * 0.35**2)
        assert scenario.recorder == "whole_surface"
        assert scenario.scene.surrounding.gravity == (0, 0, -9.81)
        assert scenario.loss_faces is None
        assert dict(scenario.node_sets) == {}  # the mass of all nodes

    @pytest.mark.parametrize("name", ["band_stretch", "vest_hang"])
    @pytest.mark.parametrize("changes", [{}, {"pole": "round"}])
    def test_simulated_built_ins_start_clear_of_everything(self, name, changes):
        options = built_in(name)
        changes = {field: value for field, value in changes.items() if hasattr(options, field)}
        scene = make_scenario(options.model_copy(update=changes)).scene
        cloth = (scene.mesh.nodes, scene.mesh.faces)
        for obstacle in scene.surrounding.obstacles:
            assert minimal_distance(cloth, (obstacle.nodes, obstacle.faces)) >= 0.004
        assert minimal_distance(cloth, cloth, apart=True) >= 0.003
        assert not find_penetrations(scene.mesh.nodes[None], scene.mesh, scene.surrounding.obstacles)
        assert all(obstacle.plane() is None for obstacle in scene.surrounding.obstacles[:1])  # the one in the targets

    def test_the_pull_makes_the_band_taut(self):
        """From the gripper around the far side of the pole and back is longer than the band."""
        options = built_in("band_stretch")
        scenario = load_scenario("band_stretch")
        gripper = scenario.scene.mesh.nodes[scenario.grasped].mean(axis=0) + options.path[-1][1:]
        pole = scenario.scene.surrounding.obstacles[0].nodes
        far = pole[:, 1].max() - gripper[1]
        assert 2 * far > 1.05 * options.circumference_m

    def test_the_gripper_passes_the_vest_to_the_hook(self):
        """Carried down as it stands, the back of the vest, above the hook, would end below it."""
        scenario = load_scenario("vest_hang")
        nodes, (hook,) = scenario.scene.mesh.nodes, scenario.scene.surrounding.obstacles
        low, high = hook.nodes[:, 2].min(), hook.nodes[:, 2].max()
        beside = np.abs(nodes[:, 1] - hook.nodes[:, 1].mean()) < 0.1
        assert nodes[beside, 2].min() < low - 0.02
        assert nodes[beside, 2].max() > high + 0.02
        assert nodes[beside, 2].max() + built_in("vest_hang").path[-1][3] < low

    def test_bodies_to_draw_are_all_but_the_tables(self):
        scene = load_scenario("band_stretch").scene
        (pole,) = scene.surrounding.obstacles
        table = load_scenario("lift").scene.surrounding.obstacles[0]
        more = replace(scene, surrounding=replace(scene.surrounding, obstacles=(pole, table, pole)))
        np.testing.assert_array_equal(scene.bodies.faces, pole.faces)
        np.testing.assert_array_equal(more.bodies.nodes[more.bodies.faces[-1]], pole.nodes[pole.faces[-1]])
        assert len(more.bodies.faces) == 2 * len(pole.faces)
        assert len(load_scenario("lift").scene.bodies.faces) == 0

    def test_own_band_and_vest(self, tmp_path):
        (tmp_path / "b.yaml").write_text("base: band_stretch\npole: round\ncircumference_m: 1.0\nnodes: [30, 2]\n")
        band = load_scenario(tmp_path / "b.yaml")
        assert len(band.scene.mesh.nodes) == 60
        assert len(band.scene.surrounding.obstacles[0].faces) > 12
        (tmp_path / "v.yaml").write_text("base: vest_hang\ncenter_m: [0.5, 0.2, 2.0]\nhook_sides: 8\n")
        vest = load_scenario(tmp_path / "v.yaml")
        assert vest.scene.mesh.nodes[:, 1].max() == pytest.approx(0.2)  # the hem
        assert vest.scene.surrounding.obstacles[0].nodes[:, 2].mean() == pytest.approx(2.0)

    @pytest.mark.parametrize("base", ["lift", "band_stretch", "vest_hang"])
    def test_a_material_in_si(self, tmp_path, base):
        sheet = "{density_kg_m2: 0.5, stretching_n_m: 120, bending_n_m: 1.0e-4}"
        (tmp_path / "s.yaml").write_text(f"base: {base}\nmaterial: {sheet}\n")
        assert load_scenario(tmp_path / "s.yaml").scene.material.density == pytest.approx(0.5)

    @pytest.mark.parametrize("name", ["../outside", "a/b", "..", "", "a\\\\b", ".hidden"])
    def test_a_name_that_is_no_name_of_a_folder(self, tmp_path, name):
        (tmp_path / "s.yaml").write_text(f'base: lift\nname: "{name}"\n')
        with pytest.raises(SceneError, match="name"):
            load_scenario(tmp_path / "s.yaml")

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("base: band_stretch\npole_width_m: 0.6\n", "does not go around a round pole"),
            ("base: band_stretch\ngrasped_columns: 32\n", "32 grasped columns, but the band has 32"),
            ("base: band_stretch\nsize_m: [1, 1]\n", "size_m: unknown"),
            ("base: vest_hang\nhook_reach_m: 0.1\n", "past its neck end"),
            ("base: vest_hang\nhook_inset_m: 0.01\n", "hook starts"),
            ("base: vest_hang\nloss_frames: [16]\n", "loss_frames"),
        ],
    )
    def test_impossible_bands_and_vests(self, tmp_path, text, message):
        (tmp_path / "t.yaml").write_text(text)
        with pytest.raises(SceneError, match=message):
            load_scenario(tmp_path / "t.yaml")

    def test_fold_samples_the_grasped_half(self):
        scenario = load_scenario("fold")
        mesh = scenario.scene.mesh
        y = mesh.nodes[mesh.faces].mean(1)[:, 1]
        assert (y[scenario.loss_faces] < 0).all()  # the grasped corner points to -y
        assert 30 <= len(scenario.loss_faces) <= 36

    def test_own_cloth_in_ten_lines(self, tmp_path):
        path = tmp_path / "towel.yaml"
        path.write_text(
            "base: fold\nsize_m: [0.5, 0.3]\nnodes: [6, 4]\nyaw_deg: 90\ncenter_m: [0.6, 0.1]\ntable_height_m: 0.1\n"
            "material: silk\ngrasped: [left_bottom, right_bottom]\nheld: [left_top]\n"
        )
        scenario = load_scenario(path)
        mesh = scenario.scene.mesh
        assert scenario.name == "towel"
        assert scenario.grasped == [0, 1, 6, 7, 4, 5, 10, 11]
        assert set(scenario.scene.handles.nodes) - set(scenario.grasped) == {12, 13, 18, 19}
        assert np.ptp(mesh.nodes, axis=0) == pytest.approx([0.3, 0.5, 0.0])  # turned by 90 degrees
        assert mesh.nodes.mean(0) == pytest.approx([0.62, 0.1, 0.1006], abs=0.03)  # grid lines lie closer where pads end
        assert scenario.scene.material.name == "silk"
        assert scenario.scene.surrounding.obstacles[0].plane()[1] == pytest.approx(0.1 + 0.0006 - 0.0024, abs=1e-4)

    def test_grippers_of_ones_own_take_the_place_of_the_bases(self, tmp_path):
        path = tmp_path / "two.yaml"
        path.write_text(
            "base: lift\ngrip: pivot\ngrippers:\n  left: {grasped: [left_top]}\n"
            "  right: {grasped: [right_top, right_bottom], path: [[0, 0, 0, 0], [1, 0, 0, 2.5]]}\n"
        )
        scenario = load_scenario(path)
        handles = scenario.scene.handles
        assert handles.grippers == ("left", "right")
        assert [(one.node, one.gripper) for one in handles.handles] == [(42, "left"), (48, "right"), (6, "right")]
        ends = [one.motion.at(np.array([9.0]))[1][0, 2] for one in handles.handles]
        assert ends == pytest.approx([0.4, 2.5, 2.5])  # the base's path, and one's own
        table = scenario.scene.surrounding.obstacles[0]
        assert np.ptp(table.nodes[:, 0]) > 2.5  # it reaches as far as any gripper does
        path.write_text("base: shake\ngrasped: [left_top]\n")
        assert load_scenario(path).scene.handles.grippers == ("gripper",)

    def test_a_material_in_the_users_own_numbers(self, tmp_path):
        path = tmp_path / "rubber.yaml"
        path.write_text(
            "material: {youngs_modulus_pa: 1.0e+6, thickness_m: 0.002, density_kg_m3: 1100, poisson: 0.45, "
            "damping_s: 0.01}\n"
        )
        material = load_scenario(path).scene.material
        assert (material.name, material.damping) == ("rubber", 0.01)
        assert material.density == pytest.approx(2.2)
        assert material.resting_stretching_stiffness == pytest.approx(2000.0)
        assert material.resting_shear_stiffness == pytest.approx(2000.0 / 2.9)
        assert material.resting_bending_stiffness == pytest.approx(1e6 * 0.002**3 / 12)
        path.write_text("material: {stretching_n_m: 300, bending_n_m: 1.0e-5, density_kg_m2: 0.2, shear_n_m: 20}\n")
        material = load_scenario(path).scene.material
        assert (material.density, material.resting_shear_stiffness) == (0.2, 20.0)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ("{stretching_n_m: 300, thickness_m: 0.1}", "a material has either density_kg_m2"),
            ("{}", "none of them"),
            ("{stretching_n_m: -1, bending_n_m: 1, density_kg_m2: 1}", "stretching_n_m: Input should be greater than 0"),
            ("{stretching_n_m: 1, bending_n_m: 1, density_kg_m2: 1, poisson: 1}", "poisson: Input should be less than 1"),
            ("{stretch: 1}", "unknown or unsupported field"),
            ("3", "material"),
        ],
    )
    def test_wrong_materials(self, tmp_path, given, message):
        path = tmp_path / "t.yaml"
        path.write_text(f"material: {given}\n")
        with pytest.raises(SceneError, match=message):
            load_scenario(path)

    def test_own_material_file_is_found_beside_the_yaml(self, tmp_path):
        (tmp_path / "m.json").write_text(json.dumps(MATERIAL))
        (tmp_path / "t.yaml").write_text("material: m.json\n")
        assert load_scenario(tmp_path / "t.yaml").scene.material.density == 0.3

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("colour: red\n", "colour: unknown"),
            ("size_m: [0.2, -1]\n", "size_m.1"),
            ("grasped: [north]\n", "Unknown corner 'north'"),
            ("grasped: [99]\n", r"node 99 does not exist, the cloth has 0\.\.48"),
            ("held: [right_top]\n", "held twice"),
            ("grasped: []\n", "either `grasped` or `grippers`"),
            ("grippers: {a: {grasped: [right_top]}}\ngrasped: [left_top]\n", "either `grasped` or `grippers`"),
            ("grippers: {a: {grasped: [right_top]}, b: {grasped: [48]}}\n", "held twice"),
            ("grippers: {a: {grasped: []}}\n", "grippers.a.grasped"),
            ("base: throw\n", "Unknown base 'throw'"),
            ("loss_frames: [40]\n", "loss_frames"),
            ("- a\n", "mapping"),
            ("a: [\n", "not readable YAML"),
        ],
    )
    def test_bad_yaml(self, tmp_path, text, message):
        (tmp_path / "t.yaml").write_text(text)
        with pytest.raises(SceneError, match=message):
            load_scenario(tmp_path / "t.yaml")

    def test_unknown_material(self, tmp_path):
        (tmp_path / "t.yaml").write_text("material: wood\n")
        with pytest.raises(ConfigError, match=r"Unknown material 'wood'. Allowed: .*silk"):
            load_scenario(tmp_path / "t.yaml")


def test_what_lies_between_held_nodes_is_held():
    scene = load_scenario("band_stretch").scene  # a gripper holds three by two nodes
    finer = scene.finer()
    held = finer.mesh.nodes[finer.handles.nodes]
    low, high = scene.mesh.nodes[scene.handles.nodes].min(0), scene.mesh.nodes[scene.handles.nodes].max(0)
    inside = ((finer.mesh.nodes >= low - 1e-9) & (finer.mesh.nodes <= high + 1e-9)).all(1)
    assert len(held) == inside.sum() == 15
    assert replace(finer.handles, handles=finer.handles.handles[: len(scene.handles.handles)]) == scene.handles


def test_a_finer_scenario_acts_on_what_lies_between_its_nodes():
    scenario = load_scenario("lift")
    corner = np.array([0, 1, 7, 8])  # a cell of 7 by 7 nodes
    scenario = replace(scenario, node_sets={"mass": corner}, loss_faces=np.array([3]))
    finer = scenario.finer()
    system, _ = finer.scene.build()
    heavy = finer.properties(system, {"mass": torch.full((1,), 2.0, dtype=torch.float64)})
    usual = finer.properties(system, {})
    factor = (heavy.node_mass / usual.node_mass)[0].numpy()
    ends = scenario.scene.mesh.nodes[corner]
    between = 0.5 * (ends[:, None] + ends).reshape(-1, 3)  # and the nodes themselves
    inside = (np.linalg.norm(finer.scene.mesh.nodes[:, None] - between, axis=-1) < 1e-9).any(1)
    assert inside.sum() == 9
    np.testing.assert_allclose(factor, np.where(inside, 2.0, 1.0))
    own, cut = scenario.scene.mesh, finer.scene.mesh
    assert cut.face_area[finer.loss_faces].sum() == pytest.approx(own.face_area[3])


def test_two_handles_of_a_node_are_both_passed_on():
    """As the published scenes have them: one that stays, and one that moves."""
    scene = load_scenario("lift").scene
    moving = [handle for handle in scene.handles.handles if handle.motion is not None][:1]
    face = scene.mesh.faces[(scene.mesh.faces == moving[0].node).any(1)][0]
    held = [replace(handle, node=int(node)) for node in face for handle in (moving[0], replace(moving[0], motion=None))]
    finer = replace(scene, handles=replace(scene.handles, handles=tuple(held), hard=False)).finer()
    assert len(finer.handles.handles) == 2 * (3 + 3)
    assert len({handle.node for handle in finer.handles.handles}) == 6
