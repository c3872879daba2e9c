"""Steps and rollouts: closed forms, batches, handles, contact, and failures that say what failed."""

from __future__ import annotations

import math
import time
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from diffcloud.arcsim.terms import TERMS
from diffcloud.errors import DivergedError, SceneError
from diffcloud.mesh import SurfaceMesh, box_surface, grid_cloth
from diffcloud.sim import Rollout, episodes, init, rollout
from diffcloud.sim.build import build_system
from diffcloud.sim.compiled.data import Parameters, Timing
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import isotropic
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.rigid.body import RigidBody
from diffcloud.sim.surrounding import ContactSettings, Surrounding
from diffcloud.sim.threads import use_threads
from tests.conftest import shaken, small_lift
from tests.sim.twins.forces import Forces

MATERIAL = isotropic("test", density=0.2, stretching=50.0, bending=1e-5, shear=10.0)
G = 9.81


def cloth_system(
    handles=(), *, hard=True, dt=0.01, height=1.0, obstacles=(), friction=0.3, air=0.0, integrator="arcsim", **options
):
    mesh = grid_cloth(5, 5, 0.2, 0.2)
    mesh = replace(mesh, nodes=mesh.nodes + np.array([0, 0, height]))
    surrounding = Surrounding(
        gravity=options.pop("gravity", (0.0, 0.0, -G)),
        air_density=air,
        obstacles=obstacles,
        friction=friction,
        contact=ContactSettings(1e5, 2e-3, 2e-4),
    )
    return build_system(
        mesh,
        MATERIAL,
        time_step=dt,
        handles=Handles(tuple(handles), hard=hard),
        surrounding=surrounding,
        integrator=integrator,
        **options,
    )


def table(tilt=0.0):
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 5
    corners[:, 2] = corners[:, 0] * np.tan(tilt)
    return SurfaceMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def test_free_fall_is_exactly_backward_euler():
    system = cloth_system()
    run = rollout(system, 20)
    steps = np.arange(21)
    drop = G * 0.01**2 * steps * (steps + 1) / 2
    np.testing.assert_allclose(run.positions[0, :, :, 2].numpy(), np.repeat((1.0 - drop)[:, None], 25, 1), atol=1e-12)


def test_free_flight_conserves_momentum_and_loses_energy_only(rng):
    system = cloth_system(gravity=(0.0, 0.0, 0.0), dt=0.002)
    positions = init(system).positions * torch.tensor([1.05, 0.97, 1.0], dtype=torch.float64)
    velocities = torch.as_tensor(0.1 * rng.normal(size=(1, 25, 3)))
    run = rollout(system, 100, state=init(system, positions=positions, velocities=velocities))
    mass = system.properties.node_mass[0, :, None]
    moved = (run.positions[0, 1:] - run.positions[0, :-1]) / system.time_step
    momentum = (mass * moved).sum(1)
    np.testing.assert_allclose(momentum, momentum[:1].repeat(100, 1), atol=1e-12)
    kinetic = 0.5 * (mass * moved.square()).sum((1, 2))
    centre = 0.5 * (momentum[0] ** 2).sum() / mass.sum()
    assert kinetic[-1] < kinetic[0]
    assert kinetic[-1] > centre


def test_the_step_solves_its_equation(rng):
    """m u = Δt f, with the forces at the velocities that it ends with."""
    system = cloth_system([Handle(0)], hard=False)
    positions = init(system).positions * 1.02
    velocities = torch.as_tensor(0.1 * rng.normal(size=positions.shape))
    run = rollout(system, 1, state=init(system, positions=positions, velocities=velocities))
    before, after = velocities[0].numpy(), run.velocities[0, 1].numpy()
    dt = system.time_step
    forces = Forces(system.mesh, MATERIAL)
    forces.terms, forces.timing = system.scene.terms, Timing(dt, dt)
    forces.parameters = Parameters(
        **{
            field.name: np.atleast_1d(getattr(system.properties, field.name)[0].numpy())
            for field in fields(system.properties)
        },
        inverse_mass=1 / system.properties.node_mass[0].numpy(),
        hold=np.array([system.handles.stiffness]),
        target=positions[0, :1].numpy(),
    )
    damping = float(system.properties.damping)
    motion = forces.motion(positions[0].numpy(), before, after, (dt + damping) * after)
    total = sum(forces.force(term.name, motion) for term in TERMS)
    mass = forces.parameters.node_mass[:, None]
    assert np.abs(mass * (after - before) - dt * total).max() < 1e-9 * mass.max() * G * dt


def test_a_batch_is_as_its_entries_alone():
    scenario = small_lift()
    system, _ = scenario.scene.build()
    values = {"stretching": torch.tensor([0.5, 1.0, 4.0]).double(), "density": torch.tensor([2.0, 1.0, 0.3]).double()}
    together = rollout(system, 8, properties=scenario.properties(system, values)).positions
    for entry in range(3):
        one = {name: value[entry : entry + 1] for name, value in values.items()}
        alone = rollout(system, 8, properties=scenario.properties(system, one)).positions
        torch.testing.assert_close(together[entry], alone[0], rtol=1e-9, atol=1e-11)


def test_a_batch_is_bit_for_bit_the_same_for_any_threads_and_company():
    scenario = small_lift()
    system, _ = scenario.scene.build()
    stretch = torch.tensor([0.5, 1.0, 4.0, 2.0, 0.7]).double()

    def run(values: torch.Tensor) -> torch.Tensor:
        values = values.clone().requires_grad_()
        found = rollout(system, 8, properties=scenario.properties(system, {"stretching": values}))
        (gradient,) = torch.autograd.grad(found.positions[:, -1].square().sum(), values)
        return torch.cat([found.positions.detach().flatten(1), gradient[:, None]], dim=1)

    together = run(stretch)
    try:
        for threads in (1, 3):
            use_threads(threads)
            assert torch.equal(run(stretch), together)
            assert torch.equal(run(stretch[[3, 1]]), together[[3, 1]])
    finally:
        use_threads(None)


def test_factors_that_are_made_again_change_nothing(monkeypatch):
    """Where memory does not hold the factors of all steps."""
    scenario = small_lift()
    system, _ = scenario.scene.build()

    def gradient() -> torch.Tensor:
        stretch = torch.tensor([0.5, 4.0]).double().requires_grad_()
        run = rollout(system, 8, properties=scenario.properties(system, {"stretching": stretch}))
        return torch.autograd.grad(run.positions[:, -1].square().sum(), stretch)[0]

    kept = gradient()
    monkeypatch.setattr(episodes, "FACTOR_MEMORY", 0)
    torch.testing.assert_close(gradient(), kept, rtol=1e-10, atol=0)


def test_progress_and_ctrl_c_reach_a_batch_that_runs():
    """Within a second, though all threads are in kernels; the batch would take minutes."""
    scenario = small_lift()
    system, _ = scenario.scene.build()
    rollout(system, 1)  # compiled
    told = []

    def progress(steps: int) -> None:
        told.append(steps)
        raise KeyboardInterrupt

    properties = scenario.properties(system, {"stretching": torch.ones(64).double()})
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        rollout(system, 10_000, properties=properties, progress=progress)
    assert time.monotonic() - began < 10  # on a busy machine
    assert len(told) == 1
    assert told[0] < 10_000


class TestHandles:
    def test_hard_handles_are_met_exactly_and_soft_ones_lag(self):
        motion = Motion((Keyframe(0.0), Keyframe(0.1, (0.0, 0.0, 0.05))))
        target = motion.at(np.cumsum(np.full(10, 0.01)))[1][:, 2]
        target = 1.0 + target - target[0]  # the anchor is taken at the end of the first step
        hard = rollout(cloth_system([Handle(7, motion)]), 10).positions[0, 1:, 7, 2].numpy()
        np.testing.assert_allclose(hard, target, atol=1e-12)
        soft = rollout(cloth_system([Handle(7, motion)], hard=False), 10).positions[0, 1:, 7, 2].numpy()
        assert 1e-6 < np.abs(soft - target).max() < 1e-2

    def test_two_soft_handles_hold_the_midpoint(self):
        motion = Motion((Keyframe(0.0), Keyframe(0.05, (0.0, 0.0, 0.02))))
        both = cloth_system([Handle(12), Handle(12, motion)], hard=False, gravity=(0, 0, 0), air=0.0)
        height = rollout(both, 200).positions[0, -1, 12, 2]
        # the moving handle takes its anchor at the end of the first step, when it has already moved a little
        first = motion.at(np.array([0.01]))[1][0, 2]
        assert float(height) == pytest.approx(1.0 + (0.02 - first) / 2, abs=1e-6)

    def test_two_hard_handles_on_a_node_are_refused(self):
        with pytest.raises(SceneError, match="hold one node"):
            cloth_system([Handle(3), Handle(3)])

    def test_a_handle_lets_go(self):
        run = rollout(cloth_system([Handle(12, end=0.05)]), 12)
        height = run.positions[0, :, 12, 2]
        assert (height[:6] == 1.0).all()
        assert height[-1] < 1.0

    def test_a_node_that_does_not_exist(self):
        with pytest.raises(SceneError, match=r"node 25, but the cloth has nodes 0\.\.24"):
            cloth_system([Handle(25)])

    def test_a_recorded_track_moves_the_grasped_node(self):
        scenario = small_lift()
        system, _ = scenario.scene.build()
        track = torch.zeros(1, 10, 1, 3, dtype=torch.float64)
        track[0, :, 0, 2] = torch.linspace(0.01, 0.1, 10, dtype=torch.float64)
        node = scenario.grasped[0]
        run = rollout(system, 10, track=track)
        torch.testing.assert_close(run.positions[0, 1:, node], run.positions[0, :1, node] + track[0, :, 0])

    @pytest.mark.parametrize("integrator", ["arcsim", "implicit"])
    def test_each_gripper_has_a_track_of_its_own(self, integrator):
        scenario = shaken(integrator=integrator, held=("left_bottom",))
        system, _ = scenario.scene.build()
        assert system.handles.grippers == ("left", "right")
        track = 0.002 * torch.randn(1, 6, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        run = rollout(system, 6, track=track)
        left, right, right_bottom, held = 20, 24, 4, 0
        start = run.positions[0, 0]
        torch.testing.assert_close(run.positions[0, 1:, left], start[left] + track[0, :, 0])
        torch.testing.assert_close(run.positions[0, 1:, right], start[right] + track[0, :, 1])
        torch.testing.assert_close(run.positions[0, 1:, right_bottom], start[right_bottom] + track[0, :, 1])
        torch.testing.assert_close(run.positions[0, 1:, held], start[held].expand(6, 3))

    def test_a_track_of_other_grippers(self):
        system, _ = shaken().scene.build()
        with pytest.raises(SceneError, match=r"6 or more steps, 2, 3\] here \(left, right\), got \[1, 6, 1, 3\]"):
            rollout(system, 6, track=torch.zeros(1, 6, 1, 3, dtype=torch.float64))

    def test_a_track_without_a_moving_handle(self):
        with pytest.raises(SceneError, match="no handle of this scene moves"):
            rollout(cloth_system([Handle(0)]), 2, track=torch.zeros(1, 2, 0, 3, dtype=torch.float64))


class TestHalfSpace:
    def test_nothing_ends_a_step_below_the_table(self):
        system = cloth_system(height=0.02, obstacles=(table(),))
        assert rollout(system, 100).positions[..., 2].min() >= 0.0

    def test_a_resting_cloth_is_carried_by_the_repulsion(self):
        """At rest the normal forces carry the weight: K c²/(2 τ) = m g for each node."""
        system = cloth_system(height=0.002, obstacles=(table(),), dt=0.005)
        heights = rollout(system, 400).positions[0, -1, :, 2].numpy()
        area = system.mesh.node_area
        violation = np.maximum(0.002 - heights, 0.0)
        carried = (1e5 * area * violation**2 / (2 * 0.002)).sum()
        assert carried == pytest.approx(0.2 * 0.04 * G, rel=0.02)

    @pytest.mark.parametrize(("friction", "slides"), [(0.5, False), (0.1, True)])
    def test_cloth_on_an_incline_sticks_or_slides_as_coulomb_says(self, friction, slides):
        tilt = np.arctan(0.3)
        system = cloth_system(height=0.0, obstacles=(table(tilt),), friction=friction, dt=0.002)
        normal = np.array([-np.sin(tilt), 0, np.cos(tilt)])
        turn = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
        flat = system.mesh.nodes
        # start where the repulsion already carries the weight
        depth = np.sqrt(2 * 0.002 * system.mesh.node_area * 0.2 * G * np.cos(tilt) / (1e5 * system.mesh.node_area))
        positions = torch.as_tensor(flat @ turn + normal * (0.002 - depth)[:, None])[None]
        run = rollout(system, 300, state=init(system, positions=positions))
        downhill = np.array([-np.cos(tilt), 0, -np.sin(tilt)])
        moved = ((run.positions[0] - run.positions[0, :1]).numpy() @ downhill).mean(1)
        time = 0.6
        if slides:
            # the contact force breathes a little, so this is not exact
            expected = 0.5 * G * (np.sin(tilt) - friction * np.cos(tilt)) * time**2
            assert moved[-1] == pytest.approx(expected, rel=0.02)
        else:
            # the lagged scheme halves a sticking node's velocity in each step, which leaves a creep of g sin(α) Δt
            assert 0 <= moved[-1] <= 1.05 * G * np.sin(tilt) * system.time_step * time

    def test_projection_and_repulsion_know_their_side(self):
        ceiling = SurfaceMesh(table().nodes + np.array([0, 0, 2.0]), table().faces)
        system = cloth_system(obstacles=(ceiling,), height=1.99, gravity=(0.0, 0.0, G))
        assert rollout(system, 100).positions[..., 2].max() <= 2.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda system: {"track": torch.zeros(1, 3, 1, 3).double()}, r"A track has shape \[batch, 4 or more steps, 1, 3\]"),
        (lambda system: {"track": torch.zeros(1, 4, 1, 2).double()}, "A track has shape"),
        (lambda system: {"track": torch.zeros(4, 1, 3).double()}, "A track has shape"),
        (
            lambda system: {"state": replace(init(system, 1), positions=torch.zeros(1, 3, 3).double())},
            r"positions must have shape \[batch, \d+, 3\], got \[1, 3, 3\]",
        ),
        (
            lambda system: {"properties": replace(system.properties, node_mass=torch.ones(1, 2).double())},
            r"node_mass must have shape \[batch, \d+\]",
        ),
    ],
)
def test_inputs_of_another_shape_are_refused(change, message):
    """Kernels do not look where arrays end."""
    system, _ = small_lift().scene.build()
    with pytest.raises(SceneError, match=message):
        rollout(system, 4, **change(system))


class TestDivergence:
    def test_names_step_entries_and_advice(self):
        scenario = small_lift()
        system, _ = scenario.scene.build()
        stretch = torch.tensor([1.0, float("nan"), 1.0]).double()
        with pytest.raises(DivergedError, match=r"step 1, batch entries \[1\].*smaller time step") as caught:
            rollout(system, 3, properties=scenario.properties(system, {"stretching": stretch}))
        assert caught.value.entries == [1]

    def test_positions_that_leave_the_numbers(self):
        system = cloth_system()
        velocities = torch.zeros(2, 25, 3, dtype=torch.float64)
        velocities[1] = 1e308
        state = init(system, 2, velocities=velocities)
        with pytest.raises(DivergedError, match=r"entries \[1\]"):
            rollout(system, 3, properties=system.properties.repeated(2), state=state)

    def test_the_others_go_on_if_asked(self):
        """Of five, one fails at once, and one at the second step, when its gripper leaves the numbers."""
        scenario = small_lift()
        system, _ = scenario.scene.build()
        stretch = torch.tensor([1.0, 2.0, float("nan"), 4.0, 5.0]).double()
        track = torch.zeros(5, 4, 1, 3, dtype=torch.float64)
        track[:, :, 0, 2] = torch.arange(1.0, 6.0)[:, None] * torch.linspace(0.001, 0.004, 4)
        track[1, 1:] = torch.nan
        run = rollout(
            system, 4, properties=scenario.properties(system, {"stretching": stretch}), track=track, drop_diverged=True
        )
        assert {entry: error.step for entry, error in run.diverged.items()} == {2: 1, 1: 2}
        assert [error.entries for error in run.diverged.values()] == [[1], [2]]
        finite = run.positions.isfinite().flatten(2).all(-1)
        assert finite.tolist() == [[True] * 5, [True] * 2 + [False] * 3, [True] + [False] * 4, [True] * 5, [True] * 5]
        rest = [0, 3, 4]
        alone = rollout(system, 4, properties=scenario.properties(system, {"stretching": stretch[rest]}), track=track[rest])
        torch.testing.assert_close(run.positions[rest], alone.positions, rtol=1e-9, atol=1e-11)
        assert not alone.diverged

    def test_one_that_fails_leaves_the_gradients_of_the_others_alone(self):
        """Those of what all share, too, in which the entries add up."""
        scenario = small_lift()
        system, _ = scenario.scene.build()
        track = torch.zeros(1, 4, 1, 3, dtype=torch.float64)
        track[..., 2] = torch.linspace(0.001, 0.004, 4)[None, :, None]
        found = []
        for values in ([1.0, 2.0], [1.0, float("nan")]):
            shared = track.clone().requires_grad_(True)
            stretch = torch.tensor(values).double().requires_grad_(True)
            run = rollout(
                system, 4, properties=scenario.properties(system, {"stretching": stretch}), track=shared, drop_diverged=True
            )
            run.positions[0, -1].square().sum().backward()
            assert len(run.diverged) == int(math.isnan(values[1]))
            found.append((shared.grad, stretch.grad[0]))
        for gradient, alone in zip(*found, strict=True):
            assert bool(gradient.isfinite().all())
            torch.testing.assert_close(gradient, alone)

    def test_bodies_go_on_too(self):
        box = box_surface((-0.05, -0.05, -0.9), (0.05, 0.05, -0.85))
        mesh = grid_cloth(5, 5, 0.2, 0.2)
        surrounding = Surrounding(bodies=(RigidBody(box, mass=0.1),), contact=ContactSettings(1e5, 2e-3, 2e-4))
        system = build_system(
            mesh, MATERIAL, time_step=0.01, handles=Handles(()), surrounding=surrounding, integrator="implicit"
        )
        whole = rollout(system, 3)
        properties = system.properties.repeated(3)
        properties.node_mass[1] = torch.nan
        run = rollout(system, 3, properties=properties, drop_diverged=True)
        assert sorted(run.diverged) == [1]
        assert torch.equal(run.bodies.centre[::2], whole.bodies.centre.expand(2, -1, -1, -1))
        assert torch.equal(run.bodies.centre[1, 0], whole.bodies.centre[0, 0])
        assert run.bodies.centre[1, 1:].isnan().all()

    def test_all_may_fail(self):
        scenario = small_lift()
        system, _ = scenario.scene.build()
        properties = scenario.properties(system, {"stretching": torch.full((2,), float("nan")).double()})
        run = rollout(system, 3, properties=properties, drop_diverged=True)
        assert sorted(run.diverged) == [0, 1]
        assert run.positions.shape[:2] == (2, 4)
        assert run.positions[:, 0].isfinite().all()
        assert run.positions[:, 1:].isnan().all()


def test_interpolation_between_steps():
    positions = torch.arange(4.0).double().view(1, 4, 1, 1).expand(1, 4, 2, 3)
    run = Rollout(positions, torch.arange(4).double() * 0.1, torch.zeros_like(positions))
    at = run.at(torch.tensor([0.0, 0.05, 0.2, 0.3, 9.0]).double())
    assert at[0, :, 0, 0].tolist() == pytest.approx([0, 0.5, 2, 3, 3])
