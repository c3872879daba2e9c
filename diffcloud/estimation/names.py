"""Names of the variables in a fit of several recordings.

Material and size belong to the cloth, so all recordings share them. `turn`, `shape` and `track` are separate for each
recording. In a joint fit, `turn@0` is the turn of the first recording; a fit of one recording has plain `turn`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

SHARED = ("size",)
"""Initial-state variables (`estimation.initial_state`) that all recordings share."""
_OWN = "@"
T = TypeVar("T")


def plain_name(name: str) -> str:
    """Return the name without its recording number."""
    return name.partition(_OWN)[0]


def of_recording(named: Mapping[str, T], recording: int) -> dict[str, T]:
    """Select the shared entries and those of one recording, under plain names.

    Args:
        recording: number of the recording, from 0.
    """
    here = {name: name.partition(_OWN)[2] in ("", str(recording)) for name in named}
    return {plain_name(name): value for name, value in named.items() if here[name]}


def without_recording(named: Mapping[str, T], recording: int) -> dict[str, T]:
    """Remove the entries of one recording. The numbers of later recordings decrease by one."""
    found = dict[str, T]()
    for name, value in named.items():
        plain, own, number = name.partition(_OWN)
        if not own:
            found[name] = value
        elif int(number) != recording:
            found[f"{plain}{_OWN}{int(number) - (int(number) > recording)}"] = value
    return found


def of_all(each: Sequence[Mapping[str, T]]) -> dict[str, T]:
    """Merge the entries of all recordings under the names of a joint fit; the inverse of `of_recording`."""
    found = dict[str, T]()
    for number, own in enumerate(each):
        for name, value in own.items():
            alone = len(each) == 1 or name in SHARED
            found[name if alone else f"{name}{_OWN}{number}"] = value
    return found
