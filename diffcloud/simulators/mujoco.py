"""Simulate problems in MuJoCo. The cloth is a 2D flex, in which each node is a body with three slide joints.

MuJoCo's membrane is Saint Venant-Kirchhoff, as is that of DiffCloud's simulator, and its damping multiplies the strain
rate. MuJoCo takes the membrane and the bending stiffness from one Young's modulus E and one thickness h.

The energy of MuJoCo's hinges depends on their chord 2 sin(θ/2) instead of their angle θ. Hinge stiffnesses depend on the
mesh as in DiffCloud's simulator, with k_b = 4 E h³/(12 (1 - ν²)). A strip with free sides has the bending stiffness
B = k_b/5. Hence h² = 15 B (1 - ν²)/(E h).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import numpy as np

from diffcloud.simulators.problem import REST_HEIGHT, Problem, Sheet, Track

_HOLDING_MASS = 1e3
"""Mass of a held node [kg], so large that forces hardly change its prescribed velocity within a step."""
_SHORTEST, _LONGEST = 2e-5, 5e-4
"""Limits of the time step of an exported cloth [s]. Damping that needs shorter steps is reduced. Longer steps degrade
contact."""


@dataclass(frozen=True)
class Settings:
    """MuJoCo settings that are not part of the problem."""

    step: float = 2e-4
    """Time step [s]. Damping is explicit, so the largest stable step is proportional to the square of the mesh size."""
    cone: str = "elliptic"
    impratio: float = 10.0
    """Ratio of friction stiffness to contact stiffness."""
    contact_time: float = 0.002
    """Time constant of contacts [s], at least two steps."""
    radius: float = REST_HEIGHT
    """Radius of the nodes [m]."""
    solid: bool = False
    """True: thickness of a solid sheet with the same E h and B, h² = 12 B/(E h). False: as in the module docstring."""
    holding_mass: float = _HOLDING_MASS


def thickness(sheet: Sheet, *, solid: bool = False) -> float:
    """Thickness h for MuJoCo [m]."""
    return float(np.sqrt((12 if solid else 15 * (1 - sheet.poisson**2)) * sheet.bending / sheet.stretching))


def stable(problem: Problem) -> tuple[Settings, Sheet]:
    """Return settings with a stable time step, and the sheet with damping reduced if necessary.

    Explicit steps Δt are stable for Δt² ω² + 2 d ω² Δt < 4. The highest frequency ω of a triangle of height a is about
    ω² = 4 E h/((1 - ν²) σ a²) for in-plane motion and 16 B/(σ a⁴) for bending. Steps are half the stable length.
    """
    sheet, height = problem.sheet, problem.mesh.smallest_height
    plane = 4 * sheet.stretching / ((1 - sheet.poisson**2) * sheet.density * height**2)
    across = 16 * sheet.bending / (sheet.density * height**4)
    squared = plane + across
    most = max((4 / squared - _SHORTEST**2 * 4) / (4 * _SHORTEST), 0.0)
    damping = min(sheet.damping, most)
    step = 0.5 * (np.sqrt(damping**2 + 4 / squared) - damping)
    touches = problem.table is not None or problem.bodies or problem.self_contact
    return Settings(step=min(float(step), _LONGEST) if touches else float(step)), replace(sheet, damping=damping)


def simulate(problem: Problem, settings: Settings | None = None) -> Track:
    """Simulate a problem with constant time steps."""
    import mujoco

    from diffcloud.simulators.scripts import run_mujoco

    chosen = settings or Settings()
    count = problem.steps_of(chosen.step)
    step, total = 1 / (problem.rate * count), (len(problem.times) - 1) * count
    model = mujoco.MjModel.from_xml_string(model_file(problem, chosen))
    model.dof_damping[run_mujoco.node_places(model)[1]] = problem.settling * problem.node_mass[:, None]
    wanted = problem.held_at(np.arange(total + 1) * step)
    began = time.process_time()
    frames = run_mujoco.frames(model, mujoco.MjData(model), np.array(list(problem.held)), wanted, count)
    return Track(np.array(list(frames)), time.process_time() - began)


def model_file(problem: Problem, settings: Settings | None = None, *, header: str = "") -> str:
    """Return the problem as MuJoCo XML (MJCF).

    Each node is a body with three slide joints. Held nodes have a large mass and no gravity, so that they keep the
    position that each step prescribes.

    Args:
        header: comment at the start of the file.
    """
    chosen, sheet = settings or Settings(), problem.sheet
    step = 1 / (problem.rate * problem.steps_of(chosen.step))
    thick = thickness(sheet, solid=chosen.solid)
    contact, itself = (
        {"friction": f"{friction:.9g} 0 0", "solref": f"{chosen.contact_time:.9g} 1"} for friction in problem.frictions
    )
    surface_of: dict[str, Any] = {**contact, "priority": "1"}  # so that the flex's own friction is only self-friction
    root = Element("mujoco", model=problem.name)
    if header:
        root.append(Comment(header))
    solver = {"timestep": repr(float(step)), "cone": chosen.cone, "impratio": f"{chosen.impratio:g}"}
    SubElement(root, "option", solver, gravity=f"0 0 {-problem.gravity:.9g}")
    asset, world = SubElement(root, "asset"), SubElement(root, "worldbody")
    if problem.table is not None:
        SubElement(world, "geom", name="table", type="plane", size="10 10 1", pos=f"0 0 {problem.table:.9g}", **surface_of)
    for number, surface in enumerate(problem.bodies):
        SubElement(asset, "mesh", name=f"body{number}", vertex=_listed(surface.nodes), face=_listed(surface.faces))
        SubElement(world, "geom", name=f"body{number}", type="mesh", mesh=f"body{number}", **surface_of)
    for node, (place, mass) in enumerate(zip(problem.mesh.nodes, problem.node_mass, strict=True)):
        held = node in problem.held
        body = SubElement(world, "body", name=f"cloth_{node}", pos=_listed(place), gravcomp=str(int(held)))
        weight = chosen.holding_mass if held else mass
        SubElement(body, "inertial", pos="0 0 0", mass=f"{weight:.9g}", diaginertia="1e-6 1e-6 1e-6")
        for axis in ("1 0 0", "0 1 0", "0 0 1"):
            SubElement(body, "joint", type="slide", axis=axis)
    names = " ".join(f"cloth_{node}" for node in range(len(problem.mesh.nodes)))
    shape = {"radius": f"{chosen.radius:.9g}", "body": names, "element": _listed(problem.mesh.faces)}
    flex = SubElement(SubElement(root, "deformable"), "flex", shape, name="cloth", dim="2")
    elasticity = {"young": sheet.stretching / thick, "poisson": sheet.poisson, "thickness": thick, "damping": sheet.damping}
    SubElement(flex, "elasticity", {name: f"{value:.9g}" for name, value in elasticity.items()}, elastic2d="both")
    SubElement(flex, "contact", itself, selfcollide="auto" if problem.self_contact else "none", condim="3")
    indent(root)
    return tostring(root, encoding="unicode") + "\n"


def _listed(numbers: Any) -> str:
    return " ".join(f"{number:.12g}" for number in np.ravel(numbers))
