"""The picture of docs/physics.md, from a table of results: `make pictures`."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib as mpl

from diffcloud.reporting.figures import INK, new_canvas, svg_of

DOCS = Path(__file__).parents[1]
OLD, PAD = "#8c96a3", "#d55e00"
mpl.rcParams.update({"font.size": 9, "text.color": INK})


def table(page: Path, first: str) -> list[dict[str, str]]:
    """Rows of the first table of a Markdown page whose head begins with this cell."""
    lines = iter(page.read_text(encoding="utf-8").splitlines())
    head = next(_cells(line) for line in lines if line.startswith(f"| {first} "))
    next(lines)
    rows = []
    for line in lines:
        if not line.startswith("|"):
            break
        rows.append(dict(zip(head, _cells(line), strict=True)))
    return rows


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def main() -> None:
    """How far MuJoCo's towels are, with a pad and with a single node."""
    canvas, (axis,) = new_canvas(1, height=2.6, width=4.6)
    for row in table(DOCS / "results" / "towels.md", "model"):
        if row["nodes"] == "19 × 15":
            points = {float(key.removesuffix(" s")): float(row[key]) for key in row if re.fullmatch(r"[\d.]+ s", key)}
            color = PAD if row["model"].startswith("pad") else OLD
            axis.plot(list(points), list(points.values()), "o-", color=color, label=row["model"])
    axis.set_yscale("log")
    axis.set_yticks([0.3, 1, 3, 10, 30], ["0.3", "1", "3", "10", "30"])
    axis.set_xlabel("time [s]")
    axis.set_ylabel("distance from MuJoCo [mm]")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False)
    (DOCS / "images" / "grasp.svg").write_text(svg_of(canvas, "grasp"), encoding="utf-8")


if __name__ == "__main__":
    main()
