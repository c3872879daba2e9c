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
    stated: bool = True,
    gaps: list[dict[str, Any]] | None = None,
    landscape: bool = False,
    reason: str = "",
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
        "nuisance": [],
        "start": None if start is None else _measured(start),
        "methods": [_row(method, loss, stretch, truth) for method, loss in losses.items()],
        "gaps": gaps or [],
        "failures": [],
        "transfers": [{"source": source, **_measured(loss)} for source, loss in (transfers or {}).items()],
        "intervals": _intervals(stretch, reason) if stated else None,
        "landscape": _landscape() if landscape else None,
    }


def records() -> list[dict[str, Any]]:
    """Two repeats in one scenario, one in another."""
    first = {"diffcloud": 0.001, "mlp": 0.00104, "middle": 0.01}
    second = {"diffcloud": 0.002, "mlp": 0.004, "middle": 0.01}
    gap = {"method": "meteornet", "reason": "no checkpoint", "expected": True}
    return [
        record("lift", "tan1", methods=first, transfers={"tan2": 0.004}, gaps=[gap], landscape=True),
        record("lift", "tan2", stretch=2.0, methods=second, reason="the misfit is 14.2 mm"),
        record("fold", "tan1", stretch=8.0, stated=False),
    ]


def _row(method: str, loss: float, stretch: float, truth: dict[str, float] | None) -> dict[str, Any]:
    values = {"stretching": stretch, "density": 1.0}
    row = {"method": method, "values": values, "clipped": values, "inside": True, "simulations": 4, "gradients": False}
    known = {"success": loss < 6e-5, "error_stretching": 0.5} if truth else {}
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


def _intervals(stretch: float, reason: str) -> dict[str, Any]:
    def entry(value: float, scale: float, unit: str) -> dict[str, Any]:
        return {
            "value": scale * value, "low": scale * value / 2, "high": scale * value * 2, "unit": unit, "nominal": scale,
            "factor": 2.0, "at_bounds": [], "status": "ratio_only",
        }  # fmt: skip

    return {
        "level": 0.9,
        "within": 1.5,
        "parameters": {"stretching": entry(stretch, 4.0, "N/m"), "density": entry(1.0, 0.2, "kg/m²")},
        "ratio": {
            "value": 20 * stretch,
            "low": 20 * stretch / 1.07,
            "high": 21.4 * stretch,
            "nominal": 20.0,
            "factor": 1.07,
        },
        "best": {"powers": {"stretching": 1.0, "density": -1.0}, "factor": 1.07},
        "worst": {"powers": {"stretching": 1.0, "density": 1.0}, "factor": 2.0},
        "sources": {
            "friction": {"stretching": 0.3, "density": 0.3, "ratio": 0.03},
            "noise": {"stretching": 0.1, "density": 0.1, "ratio": 0.02},
        },
        "clusters": 16,
        "covariance": [[0.1, 0.098], [0.098, 0.1]],
        "arrived": True,
        "fits_to_noise": not reason,
        "reason": reason,
        "warning": "" if reason else "the loss is 1.7 times what noise leaves",
        "note": "",
    }


def _landscape() -> dict[str, Any]:
    return {
        "names": ["stretching", "density"],
        "x": [0.1, 1.0, 10.0],
        "y": [0.1, 1.0, 10.0],
        "loss": [[0.01, 0.02, 0.03], [0.02, 0.001, 0.02], [0.03, None, 0.01]],
        "paths": [[[5.0, 5.0], [2.0, 2.0], [1.0, 1.0]]],
        "fitted": [1.0, 1.0],
    }
