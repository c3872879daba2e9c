"""What the page says of regressors: their predictions beside the fits, how they learned, and how sure they may be."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diffcloud.errors import ConfigError
from diffcloud.io.files import read_json


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
            raise ConfigError(f"{path} is no training written by `diffcloud train`: it lacks `history` or `held_out`.")
        return TrainingEntry(path.parents[1].name, path.parent.name, summary)


def regressor_section(
    predictions: Sequence[Mapping[str, Any]], fitted_mm: Mapping[tuple[str, str], float], trainings: Sequence[TrainingEntry]
) -> str:
    """The section as HTML; empty without regressors.

    Args:
        predictions: rows of `tables/predictions.csv`.
        fitted_mm: (scenario, episode) -> RMS distance after the fit [mm].
    """
    if not predictions and not trainings:
        return ""
    columns = dict.fromkeys(key for row in predictions for key in row if key.startswith("predicted_"))
    names = [key.removeprefix("predicted_") for key in columns]
    heads = "".join(f"<th>{html.escape(name)}</th>" for name in names)
    rows = "".join(_prediction_row(row, names, fitted_mm) for row in predictions)
    errors = "".join(_error_row(entry, name) for entry in trainings for name in entry.summary["held_out"]["parameters"])
    return (
        '<section id="regressors"><h2>Predictions of the regressors</h2>'
        '<p class="caption">A network tells the parameters from the clouds in milliseconds; the simulation with them, '
        "clipped to the bounds, is measured as the fits are. Values outside the bounds are marked.</p>"
        '<div class="scroll"><table class="sorts"><thead><tr><th>episode</th><th>scenario</th><th>model</th>'
        f"<th>predicted mm</th><th>fitted mm</th>{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
        '<p class="caption">Source: <code>data/regressors</code>, measured by <code>diffcloud evaluate</code>; the same '
        "numbers are in <code>reports/tables/predictions.csv</code>.</p>"
        '<h2>Training</h2><div id="learning"></div><div id="calibration"></div>'
        '<p class="caption">Above: loss on the validation draws after each epoch. Below: how often an interval holds the '
        "truth on held-out draws, against how often it should; on the diagonal the stated uncertainty is right.</p>"
        '<div class="scroll"><table class="sorts"><thead><tr><th>scenario</th><th>model</th><th>parameter</th>'
        "<th>median relative error</th><th>of predicting the mean</th><th>90 % interval holds</th></tr></thead>"
        f"<tbody>{errors}</tbody></table></div></section>"
    )


def training_data(trainings: Sequence[TrainingEntry]) -> list[dict[str, Any]]:
    """What the page's script draws."""
    return [
        {
            "name": f"{entry.scenario} / {entry.model}",
            "loss": [float(f"{row['validation_loss']:.4g}") for row in entry.summary["history"]],
            "levels": entry.summary["held_out"]["levels"],
            "coverage": {
                name: [round(value, 4) for value in row["coverage"]]
                for name, row in entry.summary["held_out"]["parameters"].items()
            },
        }
        for entry in trainings
    ]


def _prediction_row(row: Mapping[str, Any], names: Sequence[str], fitted_mm: Mapping[tuple[str, str], float]) -> str:
    cells = [f"<td>{html.escape(str(row[key]))}</td>" for key in ("episode", "scenario", "model")]
    fitted = fitted_mm.get((str(row["scenario"]), str(row["episode"])))
    cells += [_cell(row["rms_mm"], f"{row['rms_mm']:.1f}"), _cell(fitted, "–" if fitted is None else f"{fitted:.1f}")]
    for name in names:
        value, true = row.get(f"predicted_{name}"), row.get(f"true_{name}")
        note = "" if true is None else f"<small>true {true:.2f}</small>"
        cells.append(_cell(value, "–" if value is None else f"{value:.2f}{note}"))
    if not row["inside"]:
        cells[2] = f"<td>{html.escape(str(row['model']))}<small>outside the bounds</small></td>"
    return f"<tr>{''.join(cells)}</tr>"


def _error_row(entry: TrainingEntry, name: str) -> str:
    held_out = entry.summary["held_out"]
    row = held_out["parameters"][name]
    cells = [f"<td>{html.escape(text)}</td>" for text in (entry.scenario, entry.model, name)]
    shares = (
        row["median_relative_error"],
        row["median_relative_error_of_mean"],
        row["coverage"][held_out["levels"].index(0.9)],
    )
    cells += [_cell(share, f"{100 * share:.0f} %") for share in shares]
    return f"<tr>{''.join(cells)}</tr>"


def _cell(value: float | None, text: str) -> str:
    return f'<td data-value="{value}">{text}</td>'
