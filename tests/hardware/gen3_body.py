"""The joints of a Gen3 whose tool is somewhere: what the loopback arm and the point arm report."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from diffcloud.sensing.robot import GEN3_HOME_RAD, Robot, gen3


@cache
def robot() -> Robot:
    return gen3()


@cache
def home_pose() -> np.ndarray:
    """[4, 4]; not to be written to."""
    return robot().tool_pose(GEN3_HOME_RAD)


class Gen3Body:
    """Joints that follow the tool, each from where they were."""

    def __init__(self, joints_rad=GEN3_HOME_RAD):
        self.joints = np.array(joints_rad, dtype=float)

    @property
    def pose(self):
        return robot().tool_pose(self.joints)

    def move_tool(self, position, rotation):
        """[7] joints with the tool at `position` [3], `rotation` [3, 3]."""
        self.joints = robot().inverse_kinematics(position, rotations=rotation, start_rad=self.joints, tolerance_m=1e-7)
        return self.joints.copy()


def quaternion(rotation):
    """(w, x, y, z) of [3, 3]."""
    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)
