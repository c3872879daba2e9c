"""PNG images that are what they say: 16-bit depth and 8-bit colour, whole or refused.

Depth is lossless by contract. JPEG smears depth over object borders (and the reference recordings were stored so), hence
it is recognised by its first bytes, whatever its name says.
"""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.files import atomic
from diffcloud.io.inputs import open_input, read_input

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_LARGEST_PIXELS = 8192 * 8192
_LARGEST_BYTES = 512 << 20
"""Of a file: the largest colour image, without compression, has 200 MB, with 16 bits twice as many."""


def write_depth(path: Path, depth: NDArray[np.uint16], *, durable: bool = False) -> None:
    """Write depth [H, W] as a 16-bit PNG, atomically. `durable`: also through a power cut.

    Raises:
        EpisodeError: not uint16 [H, W].
        OutputError: the system refused the write (a full disk).
    """
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise EpisodeError(f"Depth must be uint16 [rows, columns], got {depth.dtype} {list(depth.shape)}.")
    _write(path, depth, durable)


def write_color(path: Path, color: NDArray[np.uint8], *, durable: bool = False) -> None:
    """Write colour [H, W, 3] (red, green, blue) as an 8-bit PNG, atomically.

    Raises:
        EpisodeError: not uint8 [H, W, 3].
        OutputError: the system refused the write (a full disk).
    """
    if color.dtype != np.uint8 or color.ndim != 3 or color.shape[2] != 3:
        raise EpisodeError(f"Colour must be uint8 [rows, columns, 3], got {color.dtype} {list(color.shape)}.")
    _write(path, color[..., ::-1], durable)


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Depth [H, W] of a 16-bit PNG, in units of the camera's `depth_scale_m`.

    Raises:
        EpisodeError: missing, truncated, a JPEG, or not 16-bit grey; says which.
    """
    return decode_depth(_bytes(path), str(path))


def decode_depth(data: bytes, name: str) -> NDArray[np.uint16]:
    """Depth [H, W] from the bytes of a PNG; `name` is used in messages."""
    if data.startswith(_JPEG):
        raise EpisodeError(
            f"{name} is a JPEG. JPEG changes depth by centimetres at every border: record depth as 16-bit PNG, lossless."
        )
    image = _decode(data, name)
    if image.dtype != np.uint16 or image.ndim != 2:
        bits = 8 * image.dtype.itemsize
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise EpisodeError(f"{name} has {channels} channels of {bits} bits; depth is a 16-bit grey PNG.")
    return image


def read_color(path: Path) -> NDArray[np.uint8]:
    """Colour [H, W, 3] (red, green, blue) of an 8-bit PNG.

    Raises:
        EpisodeError: missing, truncated, or not an 8-bit colour image.
    """
    return decode_color(_bytes(path), str(path))


def decode_color(data: bytes, name: str) -> NDArray[np.uint8]:
    """Colour [H, W, 3] from the bytes of a PNG, or of a JPEG: for colour that is harmless.

    Raises:
        EpisodeError: truncated, damaged, larger than any camera's image, or not 8-bit colour.
    """
    if data.startswith(_JPEG):
        _check_size(*_jpeg_size(data, name), name)
    else:
        check_png(data, name)
    image = _cv2_decode(data, name)
    if image.dtype != np.uint8:
        raise EpisodeError(f"{name} has {8 * image.dtype.itemsize} bits a channel; colour has 8.")
    if image.ndim == 2:
        return np.repeat(image[..., None], 3, axis=2)
    return np.ascontiguousarray(image[..., 2::-1])


def png_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header alone."""
    with open_input(path, kind="image", error=EpisodeError) as stream:
        head = stream.read(24)
    if not head.startswith(_PNG) or len(head) < 24:
        raise EpisodeError(f"{path} is not a PNG file.")
    width, height = struct.unpack(">II", head[16:24])
    return width, height


def check_png(data: bytes, name: str) -> None:
    """Every chunk present and its checksum right; OpenCV would fill a truncated image with zeros without a word.

    Raises:
        EpisodeError: not a PNG, truncated, damaged, or larger than any camera's image.
    """
    if not data.startswith(_PNG):
        kind = "a JPEG" if data.startswith(_JPEG) else "not a PNG"
        raise EpisodeError(f"{name} is {kind}; images of an episode are PNG files.")
    position = len(_PNG)
    while position + 12 <= len(data):
        (length,) = struct.unpack(">I", data[position : position + 4])
        kind_bytes = data[position + 4 : position + 8]
        body = data[position + 4 : position + 8 + length]
        end = position + 12 + length
        if end > len(data):
            break
        if zlib.crc32(body) != struct.unpack(">I", data[end - 4 : end])[0]:
            raise EpisodeError(f"{name} is damaged (checksum of its {kind_bytes!r} chunk); record again or drop the frame.")
        if kind_bytes == b"IHDR" and length >= 8:
            width, height = struct.unpack(">II", body[4:12])
            _check_size(width, height, name)
        if kind_bytes == b"IEND":
            return
        position = end
    raise EpisodeError(f"{name} is truncated ({len(data)} bytes); its end is missing. Drop the frame or copy it again.")


def _jpeg_size(data: bytes, name: str) -> tuple[int, int]:
    """(width, height) of the frame's header (SOF), which comes after other segments; each states its length.

    Raises:
        EpisodeError: there is none.
    """
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        kind, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4], "big")
        if kind == 0xFF:  # a byte that fills up
            position += 1
            continue
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return width, height
        if kind in (0xD9, 0xDA) or length < 2:  # the end, or pixels
            break
        position += 2 + length
    raise EpisodeError(f"{name} is a JPEG that states no size before its pixels: it is damaged. Drop the frame.")


def _check_size(width: int, height: int, name: str) -> None:
    if width * height > _LARGEST_PIXELS:
        raise EpisodeError(f"{name} claims {width} x {height} pixels; at most {_LARGEST_PIXELS} are read.")


def encode_jpeg(color: NDArray[np.uint8], *, width: int) -> bytes:
    """Colour [H, W, 3] (red, green, blue) as a JPEG at most so wide, for a page to show."""
    import cv2

    if color.shape[1] > width:
        height = round(color.shape[0] * width / color.shape[1])
        color = np.asarray(cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(color[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 75])
    return data.tobytes()


def _bytes(path: Path) -> bytes:
    return read_input(path, kind="image", error=EpisodeError, most_bytes=_LARGEST_BYTES)


def _decode(data: bytes, name: str) -> NDArray[Any]:
    check_png(data, name)
    return _cv2_decode(data, name)


def _cv2_decode(data: bytes, name: str) -> NDArray[Any]:
    import cv2

    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise EpisodeError(f"{name} is not a readable image: {error}.") from error
    if image is None:
        raise EpisodeError(f"{name} is not a readable image.")
    return np.asarray(image)


def _write(path: Path, image: NDArray[Any], durable: bool) -> None:
    import cv2

    # run lengths only: half the time of zlib's fastest level, and no larger
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE])
    if not done:
        raise EpisodeError(f"{path}: the image could not be encoded as PNG.")
    with atomic(path) as stream:
        stream.write(data.tobytes())
        if durable:
            stream.flush()
            os.fsync(stream.fileno())
