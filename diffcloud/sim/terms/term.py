"""Definition of a force term: a formula for one element, and the elements that it acts on.

The formula is written with `compiled.trace`. Its value, stiffness and derivatives are generated from it. The formula
requests each quantity of an element by name, so the file of a term defines the term completely.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.compiled.trace import Graph, Scalar, Vector
from diffcloud.sim.handles import Handles
from diffcloud.sim.materials import Material
from diffcloud.sim.rigid.bodies import Bodies
from diffcloud.sim.surrounding import Order, Surrounding

Place = Literal["element", "corner", "episode", "vector"]
"""Where a parameter has values: one per element, one per node, one per episode, or a vector [3] per element."""


@dataclass(frozen=True)
class Setup:
    """Scene data from which a term builds its elements."""

    mesh: ClothMesh
    material: Material
    surrounding: Surrounding
    handles: Handles
    bodies: Bodies
    integrator: str
    """Name of the integrator, a key of `integrators.INTEGRATORS`."""
    order: Order
    shaped: bool
    """Use the angles of the given mesh as rest angles of the hinges. Otherwise the cloth is flat at rest."""


@dataclass(frozen=True)
class Elements:
    """The groups of n nodes that a term acts on."""

    nodes: NDArray[np.int64]
    """[E, n] node indices."""
    constants: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Name -> [E, ...] constants of each element."""
    tables: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Name -> table that all elements share."""


@dataclass(frozen=True, eq=False)
class Term:
    """A force term. `force` returns the force [N] on each node of an element. It depends on the positions, and on the
    velocities at the start and at the end of the step. An elastic force also depends on the displacement in which the step
    linearises it."""

    name: str
    corners: int
    """Number of nodes of an element."""
    force: Callable[[Element], Sequence[Vector]]
    build: Callable[[Setup], Elements | None] = lambda _: None
    """Builds the elements. None: the term does not act in this scene, or each step detects its elements."""
    constants: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Constants of an element: name -> shape."""
    tables: Mapping[str, int] = field(default_factory=dict)
    """Name of each table -> its number of axes."""
    parameters: Mapping[str, Place] = field(default_factory=dict)
    """Differentiable inputs: names of fields of `Parameters`."""
    energy: Callable[[Element], Scalar] | None = None
    """Elastic energy of an element [J], if it stores any. Used to detect unstable simulations (`plausibility`)."""
    push: Callable[[Setup], float] = lambda _: 0.0
    """Upper bound of the force on the whole cloth with which the term adds energy [N]. Used to detect unstable simulations.
    Weight, wind and handles are accounted for separately."""

    @property
    def class_name(self) -> str:
        """Name of the named tuple type that holds the elements."""
        return "".join(word.capitalize() for word in self.name.split("_"))

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Node pairs (a, b >= a) of an element, in the order of their matrix blocks."""
        return [(a, b) for a in range(self.corners) for b in range(a, self.corners)]


class Element:
    """Symbolic quantities of one element, for the formula of a term."""

    def __init__(self, term: Term, graph: Graph) -> None:
        self._term, self.graph = term, graph
        corners = range(term.corners)

        def each(array: str) -> tuple[Vector, ...]:
            return tuple(graph.vector(*(f"{array}[i{corner}, {axis}]" for axis in range(3))) for corner in corners)

        self.positions = each("motion.positions")
        """[n] node positions [m], at the start of an arcsim step or at the end of an implicit step."""
        self.before = each("motion.before")
        """[n] node velocities at the start of the step [m/s]."""
        self.after = each("motion.after")
        """[n] node velocities at the end of the step [m/s]."""
        self.displacement = each("motion.displacement")
        """[n] displacement d of the linearised elastic forces F(x) - H(x) d [m]."""
        self.time_step = graph.input("timing.time_step")
        """Length of the step [s]."""
        self.ahead = graph.input("timing.ahead")
        """Time from `positions` to the end of the step [s]: the time step or zero."""

    @property
    def constants(self) -> Collection[str]:
        """Names of this element's constants."""
        return self._term.constants.keys()

    def constant(self, name: str, *index: int) -> Scalar:
        """A constant of this element."""
        self._known(name, self._term.constants, "constant")
        return self.graph.input(f"term.{name}[{', '.join(map(str, ('e', *index)))}]")

    def vector(self, name: str) -> Vector:
        """A constant [3] of this element."""
        return Vector(*(self.constant(name, axis) for axis in range(3)))

    def pick(self, name: str, *index: int | Scalar) -> Scalar:
        """A constant of this element whose last index is an expression. The index is not differentiated."""
        self._known(name, self._term.constants, "constant")
        *fixed, last = index
        assert isinstance(last, Scalar)
        return self.graph.node("pick", last, payload=(f"term.{name}[{', '.join(map(str, ('e', *fixed)))}, ", "]"))

    def parameter(self, name: str, corner: int = 0) -> Scalar:
        """A differentiable parameter."""
        self._known(name, self._term.parameters, "parameter")
        return self.graph.input(parameter_source(self._term, name, corner))

    def vector_parameter(self, name: str) -> Vector:
        """A differentiable parameter [3] of this element."""
        self._known(name, self._term.parameters, "parameter")
        return Vector(*(self.graph.input(parameter_source(self._term, name, 0, axis)) for axis in range(3)))

    def look_up(self, table: str, row: Scalar, *place: int) -> Scalar:
        """An entry of a table that all elements share. The row is an expression and is not differentiated."""
        self._known(table, self._term.tables, "table")
        return row.graph.node("pick", row, payload=(f"term.{table}[", f"{''.join(f', {index}' for index in place)}]"))

    def _known(self, name: str, names: Mapping[str, object], kind: str) -> None:
        if name not in names:
            raise KeyError(f"The term {self._term.name} has no {kind} {name!r}; list it among its {kind}s.")


def parameter_source(term: Term, name: str, corner: int = 0, axis: int | None = None) -> str:
    """Source code that reads a parameter."""
    place = {"element": "e", "corner": f"i{corner}", "episode": "0", "vector": f"e, {axis}"}[term.parameters[name]]
    return f"parameters.{name}[{place}]"
