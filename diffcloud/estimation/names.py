"""What variables are called in a fit of several recordings.

Material and size belong to the cloth, so all recordings share them. Turn, shape and track are each recording's own: in a
joint fit, `turn@0` is the turn in the first recording; in the fit of a single one, it is plain `turn`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

SHARED = ("size",)
"""Of how the cloth lies (`estimation.initial_state`), what is the same in all recordings."""
_OWN = "@"
T = TypeVar("T")


def plain_name(name: str) -> str:
    """Without the number of its recording."""
    return name.partition(_OWN)[0]


def of_recording(named: Mapping[str, T], recording: int) -> dict[str, T]:
    """What holds for one recording: what all share, and what is its own, under plain names.

    Args:
        recording: its number, from 0.
    """
    here = {name: name.partition(_OWN)[2] in ("", str(recording)) for name in named}
    return {plain_name(name): value for name, value in named.items() if here[name]}


def without_recording(named: Mapping[str, T], recording: int) -> dict[str, T]:
    """All but what is one recording's own; recordings after it are renumbered, each number lower by one."""
    found = dict[str, T]()
    for name, value in named.items():
        plain, own, number = name.partition(_OWN)
        if not own:
            found[name] = value
        elif int(number) != recording:
            found[f"{plain}{_OWN}{int(number) - (int(number) > recording)}"] = value
    return found


def of_all(each: Sequence[Mapping[str, T]]) -> dict[str, T]:
    """Puts together what is told of how the cloth lies in each recording, under the names of a joint fit; `of_recording`
    takes it apart again."""
    found = dict[str, T]()
    for number, own in enumerate(each):
        for name, value in own.items():
            alone = len(each) == 1 or name in SHARED
            found[name if alone else f"{name}{_OWN}{number}"] = value
    return found
