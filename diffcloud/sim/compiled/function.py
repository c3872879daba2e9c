"""Functions of a few numbers, defined by a formula. Code for value, gradient and tangent is generated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from diffcloud.sim.compiled.derivatives import directional, gradient
from diffcloud.sim.compiled.source import Code, straight_kernel
from diffcloud.sim.compiled.trace import Graph, Scalar


@dataclass(frozen=True, eq=False)
class Function:
    """A function outputs = formula(inputs, constants) of flat lists of numbers.

    Generated kernels:

    - `<name>_value(inputs, constants, outputs)` computes the outputs.
    - `<name>_reverse(inputs, constants, adjoint, gradients)` adds the gradients of adjoint · outputs.
    - `<name>_tangent(inputs, constants, rates, output_rates)` computes derivatives [K, outputs] along K directions.
    """

    name: str
    inputs: int
    constants: int
    formula: Callable[[Sequence[Scalar], Sequence[Scalar]], Sequence[Scalar]]

    def sources(self) -> list[str]:
        """Source code of the three kernels."""
        graph = Graph()
        inputs = [graph.input(f"inputs[{k}]") for k in range(self.inputs)]
        outputs = list(self.formula(inputs, [graph.input(f"constants[{k}]") for k in range(self.constants)]))
        weighted = graph.constant(0.0)
        for k, output in enumerate(outputs):
            weighted = weighted + graph.input(f"adjoint[{k}]") * output
        slopes = gradient(weighted, inputs)
        changes = directional(outputs, inputs, [graph.input(f"rates[k, {k}]") for k in range(self.inputs)])
        return [
            self._source("value", "outputs", [f"outputs[{k}] = " for k in range(len(outputs))], outputs),
            self._source("reverse", "adjoint, gradients", [f"gradients[{k}] += " for k in range(self.inputs)], slopes),
            self._source(
                "tangent", "rates, output_rates", [f"output_rates[k, {k}] = " for k in range(len(outputs))], changes, True
            ),
        ]

    def _source(self, kind: str, more: str, stores: Sequence[str], values: Sequence[Scalar], loop: bool = False) -> str:
        code = Code()
        code.compute(values)
        lines = code.lines + [store + code.name(value) for store, value in zip(stores, values, strict=True)]
        if loop:
            lines = ["for k in range(len(rates)):", *(f"    {line}" for line in lines)]
        return straight_kernel(f"{self.name}_{kind}", f"inputs, constants, {more}", lines)
