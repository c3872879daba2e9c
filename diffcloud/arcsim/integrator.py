"""ARCSim's integrator (`sim.integrators.Integrator`)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from diffcloud.arcsim.adjoint import reverse
from diffcloud.arcsim.build import build_scene
from diffcloud.arcsim.contact.impact_zones import PASSES
from diffcloud.arcsim.scene import UNRESOLVED, Scene
from diffcloud.arcsim.step import simulate
from diffcloud.arcsim.tangent import tangents
from diffcloud.arcsim.terms import CONTACTS, TERMS, kernels
from diffcloud.errors import DivergedError, SceneError, UnresolvedContactError
from diffcloud.sim.compiled.data import Floats, Ints, Motion, Parameters, Timing
from diffcloud.sim.integrators import Derivatives, Episode, Integrator, Outcome
from diffcloud.sim.surrounding import ContactSettings, ReferenceContact, Surrounding
from diffcloud.sim.terms.term import Setup


class Arcsim:
    """Linearised steps with lagged contact and impact zones. Only static obstacles are supported, so `Episode.scenery` is
    unused."""

    name = "arcsim"
    terms = TERMS
    contacts = CONTACTS
    smooth = False
    meshes = False

    def check(self, surrounding: Surrounding) -> None:
        if surrounding.moving or surrounding.bodies:
            raise SceneError("Moving obstacles and rigid bodies need the implicit integrator.")

    def with_contact(self, surrounding: Surrounding) -> Surrounding:
        return replace(surrounding, reference_contact=surrounding.reference_contact or ReferenceContact())

    def resting_height(self, contact: ContactSettings, weight: float) -> float:
        if not contact.stiffness:
            return 0.0
        load = 2 * weight / (contact.stiffness * contact.repulsion_thickness)  # (1 - d/τ)²; above 1: too soft
        return contact.repulsion_thickness * max(1 - math.sqrt(load), 0.0)

    def build(self, setup: Setup, time_step: float) -> Scene:
        return build_scene(setup, time_step)

    def points(self, scene: Scene) -> int:
        return scene.surface.point_count

    def simulate(self, scene: Scene, episode: Episode, keep: int, control: Ints) -> Outcome:
        held, parameters, track, _, anchors, positions, velocities, _ = episode
        found = simulate(scene, held, parameters, track, anchors, positions, velocities, keep, control)
        return Outcome(*found)

    def reverse(self, scene: Scene, episode: Episode, outcome: Outcome, gradients: Derivatives) -> None:
        held, parameters, track, _, anchors, positions, velocities, _ = episode
        reverse(
            scene, held, parameters, track, anchors, positions, velocities, outcome.kept,
            gradients.positions, gradients.velocities, gradients.parameters, gradients.track,
        )  # fmt: skip

    def tangents(self, scene: Scene, episode: Episode, outcome: Outcome, rates: Derivatives) -> None:
        held, parameters, track, _, anchors, positions, velocities, _ = episode
        tangents(
            scene, held, parameters, rates.parameters, track, rates.track, anchors, positions, velocities, outcome.kept,
            rates.positions, rates.velocities,
        )  # fmt: skip

    def energy(self, scene: Scene, parameters: Parameters, positions: Floats) -> float:
        rest, found = np.zeros_like(positions), np.zeros(1)
        kernels.energy(scene.terms, parameters, Motion(positions, rest, rest, rest), Timing(scene.time_step, 0.0), found)
        return float(found[0])

    def fault(self, entry: int, episode: Episode, outcome: Outcome) -> DivergedError:
        if outcome.status != UNRESOLVED:
            return DivergedError(outcome.step + 1, [entry], "the step matrix is not positive definite")
        impacts = outcome.kept.impacts
        kind, *points = impacts.met[impacts.used[0] - 1].tolist()
        name = "edge-edge" if kind else "point-face"
        return UnresolvedContactError(outcome.step + 1, [entry], f"the {name} pair of points {points}", PASSES)


INTEGRATOR: Integrator = Arcsim()
