"""Damaged files, disturbed commands, and faults of a moving arm: `python -m tests.robustness --out PAGE.md`."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any

from tests.robustness.arm import all_of_arm
from tests.robustness.faults import COMMANDS, all_of_command
from tests.robustness.inputs import all_of
from tests.robustness.kinds import KINDS, make_project, warm_up
from tests.robustness.page import page


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=("inputs", "faults", "arm"), action="append", help="default: all three")
    parser.add_argument("--kind", action="append", choices=[kind.name for kind in KINDS], help="of file; default: all")
    parser.add_argument("--command", action="append", choices=list(COMMANDS), help="that is disturbed; default: all")
    parser.add_argument("--sample", type=int, help="so many of each file and each command, drawn at random; default: all")
    parser.add_argument("--sample-faults", type=int, help="so many of each command; default: as --sample")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--log", type=Path, help="JSON lines, added to what is there; --out tells of all")
    parser.add_argument("--out", type=Path, help="page with the counts")
    asked = parser.parse_args(arguments)
    suites = asked.only or ["inputs", "faults", "arm"]
    told: list[dict[str, Any]] = []
    if {"inputs", "faults"} & set(suites):
        with tempfile.TemporaryDirectory() as folder:
            project = Path(folder) / "project"
            project.mkdir()
            make_project(project)
            jobs: list[Callable[[], list[dict[str, Any]]]] = []
            if "inputs" in suites:
                jobs += [
                    partial(all_of, name, project, asked.sample) for name in asked.kind or [kind.name for kind in KINDS]
                ]
            if "faults" in suites:
                count = asked.sample_faults or asked.sample
                jobs += [partial(all_of_command, name, project, count) for name in asked.command or COMMANDS]
            context = multiprocessing.get_context("spawn")
            with ProcessPoolExecutor(asked.workers, mp_context=context, initializer=warm_up) as pool:
                for done in as_completed([pool.submit(job) for job in jobs]):
                    told += done.result()
                    _report(done.result(), asked.log)
    if "arm" in suites:  # alone: it measures times
        found = list(all_of_arm(asked.sample_faults or asked.sample))
        told += found
        _report(found, asked.log)
    if asked.out is not None and asked.log is not None:
        told = _latest(asked.log)
    if asked.out is not None:
        asked.out.write_text(page(told, asked.sample), encoding="utf-8")
    return int(any(one["wrong"] for one in told))


def _latest(log: Path) -> list[dict[str, Any]]:
    """Of each kind of file and each command, what its last run told."""
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    last = {(one["suite"], one["of"]): one["run"] for one in lines}
    return [one for one in lines if one["run"] == last[one["suite"], one["of"]]]


def _report(results: list[dict[str, Any]], log: Path | None) -> None:
    verdicts = Counter(one["verdict"] for one in results)
    counts = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items())
    print(f"{results[0]['of']}: {counts}", flush=True)
    for one in results:
        if one["wrong"]:
            print(f"  {one['where']}, {one['what']}: {one['wrong']}: {one['told'][-200:]}", flush=True)
    if log is not None:
        run = time.time()
        with log.open("a", encoding="utf-8") as stream:
            stream.writelines(json.dumps({**one, "run": run}) + "\n" for one in results)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
