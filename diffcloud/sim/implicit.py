"""One converged implicit step with smooth contact and rigid bodies: backward Euler, solved by Newton's method.

The unknown u [B, D, 3] holds the velocity changes of the V cloth nodes, then of each body's centre and its rotation:
D = V + 2 N. The equations are the balances of momentum over the step (see `rigid.bodies` for the bodies'):

    r(u) = m u - Δt [ F(x₁) - β H(x₁) v₁ + m g + f_air(x₁, v₁) - strength k_h (x₁ - x*) + f_contact(x₀, x₁) ] = 0

with x₁ = x₀ + Δt v₁ and v₁ = v₀ + u. Hard handles replace their nodes' rows by u = (x* - x₀)/Δt - v₀.

Newton's matrix is the exact Jacobian, assembled from elements (each differentiated on its own), so the
last steps converge quadratically and the same matrix gives exact derivatives of the step. Each Newton step is shortened
until the straight path of all points is free of collisions, so nothing ever passes through anything. Prescribed motion
(hard handles, moving obstacles) takes part in this: it advances with the Newton steps and arrives when they are full.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from diffcloud.sim.contact.smooth import ContactBlocks, Measured, Near
from diffcloud.sim.elements import Elements
from diffcloud.sim.energies.base import geometry
from diffcloud.sim.jacobian import element_jacobian
from diffcloud.sim.linear_solve import Couplings, Factor
from diffcloud.sim.properties import Properties
from diffcloud.sim.rigid.bodies import BodyState
from diffcloud.sim.rigid.rotation import left_jacobian, rotation, skew
from diffcloud.sim.state import ImplicitSetup, System

_TOLERANCE = 1e-8
"""Expected next change of velocity, relative to the largest, at which Newton's method has converged.

It is overestimated: convergence is quadratic in the end, so what is left is far smaller."""
_ROUNDING = 1e-7
"""Below this relative change a step that no longer shrinks has reached the arithmetic's precision."""
_ITERATIONS = 30
_HALVINGS = 8
_SLOWEST = 1e-1
"""Velocities below this are at rest for the tolerance [m/s]."""
_LEAST_CAUTION = 0.05
"""Of the step after one that the exact matrix led astray."""
_REUSE = 1e-4
"""A relative change below this is followed by one correction with the same matrix instead of a new one."""
_ROOM = 0.5
"""First guess of how far points leave their predicted path, as part of the thickness and of the path."""

_PROBE = 1e-4
"""Part of the obstacles' way over which its effect is measured."""
_LONGEST = 5.0
"""Newton's steps are kept within this many times the thickness and the path."""


_FEW = 0.7
"""When at most this part of a batch has not converged, it goes on without the others."""


class StuckError(ArithmeticError):
    """Newton's method did not converge.

    `entries` lists the batch entries, `found` [B, D, 3] holds the solutions of the others; the message names the closest
    pair.
    """

    def __init__(self, entries: list[int], found: Tensor, change: float, pair: str) -> None:
        self.entries, self.found, self.change, self.pair = entries, found, change, pair
        super().__init__(f"the implicit step did not converge (relative change {change:.1e}; closest: {pair})")


@dataclass(frozen=True)
class ImplicitStart:
    """The inputs of one step."""

    positions: Tensor
    """[B, V, 3] [m]"""
    velocities: Tensor
    """[B, V, 3] [m/s]"""
    targets: Tensor
    """[B, H, 3] of the active handles [m]."""
    bodies: BodyState
    properties: Properties

    def tensors(self) -> tuple[Tensor, ...]:
        """As the inputs of an `ImplicitStep`; `of` reads them back."""
        return (self.positions, self.velocities, self.targets, *self.bodies.tensors(), *self.properties.tensors())

    def only(self, entries: Tensor) -> ImplicitStart:
        """The rows `entries` of the batch."""
        return ImplicitStart.of([tensor[entries] for tensor in self.tensors()])

    @staticmethod
    def of(inputs: Sequence[Tensor]) -> ImplicitStart:
        positions, velocities, targets, *rest = inputs
        return ImplicitStart(positions, velocities, targets, BodyState(*rest[:4]), Properties(*rest[4:]))


@dataclass
class Memory:
    """What `solve` found and derivatives need."""

    near: Near = field(default_factory=lambda: Near((), None, torch.zeros(0), ()))
    """Pairs near each other in the solution."""
    batch: int = 1
    guess: Tensor | None = None
    """u [B, D, 3] that was found before, where the step has been solved in another batch."""


@dataclass(frozen=True)
class ImplicitStep:
    """The equation of one step; inputs are `ImplicitStart.tensors`."""

    system: System
    setup: ImplicitSetup
    strength: Tensor
    """[H] of each handle in this step."""
    handle_nodes: Tensor
    """[H] node of each handle."""
    scenery: tuple[Tensor, Tensor]
    """[O, 3] points of static and moving obstacles at both ends of the step [m]."""
    memory: Memory = field(default_factory=lambda: Memory(), compare=False)

    def fresh(self, guess: Tensor | None = None) -> ImplicitStep:
        """The same step for another batch, whose solution [B, D, 3] may be known."""
        return replace(self, memory=Memory(guess=guess))

    def halves(self) -> tuple[ImplicitStep, ImplicitStep]:
        """Two steps of half the length; obstacles go straight."""
        system = replace(self.system, time_step=0.5 * self.system.time_step)
        before, after = self.scenery
        middle = 0.5 * (before + after)
        return (
            replace(self, system=system, scenery=(before, middle), memory=Memory()),
            replace(self, system=system, scenery=(middle, after), memory=Memory()),
        )

    def advanced(self, u: Tensor, start: ImplicitStart) -> tuple[Tensor, Tensor, BodyState]:
        """Positions and velocities [B, V, 3] of the cloth, and the bodies, after the step u."""
        velocities = start.velocities + u[:, : start.positions.shape[1]]
        if self.system.handles.hard and len(self.handle_nodes):
            # what a held node does is known: its derivatives need no detour over the solve
            wanted = (start.targets - start.positions[:, self.handle_nodes]) / self.system.time_step
            velocities = velocities.index_copy(1, self.handle_nodes, wanted)
        bodies = self._moved(u, start) if len(self.setup.bodies) else start.bodies
        return start.positions + self.system.time_step * velocities, velocities, bodies

    # --- what the adjoint asks for -----------------------------------------------------------------------------------

    def residual(self, u: Tensor, *inputs: Tensor) -> Tensor:
        """r [B, D, 3] [N·s, and N·m·s for rotations]."""
        start = ImplicitStart.of(inputs)
        near = self.memory.near.repeated(len(u) // self.memory.batch, self.memory.batch)
        points = self._points(u, start, self.scenery[1])
        return self._residual(u, start, self.setup.contact.measure(near, points), points)

    def solve(self, *inputs: Tensor) -> tuple[Tensor, Factor]:
        """u, and the exact ∂r/∂u there, factorised when it is first used.

        Raises:
            StuckError, SingularMatrixError: name the batch entries.
        """
        start = ImplicitStart.of([tensor.detach() for tensor in inputs])
        guess = self.memory.guess
        arrival = None if guess is None else _Arrival.at(guess, self.scenery[1].expand(len(guess), -1, -1))
        u, near = self._newton(start, arrival)
        self.memory.near, self.memory.batch = near, len(u)
        return u, _LateFactor(self, u, start)

    def _factorise(self, u: Tensor, start: ImplicitStart) -> Factor:
        points = self._points(u, start, self.scenery[1])
        return self._jacobian(u, start, self.setup.contact.measure(self.memory.near, points), points)

    # --- Newton ------------------------------------------------------------------------------------------------------

    def _newton(self, start: ImplicitStart, arrival: _Arrival | None = None) -> tuple[Tensor, Near]:
        """u and the pairs near each other there; begins at `arrival` if it is given."""
        zero = self._initial_velocities(start)
        batch = len(zero)
        scenery = self.scenery[0].expand(batch, -1, -1)
        begin = self._points(-zero, start, scenery)  # every point where the step starts
        room = _Room(self, begin, self._points(torch.zeros_like(zero), start, self.scenery[1]))
        active = torch.ones(batch, dtype=torch.bool, device=zero.device)
        if arrival is None:  # velocities go on, as far as nothing is in the way
            here = _Place(-zero, scenery, begin, self.setup.contact.measure(room.near, begin))
            here = self._towards(here, zero, start, room, active.to(zero.dtype))
            change = torch.full((batch,), torch.inf, dtype=zero.dtype, device=zero.device)
            caution, left = torch.ones_like(change), _ITERATIONS
        else:
            points = self._points(arrival.u, start, arrival.scenery)
            room.cover(float(room.away(points).max()))
            here = _Place(arrival.u, arrival.scenery, points, self.setup.contact.measure(room.near, points))
            change, caution, left = arrival.change, arrival.caution, arrival.left
        residual = self._residual(here.u, start, here.measured, here.points)
        factor: Factor | None = None
        while left:
            left -= 1
            if factor is None:
                factor = self._jacobian(here.u, start, here.measured, here.points, caution)
            direction = -factor.solve(residual + self._pushed(here, residual, start))
            downhill = -(residual * direction).sum((1, 2))
            speed = (zero + here.u).abs().amax((1, 2)).clamp(min=_SLOWEST)
            size = direction.abs().amax((1, 2)) / speed
            rough = active & (size > _REUSE)
            bad = rough & (downhill <= 0)
            going = active & ~bad  # the others wait for a better direction, without holding these up
            if bool(going.any()):
                trial, remaining, short = self._search(here, direction, downhill, start, room, going, rough & going)
                arrived = (trial.scenery == self.scenery[1]).flatten(1).all(1)
                before, change = change, torch.where(going, size, change)
                expected = torch.where(before.isfinite(), change * (change / before).clamp(max=1.0), change)
                settled = (expected < _TOLERANCE) | ((change < _ROUNDING) & (change > 0.3 * before))
                here, residual = trial, remaining
                active = active & ~(going & settled & arrived)
                if not bool(active.any()):
                    return here.u, room.near
                bad = bad | short
                if not bool(bad.any()) and not bool(rough.any()) and bool((caution == 0).all()):
                    continue
            factor = None
            caution = torch.where(bad, (4 * caution).clamp(_LEAST_CAUTION, 1.0), 0.0)
            if int(active.sum()) <= _FEW * batch:
                few = active.nonzero().flatten()
                arrival = _Arrival(here.u[few], here.scenery[few], change[few], caution[few], left)
                try:
                    u = here.u.index_copy(0, few, self._newton(start.only(few), arrival)[0])
                except StuckError as error:
                    entries = few[error.entries].tolist()
                    raise StuckError(entries, here.u.index_copy(0, few, error.found), error.change, error.pair) from error
                room.cover(float(room.away(self._points(u, start, self.scenery[1])).max()))
                return u, room.near
        entries = active.nonzero().flatten().tolist()
        pair = self.setup.contact.closest(here.measured, here.points)[1][entries[0]]
        raise StuckError(entries, here.u, float(change[active].max()), pair)

    def _pushed(self, here: _Place, residual: Tensor, start: ImplicitStart) -> Tensor:
        """How the residual changes as moving obstacles go the rest of their way, to first order.

        Without it a step would not know that they come, and they would eat up the gap instead of pushing.
        """
        left = self.scenery[1] - here.scenery
        if not left.numel() or not bool((left != 0).any()):
            return torch.zeros_like(residual)
        points = self._points(here.u, start, here.scenery + _PROBE * left)
        return (self._residual(here.u, start, here.measured, points) - residual) / _PROBE

    def _search(
        self,
        here: _Place,
        direction: Tensor,
        downhill: Tensor,
        start: ImplicitStart,
        room: _Room,
        active: Tensor,
        rough: Tensor,
    ) -> tuple[_Place, Tensor, Tensor]:
        """The step along `direction` at whose end it leads downhill still, or uphill less steeply than it began.

        Where forces have a potential, that is a step along which it falls; friction, drag and damping are judged alike.

        Returns:
            The place, the residual there, and bool [B] whether the step had to be shortened for it.
        """
        alpha = active.to(direction.dtype)
        short = torch.zeros_like(active)
        for _ in range(_HALVINGS):
            trial = self._towards(here, direction, start, room, alpha)
            remaining = self._residual(trial.u, start, trial.measured, trial.points)
            uphill = (remaining * direction).sum((1, 2))
            worse = rough & ~(uphill <= 0.9 * downhill)
            if not bool(worse.any()):
                break
            short = short | worse
            gone = (trial.u - here.u).abs().amax((1, 2)) / direction.abs().amax((1, 2)).clamp(min=1e-300)
            alpha = torch.where(worse, 0.5 * gone, alpha)
        return trial, remaining, short

    def _towards(self, here: _Place, direction: Tensor, start: ImplicitStart, room: _Room, alpha: Tensor) -> _Place:
        """`here` + α direction with the longest α up to the given [B] that has no collision on the way."""
        contact = self.setup.contact
        final = self.scenery[1]
        for halving in range(_HALVINGS + 2):
            step = alpha[:, None, None]
            u = here.u + step * direction
            scenery = torch.where(step == 1, final, here.scenery + step * (final - here.scenery))
            points = self._points(u, start, scenery)
            away = room.away(points)
            if bool((away > room.longest).any()):
                alpha = alpha * torch.where(away > room.longest, 0.5 * room.longest / away, 1.0)
                continue
            if room.cover(float(away.max())):
                here = replace(here, measured=contact.measure(room.near, here.points))
            fraction = contact.safe_fraction(here.measured, here.points, points)
            if bool((fraction == 1).all()):
                return _Place(u, scenery, points, self.setup.contact.measure(room.near, points))
            # what is straight in u is not quite straight in space where bodies turn: look again at the shorter step
            shorter = fraction * (0.9 if halving else 1.0) if halving < _HALVINGS else torch.zeros_like(fraction)
            alpha = alpha * torch.where(fraction < 1, shorter, 1.0)
        return here  # no step this way is free of collisions

    # --- forces ------------------------------------------------------------------------------------------------------

    def _initial_velocities(self, start: ImplicitStart) -> Tensor:
        """[B, D, 3]: of the cloth, then of each body and its rotation."""
        return torch.cat([start.velocities, *_interleave(start.bodies.velocity, start.bodies.angular_velocity)], dim=1)

    def _points(self, u: Tensor, start: ImplicitStart, scenery: Tensor) -> Tensor:
        """[B, N, 3] where cloth nodes, obstacles and body points are at the end of the step."""
        nodes = len(start.positions[0])
        cloth = start.positions + self.system.time_step * (start.velocities + u[:, :nodes])
        parts = [cloth, scenery.expand(len(u), -1, -1)]
        if len(self.setup.bodies):
            parts.append(self.setup.bodies.places(self._moved(u, start)))
        return torch.cat(parts, dim=1)

    def _moved(self, u: Tensor, start: ImplicitStart) -> BodyState:
        changes = u[:, len(start.positions[0]) :].unflatten(1, (-1, 2))
        velocity = start.bodies.velocity + changes[:, :, 0]
        turning = start.bodies.angular_velocity + changes[:, :, 1]
        return self.setup.bodies.moved(start.bodies, velocity, turning, self.system.time_step)

    def _start_points(self, start: ImplicitStart) -> Tensor:
        parts = [start.positions, self.scenery[0].expand(len(start.positions), -1, -1)]
        if len(self.setup.bodies):
            parts.append(self.setup.bodies.places(start.bodies))
        return torch.cat(parts, dim=1)

    def _residual(self, u: Tensor, start: ImplicitStart, measured: Measured, end: Tensor) -> Tensor:
        system, setup, dt, values = self.system, self.setup, self.system.time_step, start.properties
        nodes = start.positions.shape[1]
        change = u[:, :nodes]
        velocity = start.velocities + change
        positions = start.positions + dt * velocity
        mass = values.node_mass[..., None]
        shape = geometry(system.stretching.elements, positions)
        force = mass * system.gravity + system.air.forces(shape, velocity, values)
        for energy in (system.stretching, system.bending):
            force = force + energy.at(shape, values).forces(values.damping[:, None, None] * velocity)
        if len(self.handle_nodes) and not system.handles.hard:
            offset = start.targets - positions[:, self.handle_nodes]
            pull = (system.handles.stiffness * self.strength)[:, None] * offset
            index = self.handle_nodes.view(1, -1, 1).expand_as(pull)
            force = force.scatter_add(1, index, pull)
        touch = setup.contact.forces(
            measured, self._start_points(start), end, values.friction_obstacle, values.friction_cloth, dt
        )
        force = force + touch[:, :nodes]
        residual = mass * change - dt * force
        if len(self.handle_nodes) and system.handles.hard:
            wanted = (start.targets - start.positions[:, self.handle_nodes]) / dt - start.velocities[:, self.handle_nodes]
            rows = mass[:, self.handle_nodes] * (change[:, self.handle_nodes] - wanted)
            residual = residual.index_copy(1, self.handle_nodes, rows)
        if not len(setup.bodies):
            return residual
        return torch.cat([residual, self._body_residual(u, start, touch)], dim=1)

    def _body_residual(self, u: Tensor, start: ImplicitStart, touch: Tensor) -> Tensor:
        system, dt, bodies = self.system, self.system.time_step, self.setup.bodies
        mass = start.properties.body_mass
        moved = self._moved(u, start)
        force = mass[..., None] * system.gravity
        push = touch[:, -len(bodies.points) :]
        force = force.index_add(1, bodies.body, push)
        moment = torch.linalg.cross(bodies.arms(moved.orientation), push)
        torque = torch.zeros_like(force).index_add(1, bodies.body, moment)
        linear = mass[..., None] * (moved.velocity - start.bodies.velocity) - dt * force
        before = bodies.angular_momentum(mass, start.bodies.orientation, start.bodies.angular_velocity)
        after = bodies.angular_momentum(mass, moved.orientation, moved.angular_velocity)
        return torch.cat(_interleave(linear, after - before - dt * torque), dim=1)

    # --- Jacobian ----------------------------------------------------------------------------------------------------

    def _jacobian(
        self, u: Tensor, start: ImplicitStart, measured: Measured, end: Tensor, caution: Tensor | None = None
    ) -> Factor:
        """∂r/∂u, and with `caution` [B] in [0, 1] so much of a positive definite matrix near it instead."""
        system, setup, dt, values = self.system, self.setup, self.system.time_step, start.properties
        batch, nodes = len(u), start.positions.shape[1]
        hard = system.handles.hard and len(self.handle_nodes) > 0
        weight = values.node_mass
        if len(self.handle_nodes) and not hard:
            spring = (dt**2 * system.handles.stiffness * self.strength).expand(batch, -1)
            weight = weight.scatter_add(1, self.handle_nodes.expand(batch, -1), spring)
        identity = torch.eye(3, dtype=u.dtype, device=u.device)
        diagonal = weight[..., None, None] * identity
        careful = caution is not None and bool((caution > 0).any())
        exact = caution is None or bool((caution < 1).any())
        blocks = []
        if exact:
            blocks = [self._face_blocks(u, start), self._hinge_blocks(u, start)]
        if careful:
            assert caution is not None
            shape = geometry(system.stretching.elements, start.positions + dt * (start.velocities + u[:, :nodes]))
            scale = (dt * (dt + values.damping))[:, None, None, None]
            safe = [scale * energy.at(shape, values).hessian() for energy in (system.stretching, system.bending)]
            part = caution[:, None, None, None]
            blocks = [b + part * (s - b) for b, s in zip(blocks, safe, strict=True)] if exact else safe
        if len(setup.bodies):
            diagonal = torch.cat([diagonal, self._body_inertia(u, start)], dim=1)
        begin = self._start_points(start)
        arguments = (measured, begin, end, values.friction_obstacle, values.friction_cloth, dt)
        found = setup.contact.blocks(*arguments, caution=caution if careful else None)
        if len(setup.bodies):
            turning = self._turning(u, start)
            couplings = [c for block in found for c in self._couple(block, turning, nodes)]
            if found and exact:
                touch = setup.contact.forces(*arguments)[:, -len(setup.bodies.points) :]
                diagonal = diagonal + self._swing(touch, turning, diagonal)
        else:
            couplings = [
                Couplings(block.entry[own], block.row[own], block.column[own], -(dt**2) * block.values[own])
                for block in found
                for own in [(block.row < nodes) & (block.column < nodes)]
            ]
        if hard:  # the row of a held node says only what its own change is
            free = torch.ones(diagonal.shape[1], dtype=u.dtype, device=u.device)
            free[self.handle_nodes] = 0.0
            own = values.node_mass[:, self.handle_nodes][..., None, None] * identity
            diagonal = diagonal.index_copy(1, self.handle_nodes, own)
            blocks = [
                block * free[elements.nodes].repeat_interleave(3, dim=1)[..., None]
                for block, elements in zip(blocks, (system.stretching.elements, system.bending.elements), strict=True)
            ]
            couplings = [replace(c, blocks=c.blocks * free[c.rows][:, None, None]) for c in couplings]
        return setup.pattern.factorise(diagonal, blocks, couplings)

    def _face_blocks(self, u: Tensor, start: ImplicitStart) -> Tensor:
        """[B, F, 9, 9]: stretching and air."""
        apart = self.setup.apart

        def force(positions: Tensor, velocities: Tensor, values: Properties) -> Tensor:
            shape = geometry(apart.stretching.elements, positions)
            damped = values.damping[:, None, None] * velocities
            return apart.stretching.at(shape, values).forces(damped) + apart.air.forces(shape, velocities, values)

        return self._element_blocks(self.system.stretching.elements, force, u, start)

    def _hinge_blocks(self, u: Tensor, start: ImplicitStart) -> Tensor:
        """[B, H, 12, 12]: bending."""
        apart = self.setup.apart

        def force(positions: Tensor, velocities: Tensor, values: Properties) -> Tensor:
            shape = geometry(apart.hinge_faces, positions)
            return apart.bending.at(shape, values).forces(values.damping[:, None, None] * velocities)

        return self._element_blocks(self.system.bending.elements, force, u, start)

    def _element_blocks(
        self,
        elements: Elements,
        force: Callable[[Tensor, Tensor, Properties], Tensor],
        u: Tensor,
        start: ImplicitStart,
    ) -> Tensor:
        """-Δt d force / du [B, E, 3n, 3n] of a force on elements apart, given their corners' end-of-step motion."""
        dt = self.system.time_step
        first, before = (elements.gather(field).flatten(1, 2) for field in (start.positions, start.velocities))
        change = elements.gather(u[:, : elements.node_count]).flatten(2)

        def of_change(local: Tensor, copies: int) -> Tensor:
            velocities = before.repeat(copies, 1, 1) + local.flatten(1).view(len(local), -1, 3)
            positions = first.repeat(copies, 1, 1) + dt * velocities
            return force(positions, velocities, start.properties.repeated(copies)).view_as(local)

        return -dt * element_jacobian(of_change, change, change.shape[-1])

    def _body_inertia(self, u: Tensor, start: ImplicitStart) -> Tensor:
        """[B, 2 N, 3, 3]: mass, and the derivative of the angular momentum by the angular velocity."""
        bodies, dt = self.setup.bodies, self.system.time_step
        mass = start.properties.body_mass
        turning = start.bodies.angular_velocity + u[:, start.positions.shape[1] :].unflatten(1, (-1, 2))[:, :, 1]

        def momentum(omega: Tensor, copies: int) -> Tensor:
            turned = rotation(dt * omega) @ start.bodies.orientation.repeat(copies, 1, 1, 1)
            return bodies.angular_momentum(mass.repeat(copies, 1), turned, omega)

        angular = element_jacobian(momentum, turning, 3)
        linear = mass[..., None, None] * torch.eye(3, dtype=u.dtype, device=u.device)
        return torch.stack([linear, angular], dim=2).flatten(1, 2)

    def _turning(self, u: Tensor, start: ImplicitStart) -> tuple[Tensor, Tensor]:
        """(arms [B, P, 3], d point / d angular velocity [B, P, 3, 3] [m·s]) of the bodies' points."""
        bodies, dt = self.setup.bodies, self.system.time_step
        moved = self._moved(u, start)
        arms = bodies.arms(moved.orientation)
        return arms, -dt * skew(arms) @ left_jacobian(dt * moved.angular_velocity)[:, bodies.body]

    def _couple(self, block: ContactBlocks, turning: tuple[Tensor, Tensor], nodes: int) -> list[Couplings]:
        """Contact between points as couplings between degrees of freedom."""
        dt = self.system.time_step
        arms, swing = turning
        first_body_point = nodes + self.scenery[0].shape[0]
        found = []
        for row_turns in (False, True):
            for column_turns in (False, True):
                own = (block.row >= first_body_point) if row_turns else _moves(block.row, nodes, first_body_point)
                own = own & (
                    (block.column >= first_body_point) if column_turns else _moves(block.column, nodes, first_body_point)
                )
                entry, row, column, values = block.entry[own], block.row[own], block.column[own], block.values[own]
                values = values @ swing[entry, column - first_body_point] if column_turns else values * dt
                if row_turns:
                    values = skew(arms[entry, row - first_body_point]) @ values
                found.append(
                    Couplings(
                        entry,
                        self._freedom(row, row_turns, nodes, first_body_point),
                        self._freedom(column, column_turns, nodes, first_body_point),
                        -dt * values,
                    )
                )
        return found

    def _freedom(self, point: Tensor, turns: bool, nodes: int, first_body_point: int) -> Tensor:
        """Degree of freedom of each point: its own, or its body's centre or rotation."""
        body = self.setup.bodies.body[(point - first_body_point).clamp(min=0)]
        return torch.where(point < nodes, point, nodes + 2 * body + int(turns))

    def _swing(self, touch: Tensor, turning: tuple[Tensor, Tensor], like: Tensor) -> Tensor:
        """The moment of a force changes as its arm turns: -Δt d(arm)/dω x f, on the rotations' diagonal blocks."""
        bodies, dt = self.setup.bodies, self.system.time_step
        values = dt * (skew(touch) @ turning[1])  # -(dt) (d arm) x f = dt f x d arm
        first = like.shape[1] - 2 * len(bodies)
        return torch.zeros_like(like).index_add(1, first + 2 * bodies.body + 1, values)


class _LateFactor:
    """∂r/∂u at the solution of a step, which only derivatives need."""

    def __init__(self, step: ImplicitStep, u: Tensor, start: ImplicitStart) -> None:
        self.place = (step, u, start)

    @cached_property
    def factor(self) -> Factor:
        step, u, start = self.place
        return step._factorise(u, start)

    def solve(self, right: Tensor, *, transposed: bool = False) -> Tensor:
        return self.factor.solve(right, transposed=transposed)


def _moves(point: Tensor, nodes: int, first_body_point: int) -> Tensor:
    return (point < nodes) | (point >= first_body_point)


def _interleave(first: Tensor, second: Tensor) -> list[Tensor]:
    """[B, N, 3] and [B, N, 3] -> one [B, 2 N, 3]."""
    return [torch.stack([first, second], dim=2).flatten(1, 2)]


@dataclass(frozen=True)
class _Place:
    """Where Newton's method is."""

    u: Tensor
    """[B, D, 3]"""
    scenery: Tensor
    """[B, O, 3] how far obstacles have come."""
    points: Tensor
    """[B, N, 3]"""
    measured: Measured


@dataclass(frozen=True)
class _Arrival:
    """Where Newton's method goes on in another batch."""

    u: Tensor
    """[B, D, 3]"""
    scenery: Tensor
    """[B, O, 3]"""
    change: Tensor
    """[B] the last relative change."""
    caution: Tensor
    """[B]"""
    left: int
    """Iterations."""

    @staticmethod
    def at(u: Tensor, scenery: Tensor) -> _Arrival:
        change = torch.full((len(u),), torch.inf, dtype=u.dtype, device=u.device)
        return _Arrival(u, scenery, change, torch.zeros_like(change), _ITERATIONS)


class _Room:
    """Pairs near each other while all points stay within a distance of the path from `begin` to `predicted`."""

    def __init__(self, step: ImplicitStep, begin: Tensor, predicted: Tensor) -> None:
        self.contact = step.setup.contact
        self.low, self.high = torch.minimum(begin, predicted), torch.maximum(begin, predicted)
        self.places = (begin, predicted)
        self.held: Tensor | None = None
        if step.system.handles.hard and len(step.handle_nodes):
            self.held = ~step.setup.moves
            self.held[step.handle_nodes] = True
        path = float((self.high - self.low).max())
        self.size = _ROOM * (self.contact.barrier.thickness + 0.2 * path)
        self.longest = _LONGEST * (self.contact.barrier.thickness + path)
        self.near = self.contact.near(self.places, 2 * self.size, self.held)

    def away(self, points: Tensor) -> Tensor:
        """[B] how far the points of each entry are from the path [m]."""
        return torch.maximum(self.low - points, points - self.high).amax((1, 2)).clamp(min=0)

    def cover(self, distance: float) -> bool:
        """Make sure that the list holds all pairs that may touch so far from the path; whether it had to grow."""
        if distance <= self.size:
            return False
        self.size = min(2 * distance, self.longest)
        self.near = self.contact.near(self.places, 2 * self.size, self.held)
        return True
