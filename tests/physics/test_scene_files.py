"""Scenes read from files in which obstacles move: conservation, contact, and derivatives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from diffcloud.mesh import SurfaceMesh
from diffcloud.scene import load_scene
from diffcloud.sim.properties import scaled_properties
from diffcloud.sim.simulate import Rollout, rollout
from diffcloud.sim.system import System
from tests.arcsim.files import Data, over_moving_box, sheet_over_box, write_file, write_files
from tests.physics.test_rigid_contact import momenta
from tests.sim.contact.penetration import find_penetrations

CORNERS = [0, 4, 20, 24]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_files(tmp_path_factory.mktemp("scene"))


def loaded(folder: Path, data: Data) -> System:
    return load_scene(write_file(folder, data)).build()[0]


def falling_box(**own: Any) -> Data:
    """A box of 50 g, by default, that falls by 14 mm onto a sheet held at its corners, which is damped."""
    data = sheet_over_box(transform={"translate": [0, 0, 0.038]}, diffcloud={"mass": 0.05, **own})
    data["cloths"][0]["materials"][0]["damping"] = 0.02
    data["handles"] = [{"nodes": CORNERS}]
    return data | {"gravity": [0, 0, -9.81]}


def seen_from_body(system: System, run: Rollout) -> np.ndarray:
    """[S + 1, V, 3] positions of the cloth in the axes of the only body."""
    centre, orientation = run.bodies.centre[0], run.bodies.orientation[0, :, 0]
    return ((run.positions[0] - centre) @ orientation).numpy()


def test_a_body_that_spins_may_fling_a_cloth(folder):
    """A motion that nothing but its spin explains is no sign of an unstable simulation."""
    data = sheet_over_box(diffcloud={"mass": 0.05, "angular_velocity": [0, 20, 0]})
    data["cloths"][0]["transform"] = {"translate": [0, 0, 0.008]}
    run = rollout(loaded(folder, data), 40)
    assert float((run.positions[0, -1] - run.positions[0, 0]).norm(dim=-1).max()) > 0.05


def test_a_cloth_and_a_body_that_collide_conserve_momentum(folder):
    """Linear to rounding, angular to first order in the time step."""
    own = {"mass": 0.004, "velocity": [0.1, 0, 0.5], "angular_velocity": [0, 2, 0]}
    data = sheet_over_box(diffcloud=own, transform={"translate": [0.02, 0.01, 0], "rotate": [3, 1, 0, 0]})
    data |= {"frame_time": 2e-3, "obs_friction": 0}  # friction acts across the gap, which gives a small couple
    data["magic"] = {"repulsion_thickness": 3e-3, "collision_stiffness": 1e5}
    data["cloths"][0]["transform"] = {"translate": [0, 0, 0.008]}
    errors = []
    for steps in (1, 4):
        system = loaded(folder, data | {"frame_steps": steps})
        run = rollout(system, 60 * steps)
        hit = run.positions[0, -1] - run.positions[0, 0]
        assert float(hit.norm(dim=-1).max()) > 0.01
        before, after = momenta(system, run, 0), momenta(system, run, len(run.times) - 3)
        linear, angular = (float((b - a).abs().max()) for a, b in zip(before, after, strict=True))
        assert linear < 1e-10 * 0.004 * 0.5
        errors.append(angular / (0.004 * 0.5 * 0.1))
    assert errors[0] < 0.005
    assert errors[1] < 0.4 * errors[0]


def test_a_body_that_falls_onto_a_held_cloth_is_carried(folder):
    """In the end the handles pull with the weight of both."""
    system = loaded(folder, falling_box())
    run = rollout(system, 400)
    assert float(run.bodies.velocity[0, -1].abs().max()) < 1e-3
    pull = system.handles.stiffness * (run.positions[0, 0, CORNERS] - run.positions[0, -1, CORNERS])
    weight = 9.81 * (0.05 + float(system.properties.node_mass.sum()))
    assert float(pull[:, 2].sum()) == pytest.approx(weight, rel=0.01)


def test_nothing_passes_through_a_movable_body(folder):
    """A heavy one, which falls fast and spins."""
    fast = {"mass": 0.2, "velocity": [0, 0, -2.0], "angular_velocity": [4, 10, 0]}
    system = loaded(folder, falling_box(**fast))
    run = rollout(system, 60)
    body = SurfaceMesh(system.bodies.points, system.setup.surrounding.bodies[0].mesh.faces)
    found = find_penetrations(seen_from_body(system, run), system.mesh, [body])
    assert not found, found[0]
    struck = run.bodies.velocity[0, :, 0, 2]
    assert float(struck.max()) > -1.0  # it was stopped


def test_nothing_passes_through_a_moving_obstacle_which_pushes_the_cloth(folder):
    """A box that rises by 20 cm in 0.2 s and turns, under a cloth in air."""
    data = over_moving_box() | {"wind": {"density": 1.2}}
    data["motions"][0][1]["transform"] = {"translate": [0.03, 0, 0.2], "rotate": [60, 0.2, 0, 1]}
    system = loaded(folder, data)
    run = rollout(system, 40)
    (moving,) = system.setup.surrounding.moving
    linear, translation = moving.motion.at(run.times.numpy())
    seen = np.einsum("sji,svj->svi", linear, run.positions[0].numpy() - translation[:, None])
    found = find_penetrations(seen, system.mesh, [moving.mesh])
    assert not found, found[0]
    assert float((run.positions[0, -1] - run.positions[0, 0])[:, 2].mean()) > 0.1


def test_a_stiff_cloth_bounces_off_a_moving_obstacle(folder):
    """Faster than the obstacle: up to twice as fast is plausible."""
    data = over_moving_box() | {"frame_time": 1e-3}
    data["obstacles"][0]["transform"] = {"scale": 3}
    steady = {"velocity": {"translate": [0, 0, 1]}}
    data["motions"] = [[{"time": 0, **steady}, {"time": 1, "transform": {"translate": [0, 0, 1]}, **steady}]]
    run = rollout(loaded(folder, data), 30)
    assert 1.5 < float(run.velocities[0, -1, :, 2].mean()) < 2.0


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (over_moving_box() | {"wind": {"density": 1.2}}, "density"),
        (over_moving_box() | {"wind": {"density": 1.2}}, "stretching"),
        (falling_box(), "body_mass"),
        (falling_box(), "stretching"),
    ],
    ids=["moving-mass", "moving-stretch", "movable-body_mass", "movable-stretch"],
)
def test_derivatives_of_scenes_in_which_obstacles_move(folder, data, name):
    """Against central differences, in contact."""
    system = loaded(folder, data)

    def height(value: torch.Tensor) -> torch.Tensor:
        properties = scaled_properties(system.properties, {name: value}, faces=torch.as_tensor(system.mesh.faces))
        run = rollout(system, 20, properties=properties)
        return (run.positions[:, -1, :, 2] * torch.arange(25)).mean()

    value = torch.tensor([1.1], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(height(value), value)
    step = 1e-5
    with torch.no_grad():
        difference = (height(value + step) - height(value - step)) / (2 * step)
    assert abs(float(gradient)) > 1e-5
    assert float(gradient) == pytest.approx(float(difference), rel=1e-4)
