"""Run the cloth of cloth.npz in Newton by vertex block descent (VBD), its held nodes moved as they were recorded.

    pip install newton==1.8.0 warp-lang==1.19.0 numpy
    python run_newton.py              writes nodes.npz: nodes [T, V, 3] [m] at times [T] [s]

To use the cloth in your own model, call `add_cloth` with your builder before you add anything else that has particles.
Then call the builder's `color(include_bending=True)`, and `finish_cloth` with the finalized model. In each step, move
the held nodes as `frames` does.
"""

import argparse
from pathlib import Path

import newton
import numpy as np
import warp

CONTACT_STIFFNESS = 100.0
"""Contact stiffness [N/m]. A node of a light towel penetrates by 0.03 mm."""
CONTACT_DAMPING = 0.02
"""Contact damping of the explicit solver [N·s/m]. Without damping, nodes would bounce."""
FRICTION_GAIN = 10.0
"""Friction gain of the explicit solver [N·s/m]. A sticking node creeps by less than 0.1 mm/s."""
STICKING_SPEED = 1e-3
"""Speed below which nodes stick in VBD [m/s]."""


def add_cloth(builder, cloth, explicit=False):
    """Add the cloth, its table and the meshes of its obstacles to a model builder.

    Args:
        builder: the `newton.ModelBuilder`.
        cloth: arrays of cloth.npz.
        explicit: whether the explicit solver will run the model. Its elastic constants differ from those of VBD.
    """
    shear, lateral, damping = (float(cloth[name]) for name in ("shear", "lateral", "damping"))
    gain = float(cloth["membrane_gain"])  # compensates a membrane that is too soft at large strains
    builder.add_cloth_mesh(
        pos=warp.vec3(0.0),
        rot=warp.quat_identity(),
        scale=1.0,
        vel=warp.vec3(0.0),
        vertices=[warp.vec3(*map(float, node)) for node in cloth["nodes"]],
        indices=cloth["faces"].ravel().tolist(),
        density=float(cloth["density"]),
        tri_ke=gain * shear,
        # λ in the explicit solver is the coefficient in its energy; in VBD it is that of small-strain theory.
        tri_ka=gain * (lateral + (shear if explicit else 0.0)),
        # VBD damps the rate of FᵀF = 2 E + 1. The explicit solver damps the rate of F, and so rigid rotation too.
        tri_kd=shear * damping * (2.0 if explicit else 0.5),
        tri_drag=0.0,
        tri_lift=0.0,
        edge_ke=1.0,
        edge_kd=0.0,
        particle_radius=float(cloth["radius"]),
    )
    for node in cloth["held"].tolist():
        builder.particle_mass[node] = 0.0
        builder.particle_flags[node] = int(builder.particle_flags[node]) & ~int(newton.ParticleFlags.ACTIVE)
    surface = newton.ModelBuilder.ShapeConfig(
        mu=float(cloth["friction"]), ke=CONTACT_STIFFNESS, kd=CONTACT_DAMPING if explicit else 0.0, kf=FRICTION_GAIN
    )
    if np.isfinite(cloth["table"]):
        builder.add_ground_plane(height=float(cloth["table"]), cfg=surface)
    if len(cloth["body_faces"]):
        mesh = newton.Mesh(cloth["body_nodes"], cloth["body_faces"].ravel(), compute_inertia=False)
        builder.add_shape_mesh(-1, mesh=mesh, cfg=surface)


def finish_cloth(model, cloth, explicit=False):
    """Set properties that a builder does not accept: friction of the cloth, and stiffness and rest angle of each edge.

    The energy of an edge is K θ²/2. VBD uses k l θ²/2, so k = K/l. The explicit solver applies the force k l² θ, but the
    gradient of the energy is K θ/h, where h is a face's height over the edge. So k = K/(l (a0 + a1)) for two faces of
    the same size.
    """
    model.particle_grid = None  # no repulsion between nodes as spheres
    model.soft_contact_mu, model.soft_contact_ke = float(cloth["friction"]), CONTACT_STIFFNESS
    model.soft_contact_kd, model.soft_contact_kf = CONTACT_DAMPING if explicit else 0.0, FRICTION_GAIN
    stiffness = cloth["hinge_stiffness"] / (cloth["hinge_length"] * (cloth["hinge_area"] if explicit else 1.0))
    # Find edges by their two nodes. Boundary edges and edges of other cloths keep the builder's values.
    there, own = (np.sort(pairs, axis=1) for pairs in (model.edge_indices.numpy()[:, 2:], cloth["hinge_edges"]))
    numbers = (pairs[:, 0].astype(np.int64) * model.particle_count + pairs[:, 1] for pairs in (there, own))
    _, edges, rows = np.intersect1d(*numbers, return_indices=True)
    bending, rest = model.edge_bending_properties.numpy().copy(), model.edge_rest_angle.numpy().copy()
    bending[edges] = stiffness[rows, None] * np.array([1.0, float(cloth["damping"])])
    model.edge_bending_properties.assign(bending)
    if not cloth["shaped"]:  # by default, the builder uses the initial shape as rest shape
        rest[edges] = 0.0
        model.edge_rest_angle.assign(rest)


def build(cloth, explicit=False, gradient=False):
    """Build a model of the cloth alone, on the CPU."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, -float(cloth["gravity"])))
    add_cloth(builder, cloth, explicit)
    if not explicit:
        builder.color(include_bending=True)
    model = builder.finalize(device="cpu", requires_grad=gradient)
    finish_cloth(model, cloth, explicit)
    return model


def solver_of(model, cloth, explicit=False, iterations=10):
    if explicit:
        return newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
    return newton.solvers.SolverVBD(
        model,
        iterations=iterations,
        friction_epsilon=STICKING_SPEED,
        particle_enable_self_contact=bool(cloth["self_contact"]),
        particle_self_contact_radius=2 * float(cloth["radius"]),
        particle_self_contact_margin=2.5 * float(cloth["radius"]),
    )


def frames(model, solver, cloth, wanted, step, every):
    """Yield node positions [V, 3] [m] at the start and after every `every` steps.

    Args:
        wanted: [S + 1, K, 3] positions of the held nodes at the start and after each step [m].
        step: time step [s].
    """
    now, after, control = model.state(), model.state(), model.control()
    touches = np.isfinite(cloth["table"]) or len(cloth["body_faces"])
    contacts = model.contacts() if touches else None
    held, slowed = cloth["held"], 1 - float(cloth["settling"]) * step
    yield np.array(cloth["nodes"])
    for number in range(1, len(wanted)):
        now.clear_forces()
        now.particle_q.numpy()[held] = wanted[number]  # on the CPU, numpy() shares memory with the array
        now.particle_qd.numpy()[:] *= slowed
        if contacts is not None:
            model.collide(now, contacts)
        solver.step(now, after, control, contacts, step)
        now, after = after, now
        if number % every == 0:
            yield now.particle_q.numpy().astype(np.float64)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--step", type=float, default=1 / 1200, help="[s]; the shorter, the better VBD converges")
    parser.add_argument("--iterations", type=int, default=10, help="VBD sweeps per step")
    parser.add_argument("--out", type=Path, default=Path("nodes.npz"), help="where to write the nodes")
    chosen = parser.parse_args()
    with np.load(Path(__file__).resolve().parent / "cloth.npz") as told:
        cloth = dict(told)
    times, keys, motion = cloth["times"], cloth["motion_times"], cloth["motion"]
    every = max(1, round((times[1] - times[0]) / chosen.step))
    step = (times[1] - times[0]) / every
    steps = np.arange(every * (len(times) - 1) + 1) * step
    wanted = [[np.interp(steps, keys, motion[:, k, axis]) for axis in range(3)] for k in range(motion.shape[1])]
    model = build(cloth)
    solver = solver_of(model, cloth, iterations=chosen.iterations)
    nodes = list(frames(model, solver, cloth, np.array(wanted).transpose(2, 0, 1), step, every))
    np.savez(chosen.out, nodes=np.array(nodes), times=times)


if __name__ == "__main__":
    main()
