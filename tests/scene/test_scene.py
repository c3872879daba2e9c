"""The built-in scenarios and YAML files that vary them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.errors import ConfigError, SceneError
from diffcloud.scene import SCENARIO_NAMES, load_scenario
from diffcloud.scene.scenarios import built_in, make_scenario
from tests.arcsim.files import MATERIAL
from tests.sim.contact.penetration import find_penetrations, minimal_distance


class TestScenarios:
    def test_names(self):
        assert SCENARIO_NAMES[:6] == ("lift", "fold", "band_stretch", "vest_hang", "shake", "hang")
        assert SCENARIO_NAMES[6:8] == ("recorded_lift", "recorded_fold")
        assert SCENARIO_NAMES[8:] == ("release_lift", "release_fold", "release_hang", "release_band")
        with pytest.raises(ConfigError, match=r"Unknown scenario 'lfit'. Did you mean 'lift'.* Allowed: .*lift"):
            load_scenario("lfit")
        with pytest.raises(ConfigError, match="needs the published scene file"):
            load_scenario("release_lift")
        with pytest.raises(ConfigError, match="only release_"):
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
            ("{stretching: 1}", "unknown or unsupported field"),
            ("3", "material"),
        ],
    )
    def test_wrong_materials(self, tmp_path, given, message):
        path = tmp_path / "t.yaml"
        path.write_text(f"material: {given}\n")
        with pytest.raises(SceneError, match=message):
            load_scenario(path)

    def test_own_material_file_is_found_beside_the_yaml(self, tmp_path):
        (tmp_path / "m.json").write_text(json.dumps({**MATERIAL, "density": 0.3}))
        (tmp_path / "t.yaml").write_text("material: m.json\n")
        assert load_scenario(tmp_path / "t.yaml").scene.material.density == 0.3

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("colour: red\n", "colour: unknown"),
            ("size_m: [0.2, -1]\n", "size_m.1"),
            ("grasped: [north]\n", "Unknown corner 'north'"),
            ("grasped: [99]\n", r"node 99 does not exist. The cloth has nodes 0 to 48"),
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
    scenario = replace(scenario, node_sets={"density": corner}, loss_faces=np.array([3]))
    finer = scenario.finer()
    system, _ = finer.scene.build()
    heavy = finer.properties(system, {"density": torch.full((1,), 2.0, dtype=torch.float64)})
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
