"""Impact zones (Harmon et al. 2008, "Robust treatment of simultaneous collisions"): the candidate positions of a step are
moved as little as possible, in the metric of the masses, so that nothing has passed through anything.

Passes of detection and projection alternate until a pass finds no impact. An impact j found at time t_j is the linear
constraint n_j · Σ w_jk x_k >= thickness with the normal and the weights at that time. All constraints found in a step
stay; with disjoint zones the joint problem of an entry is the problems of its zones:

    minimise ½ Σ m_i |x_i - x̂_i|²   subject to   W x >= h

    x = x̂ + M⁻¹ Wᵀ λ,   λ >= 0,   W x >= h,   λ·(W x - h) = 0

Derivatives. With the active set held fixed, λ_a = (W_a M⁻¹ W_aᵀ)⁻¹ (h_a - W_a x̂) is an ordinary differentiable
expression. Detection and active sets are found without gradients; then the passes are replayed as such expressions,
including (on request) how the times, weights and normals of the impacts move. Both modes of automatic differentiation run
through the replay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from diffcloud.errors import UnresolvedContactError
from diffcloud.sim.contact.frames import Frames, MeetingPairs, along
from diffcloud.sim.contact.impact_times import first_impacts, meeting_time
from diffcloud.sim.contact.pairs import candidates
from diffcloud.sim.contact.surface import ContactSurface
from diffcloud.sim.elements import safe_norm

_PASSES = 100
_REACH = 0.01
"""[m] Candidate pairs of an entry are listed this far around the boxes that its points sweep, and again once one of them
leaves its box by almost half of that."""
_TIME_TIE = 1e-4
"""Impacts in one interval of this length (of the step) count as simultaneous; then the order is that of the list."""
_TOUCH = 1e-5
"""[m] Added to the boxes; covers the tolerances of the detection."""
_EXCHANGES = 10
"""Most exchanges of the active set before the slower, certain solver takes over: of 10,000 problems of folded cloths none
that ended needed more than 7, and 1 % went round in circles."""
_REGULAR = 500
"""Units of rounding added to the unit diagonal of the dual problem: redundant constraints (a point met twice) then share
their force."""
_HARD = 1e-7
"""Instead of it where an entry's constraints contradict each other: they are then met in the sense of least squares."""

_CONTRADICTION = 1e-6
"""Part of the largest correction by which a constraint may stay unmet before the entry counts as contradictory."""


@dataclass(frozen=True)
class ImpactSettings:
    """Choices of the impact stage."""

    thickness: float
    """τ_p: what the projection leaves between primitives [m]."""
    smallest: float = 0.0
    """[m⁴] Pairs with |a × b|² below never meet (ARCSim: 1e-6)."""
    residue: float = 0.0
    """Part of each correction that is left out. The original's iterative solver leaves more gap the smaller the
    correction, which decides ties of the next step; 1e-9 reproduces that."""
    differentiate_normals: bool = True
    """Whether derivatives include the motion of impact times, weights and normals (the original drops them)."""
    friction: bool = False
    """Coulomb friction at impacts, which the original lacks."""


@dataclass(frozen=True)
class Constraints:
    """The impacts of a step so far, J in all entries."""

    pairs: MeetingPairs
    time: Tensor
    """[J]"""
    sign: Tensor
    """[J] that makes the normal point against the approach."""
    weights: Tensor
    """[J, 4]"""
    normals: Tensor
    """[J, 3]"""
    place: Tensor
    """[J] row among the constraints of the entry."""

    def repeated(self, copies: int, batch: int) -> Constraints:
        """The same for `copies` copies of a batch, copies outermost."""
        if copies == 1:
            return self
        tensors = (self.time, self.sign, self.weights, self.normals, self.place)
        repeated = (tensor.repeat(copies, *[1] * (tensor.dim() - 1)) for tensor in tensors)
        return Constraints(self.pairs.repeated(copies, batch), *repeated)

    def then(self, new: Constraints, batch: int) -> Constraints:
        """These and new ones, whose rows follow in each entry."""
        used = torch.bincount(self.pairs.entry, minlength=batch)
        new = replace(new, place=new.place + used[new.pairs.entry])
        names = ("time", "sign", "weights", "normals", "place")
        joined = (torch.cat([getattr(self, name), getattr(new, name)]) for name in names)
        return Constraints(self.pairs.then(new.pairs), *joined)

    def of(self, entries: Tensor) -> Constraints:
        """Those of some batch entries [E], ascending, which are numbered anew."""
        entry = torch.searchsorted(entries, self.pairs.entry).clamp(max=len(entries) - 1)
        kept = (entries[entry] == self.pairs.entry).nonzero().flatten()
        pairs = replace(self.pairs.where(kept), entry=entry[kept])
        tensors = (self.time, self.sign, self.weights, self.normals, self.place)
        return Constraints(pairs, *(tensor[kept] for tensor in tensors))

    def frames(self, start: Tensor, places: Tensor) -> Frames:
        """Weights and normals of these impacts, differentiable in the motion [B, N, 3] from start to places."""
        begin, end = self.pairs.gather(start), self.pairs.gather(places)
        time = meeting_time(self.pairs, self.time, begin, end)
        frames = self.pairs.frames(begin + time[:, None, None] * (end - begin))
        return replace(frames, normals=self.sign[:, None] * frames.normals)


def resolve(
    surface: ContactSurface,
    settings: ImpactSettings,
    start: Tensor,
    candidate: Tensor,
    inverse_mass: Tensor,
    friction: tuple[Tensor, Tensor],
    *,
    step: int,
    copies: int = 1,
) -> Tensor:
    """Positions after the impacts of a step.

    Args:
        start: [B, N, 3] points at the start of the step, free of intersections.
        candidate: [B, N, 3] points at its end, before contact.
        inverse_mass: [B, N] [1/kg]; zero for points that cannot move.
        friction: Coulomb coefficients [B] with obstacles and among cloth; used where the settings ask for friction.
        step: named in the error.
        copies: see `adjoint.implicit_solve`.

    Returns:
        [B, N, 3], differentiable in start, candidate, inverse_mass and friction.

    Raises:
        UnresolvedContactError: 100 passes did not suffice.
    """
    batch = len(start) // copies

    def project(wanted: Tensor) -> _Projection | None:
        with torch.no_grad():
            first = slice(batch)
            given = (tensor[first].detach() for tensor in (start, wanted, inverse_mass))
            history = _Finder(surface, settings, *given).run(step)
        return _replay(history, settings, start, wanted, inverse_mass, copies) if history else None

    found = project(candidate)
    if found is None:
        return candidate
    if not settings.friction:
        return found.places
    slowed = candidate + found.friction(surface, start, inverse_mass, friction)
    found = project(slowed)
    return slowed if found is None else found.places


@dataclass(frozen=True)
class _Pass:
    """What one pass found."""

    constraints: Constraints
    """All of the step so far."""
    fresh: int
    """How many of them this pass added; they come last."""
    active: Tensor
    """bool [B, R] of the rows, after the projection."""
    regular: Tensor
    """[B] regularisation used."""

    def newest(self) -> Constraints:
        """The impacts that this pass added."""
        all_, new = self.constraints, slice(len(self.constraints.time) - self.fresh, None)
        index = torch.arange(len(all_.time), device=all_.time.device)[new]
        return Constraints(
            all_.pairs.where(index), all_.time[new], all_.sign[new], all_.weights[new], all_.normals[new], all_.place[new]
        )


class _Finder:
    """Detection and projection without gradients."""

    def __init__(
        self, surface: ContactSurface, settings: ImpactSettings, start: Tensor, candidate: Tensor, inverse_mass: Tensor
    ) -> None:
        self.surface, self.settings = surface, settings
        self.start, self.candidate, self.inverse_mass = start, candidate, inverse_mass
        self.movable = inverse_mass > 0

    def run(self, step: int) -> list[_Pass]:
        places = self.candidate
        pairs = self._list(places, torch.arange(len(places), device=places.device))
        listed_at = places
        if not len(pairs):
            return []
        changed = torch.ones_like(self.movable)
        history: list[_Pass] = []
        for _ in range(_PASSES):
            impacts = self._impacts(pairs, places, changed)
            if impacts is None:
                return history
            constraints, fresh = impacts
            met = torch.unique(constraints.pairs.entry)  # the other entries have found their places
            active, regular = self.movable.new_zeros(len(places), 0), places.new_zeros(len(places))
            if history:
                constraints = history[-1].constraints.then(constraints, len(places))
                active, regular = history[-1].active, history[-1].regular
            rows = dual_rows(constraints.of(met), self.inverse_mass[met])
            count = rows.used.shape[1]
            active = pad(active, (0, int(constraints.place.max()) + 1 - active.shape[1]))
            target = self.settings.thickness - rows.apply(self.candidate[met])
            force, used = solve_dual(rows, target, active[met, :count])
            active[met, :count] = force > 0
            history.append(_Pass(constraints, fresh, active, regular.index_copy(0, met, used)))
            moved = places.clone()
            moved[met] = self.candidate[met] + (1 - self.settings.residue) * rows.move(force)
            changed = (moved != places).any(-1)
            places = moved
            stray = torch.maximum(
                places - torch.maximum(self.start, listed_at), torch.minimum(self.start, listed_at) - places
            )
            far = stray.flatten(1).amax(1) > 0.4 * _REACH
            if bool(far.any()):
                pairs = pairs.where(~far[pairs.entry]).then(self._list(places, far.nonzero().flatten()))
                listed_at = torch.where(far[:, None, None], places, listed_at)
        last = history[-1].constraints
        late = torch.unique(last.pairs.entry[-history[-1].fresh :]).tolist()
        raise UnresolvedContactError(step, late, _describe(self.surface, last.pairs), _PASSES)

    def _list(self, places: Tensor, entries: Tensor) -> MeetingPairs:
        """Candidate pairs of some batch entries [E]."""
        found = MeetingPairs.join(candidates(self.surface, (self.start[entries], places[entries]), _REACH))
        return replace(found, entry=entries[found.entry])

    def _impacts(self, pairs: MeetingPairs, places: Tensor, changed: Tensor) -> tuple[Constraints, int] | None:
        """The impacts of this pass that are kept, none if there are none."""
        pairs = pairs.where(pairs.gather(changed).any(1))
        start, end = pairs.gather(self.start), pairs.gather(places)
        near = _boxes_meet(pairs, start, end).nonzero().flatten()
        pairs, start, end = pairs.where(near), start[near], end[near]
        if not len(pairs):
            return None
        found, time = first_impacts(pairs, start, end, self.settings.smallest)
        if not len(found):
            return None
        pairs, start, end = pairs.where(found), start[found], end[found]
        free = pairs.gather(self.movable)
        kept = select_disjoint(pairs.entry, pairs.points, free, time, self.start.shape[1])
        pairs, time, start, end = pairs.where(kept), time[kept], start[kept], end[kept]
        frames = pairs.frames(start + time[:, None, None] * (end - start))
        approach = (frames.normals * along(frames.weights, end - start)).sum(-1)
        sign = torch.where(approach > 0, -1.0, 1.0).to(time.dtype)
        place = _places(pairs.entry, len(self.start))
        return Constraints(pairs, time, sign, frames.weights, sign[:, None] * frames.normals, place), len(pairs)


def select_disjoint(entry: Tensor, points: Tensor, movable: Tensor, time: Tensor, count: int) -> Tensor:
    """Go through the impacts by time and keep each that shares no movable point with one kept before; vectorised.

    Args:
        entry, points, movable, time: [C], [C, 4], bool [C, 4], [C].
        count: N.

    Returns:
        [K] indices in the order of time.
    """
    order = torch.sort((time / _TIME_TIE).floor(), stable=True).indices
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=order.device)
    # a point that cannot move gets a number of its own in each impact, so that it conflicts with nothing
    size = (int(entry.max()) + 1) * count
    spare = size + torch.arange(points.numel(), device=points.device).view_as(points)
    node = torch.where(movable, entry[:, None] * count + points, spare)
    open_ = movable.any(1)
    kept = torch.zeros_like(open_)
    unset = torch.full((size + points.numel(),), len(order), dtype=torch.long, device=points.device)
    while bool(open_.any()):  # each round keeps every impact that is the first at all of its points
        index = node[open_].flatten()
        first = unset.scatter_reduce(0, index, rank[open_].repeat_interleave(4), "amin")
        wins = open_ & (first[node] == rank[:, None]).all(1)
        kept |= wins
        taken = torch.zeros_like(unset, dtype=torch.bool)
        taken[node[wins].flatten()] = True
        open_ = open_ & ~taken[node].any(1)
    return order[kept[order]]


@dataclass(frozen=True)
class DualRows:
    """Constraint rows of every entry, padded with zeros: W [B, R, N', 3] over the points that any of them touches."""

    matrix: Tensor
    points: Tensor
    """[N'] the points."""
    inverse_mass: Tensor
    """[B, N']"""
    used: Tensor
    """bool [B, R]"""
    point_count: int

    def apply(self, positions: Tensor) -> Tensor:
        """[B, N, 3] -> [B, R] W x."""
        flat = self.matrix.flatten(2)
        return (flat @ positions[:, self.points].flatten(1)[..., None]).squeeze(-1)

    def move(self, force: Tensor) -> Tensor:
        """[B, R] -> [B, N, 3] M⁻¹ Wᵀ λ."""
        change = (self.matrix.flatten(2).mT @ force[..., None]).view(len(force), -1, 3) * self.inverse_mass[..., None]
        full = change.new_zeros(len(force), self.point_count, 3)
        return full.index_copy(1, self.points, change)

    def scaled(self, target: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The dual problem with unit diagonal: (S W M⁻¹ Wᵀ S [B, R, R], S target [B, R], S [B, R])."""
        gram = (self.matrix * self.inverse_mass[:, None, :, None]).flatten(2) @ self.matrix.flatten(2).mT
        scale = gram.detach().diagonal(dim1=1, dim2=2).clamp(min=1e-300).rsqrt()
        scale = torch.where(self.used, scale, 0.0)
        return gram * scale[:, :, None] * scale[:, None, :], target * scale, scale


def dual_rows(constraints: Constraints, inverse_mass: Tensor) -> DualRows:
    """Rows n_j · Σ w_jk x_k, for inverse masses [B, N]."""
    pairs, place = constraints.pairs, constraints.place
    batch, point_count = inverse_mass.shape
    count = int(place.max()) + 1
    points, position = torch.unique(pairs.points, return_inverse=True)
    index = ((pairs.entry * count + place)[:, None] * len(points) + position).flatten()
    values = (constraints.weights[..., None] * constraints.normals[:, None]).flatten(0, 1)
    matrix = values.new_zeros(batch * count * len(points), 3).index_add(0, index, values)
    used = torch.zeros(batch * count, dtype=torch.bool, device=index.device)
    used[pairs.entry * count + place] = True
    return DualRows(
        matrix.view(batch, count, len(points), 3), points, inverse_mass[:, points], used.view(batch, count), point_count
    )


def solve_dual(rows: DualRows, target: Tensor, guess: Tensor) -> tuple[Tensor, Tensor]:
    """λ >= 0 with W M⁻¹ Wᵀ λ >= target, complementary, by a primal-dual active set method.

    The method (Hintermüller, Ito & Kunisch 2002) exchanges all wrong rows at once. It mostly ends after a few exchanges
    but may cycle; entries where it does go to non-negative least squares (Lawson & Hanson 1974).

    Args:
        target: [B, R] h - W x̂.
        guess: bool [B, R] rows that were active before.

    Returns:
        (λ [B, R], regularisation [B] of the unit-diagonal problem).
    """
    matrix, right, scale = rows.scaled(target)
    active = ((right > 0) | guess) & rows.used
    rounding = torch.finfo(right.dtype).eps
    regular = right.new_full((len(right),), _REGULAR * rounding)
    tolerance = 10 * _REGULAR * rounding * right.abs().amax(1, keepdim=True)
    force, lacking = torch.empty_like(right), torch.empty_like(right)
    open_ = torch.arange(len(right), device=right.device)  # entries whose active set is still changing
    for _ in range(_EXCHANGES):
        part, sought, trial = matrix[open_], right[open_], active[open_]
        found = solve_active(part, sought, trial, regular[open_])
        missing = sought - (part @ found[..., None]).squeeze(-1)
        force[open_], lacking[open_] = found, missing
        following = torch.where(trial, found > 0, missing > tolerance[open_]) & rows.used[open_]
        changing = (following != trial).any(1)
        active[open_] = following
        open_ = open_[changing]
        if not len(open_):
            break
    wrong = (lacking > max(_CONTRADICTION, 1e5 * rounding) * right.abs().amax(1, keepdim=True)).any(1)
    wrong[open_] = True
    for entry in wrong.nonzero().flatten().tolist():  # rare: the active set cycles, or there is no solution
        exact, contradiction = _least_distance(matrix[entry], right[entry])
        if contradiction:
            regular[entry] = _HARD
        force[entry] = solve_active(matrix[None, entry], right[None, entry], exact[None], regular[None, entry])[0]
    force = force.clamp(min=0)
    return force * scale, regular


def solve_active(matrix: Tensor, right: Tensor, active: Tensor, regular: Tensor) -> Tensor:
    """λ [B, R] of the active rows of a unit-diagonal problem, zero for the others; differentiable."""
    both = active[:, :, None] & active[:, None, :]
    diagonal = torch.where(active, regular[:, None], 1.0)
    system = torch.where(both, matrix, 0.0) + torch.diag_embed(diagonal)
    return torch.linalg.solve(system, torch.where(active, right, 0.0))


def _least_distance(matrix: Tensor, right: Tensor) -> tuple[Tensor, bool]:
    """(active set [R], whether the constraints contradict each other) by non-negative least squares.

    λᵀ A λ / 2 - rightᵀ λ over λ >= 0 is |Lᵀ λ - L⁻¹ right|² / 2 with A + ε = L Lᵀ.
    """
    values, target = matrix.double().cpu().numpy(), right.double().cpu().numpy()

    def active(regular: float) -> tuple[Tensor, float]:
        lower = np.linalg.cholesky(values + regular * np.eye(len(values)))
        from scipy.optimize import nnls  # slow to import, and seldom needed

        force, _ = nnls(lower.T, np.linalg.solve(lower, target), maxiter=30 * len(values))
        return torch.as_tensor(force > 0, device=matrix.device), float((target - values @ force).max())

    found, lacking = active(10 * _REGULAR * torch.finfo(torch.float64).eps)
    if lacking <= _CONTRADICTION * float(np.abs(target).max()):
        return found, False
    return active(_HARD)[0], True


@dataclass(frozen=True)
class _Projection:
    """The end of the passes."""

    places: Tensor
    """[B, N, 3]"""
    pairs: MeetingPairs
    weights: Tensor
    """[J, 4]"""
    normals: Tensor
    """[J, 3]"""
    force: Tensor
    """[J] λ: the impulse times the time step [kg·m]."""

    def friction(
        self, surface: ContactSurface, start: Tensor, inverse_mass: Tensor, coefficients: tuple[Tensor, Tensor]
    ) -> Tensor:
        """[B, N, 3] displacement by Coulomb friction: at most μ λ against the sliding of each impact, and no reversal.

        All impacts act at once; where several share a point each gets its share of the mass (Tonge, Benevolenski &
        Voroshilov 2012), so that together they do not reverse the sliding either.
        """
        pairs = self.pairs
        moved = along(self.weights, pairs.gather(self.places) - pairs.gather(start))
        sliding = moved - (self.normals * moved).sum(-1, keepdim=True) * self.normals
        with_obstacle = (pairs.points >= surface.cloth_points).any(1)
        obstacle, cloth = (coefficient[pairs.entry] for coefficient in coefficients)
        limit = torch.where(with_obstacle, obstacle, cloth) * self.force
        batch, count = inverse_mass.shape
        index = (pairs.entry[:, None] * count + pairs.points).flatten()
        acting = (self.force.detach() > 0).to(limit.dtype).repeat_interleave(4)
        shared = limit.new_zeros(batch * count).index_add(0, index, acting)
        mobility = pairs.gather(inverse_mass)
        sticking = limit * (self.weights.square() * mobility * shared[index].view(-1, 4)).sum(-1)
        gamma = limit / torch.maximum(safe_norm(sliding), sticking)
        change = -(self.weights * mobility * gamma[:, None])[..., None] * sliding[:, None]
        return torch.zeros_like(start).flatten(0, 1).index_add(0, index, change.flatten(0, 1)).view_as(start)


def _replay(
    history: list[_Pass], settings: ImpactSettings, start: Tensor, candidate: Tensor, inverse_mass: Tensor, copies: int
) -> _Projection:
    """The passes again, as differentiable expressions on their active sets.

    Where weights and normals count as constants only the last pass matters.
    """
    batch = len(start) // copies
    places, force = candidate, candidate.new_zeros(0)
    weights: list[Tensor] = []  # of the impacts of each pass, [K, J, ...]
    normals: list[Tensor] = []
    constraints = history[-1].constraints
    for found in history if settings.differentiate_normals else history[-1:]:
        constraints = found.constraints.repeated(copies, batch)
        if settings.differentiate_normals:
            frames = found.newest().repeated(copies, batch).frames(start, places)
            weights.append(frames.weights.unflatten(0, (copies, -1)))
            normals.append(frames.normals.unflatten(0, (copies, -1)))
            all_weights, all_normals = torch.cat(weights, 1).flatten(0, 1), torch.cat(normals, 1).flatten(0, 1)
            constraints = replace(constraints, weights=all_weights, normals=all_normals)
        rows = dual_rows(constraints, inverse_mass)
        matrix, right, scale = rows.scaled(settings.thickness - rows.apply(candidate))
        force = solve_active(matrix, right, found.active.repeat(copies, 1), found.regular.repeat(copies)) * scale
        places = candidate + (1 - settings.residue) * rows.move(force)
    each = force[constraints.pairs.entry, constraints.place]
    return _Projection(places, constraints.pairs, constraints.weights, constraints.normals, each)


def _places(entry: Tensor, batch: int) -> Tensor:
    """[C] the number of each impact within its entry."""
    order = torch.sort(entry, stable=True).indices
    count = torch.bincount(entry, minlength=batch)
    place = torch.empty_like(entry)
    place[order] = torch.arange(len(entry), device=entry.device) - (count.cumsum(0) - count)[entry[order]]
    return place


def _boxes_meet(pairs: MeetingPairs, start: Tensor, end: Tensor) -> Tensor:
    """[C] whether the boxes that both primitives sweep touch."""
    is_edge = (pairs.edge_edge == 1)[:, None]
    low, high = torch.minimum(start, end), torch.maximum(start, end)  # the second point belongs to the face or first edge
    low_first = torch.where(is_edge, torch.minimum(low[:, 0], low[:, 1]), low[:, 0])
    high_first = torch.where(is_edge, torch.maximum(high[:, 0], high[:, 1]), high[:, 0])
    low_last, high_last = torch.minimum(low[:, 2], low[:, 3]), torch.maximum(high[:, 2], high[:, 3])
    low_other = torch.where(is_edge, low_last, torch.minimum(low_last, low[:, 1]))
    high_other = torch.where(is_edge, high_last, torch.maximum(high_last, high[:, 1]))
    return ((low_first <= high_other + _TOUCH) & (low_other <= high_first + _TOUCH)).all(-1)


def _describe(surface: ContactSurface, pairs: MeetingPairs) -> str:
    """The pair that was met last, in words."""
    kind = "edge against edge" if int(pairs.edge_edge[-1]) else "point against face"
    points = pairs.points[-1].tolist()
    owners = [("cloth" if owner == 0 else f"obstacle {owner - 1}") for owner in surface.owner[pairs.points[-1]].tolist()]
    named = ", ".join(f"{point} ({owner})" for point, owner in zip(points, owners, strict=True))
    return f"{kind}, points {named}"
