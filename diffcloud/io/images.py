"""Read and write PNG images: 16-bit depth and 8-bit colour. Damaged or incomplete images are refused.

Depth must be lossless. JPEG blurs depth across object borders (the reference recordings were stored as JPEG), so JPEG
depth is refused. The format is recognised by the first bytes, not by the file name.
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
"""Largest file [bytes]. An uncompressed colour image of the largest size has 200 MB, or 400 MB with 16 bits."""


def write_depth(path: Path, depth: NDArray[np.uint16], *, durable: bool = False) -> None:
    """Write depth [H, W] as a 16-bit PNG, atomically. `durable` flushes the file to disk, to survive a power cut.

    Raises:
        EpisodeError: the array is not uint16 [H, W].
        OutputError: the system refused the write (a full disk).
    """
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise EpisodeError(f"Depth must be uint16 [rows, columns], got {depth.dtype} {list(depth.shape)}.")
    _write(path, depth, durable)


def write_color(path: Path, color: NDArray[np.uint8], *, durable: bool = False) -> None:
    """Write colour [H, W, 3] (red, green, blue) as an 8-bit PNG, atomically.

    Raises:
        EpisodeError: the array is not uint8 [H, W, 3].
        OutputError: the system refused the write (a full disk).
    """
    if color.dtype != np.uint8 or color.ndim != 3 or color.shape[2] != 3:
        raise EpisodeError(f"Colour must be uint8 [rows, columns, 3], got {color.dtype} {list(color.shape)}.")
    _write(path, color[..., ::-1], durable)


def read_depth(path: Path) -> NDArray[np.uint16]:
    """Read depth [H, W] from a 16-bit PNG, in units of the camera's `depth_scale_m`.

    Raises:
        EpisodeError: the file is missing, truncated, a JPEG, or not 16-bit grey.
    """
    return decode_depth(_bytes(path), str(path))


def decode_depth(data: bytes, name: str) -> NDArray[np.uint16]:
    """Decode depth [H, W] from the bytes of a PNG. `name` is used in error messages."""
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
    """Read colour [H, W, 3] (red, green, blue) from an 8-bit PNG or a JPEG.

    Raises:
        EpisodeError: the file is missing, truncated, or not an 8-bit colour image.
    """
    return decode_color(_bytes(path), str(path))


def decode_color(data: bytes, name: str) -> NDArray[np.uint8]:
    """Decode colour [H, W, 3] from the bytes of a PNG or a JPEG. Lossy compression does no harm to colour.

    Raises:
        EpisodeError: the image is truncated, damaged, too large for a camera image, or not 8-bit.
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
    """Return (width, height) of a PNG file, from its header only."""
    with open_input(path, kind="image", error=EpisodeError) as stream:
        head = stream.read(24)
    if not head.startswith(_PNG) or len(head) < 24:
        raise EpisodeError(f"{path} is not a PNG file.")
    width, height = struct.unpack(">II", head[16:24])
    return width, height


def check_png(data: bytes, name: str) -> None:
    """Check that all chunks of a PNG are present and valid. OpenCV silently fills a truncated image with zeros.

    Raises:
        EpisodeError: the data are not a PNG, truncated, damaged, or too large for a camera image.
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
    """Return (width, height) from the frame header (SOF segment) of a JPEG, skipping the segments before it.

    Raises:
        EpisodeError: there is no frame header.
    """
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        kind, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4], "big")
        if kind == 0xFF:  # a fill byte
            position += 1
            continue
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[position + 5 : position + 9])
            return width, height
        if kind in (0xD9, 0xDA) or length < 2:  # end of image, or start of the pixel data
            break
        position += 2 + length
    raise EpisodeError(f"{name} is a JPEG that states no size before its pixels: it is damaged. Drop the frame.")


def _check_size(width: int, height: int, name: str) -> None:
    if width * height > _LARGEST_PIXELS:
        raise EpisodeError(f"{name} claims {width} x {height} pixels; at most {_LARGEST_PIXELS} are read.")


def encode_jpeg(color: NDArray[np.uint8], *, width: int) -> bytes:
    """Encode colour [H, W, 3] (red, green, blue) as a JPEG of at most `width` pixels, for a web page."""
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

    # Run-length encoding takes half the time of zlib's fastest level, and the files are no larger.
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE])
    if not done:
        raise EpisodeError(f"{path}: the image could not be encoded as PNG.")
    with atomic(path) as stream:
        stream.write(data.tobytes())
        if durable:
            stream.flush()
            os.fsync(stream.fileno())
