"""Commands are listed and explained without the libraries that run them."""

from __future__ import annotations

import json
import re
import subprocess
import sys

from typer.testing import CliRunner

from diffcloud.cli.app import COMMANDS, app
from diffcloud.cli.data import COMMANDS as DATA
from diffcloud.cli.network import COMMANDS as NETWORK
from diffcloud.regressors import MODEL_NAMES, PROFILE_NAMES
from diffcloud.scene.scenarios import SCENARIO_NAMES
from tests.cli.invoke import ROOT

LEAVES = [[name] for name in COMMANDS if name not in ("data", "network")]
LEAVES += [["data", name] for name in DATA] + [["network", name] for name in NETWORK]
STAGES = ("synthesize", "preprocess", "generate", "fit", "train", "evaluate", "report")
HEAVY = {"torch", "numba", "open3d", "pandas", "scipy"}


def test_help_imports_no_large_library():
    code = (
        "import importlib, json, sys\n"
        "from typer.testing import CliRunner\n"
        "from diffcloud.cli.app import app\n"
        f"texts = [CliRunner().invoke(app, [*words, '--help']).stdout for words in {LEAVES!r}]\n"
        f"[importlib.import_module('pipeline.' + stage) for stage in {STAGES!r}]\n"
        "print(json.dumps([[len(text) for text in texts], list(sys.modules)]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    lengths, modules = json.loads(done.stdout)
    assert min(lengths) > 200
    assert not HEAVY & set(modules)


def test_settings_are_read_without_the_simulator():
    code = (
        "import sys; from pathlib import Path; from diffcloud.jobs.settings import load_config\n"
        "load_config(Path('params.yaml')); print(*sorted({'torch', 'numba', 'open3d'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_a_group_shows_the_first_paragraph_of_each_command():
    text = " ".join(CliRunner().invoke(app, ["network", "--help"], terminal_width=200).stdout.split())
    assert "train Train networks." in text
    assert "Other hyper-parameters" not in text


def test_help_lists_every_name():
    for words, names in {("fit",): SCENARIO_NAMES, ("network", "train"): (*MODEL_NAMES, *PROFILE_NAMES)}.items():
        text = CliRunner().invoke(app, [*words, "--help"]).stdout
        assert all(re.search(rf"\b{name}\b", text) for name in names)  # vest_hang is not hang


def test_the_help_of_a_command_fits_one_screen(monkeypatch):
    """Of 50 lines, in a terminal of 120 columns."""
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 120)
    lines = {" ".join(words): CliRunner().invoke(app, [*words, "--help"]).stdout.count("\n") for words in LEAVES}
    assert {name: count for name, count in lines.items() if count > 50} == {}
