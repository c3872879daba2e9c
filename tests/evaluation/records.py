"""Made-up records of the comparison."""

from __future__ import annotations

from typing import Any


def record(
    scenario: str,
    episode: str,
    *,
    fit: str | None = None,
    start: float | None = 0.02,
    fabric: str = "tan",
    stretch: float = 1.0,
    methods: dict[str, float] | None = None,
    truth: dict[str, float] | None = None,
    transfers: dict[str, float] | None = None,
    identifiability: bool = True,
    gaps: list[dict[str, Any]] | None = None,
    landscape: bool = False,
    ends: tuple[bool, ...] = (True, True, True, True),
) -> dict[str, Any]:
    """One episode; `methods` and `transfers` give losses."""
    losses = methods or {"diffcloud": 0.001, "middle": 0.01}
    return {
        "scenario": scenario,
        "episode": episode,
        "fit": fit or episode,
        "fabric": fabric,
        "category": "medium",
        "category_assumed": True,
        "repeat": 1,
        "source": "test",
        "truth": truth or {},
        "length_unit_m": 1.0,
        "threshold": 6e-5,
        "frames": [-1],
        "starts": 2,
        "start": None if start is None else _measured(start),
        "methods": [_row(method, loss, stretch, truth) for method, loss in losses.items()],
        "gaps": gaps or [],
        "failures": [],
        "transfers": [{"source": source, **_measured(loss)} for source, loss in (transfers or {}).items()],
        "identifiability": _identifiability(ends) if identifiability else None,
        "landscape": _landscape() if landscape else None,
    }


def records() -> list[dict[str, Any]]:
    """Two repeats in one scenario, one in another."""
    first = {"diffcloud": 0.001, "mlp": 0.00104, "middle": 0.01}
    second = {"diffcloud": 0.002, "mlp": 0.004, "middle": 0.01}
    gap = {"method": "meteornet", "reason": "no checkpoint", "expected": True}
    return [
        record("lift", "tan1", methods=first, transfers={"tan2": 0.004}, gaps=[gap], landscape=True),
        record("lift", "tan2", stretch=2.0, methods=second, ends=(True, True, False, True)),
        record("fold", "tan1", stretch=8.0, identifiability=False),
    ]


def _row(method: str, loss: float, stretch: float, truth: dict[str, float] | None) -> dict[str, Any]:
    values = {"stretch": stretch, "mass": 1.0}
    row = {"method": method, "values": values, "clipped": values, "inside": True, "simulations": 4, "gradients": False}
    known = {"success": loss < 6e-5, "error_stretch": 0.5} if truth else {}
    return row | _measured(loss) | known


def _measured(loss: float) -> dict[str, float]:
    return {
        "loss": loss,
        "loss_deviation": 0.03 * loss,
        "rms_mm": 1e3 * loss**0.5,
        "two_sided": 2 * loss,
        "loss_other_frames": 2 * loss,
        "rms_other_frames_mm": 1e3 * (2 * loss) ** 0.5,
    }


def _identifiability(ends: tuple[bool, ...]) -> dict[str, Any]:
    end = {"direction": 0, "end": 0.1, "rise": 1e-6, "rise_farther": 1e-4, "farther_within_bounds": True}
    return {
        "parameters": ["stretch", "mass"],
        "noise": 1e-5,
        "matrix": [[1.0, -0.9], [-0.9, 1.0]],
        "eigenvalues": [1.9, 0.1],
        "directions": [[0.7071, -0.7071], [0.7071, 0.7071]],
        "predicted": [0.05, 1.0],
        "interval": [[0.05, 0.05], [1.0, None]],
        "open": [[False, False], [False, False]],
        "half_widths": {"stretch": 0.7, "mass": 0.7},
        "ratio_half_width": 0.07,
        "combination": "stretch^+1.00 · mass^-1.00",
        "verdicts": {"stretch": "only the ratio", "mass": "only the ratio"},
        "check": [{**end, "agrees": agrees} for agrees in ends],
        "lower": None,
        "scale": {"fitted": 9.0, "with_bending": 8.0, "everything": 6.0},
        "note": "",
    }


def _landscape() -> dict[str, Any]:
    return {
        "names": ["stretch", "mass"],
        "x": [0.1, 1.0, 10.0],
        "y": [0.1, 1.0, 10.0],
        "loss": [[0.01, 0.02, 0.03], [0.02, 0.001, 0.02], [0.03, None, 0.01]],
        "paths": [[[5.0, 5.0], [2.0, 2.0], [1.0, 1.0]]],
        "fitted": [1.0, 1.0],
    }
