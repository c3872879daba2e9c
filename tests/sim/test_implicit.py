"""Laws of the implicit step's kernels: both modes of derivatives agree with each other and with differences, and
nothing passes through anything."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from diffcloud.compiled import kernel
from diffcloud.mesh.shapes import box_surface, grid_cloth, rectangle_surface
from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.compiled.data import Parameters
from diffcloud.sim.compiled.lu import factorised, solve_general
from diffcloud.sim.compiled.sparse import Pattern, pattern
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.held import Held
from diffcloud.sim.implicit import Scene, build_scene
from diffcloud.sim.implicit.adjoint import reverse
from diffcloud.sim.implicit.step import simulate
from diffcloud.sim.implicit.tangent import tangents
from diffcloud.sim.materials import preset
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.rigid.bodies import Bodies
from diffcloud.sim.rigid.body import RigidBody
from diffcloud.sim.scenery import MovingObstacle, Scenery
from diffcloud.sim.status import DONE
from diffcloud.sim.surrounding import Surrounding
from diffcloud.sim.terms.term import Setup

Floats = NDArray[np.float64]
_MATERIAL = preset("jersey-knit")
_SIDE = 4
_DIFFERENTIATED = (
    "node_mass", "stretching", "bending", "damping", "air_density", "air_drag", "friction_obstacle", "friction_cloth",
    "body_mass",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A cloth in a surrounding."""

    mesh: ClothMesh
    handles: Handles
    surrounding: Surrounding
    steps: int = 8
    time_step: float = 0.01

    def scene(self) -> Scene:
        return build_scene(Setup(self.mesh, _MATERIAL, self.surrounding, self.handles, "implicit", False), self.time_step)

    def held(self) -> Held:
        schedule = self.handles.schedule(np.cumsum(np.full(self.steps, self.time_step)))
        first = np.minimum(schedule.first_step, self.steps - 1)
        inverse = [np.linalg.inv(schedule.linear[step, h]) for h, step in enumerate(first)]
        return Held(
            np.array(self.handles.nodes, dtype=np.int64),
            self.handles.hard,
            self.handles.stiffness,
            schedule.strength,
            np.ascontiguousarray(schedule.linear),
            schedule.translation,
            schedule.first_step.astype(np.int64),
            np.array(inverse).reshape(-1, 3, 3),
            schedule.tracked.astype(np.int64),
        )

    def parameters(self, scene: Scene) -> Parameters:
        around, count = self.surrounding, len(self.handles.nodes)
        mass = _MATERIAL.density * self.mesh.node_area
        return Parameters(
            mass,
            np.concatenate([1 / mass, np.zeros(scene.surface.point_count - len(mass))]),
            np.ones(len(self.mesh.faces)),
            np.ones(len(self.mesh.hinges.length)),
            *(np.array([float(value)]) for value in (
                _MATERIAL.damping, around.air_density, around.air_drag, around.friction_obstacle, around.friction_cloth
            )),
            Bodies.build(around.bodies).mass,
            np.zeros(count),
            np.zeros((count, 3)),
        )  # fmt: skip

    def obstacles(self) -> Floats:
        around = self.surrounding
        scenery = Scenery.build([one for one in around.obstacles if one.plane() is None], around.moving)
        times = np.arange(self.steps + 1) * self.time_step
        return np.ascontiguousarray(scenery.at(times, dtype=torch.float64, device=torch.device("cpu")).numpy())


def _cloth(height: float = 0.0) -> ClothMesh:
    mesh = grid_cloth(_SIDE, _SIDE, 0.12, 0.12)
    return replace(mesh, nodes=[*mesh.nodes, 0.004, 0.003, height])


_CORNERS = (Handle(0), Handle(_SIDE - 1))
_UP = Motion((Keyframe(0.0), Keyframe(0.1, translation=(0.0, 0.02, 0.03))))
_CASES = {
    "hanging": Case(_cloth(), Handles(_CORNERS, hard=True), Surrounding(air_drag=0.1)),
    "soft": Case(_cloth(), Handles((Handle(0), Handle(3, _UP, start=0.025))), Surrounding(wind=(0.5, 0.2, 0.1))),
    "moving": Case(_cloth(), Handles((Handle(0), Handle(3, _UP)), hard=True), Surrounding()),
    "plane": Case(
        _cloth(0.0031),
        Handles(()),
        Surrounding(gravity=(3.0, 0.0, -9.0), obstacles=(rectangle_surface((0, 0), (1, 1), 0.0),)),
    ),
    "box": Case(
        _cloth(0.0031), Handles(()), Surrounding(obstacles=(box_surface((-0.02, -0.03, -0.1), (0.03, 0.02, 0.0)),))
    ),
    "pushed": Case(
        _cloth(0.0031),
        Handles(_CORNERS, hard=True),
        Surrounding(moving=(MovingObstacle(box_surface((-0.02, -0.03, -0.1), (0.03, 0.02, 0.0)), _UP),)),
    ),
    "body": Case(
        _cloth(),
        Handles(tuple(Handle(i) for i in (0, 3, 12, 15)), hard=True),
        Surrounding(
            bodies=(
                RigidBody(
                    box_surface((-0.02, -0.02, 0.0035), (0.03, 0.02, 0.03)),
                    density=200.0,
                    velocity=(0.1, 0.0, -0.3),
                    angular_velocity=(1.0, 2.0, 0.5),
                ),
            )
        ),
    ),
}


@dataclass
class Run:
    """An episode and what it was made with."""

    scene: Scene
    held: Held
    parameters: Parameters
    obstacles: Floats
    anchors: Floats
    positions: Floats
    velocities: Floats
    bodies: Floats
    kept: Any


def _run(case: Case, parameters: Parameters | None = None, start: tuple[Floats, Floats, Floats] | None = None) -> Run:
    scene, held, own = case.scene(), case.held(), Bodies.build(case.surrounding.bodies)
    parameters = case.parameters(scene) if parameters is None else parameters
    nodes = len(case.mesh.nodes)
    positions, velocities = np.zeros((case.steps + 1, nodes, 3)), np.zeros((case.steps + 1, nodes, 3))
    bodies, anchors, obstacles = np.zeros((case.steps + 1, len(own), 18)), np.zeros((len(held.node), 3)), case.obstacles()
    positions[0], bodies[0] = case.mesh.nodes, own.start
    if start is not None:
        positions[0], velocities[0], bodies[0] = start
    track, control = np.zeros((case.steps, 3)), np.zeros(2, np.int64)
    status, _, kept = simulate(
        scene, held, parameters, track, obstacles, anchors, positions, velocities, bodies, 0, control, np.zeros(6)
    )
    assert status == DONE
    assert control[0] == case.steps
    return Run(scene, held, parameters, obstacles, anchors, positions, velocities, bodies, kept)


@pytest.mark.parametrize("name", _CASES)
def test_both_modes_agree_with_each_other_and_with_differences(name: str) -> None:
    case, rng = _CASES[name], np.random.default_rng(3)
    run = _run(case)
    p, nodes, count = run.parameters, len(case.mesh.nodes), run.bodies.shape[1]
    weights, body_weights = rng.normal(size=run.positions.shape), rng.normal(size=run.bodies.shape)
    track = np.zeros((case.steps, 3))

    slopes, speeds, own = weights.copy(), np.zeros_like(weights), body_weights.copy()
    gradients, track_slopes = Parameters(*(np.zeros_like(one) for one in p)), np.zeros_like(track)
    given = (run.obstacles, run.anchors, run.positions, run.velocities, run.bodies, run.kept)
    reverse(run.scene, run.held, p, track, *given, slopes, speeds, own, gradients, track_slopes)

    rates = Parameters(*(np.zeros((1, *one.shape)) for one in p))
    for field in _DIFFERENTIATED:
        value = getattr(p, field)
        getattr(rates, field)[0] = rng.normal(size=value.shape) * (np.abs(value) + 1e-4)
    steps = case.steps + 1
    x, v, b = np.zeros((steps, 1, nodes, 3)), np.zeros((steps, 1, nodes, 3)), np.zeros((steps, 1, count, 18))
    x[0], v[0], b[0] = (1e-3 * rng.normal(size=one.shape) for one in (x[0], v[0], b[0]))
    tangents(run.scene, run.held, p, rates, track, np.zeros((1, *track.shape)), *given, x, v, b)
    change = (weights * x[:, 0]).sum() + (body_weights * b[:, 0]).sum()

    backwards = (slopes[0] * x[0, 0]).sum() + (speeds[0] * v[0, 0]).sum() + (own[0] * b[0, 0]).sum()
    backwards += sum((getattr(gradients, field) * getattr(rates, field)[0]).sum() for field in _DIFFERENTIATED)
    assert backwards == pytest.approx(change, rel=1e-10)

    def loss(step: float) -> float:
        moved = p._replace(**{field: getattr(p, field) + step * getattr(rates, field)[0] for field in _DIFFERENTIATED})
        other = _run(
            case,
            moved._replace(hold=p.hold.copy(), target=p.target.copy()),
            (run.positions[0] + step * x[0, 0], run.velocities[0] + step * v[0, 0], run.bodies[0] + step * b[0, 0]),
        )
        return float((weights * other.positions).sum() + (body_weights * other.bodies).sum())

    assert (loss(1e-5) - loss(-1e-5)) / 2e-5 == pytest.approx(change, rel=1e-5)


def test_cloth_stays_above_the_box() -> None:
    run = _run(_CASES["box"])
    x = run.positions
    inside = (x[..., 0] > -0.02) & (x[..., 0] < 0.03) & (x[..., 1] > -0.03) & (x[..., 1] < 0.02)
    assert (x[..., 2][inside] > 0).all()
    assert (x[-1, :, 2] < x[0, :, 2]).any()


def test_a_body_and_the_cloth_fall_freely_alike() -> None:
    case = replace(_CASES["body"], handles=Handles(()), surrounding=replace(
        _CASES["body"].surrounding, air_density=0.0,
        bodies=(replace(_CASES["body"].surrounding.bodies[0], mesh=box_surface((-0.02, -0.02, 0.05), (0.03, 0.02, 0.08)),
                        velocity=(0.0, 0.0, 0.0)),),
    ))  # fmt: skip
    run = _run(case)
    fall = -9.81 * case.time_step**2 * np.arange(case.steps + 1) * (np.arange(case.steps + 1) + 1) / 2
    np.testing.assert_allclose(run.positions[:, :, 2] - run.positions[0, :, 2], np.tile(fall[:, None], 16), atol=1e-10)
    np.testing.assert_allclose(run.bodies[:, 0, 2] - run.bodies[0, 0, 2], fall, atol=1e-10)


@kernel
def _solved(of: Pattern, lower: Floats, upper: Floats, right: Floats, transposed: int, found: Floats) -> bool:
    return solve_general(factorised(of, lower, upper), right, transposed, found)


@pytest.mark.parametrize("singular", [False, True])
def test_block_lu_solves_both_ways(singular: bool) -> None:
    """Also where a pivot is singular and dense LU has to help."""
    count, rng = 12, np.random.default_rng(0)
    of = pattern(count, [np.array([rng.choice(count, 3, replace=False) for _ in range(20)])])
    lower, upper = rng.normal(size=(len(of.rows) + 1, 9)), rng.normal(size=(len(of.rows) + 1, 9))
    dense = np.zeros((count, 3, count, 3))
    for j in range(count):
        if not singular or j != 3:
            lower[of.starts[j]] += 8 * np.eye(3).ravel()
        else:
            lower[of.starts[j]] = 0.0
        for at in range(of.starts[j], of.starts[j + 1]):
            i = of.rows[at]
            dense[i, :, j] = lower[at].reshape(3, 3)
            if i != j:
                dense[j, :, i] = upper[at].reshape(3, 3).T
    matrix = dense[of.place][:, :, of.place].reshape(3 * count, 3 * count)
    right, found = rng.normal(size=(count, 3)), np.empty((count, 3))
    for transposed in (0, 1):
        assert _solved(of, lower, upper, right, transposed, found)
        expected = np.linalg.solve(matrix.T if transposed else matrix, right.ravel())
        np.testing.assert_allclose(found.ravel(), expected, rtol=1e-9, atol=1e-12)
