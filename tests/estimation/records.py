"""A record of a made-up fit."""

from __future__ import annotations

from typing import Any

from diffcloud.estimation.record import FitRecord, FittedParameter, History, Measure, RecordingFit


def recording_of(name: str = "e", **changes: Any) -> RecordingFit:
    told = {
        "name": name,
        "scenario": "lift",
        "loss": 1e-4,
        "rms_mm": 10.0,
        "rms_to_recording_mm": 12.0,
        "rms_to_cloth_mm": 7.5,
        "frames": [1],
        "frame_rms_mm": [10.0],
        "counted": [0.8],
        "cut_m": None,
        "nuisance": {},
        "centre": [0.0, 0.0, 0.0],
    }
    return RecordingFit.model_validate(told | changes)


def parameter_of(**changes: Any) -> FittedParameter:
    told = {"value": 60.0, "unit": "N/m", "meaning": "", "nominal": 40.0, "multiplier": 1.5}
    told |= {"bounds": (4.0, 400.0), "centre": 40.0}
    return FittedParameter.model_validate(told | changes)


def record_of(*recordings: RecordingFit, **changes: Any) -> FitRecord:
    told = {
        "scenario": "lift",
        "episodes": list(recordings or [recording_of()]),
        "nuisance": {},
        "solver": "adam",
        "parameters": {"stretching": parameter_of()},
        "material": {
            "density": 0.2, "stretching": 6.0, "poisson": 0.0, "shear": 1.5, "compression": 1.0, "bending": 4e-6,
            "damping": 0.005, "friction": 0.3, "self_friction": 0.6, "air_density": 1.2,
            "added_mass": 0.0, "linear_drag": 0.0,
        },
        "loss": 1e-4,
        "loss_start": 2e-4,
        "loss_resampled": 1e-4,
        "rms_mm": 10.0,
        "length_unit_m": 1.0,
        "iterations": 2,
        "simulations": 3,
        "seconds": 1.5,
        "stop_reason": "iterations",
        "start": {"stretching": 1.0},
        "best_start": 0,
        "measure": Measure(paper=False, nuisance={}, frames=None, points=None, seed=0),
        "settings": {"smoothing": 0.0, "resample": False},
        "history": History(names=["stretching"], loss=[[0.2], [0.1]], values=[[[1.0]], [[1.5]]], gradient_norm=[]),
        "failures": [],
    }  # fmt: skip
    return FitRecord.model_validate(told | changes)
