"""A cloth that a gripper lifts by a corner, as a ROS recording of PointCloud2 messages with a tool."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from tests.io.ros_bag import START, Bag, Habits

FRAMES = 6
TYPES = {7: "f4", 8: "f8", 4: "u2", 3: "i2", 2: "u1"}
OPTICAL = np.eye(4)
OPTICAL[:3, :3] = Rotation.from_euler("xyz", [-120, 5, 40], degrees=True).as_matrix()
OPTICAL[:3, 3] = [0.9, -0.2, 0.8]
BASE_CAMERA = {"left_optical_frame": OPTICAL, "right_optical_frame": np.diag([1.0, -1, -1, 1]) + np.eye(4, k=3) * 0.6}


def cloud(number):
    """[N, 3] in the base frame: a cloth of 0.4 x 0.3 m, whose corner rises by 20 mm a frame."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0.4, 0.8, 25), np.linspace(-0.15, 0.15, 19)))
    lift = np.clip((x - 0.4) / 0.4 + (y + 0.15) / 0.3 - 1, 0, None)
    return np.column_stack([x, y, 0.02 + 0.02 * number * lift])


def tool_at(t):
    """[3] in the base frame at a time since the first cloud [s]; on a straight line until 0.3 s, then on another."""
    return np.array([0.8 - 0.05 * t, 0.15, 0.03 + 0.2 * t + 0.1 * max(t - 0.3, 0)])


@dataclass(frozen=True)
class Layout:
    """Bytes of a point cloud."""

    fields: tuple[tuple[str, int, int], ...] = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7))
    """(name, offset, datatype)."""
    step: int = 12
    big: bool = False
    rows: int = 1
    padding: int = 0
    """Bytes after each row."""
    holes: tuple[float, ...] = ()
    """A point of each of these values in every row."""
    dense: bool = True
    change: dict[str, int] = field(default_factory=dict)
    """Fields of the message that are damaged."""
    cut: int = 0
    """Bytes that are missing at the end."""

    def message(self, points):
        """Fields of a PointCloud2 without its header, the point fields as tuples."""
        rows = [list(part) for part in np.array_split(points, self.rows)]
        width = max(map(len, rows)) + len(self.holes)
        table = np.zeros((self.rows, width * self.step + self.padding), np.uint8)
        order = ">" if self.big else "<"
        for row, own in enumerate(rows):
            own = np.array([*[[hole] * 3 for hole in self.holes], *own, *[[np.nan] * 3] * width])[:width]
            for name, offset, kind in self.fields:
                values = own[:, "xyz".index(name)] if name in ("x", "y", "z") else np.full(width, 77)
                kind = np.dtype(order + TYPES.get(kind, "f4"))
                data = np.nan_to_num(values).astype(kind) if kind.kind in "iu" else values.astype(kind)
                cells = table[row, : width * self.step].reshape(width, self.step)
                part = data.view(np.uint8).reshape(width, -1)[:, : self.step - offset]
                cells[:, offset : offset + part.shape[1]] = part
        data = table.ravel()[: table.size - self.cut]
        sizes = {"height": self.rows, "width": width, "point_step": self.step, "row_step": table.shape[1]}
        return {**sizes, "is_bigendian": self.big, "is_dense": self.dense, "data": data, **self.change}


PLAIN = Layout()


class CloudBag(Bag):
    """Writes clouds at 10 Hz, and what else is asked for.

    Args:
        clouds: topic -> (frame, layout, stamp of a frame after its time [s]).
    """

    def __init__(self, path, kind="rosbag2", *, clouds=None, empty=()):
        super().__init__(path, kind, Habits())
        self._clouds = {"/cloth/points": ("left_optical_frame", PLAIN, 0.0)} if clouds is None else clouds
        self._empty = empty

    def points(self, topic, frame, layout, number, t):
        pose = BASE_CAMERA.get(frame, OPTICAL if "optical" in frame else np.eye(4))
        points = (cloud(number) - pose[:3, 3]) @ pose[:3, :3]
        told = layout.message(points if number not in self._empty else np.full((4, 3), np.nan))
        kind = self._type("sensor_msgs/msg/PointField")
        fields = [kind(name=name, offset=offset, datatype=form, count=1) for name, offset, form in layout.fields]
        self._send(topic, t, "sensor_msgs/msg/PointCloud2", frame=frame, arrival=START + number / 10, fields=fields, **told)

    def transform(self, topic, t, parent, child, pose):
        self._send(topic, t, "tf2_msgs/msg/TFMessage", header=False, transforms=[self.stamped(t, parent, child, pose)])

    def stamped(self, t, parent, child, pose):
        move = self._type("geometry_msgs/msg/Transform")(
            translation=self._type("geometry_msgs/msg/Vector3")(*pose[:3, 3]), rotation=self.turn(pose)
        )
        kind = self._type("geometry_msgs/msg/TransformStamped")
        return kind(header=self._header(t, parent), child_frame_id=child, transform=move)

    def turn(self, pose):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        return self._type("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)

    def pose(self, position):
        kind = self._type("geometry_msgs/msg/Pose")
        return kind(position=self._type("geometry_msgs/msg/Point")(*position), orientation=self.turn(np.eye(4)))

    def pose_stamped(self, topic, t, position, frame="base_link"):
        self._send(topic, t, "geometry_msgs/msg/PoseStamped", frame=frame, pose=self.pose(position))

    def odometry(self, topic, t, position):
        zero = self._type("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0)
        twist = self._type("geometry_msgs/msg/Twist")(linear=zero, angular=zero)
        many = np.zeros(36)
        pose = self._type("geometry_msgs/msg/PoseWithCovariance")(pose=self.pose(position), covariance=many)
        moving = self._type("geometry_msgs/msg/TwistWithCovariance")(twist=twist, covariance=many)
        self._send(topic, t, "nav_msgs/msg/Odometry", frame="base_link", child_frame_id="tool", pose=pose, twist=moving)

    def write(self, *, tf=True, stamps=lambda number: number / 10, tool=None, also=None):
        """
        Args:
            tool: called with this bag, the time of a pose [s] and the position; poses come at 25 Hz, from -0.1 s on.
            also: called with this bag at the end.
        """
        with self._writer:
            if tf:
                for frame, pose in BASE_CAMERA.items():
                    self.transform("/tf_static", START, "base_link", frame, pose)
            for number in range(FRAMES):
                for topic, (frame, layout, late) in self._clouds.items():
                    self.points(topic, frame, layout, number, START + stamps(number) + late)
            for step in range(20) if tool is not None else ():
                t = step / 25 - 0.1
                tool(self, START + t, tool_at(t))
            if also is not None:
                also(self)
