"""What is told while a command works."""

from __future__ import annotations

import itertools

from pipeline import console


def test_where_there_is_no_terminal_a_line_comes_every_ten_seconds(monkeypatch, capsys):
    """Each call adds a third of a job and comes four seconds after the last, so the third and the sixth print a line."""
    clock = itertools.count(step=4.0)
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock))
    with console.progress_bar("fit", 10) as update:
        for call in range(1, 7):
            update(call / 3, f"loss {1 / call:.2f}")
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["fit: 1 of 10, about 108 s left  loss 0.33", "fit: 2 of 10, about 96 s left  loss 0.17"]
