"""Model of a stereo depth camera (Intel RealSense D435): measured depth from true depth.

Images are depth aligned to colour, like real captures. The camera measures disparity d = f · baseline / z with its two
infrared imagers, which are beside the colour camera. So the standard deviation of depth grows with z², depth is
quantised by subpixel steps, and points that only one imager sees have no depth. f is the imagers' own focal length,
independent of the image size.
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
"""Neighbouring pixels are a border if their depths differ by more than this [m]."""
_HOLE_RADIUS_PX = 2.0
_COLOR_FOCAL = 614.9 / 480
"""Focal length of a D435's colour camera in image heights (from the published calibration)."""


@dataclass(frozen=True)
class DepthNoise:
    """Parameters of stereo matching errors."""

    subpixel_px: float = 0.08
    """Standard deviation of the disparity, in pixels of the imagers."""
    correlation_px: float = 0.7
    """Correlation length of the disparity errors, because matching windows overlap. White noise is smoothed by a
    Gaussian of this width, and its standard deviation is kept."""
    step_px: float = 1 / 32
    """Quantisation of the disparity."""
    focal_px: float = 425.0
    """Focal length of the imagers, at 848 columns."""
    baseline_m: float = 0.05
    edge_dropout: float = 0.3
    """Fraction of the border pixels without depth."""
    flying: float = 0.1
    """Fraction of the border pixels with a depth between foreground and background."""
    holes: float = 0.005
    """Fraction of the image in random patches without depth."""
    nearest_m: float = 0.2
    farthest_m: float = 4.0

    def sigma_m(self, depth_m: Floats) -> Floats:
        """Return the standard deviation of depth [m]: σ_z = z² σ_d / (f · baseline)."""
        return depth_m**2 * self.subpixel_px / (self.focal_px * self.baseline_m)


@dataclass(frozen=True)
class DepthCamera:
    """A depth camera with its pose and errors."""

    name: str
    serial: str
    view: View
    """True pose and intrinsics."""
    noise: DepthNoise = DepthNoise()
    imager_offsets_m: tuple[float, ...] = (0.015, 0.065)
    """Positions of the infrared imagers along the image's x [m]."""

    def info(self, stated: Floats | None = None) -> CameraInfo:
        """Return the content of camera.json. `stated` [4, 4] is the calibrated pose; by default the true one."""
        pose = self.view.T_world_camera if stated is None else stated
        return CameraInfo(self.name, self.serial, self.view.intrinsics, DEPTH_SCALE_M, pose)

    def measure(self, depth_m: Floats, hidden: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.uint16]:
        """Return the depth image [H, W] in millimetres; 0 is no measurement.

        Args:
            depth_m: [H, W] true z-depth; infinite for background.
            hidden: [H, W] pixels that are occluded from an imager.
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
    """Return an overhead and a side camera with the poses of the published recordings; depth is aligned to colour."""
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
    """Return the intrinsics of a D435's colour camera. Images of all aspect ratios use the full height."""
    focal = _COLOR_FOCAL * height
    return Intrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def _smooth(rng: np.random.Generator, shape: tuple[int, ...], width_px: float) -> Floats:
    """Return smoothed normal noise [H, W] of unit variance."""
    white = rng.standard_normal(shape)
    if width_px <= 0:
        return white
    smooth = gaussian_filter(white, width_px, mode="wrap", truncate=3.0)
    kernel = gaussian_filter(np.eye(1, 63, 31)[0], width_px, truncate=3.0)
    return smooth / (kernel**2).sum()
