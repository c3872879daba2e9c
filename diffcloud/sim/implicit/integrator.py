"""The implicit integrator (`integrators.Integrator`)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from diffcloud.errors import DivergedError, SceneError
from diffcloud.sim.compiled.data import Floats, Ints, Motion, Parameters, Timing
from diffcloud.sim.implicit.adjoint import reverse
from diffcloud.sim.implicit.build import build_scene
from diffcloud.sim.implicit.scene import Scene
from diffcloud.sim.implicit.step import simulate
from diffcloud.sim.implicit.tangent import tangents
from diffcloud.sim.implicit.terms import CONTACTS, kernels
from diffcloud.sim.integrators import Derivatives, Episode, Integrator, Outcome
from diffcloud.sim.surrounding import ContactSettings, Surrounding
from diffcloud.sim.terms import TERMS
from diffcloud.sim.terms.term import Setup


class Implicit:
    """Implicit steps, iterated to convergence, with smooth contact and rigid bodies."""

    name = "implicit"
    terms = TERMS
    contacts = CONTACTS
    smooth = True
    meshes = True

    def check(self, surrounding: Surrounding) -> None:
        if surrounding.reference_contact is not None:
            raise SceneError("Contact by proximity and impact zones belongs to the arcsim integrator.")

    def with_contact(self, surrounding: Surrounding) -> Surrounding:
        return replace(surrounding, reference_contact=None)

    def resting_height(self, contact: ContactSettings, weight: float) -> float:
        load = 2 * weight / (contact.stiffness * contact.repulsion_thickness)
        # Force of the barrier at d = y τ: ((1 - y)²/y - 2 (1 - y) ln y)/3. It decreases from infinity to 0.
        low, high = 0.0, 1.0
        for _ in range(60):
            y = (low + high) / 2
            low, high = (y, high) if ((1 - y) ** 2 / y - 2 * (1 - y) * math.log(y)) / 3 > load else (low, y)
        return contact.repulsion_thickness * high

    def build(self, setup: Setup, time_step: float) -> Scene:
        return build_scene(setup, time_step)

    def points(self, scene: Scene) -> int:
        return scene.surface.point_count

    def simulate(self, scene: Scene, episode: Episode, keep: int, control: Ints) -> Outcome:
        fault = np.zeros(6)
        status, step, kept = simulate(scene, *episode, keep, control, fault)
        return Outcome(status, step, kept, fault)

    def reverse(self, scene: Scene, episode: Episode, outcome: Outcome, gradients: Derivatives) -> None:
        reverse(
            scene, *episode, outcome.kept,
            gradients.positions, gradients.velocities, gradients.bodies, gradients.parameters, gradients.track,
        )  # fmt: skip

    def tangents(self, scene: Scene, episode: Episode, outcome: Outcome, rates: Derivatives) -> None:
        held, parameters, track, scenery, anchors, positions, velocities, bodies = episode
        tangents(
            scene, held, parameters, rates.parameters, track, rates.track, scenery, anchors, positions, velocities, bodies,
            outcome.kept, rates.positions, rates.velocities, rates.bodies,
        )  # fmt: skip

    def energy(self, scene: Scene, parameters: Parameters, positions: Floats) -> float:
        rest, found = np.zeros_like(positions), np.zeros(1)
        kernels.energy(scene.terms, parameters, Motion(positions, rest, rest, rest), Timing(scene.time_step, 0.0), found)
        return float(found[0])

    def fault(self, entry: int, episode: Episode, outcome: Outcome) -> DivergedError:
        assert outcome.fault is not None
        change, kind, *points = outcome.fault.tolist()
        name = ("point-face", "edge-edge")[int(kind)] if 0 <= kind < 2 else "no"
        closest = f"{name} pair of points {[int(point) for point in points if point >= 0]}"
        if kind == 2:
            closest = f"point {int(points[0])} and half-space {int(points[1])}"
        of = episode.parameters
        reason = (
            f"the implicit step did not converge (relative change {change:.1e}; closest: {closest}); sub-steps did not "
            f"help (mean stretching multiplier {of.stretching.mean():.3g}, mean node mass {of.node_mass.mean():.3g} kg). "
            "Try a smaller time step, a thicker or stiffer contact, or slower handles"
        )
        return DivergedError(outcome.step + 1, [entry], reason)


INTEGRATOR: Integrator = Implicit()
