"""Decode ROS 1 and ROS 2 messages: time stamps, depth and colour images, camera intrinsics.

Depth images have 16-bit integers in millimetres (16UC1) or 32-bit floats in metres (32FC1). A CompressedImage has
either as PNG or RVL. Both formats lack floats, so compressed_depth_image_transport stores inverse depth in 16 bits. A
header of 12 bytes (a format number, floats a and b) gives the inverse: depth = a / (value - b). Value 0 is no
measurement.
"""

from __future__ import annotations

import struct
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.camera_models import LENS_COEFFICIENTS, Distortion, Intrinsics
from diffcloud.io.images import decode_color, decode_depth
from diffcloud.io.pcd import axis_field
from diffcloud.io.rvl import decode_rvl

DepthEncoding = Literal["16UC1", "32FC1"]
DEPTH_UNITS_M: dict[DepthEncoding, float] = {"16UC1": 0.001, "32FC1": 0.00025}
"""Unit of the raw episode's 16-bit depth images. Floats are stored in quarters of a millimetre, up to 16 m."""
_COMPRESSED_DEPTH_HEADER = struct.Struct("<iff")
_LENSES: dict[str, Distortion] = {
    **dict.fromkeys(("", "plumb_bob", "rational_polynomial"), "brown_conrady"),
    **dict.fromkeys(("equidistant", "fisheye"), "equidistant"),
}
"""ROS distortion model -> ours. Similar models share an entry, because OpenCV distinguishes them by the number of
coefficients and drivers name them inconsistently."""
_COLOR_CHANNELS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0), "mono8": (0, 0, 0)}

_POINT_TYPES = ("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
"""Names of the numbers 1 to 8 that a PointField has as its datatype."""
_FLOATS = {7: "f4", 8: "f8"}
"""Datatypes of coordinates in metres."""
MOST_POINTS = 100_000_000
"""Of a recording, so of one cloud too: as float32 they take 1.2 GB."""


def stamp_s(message: Any) -> float:
    """Return a message's time stamp [s]. It is 0 if the message was not stamped, or at the start of simulated time."""
    stamp = message.header.stamp
    return float(stamp.sec + 1e-9 * stamp.nanosec)


def depth_encoding(message: Any, topic: str) -> DepthEncoding:
    """Return the encoding of a depth message (Image or CompressedImage).

    Raises:
        EpisodeError: the encoding or compression is not supported.
    """
    if hasattr(message, "encoding"):
        if message.encoding == "32FC1":
            return "32FC1"
        if message.encoding in ("16UC1", "mono16"):
            return "16UC1"
        raise EpisodeError(f"{topic} has the encoding {message.encoding!r}; depth is 16UC1, 32FC1 or compressedDepth.")
    stated, _, compression = (part.strip() for part in message.format.partition(";"))
    if not _is_compressed_depth(message):
        # A plain compressed image cannot have floats. A 16-bit PNG is in millimetres; the decoder refuses others.
        if stated == "32FC1":
            raise EpisodeError(f"{topic} has the format {message.format!r}, which loses floats; record compressedDepth.")
        return "16UC1"
    codec = compression.removeprefix("compressedDepth").strip()
    if codec not in ("", "png", "rvl"):
        raise EpisodeError(
            f"{topic} is compressed by {codec!r} (format {message.format!r}); of compressedDepth PNG and RVL are read. "
            "Record with the publisher's parameter format:=png, or republish the topic as raw images."
        )
    if stated == "32FC1":
        return "32FC1"
    if stated in ("16UC1", "mono16"):
        return "16UC1"
    raise EpisodeError(
        f"{topic} has the format {message.format!r}; compressedDepth must state its encoding first, as in "
        "'16UC1; compressedDepth png' or '32FC1; compressedDepth png'."
    )


def depth_image(message: Any, topic: str, encoding: DepthEncoding) -> NDArray[np.uint16]:
    """Decode depth [H, W] in the unit of its encoding (`DEPTH_UNITS_M`). Missing or too large values are 0.

    Args:
        encoding: encoding of the topic's first message, which all others must have.

    Raises:
        EpisodeError: the message is damaged, or has another encoding.
    """
    own = depth_encoding(message, topic)
    if own != encoding:
        raise EpisodeError(f"{topic} changes its encoding from {encoding} to {own} within the recording; import the parts.")
    if hasattr(message, "encoding"):
        values = _pixels(message, np.dtype(np.uint16 if own == "16UC1" else np.float32))[..., 0]
        return values.astype(np.uint16) if own == "16UC1" else _in_units(values, DEPTH_UNITS_M[own])
    data = bytes(message.data)
    if not _is_compressed_depth(message):
        return decode_depth(data, topic)
    size = _COMPRESSED_DEPTH_HEADER.size
    if len(data) <= size:
        raise EpisodeError(f"A compressedDepth image of {topic} has {len(data)} bytes; the recording is damaged.")
    rvl = message.format.rstrip().endswith("rvl")
    values = decode_rvl(data[size:], topic) if rvl else decode_depth(data[size:], topic)
    if own == "16UC1":
        return values
    _, a, b = _COMPRESSED_DEPTH_HEADER.unpack(data[:size])
    if not (np.isfinite([a, b]).all() and a > 0):
        raise EpisodeError(f"A 32FC1 compressedDepth image of {topic} has the quantisation {a:g}, {b:g}: it is damaged.")
    inverse = np.where(values > 0, values.astype(np.float64) - b, np.nan)
    with np.errstate(divide="ignore"):
        return _in_units(a / inverse, DEPTH_UNITS_M[own])


def color_image(message: Any, topic: str) -> NDArray[np.uint8]:
    """Decode colour [H, W, 3] (red, green, blue).

    Raises:
        EpisodeError: the message is damaged, or its encoding is not supported.
    """
    if not hasattr(message, "encoding"):
        return decode_color(bytes(message.data), topic)
    if message.encoding not in _COLOR_CHANNELS:
        raise EpisodeError(f"{topic} has the encoding {message.encoding!r}; colour is {', '.join(_COLOR_CHANNELS)}.")
    return np.ascontiguousarray(_pixels(message, np.dtype(np.uint8))[..., _COLOR_CHANNELS[message.encoding]])


def cloud_points(message: Any, topic: str) -> NDArray[np.floating[Any]]:
    """Points [N, 3] of a PointCloud2 [m], in the frame of its header; float32, or float64 if a coordinate is stored so.

    Points that are not finite are left out. Organised clouds have them where a pixel has no measurement.

    Raises:
        EpisodeError: no x, y, z as floats, or sizes that contradict each other or the data.
    """
    height, width, step, row = message.height, message.width, message.point_step, message.row_step
    if height * width == 0:  # often without fields
        return np.zeros((0, 3))
    names = [held.name for held in message.fields]
    found = [axis_field(names, axis) for axis in "xyz"]
    fields = [message.fields[index] for index in found if index is not None]
    if len(fields) < 3:
        raise EpisodeError(
            f"The clouds on {topic} have the fields {', '.join(names) or '(none)'}. A cloud needs the fields x, y and z. "
            "Record a topic that has them."
        )
    for held in fields:
        if held.datatype not in _FLOATS or held.count > 1:  # some drivers write 0 for one number
            known = 1 <= held.datatype <= len(_POINT_TYPES)
            kind = _POINT_TYPES[held.datatype - 1] if known else f"of the unknown datatype {held.datatype}"
            raise EpisodeError(
                f"The field {held.name} of the clouds on {topic} is {kind}, {held.count} per point. Coordinates are one "
                "float32 or float64 per point, in metres. Convert the clouds, and record them again."
            )
    if height * width > MOST_POINTS:
        raise EpisodeError(
            f"A cloud on {topic} states {height} x {width} points. A recording may have {MOST_POINTS:,}. If the message is "
            "not damaged, record smaller clouds."
        )
    data = np.ascontiguousarray(message.data, np.uint8)
    ends = [held.offset + np.dtype(_FLOATS[held.datatype]).itemsize for held in fields]
    if len(data) != height * row or row < width * step or max(ends) > step:
        raise EpisodeError(
            f"A cloud on {topic} is damaged: {height} rows of {row} bytes, {width} points of {step} bytes per row, "
            f"coordinates up to byte {max(ends)} of a point, and {len(data)} bytes of data. Rows must hold their points, "
            "points their coordinates, and the data all rows. Record the topic again, or cut the recording there."
        )
    order = ">" if message.is_bigendian else "<"
    formats, offsets = [order + _FLOATS[held.datatype] for held in fields], [held.offset for held in fields]
    layout = np.dtype({"names": list("xyz"), "formats": formats, "offsets": offsets})
    table = np.ndarray((height, width), layout, data, strides=(row, step))
    points = np.stack([table[axis] for axis in "xyz"], axis=-1).reshape(-1, 3)
    return np.asarray(points[np.isfinite(points).all(axis=1)])


def is_calibrated(message: Any) -> bool:
    """Whether a CameraInfo has a camera matrix. Drivers of uncalibrated cameras send zeros."""
    return bool(np.any(_field(message, "k")))


def camera_intrinsics(message: Any, name: str, topic: str, *, rectified: bool = False) -> Intrinsics:
    """Return the intrinsics in a CameraInfo message.

    Args:
        name: name of the camera, for messages.
        topic: topic of the message, for messages.
        rectified: use P, the camera matrix of undistorted images. Otherwise use K and D of the original images.

    Raises:
        EpisodeError: the camera is not calibrated, its lens model is not supported, or a value is impossible.
    """
    where = f"Camera {name}: its camera_info on {topic}"
    if not is_calibrated(message):
        raise EpisodeError(
            f"{where} has only zeros in K: this camera was never calibrated. Calibrate it and record again, or write its "
            "intrinsics into the recording."
        )
    matrix = _field(message, "k").reshape(3, 3)
    model, lens = message.distortion_model, _field(message, "d").tolist()
    if rectified:
        projection = _field(message, "p").reshape(3, 4)[:, :3]
        matrix, lens = projection if projection.any() else matrix, []
    distortion: Distortion = "none"
    if any(lens):
        if model not in _LENSES:
            raise EpisodeError(
                f"{where} has the distortion model {model!r}; allowed are {', '.join(filter(None, _LENSES))}."
            )
        distortion = _LENSES[model]
        lens = _whole(lens, LENS_COEFFICIENTS[distortion])
    try:
        fx, fy, cx, cy = (float(matrix[row, column]) for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return Intrinsics(message.width, message.height, fx, fy, cx, cy, distortion, tuple(lens) if any(lens) else ())
    except EpisodeError as error:
        raise EpisodeError(f"{where} does not describe a camera: {error}") from error


def _field(message: Any, name: str) -> NDArray[np.float64]:
    """Return the array D, K or P. ROS 1 has upper-case field names, ROS 2 lower-case ones."""
    return np.asarray(getattr(message, name if hasattr(message, name) else name.upper()), dtype=np.float64)


def _whole(lens: list[float], allowed: tuple[int, ...]) -> list[float]:
    """Truncate or pad lens coefficients to the smallest allowed number that keeps all nonzero ones."""
    used = max(index for index, value in enumerate(lens, start=1) if value)
    count = next((size for size in allowed if size >= used), None)
    return lens if count is None else (lens + [0.0] * count)[:count]


def _is_compressed_depth(message: Any) -> bool:
    return "compressedDepth" in message.format


def _in_units(metres: NDArray[Any], unit_m: float) -> NDArray[np.uint16]:
    """Round depth to whole units. Values that are not finite, not positive or beyond 16 bits become 0 (no
    measurement)."""
    known = np.isfinite(metres) & (metres > 0) & (metres < 65535.5 * unit_m)
    return np.where(known, np.rint(np.where(known, metres, 0) / unit_m), 0).astype(np.uint16)


def _pixels(message: Any, kind: np.dtype[Any]) -> NDArray[Any]:
    """Return the pixels [H, W, C] of an Image message, without row padding and in its byte order."""
    kind = kind.newbyteorder(">" if message.is_bigendian else "<")
    data = np.frombuffer(bytes(message.data), np.uint8)
    channels = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}.get(message.encoding, 1)
    if len(data) != message.height * message.step or message.step < message.width * channels * kind.itemsize:
        raise EpisodeError(
            f"An image of {message.width} x {message.height} has {len(data)} bytes; the recording is damaged."
        )
    rows = data.reshape(message.height, message.step)
    used = np.ascontiguousarray(rows[:, : message.width * channels * kind.itemsize])
    return used.view(kind).reshape(message.height, message.width, channels)
