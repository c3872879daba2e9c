"""Read and write files safely: atomic writes of groups of files, locks, and readers that never execute file contents.

Each output is first written to a temporary file beside it. All files of a group are renamed when all are complete.
After a crash, a full disk or Ctrl-C, the old files remain or no file exists, never a partial one. The next write of the
same file removes temporary files that a killed process left behind. Locks use `flock`, so the system releases them when
a process ends.
"""

from __future__ import annotations

import errno
import fcntl
import json
import math
import os
import re
import shlex
import shutil
import socket
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import yaml

from diffcloud.errors import DiffCloudError, OutputError
from diffcloud.io.inputs import read_text
from diffcloud.io.numbers import CORE, WHOLE, number, whole

_MOST_VALUES = 100_000
"""Largest number of values in a YAML file after its anchors are expanded."""
_MOST_JSON, _MOST_YAML = 50_000_000, 1_000_000
"""Largest size of a JSON and of a YAML file [bytes]. The YAML limit is lower because the YAML reader is slow."""
_COMMENT = re.compile(r'"(?:[^"\\]|\\.)*+"|//[^\n]*|#[^\n]*|/\*.*?\*/', re.DOTALL)
"""Matches a comment or a string of JSON. Strings are matched so that comment signs in them are skipped."""
_SHARED_TIME = 1_600_000_000
"""Modification time [s since 1970] of files that several processes write with the same text."""
TEMPORARY, LOCK = ".diffcloud-tmp", ".diffcloud-lock"
"""Suffixes of a temporary file, and of the lock file beside an output."""
_NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.EINVAL}
"""Error numbers of file systems without locks. On these, outputs are not locked."""


class _Outputs:
    """A group of output files that are renamed together."""

    def __init__(self) -> None:
        self._pending: dict[Path, tuple[Path, int]] = {}
        """Output -> its temporary file and the inode of this file."""
        self._folders: list[Path] = []
        """Folders created for the outputs, outermost first."""

    @contextmanager
    def open(self, path: Path) -> Iterator[BinaryIO]:
        """Open the temporary file of `path` for writing."""
        self._folders += _make_folders(path.parent)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        temporary = path.with_name(f".{path.name}{TEMPORARY}")
        with _opened_alone(path, temporary) as stream:
            self._pending.pop(path, None)
            self._pending[path] = temporary, os.fstat(stream.fileno()).st_ino
            yield stream

    def publish(self) -> None:
        """Rename all temporary files to their final names."""
        for path, (temporary, inode) in self._pending.items():
            if _inode(temporary) != inode:
                raise OutputError(f"Another process wrote {path} at the same time; run the command again.")
        if len(self._pending) > 1:
            next(reversed(self._pending)).unlink(missing_ok=True)
        for path, (temporary, _) in self._pending.items():
            os.replace(temporary, path)
        self._pending.clear()

    def discard(self) -> None:
        """Remove temporary files that were not renamed, and empty folders that were created for them."""
        for temporary, inode in self._pending.values():
            with suppress(OSError):
                if _inode(temporary) == inode:
                    temporary.unlink()
        self._pending.clear()
        _remove_empty(self._folders)


_group: ContextVar[_Outputs | None] = ContextVar("_group", default=None)
"""Outputs of the current `together` block, if any."""


@contextmanager
def together() -> Iterator[None]:
    """Publish all files written in this block together, or none of them if the block raises an error.

    Write the record last: if it exists, all other files are complete. For this reason, publishing removes the old
    record first and adds the new one last. A nested block belongs to the outer block.

    Raises:
        OutputError: the system refused to rename a file; the message names the file.
    """
    if _group.get() is not None:
        yield
        return
    outputs = _Outputs()
    token = _group.set(outputs)
    try:
        yield
        try:
            outputs.publish()
        except OSError as error:
            raise _refused(Path(error.filename2 or error.filename or "the outputs"), error) from error
    finally:
        _group.reset(token)
        outputs.discard()


@contextmanager
def atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a stream whose contents become `path` when the block and an enclosing `together` end without an error.

    For a library that needs a path instead of a stream, use the stream's `name`.

    Raises:
        OutputError: the system refused the write, or another process is writing the same file.
    """
    path = Path(path)
    with together():
        outputs = _group.get()
        assert outputs is not None
        try:
            with outputs.open(path) as stream:
                yield stream
        except OSError as error:
            raise _refused(path, error) from error


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Yield the path of a new temporary folder, which is renamed to `folder` if the block ends without an error.

    `folder` must not exist. The next call for the same folder removes what a killed process left behind.

    Raises:
        OutputError: the system refused to rename the folder.
    """
    folder = Path(folder)
    temporary = folder.with_name(f".{folder.name}{TEMPORARY}")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        yield temporary
        temporary.rename(folder)
    except OSError as error:
        raise _refused(folder, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically."""
    with atomic(path) as stream:
        stream.write(data)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically (UTF-8)."""
    write_bytes(path, text.encode("utf-8", errors="backslashreplace"))


def write_shared(path: Path, text: str) -> None:
    """Write a text file that other processes may be writing at the same time with the same text.

    The result, including its modification time (which caches compare), does not depend on which process is last.

    Raises:
        OutputError: the system refused the write.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}{TEMPORARY}")
    try:
        try:
            temporary.write_text(text, encoding="utf-8")
            os.utime(temporary, (_SHARED_TIME, _SHARED_TIME))
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    except OSError as error:
        raise _refused(path, error) from error


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically. NaN and infinity raise ValueError, because JSON does not have them."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_npz(path: Path, *, compressed: bool = True, **arrays: Any) -> None:
    """Write an NPZ file atomically and without pickles. The same arrays always give the same bytes."""
    save = np.savez_compressed if compressed else np.savez
    with atomic(path) as stream:
        save(stream, allow_pickle=False, **arrays)


def read_json(path: Path, *, error: type[DiffCloudError] = DiffCloudError, comments: bool = False) -> Any:
    """Read a JSON file.

    Args:
        comments: accept comments (`//`, `/* */` and `#`), as ARCSim does.

    Raises:
        error: the file is missing, not a regular file, too large, not JSON, or has a duplicate key.
    """
    try:
        text = read_text(path, error=error, most_bytes=_MOST_JSON)
        return json.loads(
            _COMMENT.sub(_blank, text) if comments else text,
            object_pairs_hook=partial(_object, Path(path), error),
            parse_constant=_refuse_constant,
            parse_float=_finite,
        )
    except (ValueError, RecursionError) as damage:  # ValueError: a syntax error, NaN, or an infinite number
        raise error(f"{path} is not readable JSON: {damage}.") from damage


def read_yaml(path: Path, *, error: type[DiffCloudError] = DiffCloudError, kind: str = "file") -> Any:
    """Read a YAML file of plain values.

    Booleans and numbers follow YAML 1.2, and only decimal numbers are read as numbers. `yes`, `1:30`, `0x10`, `010` and
    `1_000` are strings.

    Args:
        kind: kind of file, for the message if it is missing.

    Raises:
        error: the file is missing, not a regular file, too large, not YAML, has a duplicate key, or its anchors expand
            to too many values. The message names the file and the position.
    """
    try:
        loader = _PlainLoader(read_text(path, kind=kind, error=error, most_bytes=_MOST_YAML))
        try:
            node = loader.get_single_node()
            _refuse_twice(node, Path(path), error)
            if _yaml_size(node, {}) > _MOST_VALUES:
                raise error(f"{path} stands for more than {_MOST_VALUES} values; write out what its anchors (&, *) repeat.")
            return None if node is None else loader.construct_document(node)
        finally:
            loader.dispose()
    except (yaml.YAMLError, ValueError, RecursionError) as damage:  # ValueError: a number with too many digits
        raise error(f"{path} is not readable YAML: {damage}.") from damage


class _PlainLoader(yaml.SafeLoader):
    """YAML loader with the plain values of YAML 1.2. In PyYAML's 1.1, `1:30` is 90, `010` is 8, `no` is false."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        self.flatten_mapping(node)
        for key, _ in node.value:  # keys are strings, also a recording name such as 1e5
            if isinstance(key, yaml.ScalarNode):
                key.tag = "tag:yaml.org,2002:str"
        return super().construct_mapping(node, deep=deep)

    def construct_plain_float(self, node: yaml.ScalarNode) -> float:
        return number(re.sub(r"\.(?=inf|nan)", "", node.value.lower()))

    def construct_plain_int(self, node: yaml.ScalarNode) -> int:
        return whole(node.value)


_PlainLoader.yaml_implicit_resolvers = {}  # drop the resolvers of YAML 1.1
_PlainLoader.add_constructor("tag:yaml.org,2002:float", _PlainLoader.construct_plain_float)
_PlainLoader.add_constructor("tag:yaml.org,2002:int", _PlainLoader.construct_plain_int)
for _tag, _plain, _first in (
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("null", r"~|null|Null|NULL|", "~nN"),
    ("int", WHOLE.pattern, "-+0123456789"),
    ("float", CORE.pattern, "-+.0123456789"),
    ("float", r"[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)", "-+."),
    ("merge", r"<<", "<"),
):
    _PlainLoader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_plain})$"), [*_first, *([""] if _tag == "null" else [])]
    )


def _blank(match: re.Match[str]) -> str:
    """Replace a comment by spaces and keep its line breaks, so that errors have the right position. Keep strings."""
    held = match.group()
    return held if held.startswith('"') else re.sub(r"[^\n]", " ", held)


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is no number of JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is too large")
    return value


def _object(path: Path, error: type[DiffCloudError], pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the pairs of a JSON object as a dictionary, or raise `error` for a duplicate key."""
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise error(f"{path} names {twice!r} twice in one object; keep one of them.")
    return found


def _refuse_twice(node: yaml.Node | None, path: Path, error: type[DiffCloudError]) -> None:
    """Check that no mapping of a YAML document has a duplicate key; one of the values would be lost.

    Raises:
        error: a key occurs twice.
    """
    seen: set[int] = set()
    open_nodes = [] if node is None else [node]
    while open_nodes:
        one = open_nodes.pop()
        if not isinstance(one, yaml.CollectionNode) or id(one) in seen:
            continue
        seen.add(id(one))
        if isinstance(one, yaml.MappingNode):
            keys: set[str] = set()
            for key, value in one.value:
                if isinstance(key, yaml.ScalarNode) and key.value in keys:
                    raise error(
                        f"{path}, line {key.start_mark.line + 1}: the key {key.value!r} occurs twice; keep one of them."
                    )
                keys.add(str(key.value))
                open_nodes += [key, value]
        else:
            open_nodes += one.value


def _yaml_size(node: yaml.Node | None, known: dict[int, int]) -> int:
    """Return the number of values of a node after its aliases are expanded."""
    if isinstance(node, yaml.CollectionNode) and id(node) not in known:
        known[id(node)] = 1  # for aliases to a node that contains them
        parts = [part for pair in node.value for part in (pair if isinstance(pair, tuple) else (pair,))]
        known[id(node)] = 1 + sum(_yaml_size(part, known) for part in parts)
    return known.get(id(node), 1)


def refuse_undecoded(names: Iterable[str | Path]) -> None:
    """Check that file names are valid in the system's encoding; otherwise records and reports cannot contain them.

    Raises:
        DiffCloudError: a name has undecodable bytes.
    """
    for name in map(str, names):
        if any("\ud800" <= letter <= "\udfff" for letter in name):
            raise DiffCloudError(
                f"The name {name.encode('utf-8', 'backslashreplace').decode()} is not {sys.getfilesystemencoding()} text. "
                "Names of files and folders must be in that encoding. Rename the file, or run in a UTF-8 locale "
                "(LC_ALL=C.UTF-8)."
            )


def files_in(folder: Path, *suffixes: str) -> list[Path]:
    """List the data files of a folder, sorted by name.

    Hidden files are skipped: editors, operating systems and interrupted writes leave them behind (`._a.npz`).

    Args:
        suffixes: accepted suffixes in lower case; all files if none is given.

    Raises:
        DiffCloudError: a name is not valid in the system's encoding.
    """
    if not Path(folder).is_dir():
        return []
    found = sorted(
        path
        for path in Path(folder).iterdir()
        if not path.name.startswith(".") and (not suffixes or path.suffix.lower() in suffixes) and path.is_file()
    )
    refuse_undecoded(found)
    return found


def folders_in(folder: Path) -> list[Path]:
    """List the folders in a folder, sorted by name, without hidden ones."""
    if not Path(folder).is_dir():
        return []
    found = sorted(path for path in Path(folder).iterdir() if not path.name.startswith(".") and path.is_dir())
    refuse_undecoded(found)
    return found


@contextmanager
def claimed(output: Path) -> Iterator[None]:
    """Lock an output (file or folder) against other processes during the block, with a lock file beside it.

    Raises:
        OutputError: another process has locked it (the message names the process), or the location is not writable.
    """
    output = Path(os.path.realpath(output))
    lock = output.with_name(f".{output.name}{LOCK}")
    folders: list[Path] = []
    try:
        folders = _make_folders(lock.parent)
        descriptor = _hold(lock, output)
        os.ftruncate(descriptor, 0)
        os.write(descriptor, json.dumps(_this_process()).encode())
    except OSError as error:
        _remove_empty(folders)
        raise OutputError(f"Cannot write {output}: {error.strerror or error}. Nothing was changed.") from error
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(descriptor)
        _remove_empty(folders)


def _hold(lock: Path, output: Path) -> int:
    """Lock the lock file and return its descriptor. Closing the descriptor releases the lock."""
    while True:
        descriptor = os.open(lock, os.O_CREAT | os.O_RDWR, 0o666)
        if not _try_lock(descriptor):
            holder = _holder(descriptor)
            os.close(descriptor)
            raise OutputError(f"{output} is being written by {holder}. Wait for it, stop it, or choose another output.")
        # The previous owner removes the file before it releases the lock. A lock on a removed file has no effect.
        if os.fstat(descriptor).st_ino == _inode(lock):
            return descriptor
        os.close(descriptor)


def _this_process() -> dict[str, object]:
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    return {"process": os.getpid(), "host": socket.gethostname(), "command": command, "since": since}


def _holder(descriptor: int) -> str:
    try:
        told = json.loads(os.pread(descriptor, 65536, 0))
        return f"process {told['process']} on {told['host']} since {told['since']} ({told['command']})"
    except (OSError, ValueError, KeyError, TypeError):  # the other process has not written its description yet
        return "another process"


def _try_lock(descriptor: int) -> bool:
    """Lock an open file until it is closed; False if another process holds it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
    return True


@contextmanager
def _opened_alone(path: Path, temporary: Path) -> Iterator[BinaryIO]:
    """Create and lock a temporary file. A file that an ended process left behind is removed first.

    Raises:
        OutputError: another process has locked the file.
    """
    while True:
        try:
            stream = temporary.open("xb")
            break
        except FileExistsError:
            with suppress(FileNotFoundError), temporary.open("rb") as left:
                if not _try_lock(left.fileno()):
                    raise OutputError(
                        f"Another process is writing {path}; wait for it, or choose another output."
                    ) from None
                temporary.unlink()
    with stream:
        _try_lock(stream.fileno())
        yield stream


def _refused(path: Path, error: OSError) -> OutputError:
    return OutputError(
        f"Cannot write {path}: {error.strerror or error}. Nothing was changed; free the disk, or choose another place, and "
        "run the command again."
    )


def _inode(path: Path) -> int | None:
    try:
        return path.stat().st_ino
    except FileNotFoundError:
        return None


def _make_folders(folder: Path) -> list[Path]:
    """Create a folder and its parents, and return those that were missing, outermost first."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for one in reversed(missing):
        one.mkdir(exist_ok=True)
    return missing[::-1]


def _remove_empty(folders: list[Path]) -> None:
    for folder in reversed(folders):
        with suppress(OSError):  # the folder is no longer empty
            folder.rmdir()
