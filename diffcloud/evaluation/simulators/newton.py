"""Problems in Newton: its vertex block descent (VBD), and the explicit solver that it differentiates.

Both have a stable neo-Hookean membrane, which is this simulator's at small strain. Hinges have the energies of this
simulator's after a conversion: VBD's k l θ²/2, so k = K/l; the explicit solver pushes with k l² θ where the gradient of
θ asks for K θ/height, so k = K/(l (a0 + a1)) where both faces have one size.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from diffcloud.evaluation.simulators.problem import REST_HEIGHT, Problem, Track

Solver = Literal["vbd", "semi_implicit"]
_CONTACT_STIFFNESS = 100.0
"""[N/m] A node of the towel sinks in by 0.03 mm."""
_CONTACT_DAMPING = 0.02
"""[N·s/m] Of the explicit solver, whose nodes bounce without."""
_FRICTION_GAIN = 10.0
"""[N·s/m] Of the explicit solver: a node that sticks creeps by less than 0.1 mm/s."""
_STICKING_SPEED = 1e-3
"""[m/s] Of VBD, as this simulator's."""


@dataclass(frozen=True)
class Settings:
    """What one sets in Newton besides the problem."""

    solver: Solver = "vbd"
    step: float = 1 / 1200
    """[s]"""
    iterations: int = 10
    """Sweeps of a step of VBD."""


EXPLICIT = Settings("semi_implicit", step=2e-4)


def simulate(problem: Problem, settings: Settings | None = None) -> Track:
    """The motion in steps of constant length, in single precision on the processor."""
    newton, _ = _modules()
    chosen = settings or Settings()
    model = _model(problem, chosen.solver)
    if chosen.solver == "vbd":
        solver: Any = newton.solvers.SolverVBD(
            model,
            iterations=chosen.iterations,
            friction_epsilon=_STICKING_SPEED,
            particle_enable_self_contact=problem.self_contact,
            particle_self_contact_radius=2 * REST_HEIGHT,
            particle_self_contact_margin=2.5 * REST_HEIGHT,
        )
    else:
        solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
    now, after, control = model.state(), model.state(), model.control()
    contacts = None if problem.table is None else model.contacts()
    count = problem.steps_of(chosen.step)
    step, total = 1 / (problem.rate * count), (len(problem.times) - 1) * count
    held, wanted = list(problem.held), problem.held_at(np.arange(total + 1) * step)
    frames, began = [problem.mesh.nodes], time.process_time()
    for number in range(1, total + 1):
        now.clear_forces()
        now.particle_q.numpy()[held] = wanted[number]  # on the processor this is the array itself
        now.particle_qd.numpy()[:] *= 1 - problem.settling * step
        if contacts is not None:
            model.collide(now, contacts)
        solver.step(now, after, control, contacts, step)
        now, after = after, now
        if number == 1:
            began = time.process_time()  # kernels are compiled
        if number % count == 0:
            frames.append(now.particle_q.numpy().astype(np.float64))
    return Track(np.array(frames), time.process_time() - began)


def mean_height(problem: Problem, stretching: float = 1.0) -> tuple[float, float, float, float]:
    """As `ours.mean_height`, by the explicit solver, of a problem without table whose held nodes stay."""
    newton, warp = _modules()
    model = _model(problem, "semi_implicit", gradient=True)
    model.tri_materials.assign(model.tri_materials.numpy() * np.array([stretching, stretching, 1, 1, 1], dtype=np.float32))
    solver = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
    count = problem.steps_of(EXPLICIT.step)
    step, total = 1 / (problem.rate * count), (len(problem.times) - 1) * count
    states, control = [model.state() for _ in range(total + 1)], model.control()
    for number in range(2):  # the first time kernels are compiled
        began = time.process_time()
        with warp.Tape() as tape:
            for before, after in pairwise(states):
                before.clear_forces()
                solver.step(before, after, control, None, step)
        forward = time.process_time()
        seed = np.zeros((len(problem.mesh.nodes), 3), dtype=np.float32)
        seed[:, 2] = 1 / len(seed)
        tape.backward(grads={states[-1].particle_q: warp.array(seed, dtype=warp.vec3, device="cpu")})
        done = time.process_time()
        slopes = model.tri_materials.grad.numpy()[:, :2]
        derivative = float((slopes * model.tri_materials.numpy()[:, :2]).sum())
        if number == 0:
            tape.zero()
    return float(states[-1].particle_q.numpy()[:, 2].mean()), derivative, forward - began, done - forward


def _modules() -> tuple[Any, Any]:
    """(newton, warp), which say nothing of the kernels that they load."""
    import warp

    warp.config.quiet = True
    import newton

    return newton, warp


def _model(problem: Problem, solver: Solver, *, gradient: bool = False) -> Any:
    newton, warp = _modules()
    mesh, sheet, implicit = problem.mesh, problem.sheet, solver == "vbd"
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -problem.gravity))
    builder.add_cloth_mesh(
        pos=warp.vec3(0.0),
        rot=warp.quat_identity(),
        scale=1.0,
        vel=warp.vec3(0.0),
        vertices=[warp.vec3(*map(float, node)) for node in mesh.nodes],
        indices=mesh.faces.ravel().tolist(),
        density=sheet.density,
        tri_ke=sheet.shear,
        # the explicit solver's λ is that of its energy, VBD's that of small strains
        tri_ka=sheet.lateral + (0.0 if implicit else sheet.shear),
        # VBD multiplies rates of FᵀF = 2 E + 1; the explicit solver those of F, which resists rigid rotation too
        tri_kd=sheet.shear * sheet.damping * (0.5 if implicit else 2.0),
        tri_drag=0.0,
        tri_lift=0.0,
        edge_ke=1.0,
        edge_kd=0.0,
        particle_radius=REST_HEIGHT,
    )
    damping = 0.0 if implicit else _CONTACT_DAMPING
    if problem.table is not None:
        surface = newton.ModelBuilder.ShapeConfig(mu=problem.friction, ke=_CONTACT_STIFFNESS, kd=damping, kf=_FRICTION_GAIN)
        builder.add_ground_plane(height=problem.table, cfg=surface)
    for node in problem.held:
        builder.particle_mass[node] = 0.0
        builder.particle_flags[node] = int(builder.particle_flags[node]) & ~int(newton.ParticleFlags.ACTIVE)
    if implicit:
        builder.color(include_bending=True)
    model = builder.finalize(device="cpu", requires_grad=gradient)
    model.particle_grid = None  # nodes do not repel each other as balls
    model.soft_contact_mu, model.soft_contact_ke = problem.friction, _CONTACT_STIFFNESS
    model.soft_contact_kd, model.soft_contact_kf = damping, _FRICTION_GAIN
    model.edge_bending_properties.assign(_bending(problem, model.edge_indices.numpy(), solver))
    return model


def _bending(problem: Problem, edges: Any, solver: Solver) -> Any:
    """[E, 2] stiffness and damping of Newton's edges (opposite nodes, then the edge); zero at the boundary."""
    hinges = problem.mesh.hinges
    area = problem.mesh.face_area[hinges.faces].sum(axis=1)
    stiffness = problem.hinge_stiffness / (hinges.length * (1.0 if solver == "vbd" else area))
    rows = {frozenset(pair): row for row, pair in enumerate(hinges.nodes[:, :2].tolist())}
    found = np.zeros((len(edges), 2), dtype=np.float32)
    for edge, pair in enumerate(edges[:, 2:].tolist()):
        if frozenset(pair) in rows:
            found[edge] = stiffness[rows[frozenset(pair)]] * np.array([1.0, problem.sheet.damping])
    return found
