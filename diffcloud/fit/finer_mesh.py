"""A fit that goes on with a finer mesh where the scenario's own cannot explain the recordings.

Cloth of large faces is too stiff: it can neither fold nor wrinkle within a face, and the fitted material makes up for that.
Of recordings whose cloth had half the edge length, the scenario's mesh leaves 5 to 40 times the loss of their noise, with
a stretch that is off by a factor of 1.2 to 4. From there, descents with half the edge length find it within some per cent.
Where the scenario's mesh explains the recordings, they tell nothing of a finer one, and the fit ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from diffcloud.errors import DivergedError
from diffcloud.fit.joint import AnyObjective
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.solvers import FitOutcome, GaussNewtonSettings, Progress, Settings, solve

_CLEARLY = 0.9
"""Times the former loss, from which on a finer mesh is worth what its simulations cost."""
_MOST_NODES = 3000
"""Of a cloth; a motion of more takes minutes."""


@dataclass(frozen=True)
class MeshFit:
    """A fit, and the mesh that it ended with."""

    objective: AnyObjective
    """Of that mesh."""
    outcome: FitOutcome
    cuts: int
    """How often each face was cut into four."""
    finer_loss: float | None = None
    """Of a mesh cut once more, which was tried and is no better."""


def solve_and_refine(
    objective: AnyObjective,
    space: FitSpace,
    settings: Settings,
    *,
    cuts: int,
    progress: Callable[[Progress], None] | None = None,
) -> MeshFit:
    """Minimise; while the recordings are not explained, cut each face of the cloth into four and go on by Gauss–Newton from
    the values found. A finer mesh is kept if it lowers the loss clearly. Ctrl-C ends the fit and keeps the best so far.

    Args:
        settings: of the solver; no other than Gauss–Newton goes on.
        cuts: as often at most; never where it is not known what the recordings miss of the cloth, and thus how high a loss
            of a right motion may be.

    Raises:
        DivergedError, KeyboardInterrupt: as of `solve`.
    """
    found = MeshFit(objective, solve(objective, space, settings, progress=progress), 0)
    while found.cuts < cuts and isinstance(settings, GaussNewtonSettings) and _asks_for_more(found):
        finer, outcome = found.objective.finer(), found.outcome
        from_here = replace(settings, starts=1, screen=0, init=outcome.values)
        try:
            further = solve(finer, space, from_here, progress=progress)
        except DivergedError:
            break
        except KeyboardInterrupt:
            return replace(found, outcome=replace(outcome, stop_reason="interrupted"))
        if further.loss > _CLEARLY * outcome.loss:
            return _without(found, further)
        found = MeshFit(finer, outcome.gone_on(further), found.cuts + 1)
    return found


def _asks_for_more(found: MeshFit) -> bool:
    nodes = max(4 * len(member.scenario.scene.mesh.nodes) for member in found.objective.members)  # about
    ended = found.outcome.stop_reason not in ("interrupted", "threshold")
    return ended and nodes <= _MOST_NODES and found.outcome.loss > found.objective.unexplained


def _without(found: MeshFit, further: FitOutcome) -> MeshFit:
    """The fit as it was, with what a finer mesh has cost in vain."""
    simulations = found.outcome.simulations + further.simulations
    outcome = replace(found.outcome, simulations=simulations, seconds=found.outcome.seconds + further.seconds)
    if further.stop_reason == "interrupted":
        return replace(found, outcome=replace(outcome, stop_reason="interrupted"))
    return replace(found, outcome=outcome, finer_loss=further.loss)
