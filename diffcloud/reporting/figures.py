"""Figures of the comparison as SVG and PNG: the paper's, remade from data, and those that it leaves out.

Colours are told apart by the colour-blind (after Okabe and Ito 2008, the blue lighter for dark pages). Text and axes are
drawn in one grey-blue of their own, which the page replaces by its text colour, so that a figure is readable on light and
dark.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from diffcloud.estimation.record import History
from diffcloud.evaluation.summary import Tables, label, percent
from diffcloud.reporting.overlay import states_at

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

    from diffcloud.reporting.page import EpisodeEntry

INK = "#5b6676"
"""Text and axes: readable on white and on black; the page puts its own colour in its place."""
_COLOURS = ("#2b8ccb", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999")
_CATEGORIES = ("highly deformable", "medium", "shape retaining")


@dataclass(frozen=True)
class Figure:
    """A picture with what a reader needs to believe it."""

    name: str
    title: str
    caption: str
    source: str
    """Table that it was drawn from."""
    svg: str
    png: bytes
    width: float
    """[inch]"""


def comparison_figures(
    told: Tables, records: Sequence[Mapping[str, Any]], histories: Mapping[tuple[str, str], History]
) -> list[Figure]:
    """All figures for which there is data.

    Args:
        told: of `evaluation.summary.tables`.
        records: of `evaluation.compare_episode`.
        histories: (scenario, episode) -> history of the fit.
    """
    makers = [_losses(told), _parameters(told), _success(told), _curves(histories)]
    makers += [_landscape(record) for record in records]
    return [figure for figure in makers if figure is not None]


def _losses(told: Tables) -> Figure | None:
    measured = told["methods"][told["methods"]["status"] == "ok"]
    if measured.empty:
        return None
    scenarios, methods = _ordered(measured, "scenario"), _ordered(measured, "method")
    canvas, axes = new_canvas(len(scenarios), height=0.9 + 0.32 * len(methods))
    for axis, scenario in zip(axes, scenarios, strict=True):
        group = measured[measured["scenario"] == scenario]
        categories = _categories(group)
        for shift, (category, colour) in zip(_spread(len(categories)), categories.items(), strict=True):
            part = group[group["category"].fillna("") == category]
            places = [methods.index(method) + shift for method in part["method"]]
            axis.scatter(part["rms_mm"], places, s=16, color=colour, alpha=0.8, linewidths=0, label=category or None)
        for place, method in enumerate(methods):
            mean = group.loc[group["method"] == method, "rms_mm"].mean()
            axis.plot([mean, mean], [place - 0.38, place + 0.38], color=INK, linewidth=1.6)
        axis.set_yticks(range(len(methods)), [label(name) for name in methods])
        axis.set_xlim(left=0)
        axis.set_xlabel("RMS distance [mm]")
        axis.set_title(scenario)
        axis.invert_yaxis()
        if any(categories):
            axis.legend(fontsize=7, frameon=False, labelcolor=INK)
    return _finished(
        canvas,
        "losses",
        "Distance per method and fabric category",
        "One dot per episode, a bar at the mean. The loss by the fit's measure at its frames, as a root mean square, fresh "
        "points, the same simulator for all.",
        "tables/methods.csv",
    )


def _parameters(told: Tables) -> Figure | None:
    fits = told["parameters"]
    if fits.empty or not {"stretching", "density"} <= set(fits.columns):
        return None
    scenarios = _ordered(fits, "scenario")
    canvas, axes = new_canvas(len(scenarios), height=3.2)
    for axis, scenario in zip(axes, scenarios, strict=True):
        group = fits[fits["scenario"] == scenario]
        for category, colour in _categories(group).items():
            part = group[group["category"].fillna("") == category]
            axis.scatter(
                part["stretching"], part["density"], s=22, color=colour, alpha=0.6, linewidths=0, label=category or None
            )
            if category:
                axis.scatter(
                    part["stretching"].median(), part["density"].median(), s=110, color=colour, marker="D", alpha=0.9
                )
        _log_axes(axis, "stretching", "density")
        axis.set_title(scenario)
        if group["category"].notna().any():
            axis.legend(fontsize=7, frameon=False, labelcolor=INK)
    return _finished(
        canvas,
        "parameters",
        "Fitted parameters per category",
        "Multipliers of the nominal material, one dot per episode, a diamond at the median of a category. Dots on the "
        "frame lie at a bound.",
        "tables/parameters.csv",
    )


def _success(told: Tables) -> Figure | None:
    means = told["means"]
    if "success_rate" not in means or not means["success_rate"].notna().any():
        return None
    known = means[means["success_rate"].notna()]
    scenarios, methods = _ordered(known, "scenario"), _ordered(known, "method")
    canvas, axes = new_canvas(len(scenarios), height=0.9 + 0.3 * len(methods))
    for axis, scenario in zip(axes, scenarios, strict=True):
        group = known[known["scenario"] == scenario].set_index("method")
        rates = [100 * float(group["success_rate"].get(method, np.nan)) for method in methods]
        axis.barh(
            range(len(methods)), rates, color=[_COLOURS[0] if name == "diffcloud" else _COLOURS[5] for name in methods]
        )
        for place, (method, rate) in enumerate(zip(methods, rates, strict=True)):
            text = "not measured" if np.isnan(rate) else f"{percent(rate / 100)} of {int(group['episodes'].get(method, 0))}"
            axis.text(0 if np.isnan(rate) else rate, place, f" {text}", va="center", fontsize=7, color=INK)
        axis.set_yticks(range(len(methods)), [label(name) for name in methods])
        axis.set_xlim(0, 125)
        axis.set_xticks([0, 50, 100])
        axis.set_xlabel("below the threshold [%]")
        axis.set_title(scenario)
        axis.invert_yaxis()
    return _finished(
        canvas,
        "success",
        "Success on simulated targets",
        "Episodes with known parameters whose loss is below 0.0005 squared release units (6.1e-5 m²). A loss below it is "
        "no identification: see the errors of the parameters.",
        "tables/means.csv",
    )


def _curves(histories: Mapping[tuple[str, str], History]) -> Figure | None:
    scenarios = list(dict.fromkeys(scenario for scenario, _ in histories))
    if not scenarios:
        return None
    canvas, axes = new_canvas(len(scenarios), height=2.8)
    for axis, scenario in zip(axes, scenarios, strict=True):
        for (owner, _), history in histories.items():
            if owner == scenario:
                lowest = [min((value for value in row if value is not None), default=np.nan) for row in history.loss]
                axis.plot(np.fmin.accumulate(lowest), color=_COLOURS[0], alpha=0.8, linewidth=1)
        axis.set_yscale("log")
        axis.set_xlabel("iteration")
        axis.set_ylabel("lowest loss so far")
        axis.set_title(scenario)
    return _finished(
        canvas,
        "curves",
        "Loss curves",
        "Lowest loss so far of each fit, all its starts together [squared length unit].",
        "tables/losses.csv",
    )


def overlay_figure(entries: Sequence[EpisodeEntry]) -> Figure | None:
    """Draw the recorded cloud with the cloth at the start of the fit and after it, at the `shown_frame` of each scenario's
    first episode, seen from the side: the horizontal axis along which the cloud is widest, and the vertical."""
    first = {entry.scenario: entry for entry in reversed(entries)}
    if not first:
        return None
    shown = [first[name] for name in dict.fromkeys(entry.scenario for entry in entries)]
    canvas, axes = new_canvas(2 * len(shown), height=2.9)
    for index, entry in enumerate(shown):
        frame = entry.shown_frame
        (state,) = states_at(entry.motion.times, entry.episode.times[[frame]])
        cloud = entry.episode.frame(frame).astype(float)
        flat = cloud[:, :2] - cloud[:, :2].mean(axis=0)
        wide = np.linalg.svd(flat, full_matrices=False)[2][0]
        for axis, nodes, name, colour in zip(
            axes[2 * index : 2 * index + 2],
            (entry.motion.start_nodes[state], entry.motion.nodes[state]),
            ("start of the fit", "fitted"),
            (_COLOURS[6], _COLOURS[0]),
            strict=True,
        ):
            axis.scatter(cloud[::4, :2] @ wide, cloud[::4, 2], s=2, color=_COLOURS[2], linewidths=0, rasterized=True)
            axis.triplot(nodes[:, :2] @ wide, nodes[:, 2], entry.motion.faces, color=colour, linewidth=0.9)
            axis.set_title(f"{entry.scenario} / {entry.name}, {name}")
            axis.set_aspect("equal", adjustable="datalim")
    return _finished(
        canvas,
        "overlays",
        "Target, start and fitted cloth",
        "Recorded points (green) with the mesh at the start of the fit (left) and after it (right), from the side, at the "
        "frame with the largest residual of the first episode of each scenario [length unit].",
        "data/fits and data/episodes",
    )


def _landscape(record: Mapping[str, Any]) -> Figure | None:
    told = record["landscape"]
    if told is None:
        return None
    canvas, (axis,) = new_canvas(1, height=4.0, width=5.4)
    loss = np.array(told["loss"], dtype=float)
    x, y = np.array(told["x"]), np.array(told["y"])
    picture = axis.contourf(x, y, np.log10(np.maximum(loss, 1e-30)), levels=18, cmap="viridis")
    bar = canvas.colorbar(picture, ax=axis)
    bar.set_label("log₁₀ loss", color=INK)
    bar.ax.tick_params(colors=INK, labelsize=8)
    for index, path in enumerate(told["paths"]):
        places = np.array(path)
        name = "optimiser, one line a start" if index == 0 else None
        axis.plot(places[:, 0], places[:, 1], color="white", linewidth=1, alpha=0.8, label=name)
        axis.plot(places[0, 0], places[0, 1], "o", color="white", markersize=3)
    axis.plot(*told["fitted"], "*", color=_COLOURS[1], markersize=13, markeredgecolor="white", label="fitted")
    truth = record["truth"]
    if truth.keys() >= set(told["names"]):
        axis.plot(*(truth[name] for name in told["names"]), "X", color="white", markersize=9, label="true")
    from_zero = [name for name, places in zip(told["names"], (x, y), strict=True) if places[0] == 0]
    if not from_zero:
        _draw_ellipse(axis, record)
    axis.set_xscale("linear" if told["names"][0] in from_zero else "log")
    axis.set_yscale("linear" if told["names"][1] in from_zero else "log")
    axis.set_xlim(x[0], x[-1])
    axis.set_ylim(y[0], y[-1])
    axis.set_xlabel(told["names"][0])
    axis.set_ylabel(told["names"][1])
    axis.set_title(f"{record['scenario']} / {record['episode']}")
    axis.legend(fontsize=7, facecolor="#444444", labelcolor="white", edgecolor="none")
    name = f"landscape_{record['scenario']}_{record['episode']}"
    return _finished(
        canvas,
        name,
        f"Loss landscape of {record['scenario']} / {record['episode']}",
        f"{len(x)} × {len(y)} simulations, common random points."
        + " The ellipse holds the parameters at the level of the intervals; where it is small it is within the star."
        * (not from_zero),
        "tables/comparison.json",
    )


def _draw_ellipse(axis: Axes, record: Mapping[str, Any]) -> None:
    told, names = record["intervals"], record["landscape"]["names"]
    if told is None or list(told["parameters"]) != names:
        return
    turn = np.linspace(0, 2 * np.pi, 200)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * np.sqrt(-2 * np.log(1 - told["level"]))
    spread, axes = np.linalg.eigh(np.array(told["covariance"]))
    centre = np.log(np.array(record["landscape"]["fitted"]))
    places = np.exp(np.clip(centre + circle * np.sqrt(np.maximum(spread, 0.0)) @ axes.T, -20, 20))
    axis.plot(places[:, 0], places[:, 1], color=_COLOURS[1], linewidth=1.5, label=f"{told['level']:.0%} region")


def new_canvas(count: int, *, height: float, width: float | None = None) -> tuple[Canvas, list[Axes]]:
    """A canvas of so many axes, two in a row, whose text and lines have the colour `INK`.

    Args:
        height: [inch] of a row.
        width: [inch] of the whole; by default 5.2 for each column.
    """
    from matplotlib.figure import Figure as Canvas  # takes half a second to import; no window, no pyplot

    columns = min(count, 2)
    rows = -(-count // columns)
    canvas = Canvas(figsize=(width or 5.2 * columns, height * rows), layout="constrained")
    axes = np.atleast_1d(canvas.subplots(rows, columns, squeeze=False)).ravel().tolist()
    for spare in axes[count:]:
        spare.set_axis_off()
    for axis in axes[:count]:
        axis.tick_params(which="both", colors=INK, labelsize=8)
        axis.set_facecolor("none")
        for part in (axis.title, axis.xaxis.label, axis.yaxis.label):
            part.set_color(INK)
            part.set_fontsize(9)
        for side, spine in axis.spines.items():
            spine.set_color(INK)
            spine.set_visible(side in ("left", "bottom"))
    return canvas, axes[:count]


def svg_of(canvas: Canvas, name: str) -> str:
    """A transparent SVG. Without a date and with the name as salt, the same data gives the same bytes; text stays text."""
    import matplotlib

    svg = io.StringIO()
    engine = canvas.get_layout_engine()
    if engine is not None:  # placed once: that takes longer than drawing, and each savefig would do both twice
        engine.execute(canvas)
        canvas.set_layout_engine(None)
    with matplotlib.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
        canvas.savefig(svg, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    return svg.getvalue()


def _finished(canvas: Canvas, name: str, title: str, caption: str, source: str) -> Figure:
    svg, png = svg_of(canvas, name), io.BytesIO()
    canvas.savefig(png, format="png", dpi=150, facecolor="white", metadata={"Software": None})
    return Figure(name, title, caption, source, svg, png.getvalue(), canvas.get_figwidth())


def _ordered(table: pd.DataFrame, column: str) -> list[str]:
    return [str(name) for name in dict.fromkeys(table[column])]


def _categories(table: pd.DataFrame) -> dict[str, str]:
    """Category -> colour, in the paper's order; the empty one where there is none."""
    names = _ordered(table.assign(category=table["category"].fillna("")), "category")
    known = [name for name in _CATEGORIES if name in names]
    order = [*known, *(name for name in names if name not in known)]
    return dict(zip(order, _COLOURS * (1 + len(order) // len(_COLOURS)), strict=False))


def _spread(count: int) -> list[float]:
    """Places side by side around zero."""
    return [0.22 * (index - (count - 1) / 2) for index in range(count)]


def _log_axes(axis: Axes, first: str, second: str) -> None:
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlim(0.09, 11)
    axis.set_ylim(0.09, 11)
    axis.set_xlabel(f"{first} [× nominal]")
    axis.set_ylabel(f"{second} [× nominal]")
