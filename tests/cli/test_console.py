"""What is told while a command works."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from diffcloud import console
from diffcloud.cli.app import app
from diffcloud.console import refuse_many
from diffcloud.errors import ConfigError
from diffcloud.io.episodes import Episode, write_episode


def test_where_there_is_no_terminal_a_line_comes_every_ten_seconds(monkeypatch, capsys):
    """Each call adds a third of a job and comes four seconds after the last, so the third and the sixth print a line."""
    clock = itertools.count(step=4.0)
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock))
    with console.progress_bar("fit", 10) as update:
        for call in range(1, 7):
            update(call / 3, f"loss {1 / call:.2f}")
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["fit: 1 of 10, 12 s, about 108 s left  loss 0.33", "fit: 2 of 10, 24 s, about 96 s left  loss 0.17"]


def test_of_work_whose_amount_is_not_known_no_remaining_time_is_told(monkeypatch, capsys):
    clock = itertools.count(step=12.0)
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock))
    with console.progress_bar("identify", None) as update:
        update(0.0, "best 2.10 mm")
        update(0.99, "best 2.05 mm")
    assert capsys.readouterr().err.splitlines() == ["identify: 12 s  best 2.10 mm", "identify: 24 s  best 2.05 mm"]


@pytest.mark.parametrize(("text", "seconds"), [("90", 90), ("60s", 60), ("3min", 180), ("1h", 3600), ("0.5 h", 1800)])
def test_a_time_has_its_unit(text, seconds):
    assert console.duration_s(text, "--budget") == seconds


@pytest.mark.parametrize("text", ["", "0", "0min", "-1", "soon", "3 days", "1e9h", "nan", "inf", "1001h", "5m3"])
def test_what_is_no_time_is_refused(text):
    with pytest.raises(ConfigError, match=r"--budget takes a time above 0 .*Try --budget 10min"):
        console.duration_s(text, "--budget")


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("a.csv", r"a\.csv ends in \.csv\. Try a\.html"),
        (".", r"\. is a folder\. Try here\.html"),
        ("sub", r"Try sub/sub\.html"),
    ],
)
def test_a_file_of_another_kind_is_refused_with_what_to_try(tmp_path, monkeypatch, path, message):
    (tmp_path / "here" / "sub").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(ConfigError, match=message):
        console.with_suffix(Path(path), ".html")


def test_more_episodes_than_a_command_takes_are_refused():
    refuse_many(range(50), 50, "A page shows", "Give fewer")
    with pytest.raises(ConfigError, match=r"^51 episodes are given\. A page shows 50 at most\. Give fewer\.$"):
        refuse_many(range(51), 50, "A page shows", "Give fewer")


def test_a_thousand_episodes_are_refused_at_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "many").mkdir()
    one = Episode.from_frames([np.zeros((3, 3))] * 2, np.array([0.0, 0.1]))
    for index in range(1000):
        write_episode(tmp_path / "many" / f"{index:04d}.npz", one)
    found = CliRunner().invoke(app, ["view", "many"])
    assert "1000 episodes are given. A page " in str(found.exception)
    assert not (tmp_path / "view.html").exists()
