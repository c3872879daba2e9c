"""A stereo depth camera that looks at a rendered scene: what an Intel RealSense D435 would have made of true depth.

Images are depth aligned to colour, as captures are. The camera measures disparity d = f · baseline / z with its two
infrared imagers, which stand beside the colour camera; so the deviation of depth grows with z², depth comes in steps of
a part of a pixel, and what only one imager sees has no depth. f is the imagers' own focal length, whatever the size of
the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.special import ndtri

from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import CameraInfo
from diffcloud.sensing.cameras import looking_at
from diffcloud.sensing.masking import View

Floats = NDArray[np.float64]

DEPTH_SCALE_M = 0.001
_EDGE_M = 0.02
"""Neighbouring pixels that differ by more are a border."""
_HOLE_RADIUS_PX = 2.0
_COLOR_FOCAL = 614.9 / 480
"""Focal length of a D435's colour camera in heights of the image (of the published calibration)."""


@dataclass(frozen=True)
class DepthNoise:
    """What goes wrong in stereo matching."""

    subpixel_px: float = 0.08
    """Standard deviation of the disparity, in pixels of the imagers."""
    correlation_px: float = 0.7
    """Matching windows overlap: the disparity's errors are smoothed by a Gaussian of this width, at equal deviation."""
    step_px: float = 1 / 32
    """Disparity is a whole multiple of this."""
    focal_px: float = 425.0
    """Of the imagers, at 848 columns."""
    baseline_m: float = 0.05
    edge_dropout: float = 0.3
    """Part of the border pixels without depth."""
    flying: float = 0.1
    """Part of the border pixels that land between foreground and background."""
    holes: float = 0.005
    """Part of the image in patches without depth, wherever they fall."""
    nearest_m: float = 0.2
    farthest_m: float = 4.0

    def sigma_m(self, depth_m: Floats) -> Floats:
        """Standard deviation of depth [m]: σ_z = z² σ_d / (f · baseline)."""
        return depth_m**2 * self.subpixel_px / (self.focal_px * self.baseline_m)


@dataclass(frozen=True)
class DepthCamera:
    """A camera in its place, and its faults."""

    name: str
    serial: str
    view: View
    """Where it truly stands."""
    noise: DepthNoise = DepthNoise()
    imager_offsets_m: tuple[float, ...] = (0.015, 0.065)
    """The infrared imagers' places along the image's x [m]."""

    def info(self, stated: Floats | None = None) -> CameraInfo:
        """camera.json; `stated` [4, 4] is where the calibration puts the camera, by default where it stands."""
        pose = self.view.T_world_camera if stated is None else stated
        return CameraInfo(self.name, self.serial, self.view.intrinsics, DEPTH_SCALE_M, pose)

    def measure(self, depth_m: Floats, hidden: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.uint16]:
        """The depth image [H, W] in millimetres, 0 where there is none.

        Args:
            depth_m: [H, W] true z-depth; infinite where nothing is.
            hidden: [H, W] what an imager does not see.
        """
        noise = self.noise
        seen = np.isfinite(depth_m) & (depth_m > noise.nearest_m) & (depth_m < noise.farthest_m)
        z = np.where(seen, depth_m, noise.farthest_m)
        near, far = minimum_filter(z, 3), maximum_filter(z, 3)
        scale = noise.focal_px * noise.baseline_m
        disparity = scale / z + noise.subpixel_px * _smooth(rng, z.shape, noise.correlation_px)
        if noise.step_px > 0:
            disparity = np.rint(disparity / noise.step_px) * noise.step_px
        measured = scale / np.maximum(disparity, scale / (2 * noise.farthest_m))
        edge = seen & (far - near > _EDGE_M)
        draw = rng.random(z.shape)
        measured = np.where(edge & (draw < noise.flying), near + rng.random(z.shape) * (far - near), measured)
        lost = hidden | (edge & (draw > 1 - noise.edge_dropout))
        if noise.holes > 0:
            lost |= _smooth(rng, z.shape, _HOLE_RADIUS_PX) > -ndtri(noise.holes)
        units = np.rint(measured / DEPTH_SCALE_M)
        return np.where(seen & ~lost, units, 0.0).astype(np.uint16)


def published_cameras(width: int = 424, height: int = 240, *, noise: DepthNoise | None = None) -> tuple[DepthCamera, ...]:
    """An overhead and a side camera where those of the published recordings stood; depth is aligned to colour."""
    intrinsics = color_intrinsics(width, height)
    places = {
        "overhead": ("036522070001", (1.2477, 0.0431, 0.9373), (-0.573, 0.006, -0.819)),
        "side": ("036522070002", (0.7267, -0.7872, 0.4466), (0.031, 0.939, -0.343)),
    }
    return tuple(
        DepthCamera(
            name,
            serial,
            View(intrinsics, looking_at(place, np.add(place, direction))),
            DepthNoise() if noise is None else noise,
        )
        for name, (serial, place, direction) in places.items()
    )


def color_intrinsics(width: int, height: int) -> Intrinsics:
    """Of a D435's colour camera: images of all shapes are cut from the full height."""
    focal = _COLOR_FOCAL * height
    return Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _smooth(rng: np.random.Generator, shape: tuple[int, ...], width_px: float) -> Floats:
    """[H, W] normal noise of unit variance, smoothed."""
    white = rng.standard_normal(shape)
    if width_px <= 0:
        return white
    smooth = gaussian_filter(white, width_px, mode="wrap", truncate=3.0)
    kernel = gaussian_filter(np.eye(1, 63, 31)[0], width_px, truncate=3.0)
    return smooth / (kernel**2).sum()
