"""Every study tells what it does, before anything slow is imported."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from studies.__main__ import COMMANDS, app


@pytest.mark.parametrize("name", COMMANDS)
def test_each_study_shows_its_options(name):
    done = CliRunner().invoke(app, [name, "--help"])
    assert done.exit_code == 0, done.output
    assert "Usage" in done.output
    assert "--help" in done.output
