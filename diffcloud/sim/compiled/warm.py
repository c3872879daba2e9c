"""Compiling ahead."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from diffcloud.compiled import announcement, mark_built

Work = Sequence[tuple[str, Callable[[], object]]]
"""Names, and functions that call each kernel once with arguments of the types that it is used with."""


def compile_all(progress: Callable[[int, str], None], work: Work) -> None:
    """Compile everything that is not in the cache folder, and remember that it is complete.

    Args:
        progress: called before each piece of work with how many are done and its name, and at the end.
        work: what compiles.
    """
    announcement.silent = True  # whoever asks for it need not be told
    for done, (name, function) in enumerate(work):
        progress(done, name)
        function()
    progress(len(work), "")
    mark_built()
