"""The page's section on raw recordings: how clouds were made of them, in figures and pictures."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from diffcloud.io.episodes import Episode


class RecordedEntry(Protocol):
    """What the section needs of an episode."""

    @property
    def scenario(self) -> str: ...
    @property
    def name(self) -> str: ...
    @property
    def episode(self) -> Episode: ...
    @property
    def pictures(self) -> Mapping[str, bytes]: ...


def recording_section(entries: Sequence[RecordedEntry]) -> str:
    """HTML; empty where no episode comes from a raw recording."""
    recorded = [entry for entry in entries if "points_per_view" in entry.episode.meta.get("quality", {})]
    if not recorded:
        return ""
    heads = "".join(
        f"<th>{text}</th>"
        for text in (
            "Episode",
            "Points per view",
            "Masked",
            "Overlap mm",
            "Cameras moved mm",
            "Arm thicker mm",
            "Log late ms",
        )
    )
    rows = "".join(_row(entry) for entry in recorded)
    pictures = "".join(
        f"<figure><figcaption>{html.escape(entry.name)}: {html.escape(caption)}</figcaption>"
        f'<img alt="{html.escape(entry.name)}: {html.escape(caption)}" loading="lazy" '
        f'src="data:image/png;base64,{base64.b64encode(data).decode()}"></figure>'
        for entry in recorded
        for caption, data in entry.pictures.items()
    )
    return (
        '<section id="recordings"><h2>Raw recordings</h2><p>From depth images to clouds: least, median and greatest number '
        "of points of each camera over the frames, the part of its measurements that was masked (robot, its shadow, flying "
        "pixels), the median distance between the views where they overlap, and what the refinement found.</p>"
        f'<div class="scroll"><table><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>'
        f'<div class="pictures">{pictures}</div></section>'
    )


def _row(entry: RecordedEntry) -> str:
    quality = entry.episode.meta["quality"]
    refined = quality.get("refinement", {})
    overlap = [value for value in quality["overlap_m"] if value is not None]
    cells = [
        entry.name,
        "; ".join(f"{name} {_range(values)}" for name, values in quality["points_per_view"].items()),
        "; ".join(f"{name} {_mean(values, 100):.0f} %" for name, values in quality["masked_fraction"].items()),
        f"{_mean(overlap, 1e3):.1f}" if overlap else "–",
        "; ".join(f"{name} {1e3 * shift:.1f}" for name, shift in list(refined.get("shift_m", {}).items())[1:]) or "–",
        f"{1e3 * refined['skin_m']:.1f}" if refined else "–",
        f"{1e3 * refined['lag_s']:.0f}" if refined else "–",
    ]
    return "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>"


def _range(values: Sequence[int]) -> str:
    return f"{min(values)} / {int(np.median(values))} / {max(values)}"


def _mean(values: Sequence[Any], factor: float) -> float:
    known = [value for value in values if value is not None]
    return factor * float(np.mean(known)) if known else float("nan")
