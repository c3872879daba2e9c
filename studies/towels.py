"""`python -m studies towels`: towels that MuJoCo lifts by a pad, beside the same towels here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from diffcloud.cli.options import JsonFlag
from diffcloud.console import errors, finish, progress_bar, writes
from diffcloud.evaluation.markdown import markdown_table, result_page
from diffcloud.io.files import write_text
from diffcloud.simulators.problem import installed
from studies.mujoco_towels import COUNTS, OLD, PAD, Apart, compare

_TIMES = (0.5, 0.8, 1.0, 1.2, 1.5)
_MESHES = ((13, 10), (19, 15))
_BAR_MM = 6.0


@writes(".md")
def towels(
    count: Annotated[int, typer.Option(min=1, max=1000, help="How many towels.")] = 10,
    seed: Annotated[int, typer.Option(min=0, max=2**31, help="Of the first towel; the others follow.")] = 1,
    out: Annotated[Path, typer.Option(help="Markdown page.")] = Path("docs/results/towels.md"),
    json: JsonFlag = False,
) -> None:
    """Towels that MuJoCo lifts by a pad, simulated at their true parameters; writes a Markdown page. Half a minute each."""
    installed()
    rows: list[Apart] = []
    with progress_bar("towels", count) as update:
        for number in range(count):
            rows += compare(seed + number, _MESHES)
            update(number + 1, f"seed {seed + number}")
    write_text(out, _page(rows, seed, count))
    errors.print(f"Wrote {out}.")
    medians = {
        f"{model}, {nodes[0]} x {nodes[1]}": {f"{time:g}s": _median(rows, model, nodes, time) for time in _TIMES}
        for model in (OLD, PAD)
        for nodes in _MESHES
    }
    finish({"out": str(out), "median_mm": medians}, json)


def _page(rows: list[Apart], seed: int, count: int) -> str:
    head = ["model", "nodes", *(f"{time:g} s" for time in _TIMES), f"within {_BAR_MM:g} mm at 1 s", "CPU s"]
    summary = []
    for model in (OLD, PAD):
        for nodes in _MESHES:
            own = [row for row in rows if (row.model, row.nodes) == (model, nodes)]
            within = sum(_at(row, 1.0) <= _BAR_MM for row in own)
            medians = [f"{_median(rows, model, nodes, time):.1f}" for time in _TIMES]
            seconds = f"{np.median([row.seconds for row in own]):.1f}"
            summary.append([model, f"{nodes[0]} × {nodes[1]}", *medians, f"{within} of {len(own)}", seconds])
    each = [
        [
            row.towel.seed,
            f"{row.towel.sheet.stretching:.0f}",
            f"{1e6 * row.towel.sheet.bending:.1f}",
            f"{row.towel.friction:.2f}",
            *(f"{_at(row, time):.1f}" for time in _TIMES),
        ]
        for row in rows
        if (row.model, row.nodes) == (PAD, _MESHES[-1])
    ]
    finest = _MESHES[-1]
    old, pad = (f"{_median(rows, model, finest, 1.0):.1f}" for model in (OLD, PAD))
    return result_page(
        "How far are lifted towels from MuJoCo's at the true parameters?",
        f"With a pad, the nodes of {count} towels are {pad} mm from MuJoCo's after 1 s (median over towels of the RMS over "
        f"nodes). With a single held node they are {old} mm away.",
        markdown_table(head, summary),
        note=f"MuJoCo lifts random towels of {COUNTS[0]} × {COUNTS[1]} nodes off a table, held by a pad of 10 to 20 mm: "
        "four nodes that keep their direction. The table has medians in millimetres, without a fit. A single node is a "
        "pivot, under which the cloth can turn, and its compliance depends on the mesh. After about 1.2 s the lifted "
        "cloth buckles, and the two meshes buckle into different folds.",
        command=f"python -m studies towels --count {count} --seed {seed}",
        details={
            "Each towel": [
                f"{PAD.capitalize()}, {finest[0]} × {finest[1]} nodes.",
                markdown_table(
                    ["seed", "stretching N/m", "bending µN·m", "friction", *(f"{time:g} s" for time in _TIMES)], each
                ),
            ]
        },
    )


def _at(row: Apart, time: float) -> float:
    """[mm]"""
    return 1e3 * float(row.rms[round(10 * time)])


def _median(rows: list[Apart], model: str, nodes: tuple[int, int], time: float) -> float:
    """[mm]"""
    return float(np.median([_at(row, time) for row in rows if (row.model, row.nodes) == (model, nodes)]))
