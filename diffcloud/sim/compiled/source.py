"""Generates straight-line Python code from formulas."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

from diffcloud.sim.compiled.trace import Scalar, ordered

_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "eq": "==", "and": "&"}
_CALL = {
    "sqrt": "sqrt",
    "log": "log",
    "sin": "sin",
    "cos": "cos",
    "abs": "abs",
    "floor": "floor",
    "atan2": "atan2",
    "min": "min",
}


class Code:
    """Lines of code that compute each node once."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self._known: dict[int, str] = {}

    def compute(self, outputs: Iterable[Scalar]) -> None:
        """Append assignments for all nodes that the outputs need and that are not computed yet."""
        for node in ordered(outputs):
            if node.number in self._known:
                continue
            if node.value is not None:
                text = repr(node.value)
                self._known[node.number] = text if node.value >= 0 else f"({text})"
                continue
            name = f"t{node.number}"
            self.lines.append(f"{name} = {self._expression(node)}")
            self._known[node.number] = name

    def name(self, node: Scalar) -> str:
        """Variable name or number of a computed node."""
        return self._known[node.number]

    def _expression(self, node: Scalar) -> str:
        names = [self._known[operand.number] for operand in node.operands]
        operation = node.operation
        if operation in _INFIX:
            return f"{names[0]} {_INFIX[operation]} {names[1]}"
        if operation in _CALL:
            return f"{_CALL[operation]}({', '.join(names)})"
        match operation:
            case "input":
                return str(node.payload)
            case "held":
                return names[0]
            case "neg":
                return f"-{names[0]}"
            case "where":
                return f"{names[1]} if {names[0]} else {names[2]}"
            case "sign":
                return f"(1.0 if {names[0]} > 0 else 0.0) - (1.0 if {names[0]} < 0 else 0.0)"
            case "pick":
                before, after = cast(tuple[str, str], node.payload)  # from `terms.term.Element`
                return f"{before}int({names[0]}){after}"
        raise ValueError(f"No code for {operation}.")


def straight_kernel(name: str, arguments: str, body: Iterable[str]) -> str:
    """Source code of a kernel with a straight-line body (`compiled.straight`)."""
    head = f"@straight\ndef _{name}({arguments}):"
    call = f"@kernel\ndef {name}({arguments}):\n    _{name}({arguments})"
    return "\n".join([head, *(f"    {line}" for line in body), "", call])
