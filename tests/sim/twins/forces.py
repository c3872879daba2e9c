"""The kernels of one term of a small system, called with arrays."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from diffcloud.arcsim.terms import TERMS, kernels
from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.build import build_system
from diffcloud.sim.compiled.data import Motion, Parameters, Timing
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import Material
from diffcloud.sim.surrounding import Surrounding
from diffcloud.sim.terms.term import Term

STEP = 0.01


class Forces:
    """All terms of a cloth with two handles, over whatever surrounds it."""

    def __init__(
        self,
        mesh: ClothMesh,
        material: Material,
        surrounding: Surrounding | None = None,
        *,
        shaped: bool = False,
        rng: np.random.Generator | None = None,
    ) -> None:
        """Args: rng: draws parameters; without, they are one, compression is the material's, and air is still."""
        handles = Handles((Handle(0), Handle(1)))
        self.mesh = mesh
        self.system = build_system(
            mesh, material, time_step=STEP, handles=handles, surrounding=surrounding, shaped=shaped, integrator="arcsim"
        )
        self.terms = self.system.scene.terms
        given = self.system.properties

        def drawn(array: Any) -> np.ndarray:
            shape = np.atleast_1d(np.asarray(array)[0]).shape
            return np.ones(shape) if rng is None else rng.uniform(0.3, 2.0, shape)

        fields = {name: drawn(getattr(given, name)) for name in Parameters._fields if hasattr(given, name)}
        mass, pressed = (fields[name] * getattr(given, name)[0].numpy() for name in ("node_mass", "compression"))
        hold, target = np.ones(2), np.zeros((2, 3)) if rng is None else rng.normal(size=(2, 3))
        self.parameters = Parameters(
            **(
                fields
                | {"node_mass": mass, "inverse_mass": 1 / mass, "compression": pressed, "hold": 50 * hold, "target": target}
            )
        )
        self.timing = Timing(STEP, STEP)

    def motion(self, *fields: np.ndarray) -> Motion:
        """Positions, velocities before and after, displacement; those left out are zero."""
        nothing = np.zeros(self.mesh.nodes.shape)
        given = [np.ascontiguousarray(field, dtype=np.float64) for field in fields]
        return Motion(*(given + [nothing] * (4 - len(given))))

    def force(self, name: str, motion: Motion) -> np.ndarray:
        """[V, 3]"""
        found = np.zeros(self.mesh.nodes.shape)
        getattr(kernels, f"{name}_force")(self.of(name), self.parameters, motion, self.timing, found)
        return found

    def energy(self, name: str, motion: Motion) -> float:
        found = np.zeros(1)
        getattr(kernels, f"{name}_energy")(self.of(name), self.parameters, motion, self.timing, found)
        return float(found[0])

    def stiffness(self, name: str, motion: Motion, displaced: float, moved: float) -> np.ndarray:
        """[3 V, 3 V] displaced (-∂f/∂d) + moved (-∂f/∂after), from the blocks that `assemble` gives."""
        of, term = self.of(name), term_of(name)
        blocks = np.zeros((len(of.nodes), len(term.pairs), 9))
        getattr(kernels, f"{name}_assemble")(
            of, self.parameters, motion, self.timing, displaced, moved, np.zeros(self.mesh.nodes.shape), blocks
        )
        found = np.zeros((len(self.mesh.nodes), 3, len(self.mesh.nodes), 3))
        for element, nodes in enumerate(of.nodes):
            for (a, b), block in zip(term.pairs, blocks[element].reshape(-1, 3, 3), strict=True):
                found[nodes[a], :, nodes[b]] += block
                if a != b:
                    found[nodes[b], :, nodes[a]] += block.T
        return found.reshape(3 * len(self.mesh.nodes), -1)

    def jacobian(self, name: str, motion: Motion, displaced: float, moved: float) -> np.ndarray:
        """[3 V, 3 V] as `jacobian` gives it."""
        of, corners = self.of(name), term_of(name).corners
        blocks = np.zeros((len(of.nodes), corners**2, 9))
        getattr(kernels, f"{name}_jacobian")(of, self.parameters, motion, self.timing, displaced, moved, blocks)
        found = np.zeros((len(self.mesh.nodes), 3, len(self.mesh.nodes), 3))
        for element, nodes in enumerate(of.nodes):
            for place, block in enumerate(blocks[element].reshape(-1, 3, 3)):
                found[nodes[place // corners], :, nodes[place % corners]] += block
        return found.reshape(3 * len(self.mesh.nodes), -1)

    def reverse(self, name: str, motion: Motion, adjoint: np.ndarray) -> tuple[Parameters, Motion]:
        """Gradients of adjoint · force."""
        gradients = Parameters(*(np.zeros_like(field) for field in self.parameters))
        slopes = Motion(*(np.zeros_like(field) for field in motion))
        getattr(kernels, f"{name}_reverse")(self.of(name), self.parameters, motion, self.timing, adjoint, gradients, slopes)
        return gradients, slopes

    def tangent(self, name: str, motion: Motion, rates: Parameters, moves: Motion) -> np.ndarray:
        """[K, V, 3] along K directions."""
        found = np.zeros((len(moves.positions), *self.mesh.nodes.shape))
        getattr(kernels, f"{name}_tangent")(self.of(name), self.parameters, motion, self.timing, rates, moves, found)
        return found

    def of(self, name: str) -> Any:
        """The elements of a term."""
        return getattr(self.terms, name)

    def elements(self, name: str) -> Iterator[tuple[list[int], dict[str, torch.Tensor]]]:
        """(nodes, constants) of each element, for its twin."""
        of, term = self.of(name), term_of(name)
        for element, nodes in enumerate(of.nodes.tolist()):
            yield nodes, {key: torch.as_tensor(getattr(of, key)[element]) for key in term.constants}


def term_of(name: str) -> Term:
    return next(term for term in TERMS if term.name == name)


def twin_force(forces: Forces, name: str, twin: Any, inputs: dict[str, torch.Tensor], extra: dict) -> torch.Tensor:
    """[V, 3] the sum of a twin over all elements; inputs are tensors named as fields of `Parameters` and `Motion`."""
    total = torch.zeros(forces.mesh.nodes.shape, dtype=torch.float64)
    for element, (nodes, constants) in enumerate(forces.elements(name)):
        motion = SimpleNamespace(**{field: inputs[field][nodes] for field in Motion._fields})
        motion.time_step, motion.ahead = forces.timing
        parameters = {}
        for key, place in term_of(name).parameters.items():
            index: Any = {"element": element, "corner": nodes, "episode": 0, "vector": element}[place]
            parameters[key] = inputs[key][index]
        total = total.index_add(0, torch.tensor(nodes), twin(constants | extra, parameters, motion))
    return total
