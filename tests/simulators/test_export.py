"""What an exported cloth is: the fitted one, in numbers that another simulator takes."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.arcsim.load import load_scene
from diffcloud.errors import ConfigError
from diffcloud.estimation.record import NuisanceValue
from diffcloud.estimation.result import FittedMotion
from diffcloud.io.obj import read_cloth
from diffcloud.mesh.shapes import grid_cloth
from diffcloud.scene.scenarios import built_in, load_scenario, make_scenario
from diffcloud.sim.materials import TABLE_ENTRY_TO_STRETCHING, isotropic, preset
from diffcloud.sim.properties import one_set
from diffcloud.sim.simulate import rollout
from diffcloud.simulators import mujoco
from diffcloud.simulators.export.cloth import fitted_cloth, isotropic_sheet, start_strain
from diffcloud.simulators.export.targets import TARGETS
from diffcloud.simulators.export.write import write_export
from diffcloud.simulators.problem import Sheet
from diffcloud.simulators.problems import cantilever, strip
from tests.conftest import small_lift
from tests.estimation.records import recording_of

ISOTROPIC = {"density_kg_m2": 0.2, "stretching_n_m": 50.0, "bending_n_m": 1e-5, "poisson": 0.3}
VALUES = {"stretching": 0.7, "density": 1.3, "bending": 2.0, "damping": 0.01, "air_density": 0.5, "friction": 0.4}


def towel(**changes):
    given = {"nodes": (5, 5), "frames": 6, "material": ISOTROPIC, "path": [(0, 0, 0, 0), (0.5, 0, -0.05, 0.15)]}
    options = type(built_in("lift")).model_validate({**built_in("lift").model_dump(), **given, **changes})
    return make_scenario(options)


def simulated(scenario, values, every=None):
    system, _ = scenario.scene.build()
    tensors = one_set(values)
    with torch.no_grad():
        run = rollout(system, scenario.steps, properties=scenario.properties(system, tensors))
    every = every or scenario.scene.frame_steps
    return run.positions[0, ::every].numpy(), run.times[::every].numpy()


def recording(**nuisance):
    units = {"x": "m", "z": "m", "yaw": "rad", "tilt_x": "rad", "scale": "1"}
    found = {name: NuisanceValue(value=value, prior=1.0, unit=units[name]) for name, value in nuisance.items()}
    return recording_of("e1", nuisance=found, centre=[0.5, 0.0, 0.1])


def exported(scenario=None, values=None, one=None):
    scenario, values = scenario or towel(), VALUES if values is None else values
    return fitted_cloth(one or recording(), moved(scenario, values), scenario, values)


def moved(scenario, values):
    """As a fit keeps it."""
    steps, times = simulated(scenario, values, every=1)
    frames = slice(None, None, scenario.scene.frame_steps)
    held = np.unique(scenario.scene.handles.nodes)
    bodies, faces = scenario.scene.bodies, scenario.scene.mesh.faces
    return FittedMotion(steps[frames], steps[frames], faces, times[frames], bodies, held, times, steps[:, held])


class TestFittedScene:
    def test_has_the_fitted_compression(self):
        scene = load_scenario("recorded_lift").fitted_scene({"compression": 0.02})
        assert scene.material.compression == 0.02

    @pytest.mark.parametrize("name", ["lift", "fold"])
    def test_moves_as_the_scenario_does_with_these_parameters(self, name):
        scenario = load_scenario(name)
        scenario = replace(scenario, frames=3)
        values = {**VALUES, "shear": 0.6}
        expected, _ = simulated(scenario, values)
        found, _ = simulated(replace(scenario, scene=scenario.fitted_scene(values)), {})
        assert np.abs(expected - simulated(scenario, VALUES)[0]).max() > 1e-5
        np.testing.assert_allclose(found, expected, atol=1e-9)

    def test_refuses_parameters_that_no_material_has(self):
        scenario = replace(small_lift(), node_sets={"density": np.array([0])})
        with pytest.raises(ConfigError, match="density acts on a part of the nodes"):
            scenario.fitted_scene({"density": 2.0})
        with pytest.raises(ConfigError, match="above 0"):
            small_lift().fitted_scene({"stretching": 0.0})


class TestIsotropicSheet:
    def test_of_an_isotropic_material_is_itself(self):
        material = isotropic("towel", density=0.2, stretching=50.0, bending=1e-5, poisson=0.3, damping=0.004)
        sheet, said = isotropic_sheet(material)
        assert said == []
        expected = Sheet(density=0.2, stretching=50.0, poisson=0.3, bending=1e-5, damping=0.004)
        for name in ("density", "stretching", "poisson", "bending", "damping"):
            assert getattr(sheet, name) == pytest.approx(getattr(expected, name)), name

    def test_has_the_mean_energy_of_all_directions(self):
        """Of uniaxial strain in its plane, and of pure shear, of a fabric with different sides and little shear."""
        table = np.tile([500.0, 60.0, 300.0, 40.0], (6, 1))
        material = replace(preset("denim"), stretching=table)
        sheet, said = isotropic_sheet(material)
        assert "isotropic" in said[0]
        uu, uv, vv, k3 = TABLE_ENTRY_TO_STRETCHING * table[0]

        def energy(strain):
            e00, e11, e01 = strain[0, 0], strain[1, 1], strain[0, 1]
            return 0.5 * (uu * e00**2 + vv * e11**2 + 2 * uv * e00 * e11) + k3 * e01**2

        def alike(strain):
            return sheet.shear * (strain**2).sum() + 0.5 * sheet.lateral * np.trace(strain) ** 2

        for strain in (np.diag([1.0, 0.0]), np.array([[0.0, 1.0], [1.0, 0.0]])):
            mean = 0.0
            for angle in np.linspace(0, np.pi, 64, endpoint=False):
                turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
                mean += energy(turn @ strain @ turn.T) / 64
            assert alike(strain) == pytest.approx(mean, rel=1e-12)

    def test_says_what_a_sheet_cannot(self):
        told = " ".join(isotropic_sheet(preset("soft-knit"))[1])
        assert "at 45°" in told
        assert "3 times that at rest. The exported stiffness is the one at rest." in told
        assert "wrinkles" not in told
        wrinkling = replace(preset("soft-knit"), compression=0.25)
        assert "wrinkles finer than its mesh instead, and 25.0% of the stiffness stays" in " ".join(
            isotropic_sheet(wrinkling)[1]
        )


def test_a_strained_start_is_measured():
    mesh = grid_cloth(3, 4, 0.2, 0.3)
    assert start_strain(mesh) == pytest.approx(0.0, abs=1e-12)
    assert start_strain(replace(mesh, nodes=mesh.nodes * [1.1, 1.0, 1.0])) == pytest.approx((1.1**2 - 1) / 2)


class TestProblem:
    def test_is_the_fitted_cloth(self):
        cloth = exported()
        problem, system = cloth.problem, towel().scene.build()[0]
        assert problem.sheet.stretching == pytest.approx(0.7 * 50)
        assert problem.sheet.bending == pytest.approx(2e-5)
        assert problem.sheet.damping == pytest.approx(0.01)
        np.testing.assert_allclose(problem.node_mass, 1.3 * system.properties.node_mass[0].numpy(), rtol=1e-6)
        assert (problem.friction, problem.self_friction) == (0.4, 0.6)
        assert problem.table == pytest.approx(float(towel().scene.surrounding.obstacles[0].nodes[0, 2]))
        np.testing.assert_allclose(problem.times, np.arange(7) * 0.1)

    def test_has_the_fitted_size(self):
        size = NuisanceValue(value=0.05, prior=0.02, unit="1", of="cloth")
        larger = exported(one=recording_of("e1", nuisance={"size": size}, centre=[0.5, 0.0, 0.1])).problem
        grown, own = math.exp(0.05), exported().problem
        np.testing.assert_allclose(larger.mesh.verts, grown * own.mesh.verts)
        np.testing.assert_allclose(larger.node_mass, grown**2 * own.node_mass)
        assert larger.sheet == own.sheet

    def test_holds_its_nodes_as_the_fit_did(self):
        cloth = exported()
        held = list(cloth.problem.held)
        np.testing.assert_allclose(cloth.problem.held_at(cloth.problem.times), cloth.motion[:, held], atol=1e-9)

    def test_moves_alike_where_nothing_is_left_out(self):
        still_air = {**VALUES, "air_density": 1e-6}
        cloth = exported(values=still_air)
        assert cloth.simplified_m.max() < 0.1e-3
        assert np.ptp(cloth.motion[:, -1], axis=0).max() > 0.05

    def test_lies_as_the_recording_does_but_level(self):
        one = recording(x=0.1, yaw=0.5, tilt_x=0.05)
        space_of = exported(one=one)
        assert any("tilted by 2.9°" in sentence for sentence in space_of.left_out)
        upright = exported(one=recording(x=0.1, yaw=0.5))
        assert upright.left_out == ()
        heights = space_of.motion[0, :, 2]
        nodes = exported().motion
        # what is given lies in the recording's frame; without its tilt the flat cloth is no longer parallel to it
        assert np.ptp(nodes[0, :, 2]) < 1e-9 < np.ptp(heights)
        np.testing.assert_array_equal(upright.motion, nodes)

    def test_is_as_large_as_it_is_where_clouds_are_too_large(self):
        nodes, right = exported().motion, exported(one=recording(scale=0.05)).motion
        np.testing.assert_allclose(np.ptp(right, axis=1), math.exp(-0.05) * np.ptp(nodes, axis=1))

    def test_is_refused_where_units_or_cloth_are_others(self):
        scenario = towel()
        motion = moved(scenario, {})
        with pytest.raises(ConfigError, match="has a length unit of"):
            fitted_cloth(recording(), motion, replace(scenario, length_unit_m=0.1), {})
        with pytest.raises(ConfigError, match=r"\(25 nodes\) is not that of the scenario lift \(30"):
            fitted_cloth(recording(), motion, towel(nodes=(6, 5)), {})


class TestFiles:
    @pytest.mark.parametrize("target", TARGETS)
    def test_of_each_target_are_there_and_named(self, tmp_path, target):
        names, left_out = write_export(exported(), target, tmp_path, {"fit": "e1.json"})
        there = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
        assert there == set(names)
        assert any("air" in sentence for sentence in left_out) == TARGETS[target].simplified

    def test_mujoco_has_masses_elements_and_the_step(self, tmp_path):
        cloth = exported()
        write_export(cloth, "mujoco", tmp_path, {})
        root = ElementTree.parse(tmp_path / "cloth.xml").getroot()
        held = set(cloth.problem.held)
        masses = [float(one.get("mass")) for one in root.iter("inertial")]
        for node, mass in enumerate(cloth.problem.node_mass):
            assert masses[node] == pytest.approx(1e3 if node in held else mass, rel=1e-6)
        places = np.array([[float(x) for x in body.get("pos").split()] for body in root.iter("body")])
        np.testing.assert_allclose(places, cloth.motion[0], atol=1e-9)
        elasticity = root.find("deformable/flex/elasticity")
        membrane = float(elasticity.get("young")) * float(elasticity.get("thickness"))
        assert membrane == pytest.approx(cloth.problem.sheet.stretching)
        frame = 0.1 / float(root.find("option").get("timestep"))
        assert frame == pytest.approx(round(frame), abs=1e-6)

    def test_arcsim_is_read_back_and_moves_as_fitted(self, tmp_path):
        cloth = exported(values={**VALUES, "air_density": 1.0})
        write_export(cloth, "arcsim", tmp_path, {})
        scene = load_scene(tmp_path / "conf" / "cloth.json")
        system, _ = scene.build()
        with torch.no_grad():
            found = rollout(system, 6 * scene.frame_steps).positions[0, :: scene.frame_steps].numpy()
        assert np.sqrt(((found - cloth.motion) ** 2).sum(-1).mean(-1)).max() < 1e-4

    def test_isaac_is_read_by_usd(self, tmp_path):
        usd = pytest.importorskip("pxr.Usd")
        cloth = exported()
        write_export(cloth, "isaac", tmp_path, {})
        stage = usd.Stage.Open(str(tmp_path / "cloth.usda"))
        points = np.array(stage.GetPrimAtPath("/World/Cloth").GetAttribute("points").Get())
        np.testing.assert_allclose(points, cloth.motion[0], atol=1e-6)
        material = stage.GetPrimAtPath("/World/ClothMaterial")
        thick, young, bend, density = (
            material.GetAttribute(f"omniphysics:{name}").Get()
            for name in ("surfaceThickness", "youngsModulus", "surfaceBendStiffness", "density")
        )
        sheet = cloth.problem.sheet
        assert young * thick == pytest.approx(sheet.stretching, rel=1e-5)
        assert bend * thick**3 == pytest.approx(sheet.bending, rel=1e-5)
        assert density * thick == pytest.approx(sheet.density, rel=1e-5)
        node = next(iter(cloth.problem.held))
        moved = stage.GetPrimAtPath(f"/World/Held{node}").GetAttribute("xformOp:translate").Get(6)
        np.testing.assert_allclose(moved, cloth.motion[6, node], atol=1e-6)

    def test_isaac_is_balanced_text(self, tmp_path):
        write_export(exported(), "isaac", tmp_path, {})
        text = (tmp_path / "cloth.usda").read_text()
        for opening, closing in ("{}", "()", "[]"):
            assert text.count(opening) == text.count(closing)
        assert "nan" not in text

    def test_obj_has_the_cloth_and_what_holds_it(self, tmp_path):
        cloth = exported()
        write_export(cloth, "obj", tmp_path, {})
        np.testing.assert_allclose(read_cloth(tmp_path / "cloth.obj").nodes, cloth.motion[0], atol=1e-9)
        rows = np.loadtxt(tmp_path / "held.csv", delimiter=",", skiprows=1)
        np.testing.assert_allclose(rows[:, 0], cloth.problem.times)
        np.testing.assert_allclose(rows[:, 1:], cloth.motion[:, list(cloth.problem.held)].reshape(7, -1), atol=1e-7)


class TestWhatATargetLacks:
    @pytest.mark.parametrize("target", ["mujoco", "isaac"])
    def test_a_ratio_that_no_solid_has_is_clipped_and_said(self, target, tmp_path):
        cloth = exported(towel(material={**ISOTROPIC, "poisson": 0.6}))
        _, left_out = write_export(cloth, target, tmp_path, {})
        assert "Poisson's ratio is 0.49, the largest that can be exported; in the fit it is 0.6." in left_out
        if target == "mujoco":
            engine = pytest.importorskip("mujoco")
            engine.MjModel.from_xml_path(str(tmp_path / "cloth.xml"))  # which refuses 0.5 and more
        else:
            assert "omniphysics:poissonsRatio = 0.49\n" in (tmp_path / "cloth.usda").read_text()

    @pytest.mark.parametrize("target", TARGETS)
    def test_only_mujoco_flattens_what_is_shaped(self, target, tmp_path):
        cloth = exported(towel(shaped=True))
        _, left_out = write_export(cloth, target, tmp_path, {})
        assert any("hinges are flat" in sentence for sentence in left_out) == (target == "mujoco")

    @pytest.mark.parametrize("target", TARGETS)
    def test_a_strained_start_is_the_targets_own(self, target, tmp_path):
        cloth = exported()
        mesh = replace(cloth.problem.mesh, nodes=cloth.problem.mesh.nodes * [1.1, 1.0, 1.0])
        strained = replace(cloth, problem=replace(cloth.problem, mesh=mesh))
        assert strained.simplified == cloth.simplified
        _, left_out = write_export(strained, target, tmp_path, {})
        told = any("unstrained at the start" in sentence for sentence in left_out)
        assert told == TARGETS[target].simplified


def test_the_script_finds_the_cloth_in_a_model_with_other_things():
    """Beside a body that floats, which has more positions than velocities."""
    engine = pytest.importorskip("mujoco")
    from diffcloud.simulators.scripts import run_mujoco

    problem = exported().problem
    settings, _ = mujoco.stable(problem)
    alone = mujoco.model_file(problem, settings)
    ball = '<worldbody><body pos="5 5 5"><freejoint/><geom size="0.1"/></body>'
    wanted = problem.held_at(np.arange(41) * settings.step)
    made = []
    for text in (alone, alone.replace("<worldbody>", ball)):
        model = engine.MjModel.from_xml_string(text)
        frames = run_mujoco.frames(model, engine.MjData(model), np.array(list(problem.held)), wanted, 20)
        made.append(np.array(list(frames)))
    assert made[0].shape == (3, 25, 3)
    np.testing.assert_allclose(made[1], made[0], atol=1e-9)


class TestSteps:
    def test_are_short_enough_for_the_highest_frequency(self):
        for sheet in (Sheet(0.2, 4.0, 0.1, 4e-6, 0.005), Sheet(0.4, 2500.0, 0.3, 8e-5, 0.02)):
            for known in (strip(sheet), cantilever(sheet)):
                settings, borne = mujoco.stable(known.problem)
                height = known.problem.mesh.smallest_height
                squared = 4 * sheet.stretching / ((1 - sheet.poisson**2) * sheet.density * height**2)
                assert settings.step**2 * squared + 2 * borne.damping * squared * settings.step < 4

    def test_damping_that_needs_too_short_ones_is_reduced(self):
        problem = strip(Sheet(0.2, 500.0, 0.3, 1e-6, 0.0)).problem
        damped = replace(problem, sheet=replace(problem.sheet, damping=0.5), table=-1.0)
        settings, sheet = mujoco.stable(damped)
        assert 0 < sheet.damping < 0.5
        assert settings.step == pytest.approx(2e-5, rel=0.01)


@pytest.mark.parametrize("sheet", [Sheet(0.2, 4.0, 0.14, 4e-6, 0.005), Sheet(0.4, 2500.0, 0.3, 8e-5, 0.005)])
def test_known_answers_hold_for_any_cloth(sheet):
    """They are the same up to units, whatever the material."""
    from diffcloud.simulators import ours

    for known in (strip(sheet), cantilever(sheet)):
        found = known.measures(ours.simulate(known.problem))
        for name, value in known.theory.items():
            assert found[name] == pytest.approx(value, rel=0.02), (known.problem.name, name)
