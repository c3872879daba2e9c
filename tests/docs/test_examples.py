"""Every command and program that a page shows is run, in the page's order, in one folder; made small by more options.

`LEFT` lists what cannot be run here and is only parsed; what needs the published data runs where
DIFFCLOUD_RELEASE names it.
"""

from __future__ import annotations

import os
import re
import runpy
import shlex
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from typer.main import get_command

from studies import bench
from studies.__main__ import app as studies
from tests.cli.invoke import invoke, stage_command, study
from tests.docs.examples import PAGES, ROOT, Example, examples, mentions, read
from tests.docs.kitchen import PREPARED, STAND_INS, write
from tests.docs.site import reference

RELEASE = os.environ.get("DIFFCLOUD_RELEASE")
DATA = "PATH/pysim"
"""Stands for the folder of the published data."""

SMALLER = {
    "network generate": "--train 4 --test 5",
    "network train": "--epochs 1",
    "fit": "--starts 1 --max-steps 1 --parameters stretching",
    "fit my_clouds": "--max-steps 2 --starts 1",
    "fit examples": "--max-steps 2 --starts 1",
    "published": "--only release_lift/lift_tan --allow-missing --workers 1",
    "bench": "--repeats 1",
    "export fits/fit.json --to mujoco --samples": "--samples 2",
}
"""Command -> options that are added to it; the last of two counts."""

LEFT = {
    "pip install": "installs",
    "source .venv/bin/activate": "changes the shell",
    "diffcloud doctor --arm": "an arm",
    "diffcloud data capture --rig rig.yaml --trajectory path.csv": "a lab's own hardware",
    "diffcloud data capture --rig rig.yaml --check": "a lab's own hardware",
    "python -m diffcloud.hardware.examples": "runs until it is ended",
    "diffcloud data import overhead=a.db3": "recordings of two cameras, made by the SDK of their maker",
    "diffcloud view raw/episodes/lift/tan1 --live": "runs until it is ended",
    ".venv/bin/python -m pytest": "a test of its own",
}
"""Beginnings of commands that are not run -> what they need, or why."""

SLOW = ("python -m studies published",)
"""Beginnings of commands that run with the slow tests only, and are parsed in the others."""

WITH_EXAMPLES = [page for page in PAGES if examples(read(page))]


def parse(words: tuple[str, ...]) -> None:
    """Read a command line as the command itself does, to its last option; run nothing."""
    if words[0] == "python":
        alone = words[2].startswith("pipeline.")
        command = stage_command(words[2]) if alone else reference.members(get_command(studies))[words[3]]
        command.make_context(words[2], list(words[3 if alone else 4 :]))
        return
    path = reference.command_of(" ".join(words))
    assert path is not None, f"no such command: {shlex.join(words)}"
    rest = list(words[1 + len(path) :])
    command = reference.commands()[path]
    context = command.make_context(" ".join(path), rest)
    assert not getattr(context, "_protected_args", None), f"no such command: {shlex.join(words)}"


def is_stage(words: tuple[str, ...]) -> bool:
    return words[:2] == ("python", "-m") and words[2].startswith("pipeline.")


def run(example: Example, *, slow: bool) -> None:
    """Do what an example says in the current folder."""
    words = example.words
    if example.kind == "file":
        write(example, Path.cwd())
    elif example.kind == "python":
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*fewer than 100 points")  # the kitchen's clouds are small
            exec(compile(example.text, "example", "exec"), {})
    elif words[0] == "diffcloud" or words[:3] == ("python", "-m", "studies") or is_stage(words):
        parse(words)
        own = words[2:] if is_stage(words) else words[3:] if words[0] == "python" else words[1:]
        later = not slow and example.text.startswith(SLOW)
        absent = RELEASE is None and any(DATA in word or "release" in word for word in words)
        if not (later or absent or example.text.startswith(tuple(LEFT))):
            more = [option for name, option in SMALLER.items() if shlex.join(own).startswith(name)]
            called = study if words[0] == "python" and not is_stage(words) else invoke
            with not_yet_captured(words):
                called(*own, *shlex.split(" ".join(more)))
    elif words[0] == "python" and words[1] != "-m":
        runpy.run_path(words[1])
    elif words[0] == "make":
        targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        assert words[1] in targets, f"no such target: {example.text}"
    else:
        assert example.text.replace("'", "").startswith(tuple(LEFT)), f"neither run nor listed in LEFT: {example.text}"
        missing = [word for word in words if word.startswith("tests/") and not (ROOT / word).exists()]
        assert not missing


@contextmanager
def not_yet_captured(words: tuple[str, ...]) -> Iterator[None]:
    """What a capture would record lies there for the commands after it; a capture, also a dry one, takes a new folder."""
    if words[1:3] != ("data", "capture") or "--out" not in words:
        yield
        return
    out = Path(words[words.index("--out") + 1])
    aside = out.rename(out.with_name(f"{out.name}.later")) if out.exists() else None
    yield
    if aside is not None:
        aside.rename(out)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder to work in, with the published data if they are here."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bench, "_BATCHES", (1,))
    monkeypatch.setattr(bench, "_SIDES", (3,))
    monkeypatch.setattr(bench, "_CONTACT_SIDES", (4, 5))
    if RELEASE is not None:
        (tmp_path / "PATH").mkdir()
        (tmp_path / DATA).symlink_to(RELEASE)
        (tmp_path / "PATH" / "trajs").symlink_to(Path(RELEASE).parent / "trajs")
    return tmp_path


def follow(page: str, folder: Path, *, slow: bool) -> None:
    PREPARED.get(page, lambda _: None)(folder)
    text = read(page)
    for word, other in STAND_INS.get(page, {}).items():
        text = re.sub(rf"\b{word}\b", other, text)
    for example in examples(text):
        try:
            run(example, slow=slow)
        except (Exception, SystemExit) as error:
            raise AssertionError(f"{page}: {example.text}\n{error or type(error).__name__}") from error


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_EXAMPLES)
def test_what_a_page_shows_works(page, folder):
    follow(page, folder, slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in WITH_EXAMPLES if any(e.text.startswith(SLOW) for e in examples(read(p)))])
def test_what_a_page_shows_works_whole(page, folder):
    follow(page, folder, slow=True)


def test_nothing_is_left_out_in_vain():
    texts = [example.text.replace("'", "") for page in PAGES for example in examples(read(page))]
    for beginning in LEFT:
        assert any(text.startswith(beginning) for text in texts), beginning
    for beginning in SLOW:
        assert any(text.startswith(beginning) for text in texts), beginning


@pytest.mark.parametrize("page", PAGES)
def test_commands_and_options_that_the_prose_names_exist(page):
    stages = [stage_command(f"pipeline.{path.stem}") for path in (ROOT / "pipeline").glob("[a-z]*.py")]
    options = {
        option
        for command in [*reference.commands().values(), *reference.members(get_command(studies)).values(), *stages]
        for p in command.params
        for option in (*p.opts, *p.secondary_opts)
    }
    for code in mentions(read(page)):
        if code.startswith("--"):
            for word in code.split():
                assert not word.startswith("--") or word in {*options, "--help"}, f"{page}: no command has {word}"
        else:
            path = reference.command_of(code)
            assert path is not None, f"{page}: no such command: {code}"
            words = code.split()[1 + len(path) :]
            own = {option for p in reference.commands()[path].params for option in (*p.opts, *p.secondary_opts)}
            group = reference.members(reference.commands()[path])
            assert not (group and words and not words[0].startswith("-")), f"{page}: no such command: {code}"
            assert {word for word in words if word.startswith("--")} <= own, f"{page}: {code}"


@pytest.mark.parametrize(
    "line",
    ["diffcloud fit --scene lift --out fits --twice e.npz", "diffcloud data chek e.npz", "diffcloud fly --high"],
)
def test_what_does_not_exist_is_found(line, folder):
    (example,) = examples(f"```bash\n{line}\n```\n")
    with pytest.raises(Exception, match=r"(?i)no such (option|command)"):
        run(example, slow=False)


def test_a_value_that_does_not_convert_is_found(folder):
    (example,) = examples("Try `diffcloud fit --scene lift --out fits --starts few e.npz`.")
    with pytest.raises(Exception, match=r"(?i)integer"):
        run(example, slow=False)
