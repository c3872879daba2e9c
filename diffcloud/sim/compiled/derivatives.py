"""Symbolic derivatives of formulas.

Where a function is not smooth, the derivative is that of torch, because the reference implementations in tests/ use torch:
that of the active side for `maximum` with a constant (of the argument at equality), half of both for `minimum` of equal
arguments, zero for `absolute` at zero, and zero for every table index.
"""

from __future__ import annotations

from collections.abc import Sequence

from diffcloud.sim.compiled.trace import Scalar, cosine, ordered, sine, unary, where


def gradient(output: Scalar, inputs: Sequence[Scalar]) -> list[Scalar]:
    """d output / d input for each input, by reverse accumulation."""
    zero = output.graph.constant(0.0)
    if output.value is not None:
        return [zero] * len(inputs)
    wanted = _depending(output, inputs)
    slopes: dict[int, Scalar] = {output.number: output.graph.constant(1.0)}
    for node in reversed(ordered([output])):
        slope = slopes.get(node.number)
        if slope is None or node.number not in wanted:
            continue
        for operand, part in _partials(node, slope):
            if operand.number in wanted:
                slopes[operand.number] = slopes[operand.number] + part if operand.number in slopes else part
    return [slopes.get(one.number, zero) for one in inputs]


def directional(outputs: Sequence[Scalar], inputs: Sequence[Scalar], rates: Sequence[Scalar]) -> list[Scalar]:
    """Directional derivatives of the outputs for given rates of the inputs, by forward accumulation."""
    zero = outputs[0].graph.constant(0.0)
    one = outputs[0].graph.constant(1.0)
    known = {source.number: rate for source, rate in zip(inputs, rates, strict=True)}
    for node in ordered(outputs):
        if node.number in known:
            continue
        for operand, part in _partials(node, one):
            rate = known.get(operand.number, zero)
            if rate.value != 0:
                change = part * rate
                known[node.number] = known[node.number] + change if node.number in known else change
    return [known.get(output.number, zero) for output in outputs]


def _partials(node: Scalar, slope: Scalar) -> list[tuple[Scalar, Scalar]]:
    """Pairs (operand, slope times d node / d operand) for each differentiable operand."""
    a = node.operands[0] if node.operands else None
    match node.operation, node.operands:
        case "add", (p, q):
            return [(p, slope), (q, slope)]
        case "sub", (p, q):
            return [(p, slope), (q, -slope)]
        case "mul", (p, q):
            return [(p, slope * q), (q, slope * p)]
        case "div", (p, q):
            part = slope / q
            return [(p, part), (q, -part * node)]
        case "neg", (p,):
            return [(p, -slope)]
        case "sqrt", (p,):
            return [(p, slope * 0.5 / node)]
        case "log", (p,):
            return [(p, slope / p)]
        case "sin", (p,):
            return [(p, slope * cosine(p))]
        case "cos", (p,):
            return [(p, -slope * sine(p))]
        case "abs", (p,):
            return [(p, slope * unary("sign", p))]
        case "atan2", (p, q):
            part = slope / (p * p + q * q)
            return [(p, part * q), (q, -part * p)]
        case "where", (condition, p, q):
            return [(p, where(condition, slope, 0.0)), (q, where(condition, 0.0, slope))]
        case "min", (p, q):
            half = where(p.equals(q), 0.5, 0.0)
            return [(p, slope * where(p < q, 1.0, half)), (q, slope * where(q < p, 1.0, half))]
        case (("constant" | "input" | "floor" | "sign" | "pick" | "held" | "lt" | "le" | "eq" | "and"), _):
            return []
    raise ValueError(f"No derivative of {node.operation} ({a}).")


def _depending(output: Scalar, inputs: Sequence[Scalar]) -> set[int]:
    """Numbers of the nodes between inputs and output that depend differentiably on an input."""
    sources = {one.number for one in inputs}
    found: set[int] = set()
    for node in ordered([output]):
        differentiable = node.operation not in ("floor", "sign", "pick", "held", "lt", "le", "eq", "and")
        if node.number in sources or (differentiable and any(one.number in found for one in node.operands)):
            found.add(node.number)
    return found
