"""Build the report page. All data and scripts are inside it: no request leaves the page."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.io.episodes import Episode
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.report.comparison import ComparisonEntry, comparison_failures, comparison_section, comparison_summary
from diffcloud.report.recordings import recording_section
from diffcloud.report.regressors import TrainingEntry, regressor_section, training_data

_DECIMALS = 4


@dataclass(frozen=True)
class EpisodeEntry:
    """One fitted episode as the page shows it."""

    scenario: str
    name: str
    row: Mapping[str, Any]
    """Of `evaluation.summary.fit_table`."""
    fit: Mapping[str, Any]
    """Of `fit.result.read_fit`."""
    episode: Episode
    nodes: NDArray[np.float64]
    """[T + 1, V, 3] fitted motion at the scenario's frames."""
    start_nodes: NDArray[np.float64]
    faces: NDArray[np.int64]
    times: NDArray[np.float64]
    """[T + 1] [s]"""
    bodies: SurfaceMesh
    """Fixed bodies around the cloth; may be empty."""
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    """Caption -> PNG, of episodes made from raw recordings."""


def build_page(
    entries: Sequence[EpisodeEntry],
    *,
    title: str,
    overlay_points: int,
    environment: Mapping[str, str],
    predictions: Sequence[Mapping[str, Any]] = (),
    trainings: Sequence[TrainingEntry] = (),
    comparison: ComparisonEntry | None = None,
    seed: int = 0,
) -> str:
    """The page as HTML text.

    Args:
        overlay_points: points of the recorded cloud shown per frame.
        environment: name -> value lines for the last section.
        predictions: rows of the table of predictions.
        comparison: of all methods; left out if not given.
        seed: of the choice of shown points.
    """
    from plotly.offline import get_plotlyjs

    rng = np.random.default_rng(seed)
    data = [_entry_data(entry, overlay_points, rng) for entry in entries]
    names = _parameter_names(entries)
    lines = (f"<tr><td>{html.escape(key)}</td><td>{html.escape(value)}</td></tr>" for key, value in environment.items())
    parts = {
        "title": html.escape(title),
        "summary": _summary(entries) + (comparison_summary(comparison) if comparison else ""),
        "comparison": comparison_section(comparison) if comparison else "",
        "parameter_heads": "".join(f"<th>{html.escape(name)}</th>" for name in names),
        "rows": "".join(_table_row(index, entry, names) for index, entry in enumerate(entries)),
        "regressors": regressor_section(
            predictions, {(entry.scenario, entry.name): entry.row["rms_mm"] for entry in entries}, trainings
        ),
        "trainings": _script_json(training_data(trainings)),
        "failures": _failures(entries, comparison_failures(comparison) if comparison else []),
        "recordings": recording_section(entries),
        "environment": "".join(lines),
        "data": _script_json(data),
        "plotly": get_plotlyjs(),
    }
    template = files("diffcloud.report").joinpath("template.html").read_text(encoding="utf-8")
    # one pass, so that what is put in is never searched for further places
    return re.sub(r"\{\{(\w+)\}\}", lambda place: parts[place.group(1)], template)


def _entry_data(entry: EpisodeEntry, overlay_points: int, rng: np.random.Generator) -> dict[str, Any]:
    frames = []
    for index, time in enumerate(entry.episode.times):
        if time > entry.times[-1] + 1e-6:
            break
        cloud = entry.episode.frame(index)
        if len(cloud) > overlay_points:
            cloud = cloud[np.sort(rng.choice(len(cloud), overlay_points, replace=False))]
        state = int(np.abs(entry.times - time).argmin())
        frames.append(
            {
                "time": round(float(time), 3),
                "target": _axes(cloud),
                "fitted": _axes(entry.nodes[state]),
                "start": _axes(entry.start_nodes[state]),
            }
        )
    history = entry.fit["history"]
    best = np.minimum.accumulate([min(v for v in row if v is not None) for row in history["loss"]])
    count = entry.episode.frame_count
    return {
        "name": f"{entry.scenario} / {entry.name}",
        "frames": frames,
        "faces": entry.faces.T.tolist(),
        "bodies": {"nodes": _axes(entry.bodies.nodes), "faces": entry.bodies.faces.T.tolist()},
        "lossFrame": min(entry.fit["settings"]["frames"][0] % count, len(frames) - 1),
        "loss": [float(f"{value:.4g}") for value in best],
    }


def _axes(points: NDArray[Any]) -> list[list[float]]:
    """[N, 3] -> three lists, rounded to a tenth of a millimetre to keep the page small."""
    columns: list[list[float]] = np.round(points.T.astype(np.float64), _DECIMALS).tolist()
    return columns


def _parameter_names(entries: Sequence[EpisodeEntry]) -> list[str]:
    names: dict[str, None] = {}
    for entry in entries:
        names |= dict.fromkeys(entry.fit["parameters"])
    return list(names)


def _summary(entries: Sequence[EpisodeEntry]) -> str:
    start = np.array([entry.row["rms_start_mm"] for entry in entries])
    final = np.array([entry.row["rms_mm"] for entry in entries])
    text = (
        f"<p><b>{len(entries)} episodes</b> were fitted. The mean distance between the simulated cloth and the recorded "
        f"cloud at the loss frame fell from <b>{start.mean():.1f} mm</b> to <b>{final.mean():.1f} mm</b> (RMS, fresh "
        f"points).</p>"
    )
    errors = [
        abs(np.log(entry.row["fitted_ratio"] / entry.row["true_ratio"])) for entry in entries if "true_ratio" in entry.row
    ]
    if errors:
        text += (
            f"<p>The hidden stretch-to-mass ratio is known for {len(errors)} of them; the fits miss it by "
            f"<b>{100 * (np.exp(np.median(errors)) - 1):.0f} %</b> (median). A motion under gravity identifies this ratio: "
            "stretch and mass alone are tied together, and only bending, air and soft contacts tell them apart weakly. "
            "Weigh the cloth and use <code>--fix mass=…</code> to settle the scale.</p>"
        )
    return text


def _table_row(index: int, entry: EpisodeEntry, names: Sequence[str]) -> str:
    row, fit = entry.row, entry.fit
    cells = [
        f'<td><a href="#overlay" data-episode="{index}">{html.escape(entry.name)}</a></td>',
        f"<td>{html.escape(entry.scenario)}</td>",
        f"<td>{html.escape(str(entry.episode.meta.get('fabric', '')))}</td>",
        _number(row["rms_start_mm"], 1),
        _number(row["rms_mm"], 1, strong=True),
        _number(row["rms_other_frames_mm"], 1),
    ]
    for name in names:
        value = fit["parameters"].get(name)
        if value is None:
            cells.append("<td></td>")
            continue
        true = row.get(f"true_{name}")
        notes = [f"{value['physical']:.3g} {html.escape(value['physical_unit'])}"]
        notes += [f"true {true:.2f}"] if true is not None else []
        notes += ["at its bound"] if value.get("at_bound") else []
        notes += ["given"] if value.get("fixed") else []
        cells.append(f'<td data-value="{value["value"]}">{value["value"]:.2f}<small>{" · ".join(notes)}</small></td>')
    ratio, true_ratio = row.get("fitted_ratio"), row.get("true_ratio")
    note = f"<small>true {true_ratio:.2f}</small>" if true_ratio is not None else ""
    cells.append("<td></td>" if ratio is None else f'<td data-value="{ratio}">{ratio:.2f}{note}</td>')
    cells.append(_number(fit["iterations"], 0))
    cells.append(_number(fit["seconds"], 1))
    return f"<tr>{''.join(cells)}</tr>"


def _number(value: float, digits: int, *, strong: bool = False) -> str:
    text = "–" if value != value else f"{value:.{digits}f}"
    return f'<td data-value="{value}">{f"<b>{text}</b>" if strong else text}</td>'


def _failures(entries: Sequence[EpisodeEntry], missing: Sequence[str]) -> str:
    lines = [*missing, *(f"{entry.name}: {text}" for entry in entries for text in entry.fit["failures"])]
    if not lines:
        return "<p>No start of any fit diverged, and no method is missing.</p>"
    return "<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>"


def _script_json(value: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
