"""What an integrator is to the simulation, and the integrators by name.

An integrator is an object with the methods of `Integrator`, called `INTEGRATOR`, in a module of its own, and a line in
`INTEGRATORS`. Its module is imported when a system is first built with it, so that nothing here depends on it.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Annotated, Any, NamedTuple, Protocol, runtime_checkable

from pydantic import AfterValidator

from diffcloud.errors import DivergedError, SceneError, unknown_name
from diffcloud.sim.compiled.data import Floats, Ints, Parameters
from diffcloud.sim.held import Held
from diffcloud.sim.surrounding import ContactSettings, Surrounding
from diffcloud.sim.terms.term import Setup, Term

INTEGRATORS = {
    "implicit": "diffcloud.sim.implicit.integrator",
    "arcsim": "diffcloud.arcsim.integrator",
}
"""Name -> module."""


class Episode(NamedTuple):
    """The arrays of one cloth's episode: S steps, V nodes, O points of obstacles, B bodies, H handles, G grippers."""

    held: Held
    parameters: Parameters
    track: Floats
    """[S, G, 3] displacement of each gripper at the end of each step [m]."""
    scenery: Floats
    """[S + 1, O, 3] points of obstacles at the steps' times [m]."""
    anchors: Floats
    """[H, 3] of the handles [m]; `simulate` takes them."""
    positions: Floats
    """[S + 1, V, 3] [m]"""
    velocities: Floats
    """[S + 1, V, 3] [m/s]"""
    bodies: Floats
    """[S + 1, B, 18] centre [m], orientation row by row, velocity [m/s], angular velocity [rad/s]."""


class Outcome(NamedTuple):
    """How an episode ended, and what its derivatives need."""

    status: int
    """As of `status`."""
    step: int
    """The step in which it ended; S where it was completed."""
    kept: Any
    """What only the integrator reads."""
    fault: Floats | None = None
    """Numbers about a failure, which only the integrator reads."""


class Derivatives(NamedTuple):
    """Gradients of a loss by an episode's arrays, or how these change along K directions."""

    parameters: Parameters
    """Gradients, or rates with a leading axis K."""
    track: Floats
    """[S, G, 3], or [K, S, G, 3]."""
    positions: Floats
    """[S + 1, V, 3], or [S + 1, K, V, 3]."""
    velocities: Floats
    """As the positions."""
    bodies: Floats
    """[S + 1, B, 18], or [S + 1, K, B, 18]."""


@runtime_checkable
class Integrator(Protocol):
    """A time stepping scheme with its contact and its derivatives.

    `simulate`, `reverse` and `tangents` treat one cloth. They run in several threads at once and must release the
    interpreter's lock, as kernels do.
    """

    name: str
    """Its key in `INTEGRATORS`."""
    terms: tuple[Term, ...]
    """Forces whose elements are known before the motion."""
    contacts: tuple[Term, ...]
    """Forces between points that each step finds."""
    smooth: bool
    """Whether derivatives hold over finite changes of the parameters. Fits then step by tangents and fit nuisance
    variables by default; else they use finite differences."""
    meshes: bool
    """Whether its own contact stops the cloth at obstacles that are no planes."""

    def check(self, surrounding: Surrounding) -> None:
        """
        Raises:
            SceneError: the surrounding has something that this integrator cannot simulate.
        """

    def with_contact(self, surrounding: Surrounding) -> Surrounding:
        """The same surrounding with the contact that is this integrator's own."""

    def resting_height(self, contact: ContactSettings, weight: float) -> float:
        """Distance from a level obstacle at which contact carries a cloth of that weight per area [N/m²], above 0 [m]."""

    def build(self, setup: Setup, time_step: float) -> Any:
        """What the kernels are given: everything that is constant in a run with steps of that length [s]."""

    def points(self, scene: Any) -> int:
        """How many points of cloth, obstacles and bodies forces know: the length of `Parameters.inverse_mass`."""

    def simulate(self, scene: Any, episode: Episode, keep: int, control: Ints) -> Outcome:
        """Fill an episode from its start.

        Args:
            scene: what `build` gave.
            episode: the first rows of positions, velocities and bodies are the start; the others are taken.
            keep: rows of factors [9] that may be kept for the derivatives; below zero: nothing is kept.
            control: [2] finished steps are added to the first; the second one stops the run when it is not zero.
        """

    def reverse(self, scene: Any, episode: Episode, outcome: Outcome, gradients: Derivatives) -> None:
        """Sweep gradients backwards through an episode (the adjoint).

        Args:
            episode: as `simulate` left it, without the steps that it did not finish.
            gradients: by the states after each step, which are overwritten: the first rows take those by the start. The
                parameters and the track are zeros and take the sums over all steps.
        """

    def tangents(self, scene: Any, episode: Episode, outcome: Outcome, rates: Derivatives) -> None:
        """Carry K directions through an episode.

        Args:
            episode: as `simulate` left it.
            rates: of the parameters, the track, and the start in the first rows of the states; the other rows are taken.
                `hold` is zero, `target` is room.
        """

    def energy(self, scene: Any, parameters: Parameters, positions: Floats) -> float:
        """Elastic energy of a cloth whose nodes are at positions [V, 3], with constant damping [J]."""

    def fault(self, entry: int, episode: Episode, outcome: Outcome) -> DivergedError:
        """What is wrong with an episode whose status is one of the integrator's own.

        Args:
            entry: of the batch, for the message.
        """


@cache
def load_integrator(name: str) -> Integrator:
    """An integrator by its name; its module is imported when it is first asked for.

    Raises:
        SceneError: no such integrator.
    """
    if name not in INTEGRATORS:
        raise SceneError(unknown_name("integrator", name, INTEGRATORS))
    found: Integrator = import_module(INTEGRATORS[name]).INTEGRATOR
    return found


def _known(name: str) -> str:
    if name not in INTEGRATORS:
        raise ValueError(unknown_name("integrator", name, INTEGRATORS))
    return name


IntegratorName = Annotated[str, AfterValidator(_known)]
"""A field of a file that names an integrator."""
