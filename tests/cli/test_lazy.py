"""Commands are read without the files that run them."""

from __future__ import annotations

import inspect
import json
import subprocess
import sys
from typing import get_args

import pytest
from typer.testing import CliRunner

from diffcloud.cli import lazy
from diffcloud.cli.app import COMMANDS, app
from diffcloud.regressors import MODEL_NAMES, PROFILE_NAMES
from diffcloud.scene.scenarios import SCENARIO_NAMES

ALONE = {name: place for name, place in COMMANDS.items() if not place.endswith(":app")}
HEAVY = {"torch", "numba", "open3d", "diffcloud.cli.config"}


@pytest.mark.parametrize("name", ALONE)
def test_a_command_is_read_with_the_options_of_its_function(name):
    module, _, function = ALONE[name].partition(":")
    read, real = lazy._signature(module, function), lazy._imported(module, function)
    assert read is not None
    assert read.__doc__ == real.__doc__
    (own, real_own) = (dict(inspect.signature(one, eval_str=True).parameters) for one in (read, real))
    assert list(own) == list(real_own)
    for option, parameter in own.items():
        assert parameter.default == real_own[option].default
        (kind, *notes), (real_kind, *real_notes) = (
            get_args(one.annotation) or (one.annotation,) for one in (parameter, real_own[option])
        )
        assert kind == real_kind
        assert [vars(note) for note in notes] == [vars(note) for note in real_notes]


def test_a_command_that_is_read_runs(tmp_path):
    """With what it was given: an option's name and its argument reach the function."""
    done = CliRunner().invoke(app, ["simulate", "--scenario", "towel.yaml", "--out", str(tmp_path / "set")])
    assert "towel.yaml" in str(done.exception)


def test_help_imports_no_large_library():
    code = (
        "import json, sys\n"
        "from typer.testing import CliRunner\n"
        "from diffcloud.cli.app import app\n"
        f"texts = [CliRunner().invoke(app, [name, '--help']).stdout for name in {list(ALONE)!r}]\n"
        "print(json.dumps([[len(text) for text in texts], list(sys.modules)]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    lengths, modules = json.loads(done.stdout)
    assert min(lengths) > 200
    assert not HEAVY & set(modules)


def test_help_lists_every_name():
    for command, names in {"fit": SCENARIO_NAMES, "train": (*MODEL_NAMES, *PROFILE_NAMES)}.items():
        text = CliRunner().invoke(app, [command, "--help"]).stdout
        assert all(name in text for name in names)
