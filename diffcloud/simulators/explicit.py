"""Independent reference simulator: explicit steps in plain NumPy, with the model choices of DiffCloud or of others.

Symplectic Euler steps are so short that the time-step error is negligible. The forces are implemented independently.
With DiffCloud's model choices, results must agree with DiffCloud. So the effect of each other choice can be measured.
Contact with the table is as in DiffCloud; self-contact is not modelled.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from diffcloud.sim.surrounding import ContactSettings
from diffcloud.simulators.problem import Problem, Track

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Choices:
    """Model choices in which simulators differ. Defaults are those of DiffCloud's simulator."""

    rotation_damped: bool = False
    """True: damping is proportional to the full stiffness matrix including tension, and also damps rigid rotation
    (ARCSim). False: only the strain rate is damped."""
    neo_hookean: bool = False
    """True: stable neo-Hookean membrane as in Newton. False: Saint Venant-Kirchhoff membrane."""
    chord: bool = False
    """True: bending energy in the hinge chord 2 sin(θ/2) (MuJoCo). False: in the hinge angle θ."""


def simulate(problem: Problem, choices: Choices | None = None, *, step: float = 1e-4) -> Track:
    """Simulate a problem with explicit steps of about `step` seconds."""
    chosen = choices or Choices()
    count = problem.steps_of(step)
    step, total = 1 / (problem.rate * count), (len(problem.times) - 1) * count
    held, places = list(problem.held), problem.held_at(np.arange(total + 1) * step)
    parts = [membrane_force(problem, chosen), _hinges(problem, chosen), _table(problem)]
    mass = problem.node_mass[:, None]
    x, v = problem.mesh.nodes.copy(), np.zeros_like(problem.mesh.nodes)
    frames, began = [x.copy()], time.process_time()
    for number in range(1, total + 1):
        force = sum(part(x, v) for part in parts)
        v = v + step * (force / mass - [0.0, 0.0, problem.gravity])
        v[held] = (places[number] - x[held]) / step
        x = x + step * v
        if number % count == 0:
            frames.append(x.copy())
    return Track(np.array(frames), time.process_time() - began)


def _gathered(index: NDArray[np.int64], nodes: int) -> csr_array:
    """Sparse matrix [V, index.size] that sums element contributions at the nodes."""
    flat = index.ravel()
    return csr_array((np.ones(len(flat)), (flat, np.arange(len(flat)))), shape=(nodes, len(flat)))


def membrane_force(problem: Problem, chosen: Choices) -> Callable[[Array, Array], Array]:
    """Return the force of stretching and its damping, as a function of positions and velocities [V, 3] -> forces [V,
    3].

    The energy per area of the neo-Hookean membrane is μ (tr FᵀF - 2)/2 + (λ + μ) (J - α)²/2. J is the area ratio and
    α = 1 + μ/(λ + μ).
    """
    mesh, sheet = problem.mesh, problem.sheet
    inverse = np.linalg.inv(mesh.material_edges)  # [F, 2, 2]
    gather, area = _gathered(mesh.faces, len(mesh.nodes)), mesh.face_area[:, None, None]
    plane = sheet.stretching / (1 - sheet.poisson**2)

    def stress(strain: Array) -> Array:
        trace = np.trace(strain, axis1=1, axis2=2)[:, None, None]
        return 2 * sheet.shear * strain + sheet.lateral * trace * np.eye(2)

    def force(x: Array, v: Array) -> Array:
        corner, speed = x[mesh.faces], v[mesh.faces]
        gradient = np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=2) @ inverse  # [F, 3, 2]
        rate = np.stack([speed[:, 1] - speed[:, 0], speed[:, 2] - speed[:, 0]], axis=2) @ inverse
        strain = 0.5 * (np.swapaxes(gradient, 1, 2) @ gradient - np.eye(2))
        mixed = np.swapaxes(gradient, 1, 2) @ rate
        damped = sheet.damping * 0.5 * (mixed + np.swapaxes(mixed, 1, 2))
        if chosen.neo_hookean:
            first, second = gradient[..., 0], gradient[..., 1]
            normal = np.cross(first, second)
            ratio = np.linalg.norm(normal, axis=1)[:, None]
            swelling = (sheet.lateral + sheet.shear) * (ratio - 1) - sheet.shear
            slope = np.stack([np.cross(second, normal / ratio), np.cross(normal / ratio, first)], axis=2)
            pull = sheet.shear * gradient + swelling[..., None] * slope + gradient @ stress(damped)
        else:
            pull = gradient @ stress(strain + damped)
        if chosen.rotation_damped:
            e0, e1 = (np.maximum(strain[:, k, k], 0.0) for k in (0, 1))
            tension = plane * np.stack([e0 + sheet.poisson * e1, sheet.poisson * e0 + e1], axis=1)
            pull = pull + sheet.damping * rate * tension[:, None]
        sides = -area * np.einsum("fai,fki->fka", pull, inverse)  # [F, 2, 3]
        corners = np.stack([-sides.sum(1), sides[:, 0], sides[:, 1]], axis=1)
        return np.asarray(gather @ corners.reshape(-1, 3))

    return force


def neo_hookean_gain(problem: Problem, motion: Array) -> float:
    """Stiffness factor for a neo-Hookean membrane that best matches the forces of the Saint Venant-Kirchhoff membrane.

    The match is a least-squares fit of the node forces over a motion [T, V, 3].
    """
    still = np.zeros_like(motion[0])
    linear, other = (
        np.array([force(nodes, still) for nodes in motion])
        for force in (membrane_force(problem, Choices(neo_hookean=chosen)) for chosen in (False, True))
    )
    size = float((other**2).sum())
    return float((linear * other).sum()) / size if size > 0 else 1.0


def _hinges(problem: Problem, chosen: Choices) -> Callable[[Array, Array], Array]:
    """Return the bending force of the hinges (interior edges), as a function of positions and velocities."""
    mesh, hinges = problem.mesh, problem.mesh.hinges
    gather = _gathered(hinges.nodes, len(mesh.nodes))
    stiffness, damping = problem.hinge_stiffness, problem.sheet.damping

    def force(x: Array, v: Array) -> Array:
        start, end, first, second = np.moveaxis(x[hinges.nodes], 1, 0)
        edge = end - start
        length = np.linalg.norm(edge, axis=1)
        normals = [np.cross(edge, first - start), np.cross(second - start, edge)]
        areas = [np.linalg.norm(normal, axis=1) for normal in normals]
        angle = np.arctan2(-(edge * np.cross(normals[0], normals[1])).sum(1) / length, (normals[0] * normals[1]).sum(1))
        tilts = [normal * (length / size**2)[:, None] for normal, size in zip(normals, areas, strict=True)]
        along = [((arm - start) * edge).sum(1)[:, None] / length[:, None] ** 2 for arm in (first, second)]
        gradient = np.stack(
            [
                (along[0] - 1) * tilts[0] + (along[1] - 1) * tilts[1],
                -(along[0] * tilts[0] + along[1] * tilts[1]),
                tilts[0],
                tilts[1],
            ],
            axis=1,
        )
        turning = (gradient * v[hinges.nodes]).sum((1, 2))
        moment = np.sin(angle) if chosen.chord else angle  # from the energies K (2 sin(θ/2))²/2 and K θ²/2
        put = -(stiffness * (moment + damping * turning))[:, None, None] * gradient
        return np.asarray(gather @ put.reshape(-1, 3))

    return force


def _table(problem: Problem) -> Callable[[Array, Array], Array]:
    """Return the contact and friction force of the table on the nodes, as in DiffCloud's simulator."""
    if problem.table is None:
        return lambda x, v: np.zeros_like(x)
    settings = ContactSettings()
    height, reach = problem.table, settings.repulsion_thickness
    stiffness = settings.stiffness * problem.mesh.node_area

    def force(x: Array, v: Array) -> Array:
        gap = np.clip(x[:, 2] - height, 1e-3 * reach, reach)
        below = gap - reach
        normal = stiffness / 6 * (2 * below * np.log(gap / reach) + below**2 / gap)
        speed = np.linalg.norm(v[:, :2], axis=1)
        y = np.minimum(speed / settings.sticking_speed, 1.0)
        rub = problem.friction * normal * (2 - y) * y / np.maximum(speed, 1e-12)
        return np.column_stack([-rub[:, None] * v[:, :2], normal])

    return force
