"""Problems in MuJoCo: a flex of two dimensions, each of its nodes a body that slides along three axes.

Its membrane is Saint Venant's and Kirchhoff's, as is this simulator's, and its damping multiplies the rate of the
strain. It takes both stiffnesses from one Young's modulus E and one thickness h. Its hinges resist by their chord, with
the same dependence on the mesh as this simulator's, and k_b = 4 E h³/(12 (1 - ν²)); with B = k_b/5 of a strip whose
sides are free that gives h² = 15 B (1 - ν²)/(E h).
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from diffcloud.evaluation.simulators.problem import REST_HEIGHT, Problem, Sheet, Track

_HOLDING_MASS = 1e3
"""[kg] Of a held node: what is prescribed to it stays so within a step."""


@dataclass(frozen=True)
class Settings:
    """What one sets in MuJoCo besides the problem."""

    step: float = 2e-4
    """[s] Damping is explicit, so what a step may be falls with the square of the mesh size."""
    cone: str = "elliptic"
    impratio: float = 10.0
    """How much stiffer friction is than the contact itself."""
    contact_time: float = 0.002
    """Time constant of contacts [s], at least two steps."""
    radius: float = REST_HEIGHT
    """Of the nodes [m]."""
    solid: bool = False
    """Whether the thickness is that of a solid sheet with the same E h and B, h² = 12 B/(E h), else as above."""
    holding_mass: float = _HOLDING_MASS


def thickness(sheet: Sheet, *, solid: bool = False) -> float:
    """That MuJoCo is given [m]."""
    return float(np.sqrt((12 if solid else 15 * (1 - sheet.poisson**2)) * sheet.bending / sheet.stretching))


def simulate(problem: Problem, settings: Settings | None = None) -> Track:
    """The motion in steps of constant length."""
    import mujoco

    chosen = settings or Settings()
    count = problem.steps_of(chosen.step)
    step, total = 1 / (problem.rate * count), (len(problem.times) - 1) * count
    model = mujoco.MjModel.from_xml_string(_xml(problem, chosen, step))
    bodies, held = np.asarray(model.flex_vertbodyid), list(problem.held)
    places = model.body_dofadr[bodies][:, None] + np.arange(3)  # of each node in qpos and qvel
    model.dof_damping[places] = problem.settling * problem.node_mass[:, None]
    model.body_mass[bodies] = problem.node_mass
    model.body_mass[bodies[held]] = chosen.holding_mass
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    start, wanted = problem.mesh.nodes, problem.held_at(np.arange(total + 1) * step)
    frames, began = [start], time.process_time()
    for number in range(total):
        data.qpos[places[held]] = wanted[number] - start[held]
        data.qvel[places[held]] = (wanted[number + 1] - wanted[number]) / step
        mujoco.mj_step(model, data)
        if (number + 1) % count == 0:
            frames.append(start + data.qpos[places])
    return Track(np.array(frames), time.process_time() - began)


def _xml(problem: Problem, chosen: Settings, step: float) -> str:
    sheet, thick = problem.sheet, thickness(problem.sheet, solid=chosen.solid)
    contact = f'friction="{problem.friction} 0 0" solref="{chosen.contact_time} 1"'
    table = ""
    if problem.table is not None:
        table = f'<geom type="plane" size="10 10 1" pos="0 0 {problem.table}" {contact}/>'
    points = " ".join(f"{number:.12g}" for number in problem.mesh.nodes.ravel())
    return f"""
<mujoco>
  <option timestep="{step}" gravity="0 0 {-problem.gravity}" cone="{chosen.cone}" impratio="{chosen.impratio}"/>
  <worldbody>
    {table}
    <flexcomp name="cloth" type="direct" dim="2" mass="{problem.node_mass.sum()}" radius="{chosen.radius}"
              point="{points}" element="{" ".join(map(str, problem.mesh.faces.ravel()))}">
      <elasticity young="{sheet.stretching / thick}" poisson="{sheet.poisson}" thickness="{thick}"
                  damping="{sheet.damping}" elastic2d="both"/>
      <contact selfcollide="{"auto" if problem.self_contact else "none"}" condim="3" {contact}/>
      <edge equality="false"/>
    </flexcomp>
  </worldbody>
</mujoco>"""
