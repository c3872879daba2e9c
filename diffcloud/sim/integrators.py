"""The interface of a time integrator, and the integrators by name.

To add an integrator, write a module whose constant `INTEGRATOR` has the methods of `Integrator`, and list the module in
`INTEGRATORS`. It is imported on first use, so this package does not depend on it.
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
"""Name of each integrator -> its module."""


class Episode(NamedTuple):
    """The arrays of one simulation: S steps, V nodes, O obstacle points, B bodies, H handles, G grippers."""

    held: Held
    parameters: Parameters
    track: Floats
    """[S, G, 3] displacement of each gripper at the end of each step [m]."""
    scenery: Floats
    """[S + 1, O, 3] obstacle points at the start and after each step [m]."""
    anchors: Floats
    """[H, 3] anchors of the handles [m]; `simulate` fills them."""
    positions: Floats
    """[S + 1, V, 3] node positions [m]."""
    velocities: Floats
    """[S + 1, V, 3] node velocities [m/s]."""
    bodies: Floats
    """[S + 1, B, 18] centre [m], rotation matrix in row-major order, velocity [m/s], angular velocity [rad/s]."""


class Outcome(NamedTuple):
    """How a simulation ended, and the data that its derivatives need."""

    status: int
    """One of the numbers in `status`, or of the integrator's own."""
    step: int
    """Index of the step in which the simulation ended; S if it completed."""
    kept: Any
    """Data for the derivatives, private to the integrator."""
    fault: Floats | None = None
    """Data about a failure, private to the integrator."""


class Derivatives(NamedTuple):
    """Gradients of a loss with respect to an episode's arrays, or derivatives of these arrays along K directions."""

    parameters: Parameters
    """Gradients, or derivatives with a leading axis K."""
    track: Floats
    """[S, G, 3] gradients, or [K, S, G, 3] derivatives."""
    positions: Floats
    """[S + 1, V, 3] gradients, or [S + 1, K, V, 3] derivatives."""
    velocities: Floats
    """Shape as of `positions`."""
    bodies: Floats
    """[S + 1, B, 18] gradients, or [S + 1, K, B, 18] derivatives."""


@runtime_checkable
class Integrator(Protocol):
    """A time stepping scheme with its contact model and its derivatives. `simulate`, `reverse` and `tangents` process one
    cloth. Several threads call them at once, so they must release Python's global interpreter lock, as kernels do."""

    name: str
    """Its key in `INTEGRATORS`."""
    terms: tuple[Term, ...]
    """Forces on elements that are fixed before the simulation, such as faces and hinges."""
    contacts: tuple[Term, ...]
    """Contact forces, whose point pairs each step detects."""
    smooth: bool
    """Whether derivatives predict finite changes of the parameters. If so, fits use tangents and estimate nuisance
    variables by default. Otherwise fits use finite differences."""
    meshes: bool
    """Whether its contact model also handles obstacles that are not planes."""

    def check(self, surrounding: Surrounding) -> None:
        """Check that this integrator can simulate the surroundings.

        Raises:
            SceneError: it cannot.
        """

    def with_contact(self, surrounding: Surrounding) -> Surrounding:
        """Return the surroundings with the default contact model of this integrator."""

    def resting_height(self, contact: ContactSettings, weight: float) -> float:
        """Height above a level obstacle at which contact supports a cloth of weight `weight` per area [N/m²], above 0
        [m]."""

    def build(self, setup: Setup, time_step: float) -> Any:
        """Build the constant data for the kernels, for steps of `time_step` [s]."""

    def points(self, scene: Any) -> int:
        """Number of points of cloth, obstacles and bodies: the length of `Parameters.inverse_mass`."""

    def simulate(self, scene: Any, episode: Episode, keep: int, control: Ints) -> Outcome:
        """Simulate an episode in place.

        Args:
            scene: result of `build`.
            episode: the first rows of positions, velocities and bodies are the initial state; the other rows are written.
            keep: how many rows of factors [9] may be stored for the derivatives; negative to store nothing.
            control: [2] the first number counts finished steps. If another thread sets the second one, the run stops.
        """

    def reverse(self, scene: Any, episode: Episode, outcome: Outcome, gradients: Derivatives) -> None:
        """Propagate gradients backwards through an episode (adjoint method).

        Args:
            episode: as `simulate` left it, without the unfinished steps.
            gradients: with respect to the states after each step. They are overwritten: the first rows receive the gradient
                of the initial state. Parameters and track must be zero, and receive the sums over all steps.
        """

    def tangents(self, scene: Any, episode: Episode, outcome: Outcome, rates: Derivatives) -> None:
        """Propagate K directional derivatives forward through an episode.

        Args:
            episode: as `simulate` left it.
            rates: derivatives of the parameters, the track and, in the first rows, the initial state. The other rows are
                written. `hold` must be zero. `target` is scratch space.
        """

    def energy(self, scene: Any, parameters: Parameters, positions: Floats) -> float:
        """Elastic energy of a cloth at node positions [V, 3] [J]."""

    def fault(self, entry: int, episode: Episode, outcome: Outcome) -> DivergedError:
        """Error for batch entry `entry`, whose episode ended with one of the integrator's own status numbers."""


@cache
def load_integrator(name: str) -> Integrator:
    """Return an integrator by name, and import its module if necessary.

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
"""Type of a configuration field that names an integrator."""
