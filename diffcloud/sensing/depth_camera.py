"""A stereo depth camera that looks at a surface: partial views, self-occlusion, and noise that grows with distance.

The model is a z-buffer over densely sampled surface points. Depth noise follows stereo triangulation,
σ_z = z² σ_px / (f · baseline), with the numbers of a RealSense D435.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_FLYING_FRACTION = 0.02
"""Part of the edge pixels that land between foreground and background."""
_EDGE_DROPOUT = 0.3
"""Part of the edge pixels without depth."""


@dataclass(frozen=True)
class DepthCamera:
    """A pinhole depth camera. Its frame is OpenCV's: x right, y down, z forward; pixel centres at whole numbers."""

    name: str
    T_world_camera: NDArray[np.float64]
    """[4, 4] maps camera points to world points [m]."""
    width: int = 320
    height: int = 240
    focal_px: float = 307.5
    baseline_m: float = 0.05
    subpixel_px: float = 0.04
    """Standard deviation of the disparity [px at this resolution]."""
    depth_scale_m: float = 0.001
    """Depth is a whole multiple of this [m]."""

    @staticmethod
    def looking_at(name: str, position: tuple[float, float, float], target: tuple[float, float, float]) -> DepthCamera:
        """A camera at `position` that looks at `target`, upright [m]."""
        forward = np.subtract(target, position)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(right) < 1e-6 else right / np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = position
        return DepthCamera(name, pose)

    def see(
        self, surface: NDArray[np.float64], rng: np.random.Generator
    ) -> tuple[NDArray[np.float64], NDArray[np.uint16], NDArray[np.float32]]:
        """What the camera measures of a densely sampled surface.

        Args:
            surface: [N, 3] world points, several per pixel [m].

        Returns:
            World points [P, 3] [m], their pixels [P, 2] (column, row), and the deviation of their depth [P] [m].
        """
        rotation, origin = self.T_world_camera[:3, :3], self.T_world_camera[:3, 3]
        local = (surface - origin) @ rotation
        local = local[local[:, 2] > 0.1]
        centre = np.array([(self.width - 1) / 2, (self.height - 1) / 2])
        pixel = np.rint(local[:, :2] / local[:, 2:] * self.focal_px + centre).astype(int)
        inside = ((pixel >= 0) & (pixel < [self.width, self.height])).all(axis=1)
        nearest = np.full(self.width * self.height, np.inf)
        np.minimum.at(nearest, (pixel[:, 1] * self.width + pixel[:, 0])[inside], local[inside, 2])
        depth = nearest.reshape(self.height, self.width)

        seen = np.isfinite(depth)
        padded = np.pad(seen, 1)
        surrounded = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
        edge = seen & ~surrounded
        seen &= ~(edge & (rng.random(seen.shape) < _EDGE_DROPOUT))
        row, column = np.nonzero(seen)
        z = depth[row, column]
        sigma = z**2 * self.subpixel_px / (self.focal_px * self.baseline_m)
        z = z + rng.normal(size=len(z)) * sigma
        flying = edge[row, column] & (rng.random(len(z)) < _FLYING_FRACTION)
        z = np.where(flying, z + rng.uniform(0.01, 0.06, len(z)), z)
        z = np.rint(z / self.depth_scale_m) * self.depth_scale_m
        rays = np.column_stack([(column - centre[0]) / self.focal_px, (row - centre[1]) / self.focal_px, np.ones(len(z))])
        points = (rays * z[:, None]) @ rotation.T + origin
        return points, np.column_stack([column, row]).astype(np.uint16), sigma.astype(np.float32)


def default_cameras(target: tuple[float, float, float]) -> tuple[DepthCamera, DepthCamera]:
    """An overhead and a side camera around a point, at the distances of the paper's set-up."""
    x, y, z = target
    return (
        DepthCamera.looking_at("overhead", (x + 0.45, y + 0.05, z + 0.75), target),
        DepthCamera.looking_at("side", (x + 0.05, y - 0.80, z + 0.25), target),
    )
