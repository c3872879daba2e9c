"""One linearised backward-Euler step, ARCSim's, as an equation for the velocity change u.

    r(u) = m u - Δt f(u) = 0,   v = v₀ + u,   x = x₀ + Δt v

    f = F(x₀) - H(x₀) (x - x₀ + β v) + m g + f_air(x₀, v₀) - strength k_h (x - x*) + contact

The equation is linear: ∂r/∂u is the assembled matrix. β is stiffness-proportional damping. Hard handles replace the rows of
their nodes. (`implicit` has the converged step.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.sim.contact import HalfSpaceContact
from diffcloud.sim.contact.proximity import Proximity, ProximityContact
from diffcloud.sim.energies.base import Geometry, Linearisation, geometry
from diffcloud.sim.linear_solve import Couplings, Factor
from diffcloud.sim.properties import Properties
from diffcloud.sim.state import System


@dataclass(frozen=True)
class StepStart:
    """The inputs of one step."""

    positions: Tensor
    """[B, V, 3] [m]"""
    velocities: Tensor
    """[B, V, 3] [m/s]"""
    targets: Tensor
    """[B, H, 3] of the active handles [m]."""
    properties: Properties

    def tensors(self) -> tuple[Tensor, ...]:
        """As the inputs of a `LinearisedStep`; `of` reads them back."""
        return (self.positions, self.velocities, self.targets, *self.properties.tensors())

    @staticmethod
    def of(inputs: Sequence[Tensor]) -> StepStart:
        positions, velocities, targets, *properties = inputs
        return StepStart(positions, velocities, targets, Properties(*properties))


@dataclass(frozen=True)
class StepTerms:
    """All forces at the point of linearisation."""

    geometry: Geometry
    energies: tuple[Linearisation, ...]
    contact: HalfSpaceContact | None
    proximity: ProximityContact | None


@dataclass(frozen=True)
class Held:
    """Nodes prescribed by hard handles."""

    mask: Tensor
    """bool [V, 1]"""
    free_blocks: tuple[Tensor, ...]
    """Per energy [E, 3n, 3n]: 1 where row and column are free, else 0."""

    @staticmethod
    def build(system: System, nodes: Tensor) -> Held:
        mask = torch.zeros(len(system.mesh.nodes), 1, dtype=torch.bool, device=system.device)
        mask[nodes] = True
        free = (~mask[:, 0]).to(system.dtype)
        corners = [free[e.elements.nodes].repeat_interleave(3, dim=1) for e in (system.stretching, system.bending)]
        return Held(mask, tuple(corner[:, :, None] * corner[:, None, :] for corner in corners))


@dataclass(frozen=True)
class LinearisedStep:
    """The equation of one step. Inputs: positions, velocities [B, V, 3], targets [B, H, 3], *properties."""

    system: System
    strength: Tensor
    """[H] of each handle in this step."""
    handle_nodes: Tensor
    """[H] node of each handle."""
    held: Held | None
    """None if no hard handle is active."""
    proximity: Proximity | None = None
    """Pairs of meshes that repel in this step."""

    def residual(self, u: Tensor, *inputs: Tensor) -> Tensor:
        """r [B, V, 3] [N·s]."""
        start = StepStart.of(inputs)
        return self._residual(u, start, self._linearise(start))

    def solve(self, *inputs: Tensor) -> tuple[Tensor, Factor]:
        """u [B, V, 3] [m/s] and the factor of the step matrix.

        Raises:
            NotPositiveDefiniteError: names the batch entries.
        """
        start = StepStart.of(inputs)
        terms = self._linearise(start)
        factor = self._factorise(start, terms)
        return -factor.solve(self._residual(torch.zeros_like(start.velocities), start, terms)), factor

    def prescribe(self, u: Tensor, start: StepStart) -> Tensor:
        """u with the velocity change of hard-held nodes filled in."""
        if self.held is None:
            return u
        wanted = start.positions.index_copy(1, self.handle_nodes, start.targets.expand(len(u), -1, -1))
        change = (wanted - start.positions) / self.system.time_step - start.velocities
        return torch.where(self.held.mask, change, u)

    def _linearise(self, start: StepStart) -> StepTerms:
        system, values = self.system, start.properties
        shape = geometry(system.stretching.elements, start.positions)
        contact = None
        if system.halfspaces is not None:
            contact = system.halfspaces.at(
                start.positions, start.velocities, values.node_mass, values.friction_obstacle, system.time_step
            )
        proximity = None
        if self.proximity is not None and system.contact is not None:
            proximity = self.proximity.at(
                system.contact.all_points(start.positions),
                system.contact.with_rest(start.velocities),
                system.contact.with_rest(1 / values.node_mass),
                (values.friction_obstacle, values.friction_cloth),
                system.time_step,
            )
        return StepTerms(
            shape,
            tuple(energy.at(shape, values) for energy in (system.stretching, system.bending)),
            contact,
            proximity,
        )

    def _residual(self, u: Tensor, start: StepStart, terms: StepTerms) -> Tensor:
        system, dt, values = self.system, self.system.time_step, start.properties
        change = self.prescribe(u, start)
        velocity = start.velocities + change
        mass = values.node_mass[..., None]
        step = dt * velocity
        displacement = step + values.damping[:, None, None] * velocity

        force = mass * system.gravity + system.air.forces(terms.geometry, start.velocities, values)
        for energy in terms.energies:
            force = force + energy.forces(displacement)
        if terms.contact is not None:
            force = force + terms.contact.forces(step, velocity)
        if terms.proximity is not None:
            force = force + terms.proximity.forces(step, velocity)
        if self.held is None and len(self.handle_nodes):
            offset = start.targets - (start.positions + dt * velocity)[:, self.handle_nodes]
            pull = (system.handles.stiffness * self.strength)[:, None] * offset
            index = self.handle_nodes.view(1, -1, 1).expand_as(pull)
            force = force.scatter_add(1, index, pull)
        residual = mass * change - dt * force
        return residual if self.held is None else torch.where(self.held.mask, mass * u, residual)

    def _factorise(self, start: StepStart, terms: StepTerms) -> Factor:
        """The step matrix m + Δt (Δt + β) H + handles + contact."""
        system, dt, values = self.system, self.system.time_step, start.properties
        weight = values.node_mass
        identity = torch.eye(3, dtype=weight.dtype, device=weight.device)
        if self.held is None and len(self.handle_nodes):
            spring = (dt**2 * system.handles.stiffness * self.strength).expand(len(weight), -1)
            weight = weight.scatter_add(1, self.handle_nodes.expand(len(weight), -1), spring)
        diagonal = weight[..., None, None] * identity
        if terms.contact is not None:
            diagonal = diagonal + terms.contact.blocks(dt)
        scale = (dt * (dt + values.damping))[:, None, None, None]
        blocks = [scale * energy.hessian() for energy in terms.energies]
        if self.held is not None:
            own = values.node_mass[..., None, None] * identity
            diagonal = torch.where(self.held.mask[..., None], own, diagonal)
            blocks = [block * free for block, free in zip(blocks, self.held.free_blocks, strict=True)]
        return system.pattern.factorise(diagonal, blocks, self._couplings(terms))

    def _couplings(self, terms: StepTerms) -> Couplings | None:
        if terms.proximity is None:
            return None
        couplings = terms.proximity.couplings(self.system.time_step)
        if self.held is None:
            return couplings
        mask = self.held.mask[:, 0]
        free = ~(mask[couplings.rows] | mask[couplings.columns])
        return Couplings(*(getattr(couplings, name)[free] for name in ("entry", "rows", "columns", "blocks")))
