"""The pictures of docs/physics.md, from tables of the documentation: `make pictures`."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes

from diffcloud.reporting.figures import INK, new_canvas, svg_of

DOCS = Path(__file__).parents[1]
OLD, PAD, PIVOT = "#8c96a3", "#d55e00", "#2b8ccb"
TRUTH_N_M = 40.0
mpl.rcParams.update({"font.size": 9, "text.color": INK})


def main() -> None:
    grasp()
    mesh()


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


def grasp() -> None:
    """How far MuJoCo's towels are, with a pad and with a single node."""
    canvas, (axis,) = new_canvas(1, height=2.6, width=4.6)
    for row in table(DOCS / "results" / "towels.md", "model"):
        if row["nodes"] == "19 × 15":
            points = {float(key.removesuffix(" s")): float(row[key]) for key in row if re.fullmatch(r"[\d.]+ s", key)}
            color = PAD if row["model"].startswith("pad") else OLD
            axis.plot(list(points), list(points.values()), "o-", color=color, label=row["model"])
    axis.set_yscale("log")
    axis.set_yticks([0.3, 1, 3, 10, 30], ["0.3", "1", "3", "10", "30"])
    _finish(axis, "time [s]", "distance from MuJoCo [mm]")
    (DOCS / "images" / "grasp.svg").write_text(svg_of(canvas, "grasp"), encoding="utf-8")


def mesh() -> None:
    """The stiffness that coarse meshes find of a fine one's."""
    canvas, (axis,) = new_canvas(1, height=2.6, width=4.6)
    rows = table(DOCS / "physics.md", "nodes")
    counts = [row["nodes"].replace(" ", "") for row in rows]
    for column, color in (("pad of 20 mm", PAD), ("pivot of 20 mm", PIVOT)):
        axis.plot(counts, [float(row[column].split()[0]) for row in rows], "o-", color=color, label=column)
    axis.axhline(TRUTH_N_M, color=OLD, linestyle="--", label="truth, 49×37 nodes")
    axis.set_ylim(0, 50)
    _finish(axis, "nodes", "stiffness found [N/m]")
    (DOCS / "images" / "mesh.svg").write_text(svg_of(canvas, "mesh"), encoding="utf-8")


def _finish(axis: Axes, x: str, y: str) -> None:
    axis.set_xlabel(x)
    axis.set_ylabel(y)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False)


if __name__ == "__main__":
    main()
