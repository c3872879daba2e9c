"""`python -m studies simulators`: the same cloth in this simulator, in MuJoCo and in Newton."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import typer

from diffcloud import __version__
from diffcloud.cli.options import JsonFlag
from diffcloud.console import errors, finish, progress_bar, writes
from diffcloud.evaluation.markdown import Blocks, markdown_table, result_page
from diffcloud.io.files import write_text
from diffcloud.simulators.problem import installed
from studies.simulator_motions import (
    FINER,
    THIS,
    WHOLE_STIFFNESS,
    Answer,
    Derivative,
    Pair,
    gradients,
    known_answers,
    motions,
    opinions,
    switches,
)
from studies.towel_problems import TOWEL

_TIMES = {"lift": (0.5, 1.0, 1.5, 2.0, 2.4), "fold": (0.5, 1.0, 1.5, 2.0, 2.4), "swing": (0.25, 0.5, 0.75, 1.0, 1.5)}
"""Problem -> times [s] that tables show."""
_SEPARATING = (("lift", 1.0), ("lift", 1.5), ("lift", 2.4), ("swing", 0.25), ("swing", 0.5), ("swing", 1.0))
_STEPS = {"known answers": 10, "motions": 22, "third opinion": 16, "one thing at a time": 32, "gradients": 2}
"""Part of the study -> how many rows it has."""

Row = TypeVar("Row", Answer, Pair, Derivative)


@writes(".md")
def simulators(
    out: Annotated[Path, typer.Option(help="Markdown page.")] = Path("docs/results/other-simulators.md"),
    json: JsonFlag = False,
) -> None:
    """This simulator against MuJoCo, Newton and theory, with one cloth; writes a Markdown page. Takes ten minutes."""
    versions = {"diffcloud": __version__, **installed()}
    errors.print("Comparing " + ", ".join(f"{name} {version}" for name, version in versions.items()) + ".")
    answers = _shown("known answers", known_answers())
    pairs = _shown("motions", motions())
    third = _shown("third opinion", opinions())
    separate = _shown("one thing at a time", switches())
    slopes = _shown("gradients", gradients())
    write_text(out, _page(versions, answers, pairs, third, separate, slopes))
    errors.print(f"Wrote {out}.")
    plain = [row for row in separate if row.what == "nothing"]
    finish(
        {
            "out": str(out),
            "versions": versions,
            "mujoco_mm": {f"{row.problem}_{time:g}s": 1e3 * row.at(time) for row in plain for time in _TIMES[row.problem]},
            "theory": {f"{row.test}, {row.simulator}": _errors(row) for row in answers},
        },
        json,
    )


def _shown(part: str, rows: Iterable[Row]) -> list[Row]:
    found: list[Row] = []
    with progress_bar(part, _STEPS[part]) as update:
        for row in rows:
            found.append(row)
            update(len(found), part)
    errors.print(f"{part}: {len(found)} rows")
    return found


def _page(
    versions: dict[str, str],
    answers: Sequence[Answer],
    pairs: Sequence[Pair],
    third: Sequence[Pair],
    separate: Sequence[Pair],
    slopes: Sequence[Derivative],
) -> str:
    theory = 100 * max(abs(error) for row in answers if row.simulator == THIS for error in _errors(row).values())
    largest = {(row.problem, row.what, row.against): _millimetres(float(row.apart.max())) for row in pairs}
    compared = {
        "MuJoCo, 0.1 ms": ("MuJoCo, 0.1 ms", THIS),
        "Newton, VBD": ("Newton, VBD", THIS),
        "itself with 4 times the steps": (f"{THIS}, {FINER} times the steps", THIS),
        "MuJoCo with 0.2 ms to 0.1 ms": ("MuJoCo, 0.2 ms", "MuJoCo, 0.1 ms"),
    }
    rows = [[problem, *(largest.get((problem, *pair)) for pair in compared.values())] for problem in _TIMES]
    return result_page(
        "Does the simulator agree with theory and with other simulators?",
        f"A hanging strip and a cantilever are within {theory:.1f} % of theory. A lifted towel stays within "
        f"{largest[('lift', 'MuJoCo, 0.1 ms', THIS)]} mm of MuJoCo's.",
        markdown_table(["motion", *compared], rows),
        note="Largest RMS distance over nodes during a motion, in millimetres: of this simulator, and of MuJoCo to "
        "itself. The same cloth is simulated in MuJoCo (a flex, with elliptic friction cones) and in Newton (vertex "
        "block descent, VBD, and its differentiable explicit solver), with equal mesh, node masses, material, "
        "prescribed nodes and friction, and no air. Where motions are fast, any difference grows, such as that between "
        "two step sizes of MuJoCo.",
        made=f"{datetime.now(UTC).date()} with {', '.join(f'{name} {version}' for name, version in versions.items())}",
        command="python -m studies simulators",
        details={
            "Material": _material(),
            "Known answers": _known(answers),
            "Motions": _motions(pairs),
            "What separates them": _separated(pairs, third, separate),
            "Gradients": _gradients(slopes),
        },
    )


def _material() -> Blocks:
    rows = [
        [
            THIS,
            "E h, ν",
            "Green's strain, constant moduli",
            "angle θ, k_b = 5 B",
            "the stiffness, without the tension in it",
        ],
        ["MuJoCo", "E h, ν", "the same", "chord 2 sin(θ/2), h² = 15 B (1 - ν²)/(E h)", "strain's rate"],
        ["Newton, VBD", "μ h, λ h of plane stress", "stable neo-Hookean", "angle, edge_ke = K/l", "strain's rate, μ alone"],
        [
            "Newton, explicit",
            "μ h, (λ + μ) h",
            "stable neo-Hookean",
            "angle, edge_ke = K/(l (a0 + a1))",
            "rate of F, which stops rotation: none here",
        ],
    ]
    return [
        f"The towel is an isotropic sheet of 0.40 m × 0.30 m with 9 × 7 nodes: {TOWEL.density} kg/m², E h = "
        f"{TOWEL.stretching:g} N/m, ν = {TOWEL.poisson}, B = {TOWEL.bending:.0e} N·m, damping {1e3 * TOWEL.damping:g} ms. "
        "What each simulator is given so that this is its material (K, l, a0 and a1 of a hinge: "
        "[physics.md](../physics.md#bending)):",
        markdown_table(["simulator", "stretching", "membrane", "bending", "damping multiplies"], rows),
        "MuJoCo has one Young's modulus and one thickness for both stiffnesses. The thickness that gives a strip with free "
        "sides the stiffness B is not that of a solid sheet, since its hinges depend on the mesh as this simulator's do. "
        "Newton computes in single precision.",
    ]


def _known(answers: Sequence[Answer]) -> Blocks:
    rows = [
        [row.test, row.simulator, name, f"{row.theory[name]:.4g}", f"{value:.4g}", _percent(value / row.theory[name] - 1)]
        for row in answers
        for name, value in row.found.items()
    ]
    return [
        "A strip hangs and stretches under its weight by σ g s/(2 E h) over its lower part s, and contracts by ν times "
        "that. A clamped strip bends under its own: the heavy elastica with Γ = 5, 24 cells along it. All have come to "
        "rest.",
        markdown_table(["test", "simulator", "measure", "theory", "found", "error"], rows),
        "VBD makes ten sweeps a step, however stiff the cloth. Where these do not converge the cloth gives way to what a "
        "step adds of gravity: with long steps the cantilever hangs down, with short ones it bears itself.",
    ]


def _motions(pairs: Sequence[Pair]) -> Blocks:
    told = {
        "lift": "The towel is lifted off a table by a corner, by 0.45 m in 2.5 s, and from about 1.5 s on hangs and "
        "swings.",
        "fold": "The towel is folded over its diagonal on the table, the opposite corner held, and meets itself. Newton's "
        "explicit solver is left out: it has no contact between the cloth's faces.",
        "swing": "The towel is let go level, held by two corners, without a table: faster than any of the scenarios.",
    }
    blocks: list[str | list[str]] = ["RMS distance over nodes in millimetres."]
    for problem, sentence in told.items():
        own = [row for row in pairs if row.problem == problem]
        head = ["motion", "against", *(f"{time:g} s" for time in _TIMES[problem]), "largest", "s a second of motion"]
        rows = [
            [
                row.what,
                row.against,
                *(_millimetres(row.at(time)) for time in _TIMES[problem]),
                _millimetres(float(row.apart.max())),
                f"{row.seconds:.2f}",
            ]
            for row in own
        ]
        blocks += [f"**{problem.capitalize()}.** {sentence}", markdown_table(head, rows)]
    return blocks


def _separated(pairs: Sequence[Pair], third: Sequence[Pair], separate: Sequence[Pair]) -> Blocks:
    head = [f"{problem} {time:g} s" for problem, time in _SEPARATING]

    def cells(rows: Sequence[Pair]) -> list[str]:
        of = {row.problem: row for row in rows}
        return [_millimetres(of[problem].at(time)) if problem in of else "–" for problem, time in _SEPARATING]

    opinion = [
        [what, against, *cells([row for row in third if (row.what, row.against) == (what, against)])]
        for what, against in dict.fromkeys((row.what, row.against) for row in third)
    ]
    changes = [
        [what, *cells([row for row in separate if row.what == what])]
        for what in dict.fromkeys(row.what for row in separate)
    ]
    damped = ("swing", WHOLE_STIFFNESS, THIS)
    alone = next(_millimetres(row.at(0.5)) for row in third if (row.problem, row.what, row.against) == damped)
    itself = ", ".join(
        _millimetres(float(row.apart.max()))
        for row in pairs
        if (row.problem, row.against) == ("swing", "MuJoCo, 0.1 ms") and row.what.startswith("MuJoCo")
    )
    return [
        "This simulator against MuJoCo (0.2 ms), with one thing changed at a time; millimetres.",
        markdown_table(["changed", *head], changes),
        "A third implementation shows the effect of what cannot be changed from outside: explicit steps of 0.1 ms, their "
        "forces written anew in NumPy, with this simulator's table, and with the choices of the one or the other.",
        markdown_table(["third opinion", "against", *head], opinion),
        "With all choices of this simulator it gives this simulator's motions. Damping that multiplied the whole stiffness "
        "matrix, as ARCSim's does, would also resist a rotation of the stretched cloth as a whole, by the part of that "
        "matrix that is due to tension: a sheet of length L that swings from its upper edge would lose energy at a rate of "
        f"3 β g/(2 L), and half a second into the swing this towel would be {alone} mm from where it is. MuJoCo's hinges "
        "by their chord, and Newton's membrane in large strain, explain most of what is left. "
        f"Later in the swing any difference grows: MuJoCo comes to be {itself} mm from itself with half the step. At "
        "the end of the lift, 3 % of friction are worth as much as the simulator.",
    ]


def _gradients(slopes: Sequence[Derivative]) -> Blocks:
    rows: list[list[object]] = [
        [
            row.simulator,
            f"{1e3 * row.exact:.3f}",
            f"{1e3 * row.difference:.3f}",
            f"{row.forward:.2f}",
            f"{row.backward:.2f}",
        ]
        for row in slopes
    ]
    rows += [[name, "none", "–", "–", "–"] for name in ("MuJoCo", "Newton, VBD")]
    return [
        "Derivative of the towel's mean height by the logarithm of E h, half a second into the swing without damping, and "
        "central differences over 1 % to both sides; millimetres. Each agrees with its own differences; the two motions "
        "are those of two membranes.",
        markdown_table(["simulator", "derivative", "differences", "s forward", "s backward"], rows),
        "This simulator's gradients go through contact and friction ([gradients.md](gradients.md)).",
    ]


def _errors(row: Answer) -> dict[str, float]:
    return {name: value / row.theory[name] - 1 for name, value in row.found.items()}


def _percent(part: float) -> str:
    return f"{100 * part:+.1f} %"


def _millimetres(metres: float) -> str:
    return f"{1e3 * metres:.1f}" if np.isfinite(metres) else "–"
