"""The simulation: init, step, rollout."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.sim.adjoint import implicit_solve
from diffcloud.sim.energies.base import geometry
from diffcloud.sim.energies.handles import HandleSchedule, follow_track
from diffcloud.sim.implicit import ImplicitStart, ImplicitStep, StuckError
from diffcloud.sim.linear_solve import NotPositiveDefiniteError, SingularMatrixError
from diffcloud.sim.linearised import Held, LinearisedStep, StepStart
from diffcloud.sim.plausibility import Motion, implausible
from diffcloud.sim.properties import Properties
from diffcloud.sim.rigid import BodyState
from diffcloud.sim.state import ImplicitSetup, State, System

_DEEPEST = 5
"""A step that does not converge is halved up to this many times."""


@dataclass(frozen=True)
class Rollout:
    """A batch of trajectories."""

    positions: Tensor
    """[B, S + 1, V, 3] after 0, 1, ... S steps [m]."""
    times: Tensor
    """[S + 1] [s]"""
    bodies: BodyState | None = None
    """Of rigid bodies, its fields stacked [B, S + 1, N, ...]."""
    diverged: Mapping[int, DivergedError] = field(default_factory=dict)
    """Batch entries that diverged, if `rollout` was to drop them: from that step on their positions are NaN."""

    def at(self, times: Tensor) -> Tensor:
        """[B, T, V, 3] positions at times [T], linear between steps."""
        place = (times / self.times[1]).clamp(0, len(self.times) - 1)
        nearest = place.round()
        place = torch.where((place - nearest).abs() < 1e-6, nearest, place)
        low = place.floor().long().clamp(max=len(self.times) - 2)
        fraction = (place - low)[:, None, None]
        return self.positions[:, low] * (1 - fraction) + self.positions[:, low + 1] * fraction


def init(system: System, batch: int = 1, *, positions: Tensor | None = None, velocities: Tensor | None = None) -> State:
    """The state at time zero.

    Args:
        batch: B, the number of parameter sets.
        positions, velocities: [B or 1, V, 3] instead of the mesh's own positions and rest.
    """
    if positions is None:
        positions = torch.as_tensor(system.mesh.nodes, dtype=system.dtype, device=system.device)[None]
    positions = positions.expand(batch, -1, -1)
    velocities = torch.zeros_like(positions) if velocities is None else velocities.expand(batch, -1, -1)
    bodies = None
    if system.implicit is not None:
        bodies = BodyState(*(t.expand(batch, *t.shape[1:]) for t in system.implicit.bodies.start.tensors()))
    return State(positions, velocities, anchors=positions[:, system.handles.nodes], bodies=bodies)


def step(system: System, properties: Properties, schedule: HandleSchedule, state: State, *, copies: int = 1) -> State:
    """One time step of every cloth in the batch.

    Args:
        schedule: handles over the run; its translation is [B or 1, S, H, 3].
        copies: see `adjoint.implicit_solve`.

    Raises:
        DivergedError: names the step and the batch entries.
    """
    state = _take_anchors(system, schedule, state)
    if system.implicit is not None:
        return _implicit_step(system, system.implicit, properties, schedule, state, copies)
    problem, targets = _problem(system, schedule, state, copies)
    start = StepStart(state.positions, state.velocities, targets.expand(properties.batch, -1, -1), properties)
    try:
        change = implicit_solve(problem, *start.tensors(), copies=copies)
    except NotPositiveDefiniteError as error:
        raise DivergedError(state.step + 1, error.entries, str(error)) from error
    velocities = state.velocities + problem.prescribe(change, start)
    positions = state.positions + system.time_step * velocities
    if system.halfspaces is not None:
        projected = system.halfspaces.project(positions)
        velocities = velocities + (projected - positions) / system.time_step
        positions = projected
    _refuse_divergence(positions, state.step + 1)
    if system.contact is not None:
        inverse_mass = 1 / properties.node_mass
        if problem.held is not None:
            inverse_mass = torch.where(problem.held.mask[:, 0], 0.0, inverse_mass)
        resolved = system.contact.resolve(
            state.positions,
            positions,
            inverse_mass,
            (properties.friction_obstacle, properties.friction_cloth),
            step=state.step + 1,
            copies=copies,
        )
        velocities = velocities + (resolved - positions) / system.time_step
        positions = resolved
    return State(positions, velocities, state.anchors, state.step + 1)


def _implicit_step(
    system: System, setup: ImplicitSetup, properties: Properties, schedule: HandleSchedule, state: State, copies: int
) -> State:
    active = torch.as_tensor(schedule.active[state.step], device=system.device)
    targets = schedule.translation[:, state.step] + (schedule.linear[state.step] @ state.anchors[..., None]).squeeze(-1)
    nodes = torch.tensor(system.handles.nodes, dtype=torch.long, device=system.device)[active]
    times = np.array([state.step, state.step + 1]) * system.time_step
    before, after = setup.scenery.at(times, dtype=system.dtype, device=system.device)
    problem = ImplicitStep(system, setup, schedule.strength[state.step][active], nodes, (before, after))
    assert state.bodies is not None
    start = ImplicitStart(
        state.positions,
        state.velocities,
        targets[:, active].expand(properties.batch, -1, -1),
        state.bodies,
        properties,
    )
    positions, velocities, bodies = _advance(problem, start, copies, state.step + 1)
    _refuse_divergence(positions, state.step + 1)
    return State(positions, velocities, state.anchors, state.step + 1, bodies)


def _advance(
    problem: ImplicitStep, start: ImplicitStart, copies: int, step: int, depth: int = 0
) -> tuple[Tensor, Tensor, BodyState]:
    """Positions and velocities of the cloth, and the bodies, after one step; entries that fail take two half steps."""
    try:
        return problem.advanced(implicit_solve(problem, *start.tensors(), copies=copies), start)
    except (StuckError, SingularMatrixError) as error:
        if depth == _DEEPEST:
            values = {
                name: getattr(start.properties, name)[error.entries[0]].mean().item()
                for name in ("stretching", "node_mass")
            }
            advice = (
                f"{error}; {2**depth} sub-steps did not help (mean stretching multiplier {values['stretching']:.3g}, mean "
                f"node mass {values['node_mass']:.3g} kg). Try a smaller time step, a thicker or stiffer contact, or "
                "slower handles"
            )
            raise DivergedError(step, error.entries, advice) from error
        failed = error.entries
        found = error.found if isinstance(error, StuckError) else None
    batch = len(start.positions) // copies
    rest = [entry for entry in range(batch) if entry not in set(failed)]
    parts = []
    if rest:
        chosen = _entries(rest, batch, copies, start.positions.device)
        known = None if found is None else found[rest]
        parts.append((chosen, _advance(problem.fresh(known), start.only(chosen), copies, step, depth)))
    chosen = _entries(failed, batch, copies, start.positions.device)
    try:
        parts.append((chosen, _halves(problem, start.only(chosen), copies, step, depth)))
    except DivergedError as error:
        raise DivergedError(step, [failed[entry] for entry in error.entries], error.reason) from error
    order = torch.cat([chosen for chosen, _ in parts]).argsort()
    positions = torch.cat([part[0] for _, part in parts])[order]
    velocities = torch.cat([part[1] for _, part in parts])[order]
    bodies = BodyState(*(torch.cat(columns)[order] for columns in zip(*(p[2].tensors() for _, p in parts), strict=True)))
    return positions, velocities, bodies


def _halves(
    problem: ImplicitStep, start: ImplicitStart, copies: int, step: int, depth: int
) -> tuple[Tensor, Tensor, BodyState]:
    first, second = problem.halves()
    held = start.positions[:, problem.handle_nodes]
    middle = replace(start, targets=0.5 * (held + start.targets)) if problem.system.handles.hard else start
    positions, velocities, bodies = _advance(first, middle, copies, step, depth + 1)
    start = replace(start, positions=positions, velocities=velocities, bodies=bodies)
    return _advance(second, start, copies, step, depth + 1)


def _entries(entries: list[int], batch: int, copies: int, device: torch.device) -> Tensor:
    """Rows of batch entries in K copies of a batch."""
    chosen = torch.tensor(entries, device=device)
    return (torch.arange(copies, device=device)[:, None] * batch + chosen).flatten()


def rollout(
    system: System,
    steps: int,
    *,
    properties: Properties | None = None,
    state: State | None = None,
    track: Tensor | None = None,
    copies: int = 1,
    drop_diverged: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Rollout:
    """Simulate `steps` steps.

    Args:
        properties: of a batch of parameter sets; default the basis material, batch 1.
        state: where to begin; default rest.
        track: [B or 1, S, 3] displacement of the gripper since the start at the end of each step [m]; then the moving
            handles follow it instead of the scene's own motion.
        copies: see `adjoint.implicit_solve`.
        drop_diverged: go on without batch entries that diverge, and name them in `Rollout.diverged`; not with copies.
        progress: called with the number of finished steps.

    Raises:
        DivergedError: names the step and the batch entries.
    """
    if drop_diverged and copies > 1:
        raise ValueError(f"Entries of {copies} copies cannot be dropped.")
    properties = system.properties if properties is None else properties
    times = np.cumsum(np.full(steps, system.time_step))  # repeated addition, as the reference accumulates time
    if track is not None:
        system = replace(system, handles=system.handles.following_track())
    schedule = system.handles.schedule(times, dtype=system.dtype, device=system.device)
    if track is not None:
        schedule = follow_track(system.handles, schedule, track)
    if state is None:
        state = init(system, properties.batch)
    elif state.anchors.shape[1] != len(system.handles.nodes):
        state = replace(state, anchors=state.positions[:, system.handles.nodes])
    if state.bodies is None and system.implicit is not None:
        state = replace(state, bodies=init(system, len(state.positions)).bodies)
    given, first, anchors = (properties, schedule), state, state.anchors.detach()
    kept = torch.arange(len(state.positions), device=system.device)
    positions, poses, entries = [state.positions], [state.bodies], [kept]
    diverged: dict[int, DivergedError] = {}
    while len(kept) and len(positions) <= steps:
        try:
            state = step(system, properties, schedule, state, copies=copies)
        except DivergedError as error:
            if not drop_diverged or not error.entries:
                raise
            lost = kept[sorted(set(error.entries))].tolist()
            diverged |= {entry: DivergedError(error.step, [entry], error.reason) for entry in lost}
            rest = (~torch.isin(kept, torch.tensor(lost, device=kept.device))).nonzero().flatten()
            kept = kept[rest]
            properties, schedule, state = _only(rest, properties, schedule, state)
            continue
        anchors = anchors.index_copy(0, kept, state.anchors.detach())
        positions.append(state.positions)
        poses.append(state.bodies)
        entries.append(kept)
        if progress is not None:
            progress(len(positions) - 1)
    all_times = torch.as_tensor(np.concatenate([[0.0], times]), dtype=system.dtype, device=system.device)
    bodies = None
    if poses[0] is not None and poses[0].centre.shape[1]:
        columns = zip(*(pose.tensors() for pose in poses if pose is not None), strict=True)
        bodies = BodyState(*(_over_time(column, entries, steps) for column in columns))
    joined = _over_time(positions, entries, steps)
    for entry, fault in _implausible(system, given, (first, anchors), joined, bodies, copies).items():
        if entry in diverged:
            continue
        if not drop_diverged:
            raise fault
        diverged[entry] = fault
        later = torch.arange(steps + 1, device=joined.device)[:, None, None] >= fault.step
        joined = joined.index_copy(0, torch.tensor([entry]), torch.where(later, torch.nan, joined[entry])[None])
    return Rollout(joined, all_times, bodies, diverged)


def _implausible(
    system: System,
    given: tuple[Properties, HandleSchedule],
    begin: tuple[State, Tensor],
    positions: Tensor,
    bodies: BodyState | None,
    copies: int,
) -> dict[int, DivergedError]:
    """Batch entries whose motion cannot be one.

    Args:
        given: of the whole batch.
        begin: the state that it began with, and the handles' anchors [B, H, 3] at its end.
        positions: [B, S + 1, V, 3].
    """
    (properties, schedule), (first, anchors) = given, begin
    batch, nodes = len(positions) // copies, positions.detach()
    linear = schedule.linear
    others = np.zeros((nodes.shape[1], 0, 3))
    if system.implicit is not None:
        times = np.arange(nodes.shape[1], dtype=np.float64) * system.time_step
        scenery = system.implicit.scenery
        moving = [number for place, _ in scenery.moving for number in range(*place.indices(len(scenery.fixed)))]
        others = scenery.at(times, dtype=torch.float64, device=torch.device("cpu")).numpy()[:, moving]
    found: dict[int, DivergedError] = {}
    for entry in range(batch):
        known = nodes[entry].isfinite().all(-1).all(-1).nonzero().flatten()
        last = int(known[-1])  # a dropped entry is not known to the end
        translation = schedule.translation[min(entry, len(schedule.translation) - 1), :last].detach()
        targets = translation + (linear[:last] @ anchors[entry, ..., None]).squeeze(-1)
        own = others[: last + 1]
        if bodies is not None:
            own = np.concatenate([own, bodies.centre[entry, : last + 1].detach().numpy()], axis=1)
        motion = Motion(
            positions=nodes[entry, : last + 1].cpu().numpy(),
            time_step=system.time_step,
            mass=properties.node_mass[entry].detach().cpu().numpy(),
            size=system.mesh.size,
            places=torch.cat([nodes[entry, :1, system.handles.nodes], targets]).cpu().numpy(),
            held=schedule.active[:last],
            gravity=float(system.gravity.norm()),
            wind=float(system.air.wind.norm()),
            velocities=first.velocities[entry].detach().cpu().numpy(),
            others=own,
        )

        def stored(step: int, entry: int = entry) -> float:
            one = Properties(*(tensor[entry : entry + 1] for tensor in properties.tensors()))
            shape = geometry(system.stretching.elements, nodes[entry : entry + 1, step])
            with torch.no_grad():
                return float(sum(energy.at(shape, one).energy() for energy in (system.stretching, system.bending)))

        fault = implausible(motion, stored) if last else None
        if fault is not None:
            found[entry] = DivergedError(fault[0], [entry], fault[1])
    return found


def _only(
    rest: Tensor, properties: Properties, schedule: HandleSchedule, state: State
) -> tuple[Properties, HandleSchedule, State]:
    """Of the batch entries `rest` alone."""
    if len(schedule.translation) > 1:
        schedule = replace(schedule, translation=schedule.translation[rest])
    bodies = None if state.bodies is None else BodyState(*(tensor[rest] for tensor in state.bodies.tensors()))
    state = State(state.positions[rest], state.velocities[rest], state.anchors[rest], state.step, bodies)
    return Properties(*(tensor[rest] for tensor in properties.tensors())), schedule, state


def _over_time(parts: Sequence[Tensor], entries: Sequence[Tensor], steps: int) -> Tensor:
    """[B, S + 1, ...] of what is known at each time [b, ...] of the batch entries [b], NaN where nothing is."""
    batch = len(parts[0])
    if len(parts) == steps + 1 and len(parts[-1]) == batch:
        return torch.stack(list(parts), dim=1)
    nothing = torch.full_like(parts[0], torch.nan)
    whole = [nothing.index_copy(0, kept, part) for kept, part in zip(entries, parts, strict=True)]
    return torch.stack(whole + [nothing] * (steps + 1 - len(whole)), dim=1)


def _take_anchors(system: System, schedule: HandleSchedule, state: State) -> State:
    """Anchors of the handles that become active in this step: the node's position, back through the motion."""
    starting = np.flatnonzero(schedule.first_step == state.step)
    if not len(starting):
        return state
    held = state.positions[:, [system.handles.nodes[index] for index in starting]]
    linear, translation = schedule.linear[state.step, starting], schedule.translation[:, state.step, starting]
    anchors = torch.linalg.solve(linear, (held - translation)[..., None]).squeeze(-1)
    index = torch.as_tensor(starting, device=anchors.device)
    return replace(state, anchors=state.anchors.index_copy(1, index, anchors))


def _problem(system: System, schedule: HandleSchedule, state: State, copies: int = 1) -> tuple[LinearisedStep, Tensor]:
    """The equation of this step, and the targets [B, H, 3] of its active handles."""
    active = schedule.active[state.step]
    nodes, held = _held(system, schedule, tuple(np.flatnonzero(active)))
    targets = schedule.translation[:, state.step] + (schedule.linear[state.step] @ state.anchors[..., None]).squeeze(-1)
    strength = schedule.strength[state.step]
    if len(nodes) < len(active):
        targets, strength = targets[:, active], strength[active]
    proximity = None
    if system.contact is not None:
        proximity = system.contact.near(state.positions[: len(state.positions) // copies])
    return LinearisedStep(system, strength, nodes, held, proximity), targets


def _held(system: System, schedule: HandleSchedule, active: tuple[int, ...]) -> tuple[Tensor, Held | None]:
    """Nodes of the active handles, and what hard ones prescribe; made once per set of active handles."""
    if active not in schedule.cache:
        nodes = torch.tensor([system.handles.nodes[i] for i in active], dtype=torch.long, device=system.device)
        schedule.cache[active] = nodes, Held.build(system, nodes) if system.handles.hard and active else None
    return schedule.cache[active]


def _refuse_divergence(positions: Tensor, step: int) -> None:
    if not bool(torch.isfinite(positions.detach().sum())):
        entries = (~torch.isfinite(positions).all(-1).all(-1)).nonzero().flatten().tolist()
        raise DivergedError(step, entries, "positions are not finite")
