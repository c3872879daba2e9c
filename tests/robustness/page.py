"""docs/results/robustness.md."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from typing import Any

from diffcloud.evaluation.markdown import Blocks, markdown_table, result_page
from tests.robustness.arm import STOP_WITHIN_S
from tests.robustness.faults import DISTURBANCES
from tests.robustness.isolated import MEGABYTES, SECONDS

_LONGEST = 260
_INPUTS = f"""\
Each field of a document, each column of a table and each array is, in turn, missing, of the wrong type, NaN, infinite,
negative, zero, huge, duplicated, or nested 100,000 levels deep. Bytes are flipped or cut off at random. Each file is
read in its own process, which may take {SECONDS:.0f} seconds and {MEGABYTES / 1000:.0f} GB. The command must either
succeed, or end with an error of this project that names file and field, and leave nothing behind.
`tests/robustness/expected.yaml` lists the damages that may be accepted; all others must be refused. Flipped bytes may
happen to give another valid file. `data check` must find a fault wherever `preprocess` refuses a raw recording."""
_FAULTS = """\
Every stage of the pipeline, `fit`, and `dvc repro` itself are disturbed at a random moment: by a kill, by Ctrl-C, by a
kill of one of their worker processes, by a full disk (no file may grow beyond a random size of a hundred bytes to ten
kilobytes), by a folder that cannot be written to, or by a second start of the same command. Afterwards, any output
under its final name must be complete. There must be no traceback and no hang. The command is then run again. It must
give the same contents as an undisturbed run, and leave nothing else behind."""
_ARM = f"""\
A capture runs with two cameras and a loopback arm that moves at 0.1 m/s and speaks the real arm's protocol. "Detected
within" is when the fault can be noticed at the latest: at the next reading of the arm (20 ms) or the next velocity (100
ms); when a call to the arm is given up (400 ms; 2 s if the arm's own process does not answer); when a camera has been
silent for its timeout (500 ms here), or its driver has not returned half a second after that; when the disk refuses or
its queue is full (up to 1.2 s); or when the capture has been silent for the watchdog's half second. As long as the
arm's process and its link work, Stop must reach the arm within {1000 * STOP_WITHIN_S:.0f} ms of that. Otherwise the
arm's own timeout for a silent link (500 ms) must stop it. What was recorded until then must be readable."""


def page(told: list[dict[str, Any]], sample: int | None) -> str:
    """Of the results of the suites, or of a sample of so many of each kind of file."""
    inputs, faults, arm = ([one for one in told if one["suite"] == suite] for suite in ("inputs", "faults", "arm"))
    named = {"damaged files": inputs, "disturbed commands": faults, "faults of a moving arm": arm}
    counts = [(what, len(of), sum(one["wrong"] is None for one in of)) for what, of in named.items() if of]
    details: dict[str, Blocks] = {}
    if inputs:
        messages = "One message for each kind of file, as it was printed:"
        details["Damaged files"] = [_INPUTS, _inputs(inputs), messages, _messages(inputs)]
    if faults:
        details["Disturbed commands"] = [_FAULTS, _faults(faults)]
    if arm:
        latest = max((one["late_ms"] for one in arm if one["late_ms"] is not None), default=0.0)
        details["Faults while an arm moves"] = [
            _ARM,
            _arm(arm),
            f"The latest Stop came {latest:.0f} ms after the detection.",
        ]
    note = (
        "`make robustness` makes a small project with the outputs of all stages. It damages its files one at a time, "
        "disturbs its commands and runs them again, and causes faults while an arm moves. A small fixed sample is part of "
        "the slow tests (`tests/robustness/`)."
    )
    if sample is not None:
        note += f" The counts are those of a random sample, at most {sample} of each file."
    return result_page(
        "Do damaged files, disturbed commands and faults of an arm end safely?",
        f"{', '.join(f'{right} of {count} {what}' for what, count, right in counts)} ended as required.",
        markdown_table(["what", "cases", "as required"], counts),
        note=note,
        command="make robustness",
        details=details,
    )


def _inputs(results: list[dict[str, Any]]) -> list[str]:
    groups = defaultdict(list)
    for one in results:
        groups[one["of"]].append(one)
    rows = [_counted(name, group) for name, group in groups.items()]
    rows.append(_counted("all", results))
    heads = [
        "file",
        "damages",
        "refused",
        "taken",
        "traceback",
        "hang or memory",
        "left over",
        "not as expected",
        "longest s",
    ]
    return markdown_table(heads, rows)


def _counted(name: str, group: list[dict[str, Any]]) -> list[str]:
    verdicts = Counter(one["verdict"] for one in group)
    unexpected = sum(one["wrong"] is not None and one["verdict"] in ("taken", "refused") for one in group)
    counts = [
        len(group), verdicts["refused"], verdicts["taken"], verdicts["traceback"], verdicts["hang"] + verdicts["memory"],
        verdicts["left over"], unexpected,
    ]  # fmt: skip
    return [name, *map(str, counts), f"{max(one['seconds'] for one in group):.1f}"]


def _faults(results: list[dict[str, Any]]) -> list[str]:
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for one in results:
        counts[one["of"]][one["what"]] += 1
        counts[one["of"]]["wrong"] += one["wrong"] is not None
    rows = [[name, *(str(found[key]) for key in (*DISTURBANCES, "wrong"))] for name, found in counts.items()]
    rows.append(["all", *(str(sum(found[key] for found in counts.values())) for key in (*DISTURBANCES, "wrong"))])
    return markdown_table(["command", *DISTURBANCES, "not survived"], rows)


def _arm(results: list[dict[str, Any]]) -> list[str]:
    rows = []
    for one in results:
        late = "" if one["late_ms"] is None else f"{one['late_ms']:.1f}"
        kept = "yes" if one["wrong"] is None else one["wrong"]
        within, counts = f"{1000 * one['detected_s']:.0f}", (str(one["frames"]), str(one["rows"]))
        rows.append([one["where"], one["what"], within, late, *counts, kept, _plain(one["told"])])
    heads = ["fault", "stopped by", "detected within ms", "Stop after that, ms", "frames", "rows", "as required", "message"]
    return markdown_table(heads, rows)


def _messages(results: list[dict[str, Any]]) -> list[str]:
    rows = []
    for name in dict.fromkeys(one["of"] for one in results):
        refused = [one for one in results if one["of"] == name and one["verdict"] == "refused" and one["where"] != "bytes"]
        refused = refused or [one for one in results if one["of"] == name and one["verdict"] == "refused"]
        if refused:
            one = refused[len(refused) // 3]
            rows.append([name, f"{one['where']}: {one['what']}", _plain(one["told"].split("Error: ")[-1])])
    return markdown_table(["file", "damage", "message"], rows)


def _plain(text: str) -> str:
    """Without what differs from one computer to the next, and what would end a cell or be an element of HTML."""
    text = re.sub(r"(/\S*)?/(project|tmp)/", "", text)
    for plain, escaped in (("&", "&amp;"), ("<", "&lt;"), ("|", "\\|")):
        text = text.replace(plain, escaped)
    return text if len(text) <= _LONGEST else text[:_LONGEST] + " …"
