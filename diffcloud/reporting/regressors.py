"""What the page says of regressors: their predictions beside the fits, how they learned, and how sure they may be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diffcloud.errors import ConfigError
from diffcloud.io.files import read_json
from diffcloud.reporting.tables import Cell, Table, number, part, table


@dataclass(frozen=True)
class TrainingEntry:
    """One trained regressor."""

    scenario: str
    model: str
    summary: Mapping[str, Any]
    """Of `regressors.training.train_regressor`."""

    @staticmethod
    def read(path: Path) -> TrainingEntry:
        """Read <scenario>/<model>/training.json.

        Raises:
            ConfigError: missing, damaged, or not of a training.
        """
        summary = read_json(path, error=ConfigError)
        if not isinstance(summary, dict) or not {"history", "held_out"} <= summary.keys():
            raise ConfigError(
                f"{path} is no training written by `diffcloud network train`: it lacks `history` or `held_out`."
            )
        return TrainingEntry(path.parents[1].name, path.parent.name, summary)


def predictions_table(predictions: Sequence[Mapping[str, Any]], fitted_mm: Mapping[tuple[str, str], float]) -> Table:
    """What networks predicted, and the simulation with it beside the fit.

    Args:
        predictions: rows of `tables/predictions.csv`.
        fitted_mm: (scenario, episode) -> RMS distance after the fit [mm].
    """
    columns = dict.fromkeys(key for row in predictions for key in row if key.startswith("predicted_"))
    names = [key.removeprefix("predicted_") for key in columns]
    heads = ("episode", "scenario", "model", "predicted mm", "fitted mm", *names)
    return table(heads, (_prediction_row(row, names, fitted_mm) for row in predictions))


def errors_table(trainings: Sequence[TrainingEntry]) -> Table:
    """Errors on held-out draws."""
    heads = ("scenario", "model", "parameter", "median relative error", "of predicting the mean", "90 % interval holds")
    return table(heads, (_error_row(e, name) for e in trainings for name in e.summary["held_out"]["parameters"]))


def training_data(trainings: Sequence[TrainingEntry]) -> list[dict[str, Any]]:
    """What the page's script draws."""
    return [
        {
            "name": f"{entry.scenario} / {entry.model}",
            "loss": [float(f"{row['validation_loss']:.4g}") for row in entry.summary["history"]],
            "levels": entry.summary["held_out"]["levels"],
            "coverage": {name: [round(value, 4) for value in row] for name, row in _coverage(entry).items()},
        }
        for entry in trainings
    ]


def _coverage(entry: TrainingEntry) -> dict[str, list[float]]:
    """How often the truth is inside at each level: of each parameter, and of all of a posterior's together."""
    held_out = entry.summary["held_out"]
    found = {name: list(row["coverage"]) for name, row in held_out["parameters"].items()}
    together = held_out.get("calibration")
    return found | ({} if together is None else {"all together": list(together["expected_coverage"])})


def _prediction_row(row: Mapping[str, Any], names: Sequence[str], fitted_mm: Mapping[tuple[str, str], float]) -> list[Cell]:
    outside = "" if row["inside"] else "outside the bounds"
    cells = [Cell(str(row["episode"])), Cell(str(row["scenario"])), Cell(str(row["model"]), note=outside)]
    cells += [number(row["rms_mm"], 1), number(fitted_mm.get((str(row["scenario"]), str(row["episode"]))), 1)]
    for name in names:
        true = row.get(f"true_{name}")
        cells.append(number(row.get(f"predicted_{name}"), 2, note="" if true is None else f"true {true:.2f}"))
    return cells


def _error_row(entry: TrainingEntry, name: str) -> list[Cell]:
    held_out = entry.summary["held_out"]
    row = held_out["parameters"][name]
    shares = (
        row["median_relative_error"],
        row["median_relative_error_of_mean"],
        row["coverage"][held_out["levels"].index(0.9)],
    )
    ranks = held_out.get("calibration")
    note = "" if ranks is None else f"ranks uniform: p = {ranks['uniform_ranks'][name]:.2g}"
    return [
        Cell(entry.scenario),
        Cell(entry.model),
        Cell(name),
        *map(part, shares[:2]),
        part(shares[2], note=note),
    ]
