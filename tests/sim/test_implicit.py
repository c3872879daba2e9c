"""Laws of implicit steps: both modes of derivatives agree with each other and with differences, nothing passes through
anything, and steps that are halved are derived like others."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from diffcloud.compiled import kernel
from diffcloud.errors import DivergedError
from diffcloud.mesh import ClothMesh, box_surface, grid_cloth, rectangle_surface
from diffcloud.sim import Properties, Rollout, State, init, rollout, rollout_tangents
from diffcloud.sim.build import build_system
from diffcloud.sim.compiled.data import Floats
from diffcloud.sim.compiled.lu import factorised, solve_general
from diffcloud.sim.compiled.sparse import Pattern, pattern
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import preset
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.rigid.bodies import BodyState
from diffcloud.sim.rigid.body import RigidBody
from diffcloud.sim.scenery import MovingObstacle
from diffcloud.sim.surrounding import Surrounding
from diffcloud.sim.system import System

STEPS, _SIDE = 8, 4


@dataclass(frozen=True)
class Case:
    """A cloth in a surrounding."""

    mesh: ClothMesh
    handles: Handles
    surrounding: Surrounding
    time_step: float = 0.01
    compression: float = 1.0

    def system(self) -> System:
        return build_system(
            self.mesh,
            replace(preset("jersey-knit"), compression=self.compression),
            time_step=self.time_step,
            handles=self.handles,
            surrounding=self.surrounding,
            integrator="implicit",
        )


def _cloth(height: float = 0.0) -> ClothMesh:
    mesh = grid_cloth(_SIDE, _SIDE, 0.12, 0.12)
    return replace(mesh, nodes=np.add(mesh.nodes, (0.004, 0.003, height)))


_CORNERS = (Handle(0), Handle(_SIDE - 1))
_UP = Motion((Keyframe(0.0), Keyframe(0.1, translation=(0.0, 0.02, 0.03))))
_IN = Motion((Keyframe(0.0), Keyframe(0.1, translation=(-0.04, 0.0, 0.0))))
_CASES = {
    "hanging": Case(_cloth(), Handles(_CORNERS, hard=True), Surrounding(air_drag=0.1)),
    "soft": Case(_cloth(), Handles((Handle(0), Handle(3, _UP, start=0.025))), Surrounding(wind=(0.5, 0.2, 0.1))),
    "moving": Case(_cloth(), Handles((Handle(0), Handle(3, _UP)), hard=True), Surrounding()),
    "wrinkling": Case(_cloth(), Handles((Handle(0), Handle(3, _IN)), hard=True), Surrounding(), compression=0.1),
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


def moved(value: Tensor, rate: Tensor, step: float) -> Tensor:
    return value + step * rate


@pytest.mark.parametrize("name", _CASES)
def test_both_modes_agree_with_each_other_and_with_differences(name):
    system, rng = _CASES[name].system(), np.random.default_rng(3)
    tracked = system.handles.moving.any()

    def random(like: Tensor, scale: Tensor | float) -> Tensor:
        return torch.as_tensor(rng.normal(size=like.shape)) * scale

    start = init(system)
    track = 1e-3 * torch.arange(1.0, STEPS + 1).double()[None, :, None, None].expand(1, STEPS, 1, 3) if tracked else None
    fields = list(system.properties.tensors())
    rates = [random(field, field.abs() + 1e-4) for field in fields]
    places = [start.positions, start.velocities, *([] if start.bodies is None else start.bodies.tensors())]
    moves = [random(place, 1e-3) for place in places]
    pull = None if track is None else random(track, 1e-3)
    weights = random(torch.zeros(STEPS + 1, *start.positions.shape[1:]), 1.0)

    def state(parts: list[Tensor]) -> State:
        return State(parts[0], parts[1], BodyState(*parts[2:]) if len(parts) > 2 else None)

    def value(step: float) -> Tensor:
        run = rollout(
            system,
            STEPS,
            properties=Properties(*(moved(f, r, step) for f, r in zip(fields, rates, strict=True))),
            state=state([moved(p, m, step) for p, m in zip(places, moves, strict=True)]),
            track=None if track is None else moved(track, pull, step),
        )
        return (run.positions[0] * weights).sum()

    inputs = [one.clone().requires_grad_(True) for one in [*fields, *places, *([] if track is None else [track])]]
    own = inputs[len(fields) :]
    run = rollout(
        system,
        STEPS,
        properties=Properties(*inputs[: len(fields)]),
        state=state(own[: len(places)]),
        track=None if track is None else own[-1],
    )
    gradients = torch.autograd.grad((run.positions[0] * weights).sum(), inputs, materialize_grads=True)
    along = [*rates, *moves, *([] if pull is None else [pull])]
    parts = [g * a for g, a in zip(gradients, along, strict=True)]
    backwards = float(sum(part.sum() for part in parts))
    usual = float(sum(part.square().sum() for part in parts)) ** 0.5
    scale = abs(backwards) if abs(backwards) > 0.3 * usual else usual  # where the parts cancel, that of a random direction
    _, found = rollout_tangents(
        system,
        STEPS,
        properties=system.properties,
        tangents=Properties(*rates),
        state=state(places),
        state_tangents=state(moves),
        track=track,
        track_tangents=pull,
    )
    assert backwards == pytest.approx(float((found[0, 0] * weights).sum()), rel=1e-10)
    with torch.no_grad():
        # where something begins to touch within the step of a difference, that difference is of two motions; and small
        # ones are of the iterate with which the solver stops, not of the solution that it is close to
        sizes = (3e-4, 3e-5, 3e-6)
        differences = [float(value(size) - value(-size)) / (2 * size) for size in sizes]
    assert min(abs(one - backwards) for one in differences) < 1e-5 * scale
    assert (float(Properties(*gradients[: len(fields)]).compression) != 0) == (name == "wrinkling")


def test_a_step_that_does_not_converge_is_halved_and_its_gradient_holds():
    """A corner that is jerked away by many thicknesses within a step, beside a box."""
    jerk = Motion((Keyframe(0.0), Keyframe(0.02, translation=(0.05, 0.03, 0.12))))
    case = replace(_CASES["box"], handles=Handles((Handle(0, jerk), Handle(15)), hard=True), time_step=0.02)
    system = case.system()

    def last(values: Tensor) -> Tensor:
        properties = replace(system.properties.repeated(len(values)), damping=values)
        run = rollout(system, 4, properties=properties)
        return run.positions[:, -1].square().sum((1, 2))

    damping = torch.tensor([2e-3], dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(last(damping).sum(), damping)
    with torch.no_grad():
        plus, minus = last(torch.tensor([2e-3 + 1e-7, 2e-3 - 1e-7], dtype=torch.float64))
    assert float(gradient) == pytest.approx(float(plus - minus) / 2e-7, rel=1e-4)


def test_a_step_without_solution_names_itself():
    """A plate that presses the cloth through a table."""
    plate, table = box_surface((-0.1, -0.1, 0.02), (0.1, 0.1, 0.1)), rectangle_surface((0, 0), (1, 1), 0.0)
    crush = MovingObstacle(plate, Motion((Keyframe(0.0), Keyframe(0.05, translation=(0.0, 0.0, -0.05)))))
    system = Case(_cloth(0.004), Handles(()), Surrounding(obstacles=(table,), moving=(crush,))).system()
    with pytest.raises(
        DivergedError, match=r"step \d.*not converge.*closest: (.*pair of points|point \d+ and half-space 0)"
    ):
        rollout(system, STEPS)


def test_cloth_stays_above_the_box():
    x = rollout(_CASES["box"].system(), STEPS).positions[0].numpy()
    inside = (x[..., 0] > -0.02) & (x[..., 0] < 0.03) & (x[..., 1] > -0.03) & (x[..., 1] < 0.02)
    assert (x[..., 2][inside] > 0).all()
    assert (x[-1, :, 2] < x[0, :, 2]).any()


def test_a_body_and_the_cloth_fall_freely_alike():
    around = _CASES["body"].surrounding
    far = box_surface((-0.02, -0.02, 0.05), (0.03, 0.02, 0.08))
    body = replace(around.bodies[0], mesh=far, velocity=(0.0, 0.0, 0.0))
    free = replace(_CASES["body"], handles=Handles(()), surrounding=replace(around, air_density=0.0, bodies=(body,)))
    run: Rollout = rollout(free.system(), STEPS)
    fall = -9.81 * free.time_step**2 * np.arange(STEPS + 1) * (np.arange(STEPS + 1) + 1) / 2
    heights = run.positions[0, :, :, 2].numpy()
    np.testing.assert_allclose(heights - heights[0], np.tile(fall[:, None], 16), atol=1e-10)
    centre = run.bodies.centre[0, :, 0, 2].numpy()
    np.testing.assert_allclose(centre - centre[0], fall, atol=1e-10)


@kernel
def _solved(of: Pattern, lower: Floats, upper: Floats, right: Floats, transposed: int, found: Floats) -> bool:
    """After it has been asked for nothing, which must not make it trust its factors."""
    matrix = factorised(of, lower, upper)
    return solve_general(matrix, np.zeros_like(right), transposed, found) and solve_general(
        matrix, right, transposed, found
    )


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
    lower[:], upper[:] = 0.0, 0.0
    for transposed in (0, 1):
        assert not _solved(of, lower, upper, right, transposed, found)
        assert np.isnan(found).all()
