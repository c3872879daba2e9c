"""What a force is, to the step: a formula for one element, and the elements it acts on.

The formula is written with `compiled.trace`; its value, stiffness and derivatives are generated from it. Every
quantity of an element is asked for by name, so that a term's file is all there is to say about it.
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
"""Whether a parameter has a value for each element, for each node, one for the whole motion, or three for each element."""


@dataclass(frozen=True)
class Setup:
    """What a term's elements are built from."""

    mesh: ClothMesh
    material: Material
    surrounding: Surrounding
    handles: Handles
    bodies: Bodies
    integrator: str
    """A key of `integrators.INTEGRATORS`."""
    order: Order
    shaped: bool
    """Whether the cloth's hinges are at rest as the mesh stands, not flat."""


@dataclass(frozen=True)
class Elements:
    """Groups of nodes that a term acts on."""

    nodes: NDArray[np.int64]
    """[E, n]"""
    constants: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Name -> [E, ...] numbers of each element."""
    tables: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """Name -> numbers that all elements look up."""


@dataclass(frozen=True, eq=False)
class Term:
    """A force of the step.

    `force` gives the force [N] on each of an element's nodes, as a function of where they are, how fast they are before and
    after the step, and, where it is elastic, of the displacement in which the step linearises it.
    """

    name: str
    corners: int
    """Nodes of an element."""
    force: Callable[[Element], Sequence[Vector]]
    build: Callable[[Setup], Elements | None] = lambda _: None
    """None: nothing to act on, or elements that each step finds."""
    constants: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    """Numbers of an element: name -> shape."""
    tables: Mapping[str, int] = field(default_factory=dict)
    """Name -> number of axes."""
    parameters: Mapping[str, Place] = field(default_factory=dict)
    """What it can be differentiated by: fields of `Parameters`."""
    energy: Callable[[Element], Scalar] | None = None
    """[J] that an element stores, where it does; tells explosions from motions."""
    push: Callable[[Setup], float] = lambda _: 0.0
    """[N] that it pushes the whole cloth with at most, where it brings energy in; tells motions from explosions. Weight,
    wind and handles are known without."""

    @property
    def class_name(self) -> str:
        """Of the named tuple that holds its elements."""
        return "".join(word.capitalize() for word in self.name.split("_"))

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """The pairs (a, b >= a) of an element's nodes, in the order of their blocks."""
        return [(a, b) for a in range(self.corners) for b in range(a, self.corners)]


class Element:
    """One element of a term, as its formula sees it."""

    def __init__(self, term: Term, graph: Graph) -> None:
        self._term, self.graph = term, graph
        corners = range(term.corners)

        def each(array: str) -> tuple[Vector, ...]:
            return tuple(graph.vector(*(f"{array}[i{corner}, {axis}]" for axis in range(3))) for corner in corners)

        self.positions = each("motion.positions")
        """[n] where the nodes are [m]: at the start of a step of ARCSim's, at the end of an implicit one."""
        self.before = each("motion.before")
        """[n] velocities at the start of the step [m/s]."""
        self.after = each("motion.after")
        """[n] velocities at its end [m/s]."""
        self.displacement = each("motion.displacement")
        """[n] in which elastic forces are linear: force = F(x) - H(x) d [m]."""
        self.time_step = graph.input("timing.time_step")
        """[s]"""
        self.ahead = graph.input("timing.ahead")
        """From the positions to the end of the step [s]: the time step, or zero."""

    @property
    def constants(self) -> Collection[str]:
        """Names of the numbers of this element."""
        return self._term.constants.keys()

    def constant(self, name: str, *index: int) -> Scalar:
        """A number of this element."""
        self._known(name, self._term.constants, "constant")
        return self.graph.input(f"term.{name}[{', '.join(map(str, ('e', *index)))}]")

    def vector(self, name: str) -> Vector:
        """Three numbers of this element."""
        return Vector(*(self.constant(name, axis) for axis in range(3)))

    def pick(self, name: str, *index: int | Scalar) -> Scalar:
        """A number of this element whose last index is an expression; without derivative by it."""
        self._known(name, self._term.constants, "constant")
        *fixed, last = index
        assert isinstance(last, Scalar)
        return self.graph.node("pick", last, payload=(f"term.{name}[{', '.join(map(str, ('e', *fixed)))}, ", "]"))

    def parameter(self, name: str, corner: int = 0) -> Scalar:
        """A number that the motion can be differentiated by."""
        self._known(name, self._term.parameters, "parameter")
        return self.graph.input(parameter_source(self._term, name, corner))

    def vector_parameter(self, name: str) -> Vector:
        """Three numbers of this element that the motion can be differentiated by."""
        self._known(name, self._term.parameters, "parameter")
        return Vector(*(self.graph.input(parameter_source(self._term, name, 0, axis)) for axis in range(3)))

    def look_up(self, table: str, row: Scalar, *place: int) -> Scalar:
        """A number of a table that all elements share; without derivative by the row."""
        self._known(table, self._term.tables, "table")
        return row.graph.node("pick", row, payload=(f"term.{table}[", f"{''.join(f', {index}' for index in place)}]"))

    def _known(self, name: str, names: Mapping[str, object], kind: str) -> None:
        if name not in names:
            raise KeyError(f"The term {self._term.name} has no {kind} {name!r}; list it among its {kind}s.")


def parameter_source(term: Term, name: str, corner: int = 0, axis: int | None = None) -> str:
    """The code that reads a parameter."""
    place = {"element": "e", "corner": f"i{corner}", "episode": "0", "vector": f"e, {axis}"}[term.parameters[name]]
    return f"parameters.{name}[{place}]"
