"""The one way to disk and back: outputs that belong together appear together, by one process at a time, and only data are
read as data.

An output is written under a temporary name beside it and renamed when all outputs of its group are whole. A crash, a full
disk or Ctrl-C leaves the former files, or none, never half of one. What a kill leaves behind has a suffix that no reader
takes for data, and is removed by the next write of the same file. Locks are the system's (`flock`): they end with the
process that holds them, however that ends.
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
"""Values that a YAML file may stand for."""
_MOST_JSON, _MOST_YAML = 50_000_000, 1_000_000
"""Bytes of a file of text that is read as a whole: JSON; YAML, whose reader is slow."""
_COMMENT = re.compile(r'"(?:[^"\\]|\\.)*+"|//[^\n]*|#[^\n]*|/\*.*?\*/', re.DOTALL)
"""A string of JSON, in which nothing is a comment, or a comment."""
_SHARED_TIME = 1_600_000_000
"""Modification time given to files that several processes write with the same text [s]."""
TEMPORARY, LOCK = ".diffcloud-tmp", ".diffcloud-lock"
"""Suffixes of a file that is being written, and of the lock file beside an output that a command holds."""
_NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.EINVAL}
"""What a file system without locks answers; nothing is locked there."""


class _Outputs:
    """Files that take their names together."""

    def __init__(self) -> None:
        self._pending: dict[Path, tuple[Path, int]] = {}
        """Output -> its temporary file and that file's inode."""
        self._folders: list[Path] = []
        """Made for the outputs, outermost first."""

    @contextmanager
    def open(self, path: Path) -> Iterator[BinaryIO]:
        """A stream to the temporary file of `path`."""
        self._folders += _make_folders(path.parent)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        temporary = path.with_name(f".{path.name}{TEMPORARY}")
        with _opened_alone(path, temporary) as stream:
            self._pending.pop(path, None)
            self._pending[path] = temporary, os.fstat(stream.fileno()).st_ino
            yield stream

    def publish(self) -> None:
        """Give all files their names."""
        for path, (temporary, inode) in self._pending.items():
            if _inode(temporary) != inode:
                raise OutputError(f"Another process wrote {path} at the same time; run the command again.")
        if len(self._pending) > 1:
            next(reversed(self._pending)).unlink(missing_ok=True)
        for path, (temporary, _) in self._pending.items():
            os.replace(temporary, path)
        self._pending.clear()

    def discard(self) -> None:
        """Remove what has not been published."""
        for temporary, inode in self._pending.values():
            with suppress(OSError):
                if _inode(temporary) == inode:
                    temporary.unlink()
        self._pending.clear()
        _remove_empty(self._folders)


_group: ContextVar[_Outputs | None] = ContextVar("_group", default=None)
"""Of the innermost `together`."""


@contextmanager
def together() -> Iterator[None]:
    """What is written in this block is all there after it, or, if it ends with an error, all as it was before.

    The file written last is the record: while it is there, the others are whole. So it is the first to go where the group
    replaces a former one, and the last to come. A block inside another belongs to the outer one.

    Raises:
        OutputError: the system refused to put the files in place; the message names one.
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
    """A stream that becomes `path` when the block, and a `together` around it, ends without an error.

    A library that wants a path may write to the stream's `name`.

    Raises:
        OutputError: the system refused the write, or another process is writing the same file; names the file.
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
    """A temporary folder, not yet there, that becomes `folder`, which must not exist, if the block ends without an error.

    What a kill leaves of it is removed by the next call for the same folder.

    Raises:
        OutputError: the system refused to put it in place.
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
    """Write a text file that other processes may be writing at this moment with the same text.

    Whoever comes last, the file is the same, and so is its time of change, which caches compare.

    Raises:
        OutputError: the system refused the write; names the file.
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
    """Write JSON atomically; NaN and infinity are refused, since no other reader takes them."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")


def write_npz(path: Path, *, compressed: bool = True, **arrays: Any) -> None:
    """Write an NPZ file atomically, without pickles; the same arrays give the same bytes."""
    save = np.savez_compressed if compressed else np.savez
    with atomic(path) as stream:
        save(stream, allow_pickle=False, **arrays)


def read_json(path: Path, *, error: type[DiffCloudError] = DiffCloudError, comments: bool = False) -> Any:
    """Read a JSON file.

    Args:
        comments: accept comments (`//`, `/* */` and `#`), as the reader of ARCSim does.

    Raises:
        error: the file is missing, no regular file or not JSON, too large, or names a field twice; the message names the
            file and the place.
    """
    try:
        text = read_text(path, error=error, most_bytes=_MOST_JSON)
        return json.loads(
            _COMMENT.sub(_blank, text) if comments else text,
            object_pairs_hook=partial(_object, Path(path), error),
            parse_constant=_refuse_constant,
            parse_float=_finite,
        )
    except (ValueError, RecursionError) as damage:  # of JSON and numbers
        raise error(f"{path} is not readable JSON: {damage}.") from damage


def read_yaml(path: Path, *, error: type[DiffCloudError] = DiffCloudError, kind: str = "file") -> Any:
    """Read a YAML file of plain values. Booleans and numbers are those of YAML 1.2; `yes`, `1:30`, `0x10`, `010` and
    `1_000` are texts.

    Args:
        kind: what it is, for the message if it is missing.

    Raises:
        error: the file is missing, no regular file, is not YAML, too large, names a field twice, or its anchors stand for
            too much; the message names file and place.
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
    """Plain values as in YAML 1.2. PyYAML's own are of YAML 1.1, where `1:30` is 90, `010` is 8 and `no` is false."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        self.flatten_mapping(node)
        for key, _ in node.value:  # names are texts, also of a recording that is called 1e5
            if isinstance(key, yaml.ScalarNode):
                key.tag = "tag:yaml.org,2002:str"
        return super().construct_mapping(node, deep=deep)

    def construct_plain_float(self, node: yaml.ScalarNode) -> float:
        return number(re.sub(r"\.(?=inf|nan)", "", node.value.lower()))

    def construct_plain_int(self, node: yaml.ScalarNode) -> int:
        return whole(node.value)


_PlainLoader.yaml_implicit_resolvers = {}  # its own, without those of YAML 1.1
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
    """A comment as white space on as many lines, so that errors name the right place; a string as it is."""
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
    """A JSON object whose names are all different."""
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = Counter(name for name, _ in pairs).most_common(1)[0][0]
        raise error(f"{path} names {twice!r} twice in one object; keep one of them.")
    return found


def _refuse_twice(node: yaml.Node | None, path: Path, error: type[DiffCloudError]) -> None:
    """
    Raises:
        error: a mapping names a key twice, of which one would be lost.
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
                        f"{path}, line {key.start_mark.line + 1}: {key.value!r} stands there twice; keep one of them."
                    )
                keys.add(str(key.value))
                open_nodes += [key, value]
        else:
            open_nodes += one.value


def _yaml_size(node: yaml.Node | None, known: dict[int, int]) -> int:
    """How many values a node stands for, its aliases written out."""
    if isinstance(node, yaml.CollectionNode) and id(node) not in known:
        known[id(node)] = 1  # of an alias to what surrounds it
        parts = [part for pair in node.value for part in (pair if isinstance(pair, tuple) else (pair,))]
        known[id(node)] = 1 + sum(_yaml_size(part, known) for part in parts)
    return known.get(id(node), 1)


def refuse_undecoded(names: Iterable[str | Path]) -> None:
    """
    Raises:
        DiffCloudError: the name of a file is not in the system's encoding; records and reports could not hold it.
    """
    for name in map(str, names):
        if any("\ud800" <= letter <= "\udfff" for letter in name):
            raise DiffCloudError(
                f"{name.encode('utf-8', 'backslashreplace').decode()} is a name that is not {sys.getfilesystemencoding()}. "
                "Names of files and folders must be text in that encoding. Rename the file, or run in a UTF-8 locale "
                "(LC_ALL=C.UTF-8)."
            )


def files_in(folder: Path, *suffixes: str) -> list[Path]:
    """Data files of a folder by name, with one of these suffixes (lower case; none given: any).

    Hidden files are never data: editors, operating systems and interrupted writes leave such behind (`._a.npz`).

    Raises:
        DiffCloudError: a name is not in the system's encoding.
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
    """Folders of a folder by name, without hidden ones."""
    if not Path(folder).is_dir():
        return []
    found = sorted(path for path in Path(folder).iterdir() if not path.name.startswith(".") and path.is_dir())
    refuse_undecoded(found)
    return found


@contextmanager
def claimed(output: Path) -> Iterator[None]:
    """Hold an output, file or folder, against other processes; by a lock file beside it that is there only meanwhile.

    Raises:
        OutputError: another process holds it (names that process), or the place cannot be written.
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
    """A descriptor of the lock file, locked until it is closed."""
    while True:
        descriptor = os.open(lock, os.O_CREAT | os.O_RDWR, 0o666)
        if not _try_lock(descriptor):
            holder = _holder(descriptor)
            os.close(descriptor)
            raise OutputError(f"{output} is being written by {holder}. Wait for it, stop it, or choose another output.")
        # the former holder removes the file before it lets go: a lock on a removed file holds nobody off
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
    except (OSError, ValueError, KeyError, TypeError):  # it is only just about to tell
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
    """The temporary file, new and locked; one that an ended process left is removed.

    Raises:
        OutputError: another process holds it.
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
    """Make a folder and what it lies in; those that were missing, outermost first."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for one in reversed(missing):
        one.mkdir(exist_ok=True)
    return missing[::-1]


def _remove_empty(folders: list[Path]) -> None:
    for folder in reversed(folders):
        with suppress(OSError):  # it has something in it by now
            folder.rmdir()
