"""Live view of clouds in a browser, based on viser (https://viser.studio), which the extra `live` installs."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from types import TracebackType
from typing import Self

import numpy as np

from diffcloud.errors import ConfigError
from diffcloud.live.follower import LiveFrame
from diffcloud.sensing.cameras import Floats

_POINT_M = 0.004
_TINTS = ((70, 120, 200), (220, 140, 60), (90, 170, 110), (180, 90, 170))
"""Colours for the points of cameras without colour images."""
_AXES_M = 0.1
_FROM_M = np.array([0.9, -0.9, 0.8])
"""Initial viewpoint, relative to the centre of the clouds."""


class LivePage:
    """A web page that shows the newest frame. Close it with `close`, or use it as a context manager.

    Args:
        port: local port; other computers cannot open the page. If it is taken, the next free one is used (see `url`).

    Raises:
        ConfigError: viser is not installed.
    """

    def __init__(self, *, port: int = 8080, title: str = "") -> None:
        try:
            import viser
        except ImportError as error:
            raise ConfigError("Watching needs viser: pip install 'diffcloud[live]'.") from error
        with redirect_stdout(io.StringIO()):  # hides viser's own banner; the command prints one line instead
            self._server = viser.ViserServer(host="127.0.0.1", port=port, label=title, verbose=False)
        self._server.scene.set_up_direction("+z")
        self._server.scene.add_frame("/base", axes_length=_AXES_M, axes_radius=_AXES_M / 25)
        self._text = self._server.gui.add_markdown("Waiting for the first frame.")
        self._aimed = False

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.get_port()}"

    def show(self, frame: LiveFrame) -> None:
        """Replace the displayed frame."""
        from viser.transforms import SO3

        scene = self._server.scene
        lines = [f"**{frame.status}**", ""]
        for index, (name, cloud) in enumerate(frame.clouds.items()):
            tint = np.array(_TINTS[index % len(_TINTS)], dtype=np.uint8)
            colors = np.broadcast_to(tint, cloud.points.shape) if cloud.colors is None else cloud.colors
            scene.add_point_cloud(f"/{name}/cloud", cloud.points.astype(np.float32), colors, point_size=_POINT_M)
            pose, lens = cloud.T_world_camera, cloud.intrinsics
            scene.add_camera_frustum(
                f"/{name}/camera",
                fov=2 * float(np.arctan(lens.height / 2 / lens.fy)),
                aspect=lens.width / lens.height,
                scale=_AXES_M / 2,
                color=_TINTS[index % len(_TINTS)],
                wxyz=SO3.from_matrix(pose[:3, :3]).wxyz,
                position=pose[:3, 3],
            )
            lines.append(f"- {name}: frame {cloud.frame}, {cloud.t_s:.2f} s, {len(cloud.points)} points")
        if frame.tool is not None:
            scene.add_icosphere("/tool", radius=0.015, color=(230, 60, 60), position=frame.tool)
            lines.append(f"- tool (red): {', '.join(f'{value:.3f}' for value in frame.tool)} m")
        self._text.content = "\n".join(lines)
        if frame.clouds and not self._aimed:
            self._aim(np.median(np.concatenate([cloud.points for cloud in frame.clouds.values()]), axis=0))

    def _aim(self, centre: Floats) -> None:
        """Point current and future viewers at the scene from close up."""
        self._aimed = True
        first = self._server.initial_camera
        first.position, first.look_at = centre + _FROM_M, centre
        for client in self._server.get_clients().values():
            client.camera.position, client.camera.look_at = centre + _FROM_M, centre

    def close(self) -> None:
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
