"""A capture in a process of its own, for tests that suspend, kill or interrupt it.

    python -m tests.hardware.capturing TCP_PORT UDP_PORT FOLDER WATCHDOG_S

The tool moves sideways by 0.35 m at the default limit of 0.1 m/s.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import numpy as np

from diffcloud.hardware import ArmProcess, CaptureSettings, ToolTrajectory, capture
from tests.hardware.kortex.opening import connect
from tests.hardware.kortex.server import HOME_M
from tests.hardware.simulated import TestCard

SPEED_M_S = 0.1


def sideways() -> ToolTrajectory:
    return ToolTrajectory(np.array([0.0, 3.5]), np.stack([HOME_M, np.add(HOME_M, [0.0, 3.5 * SPEED_M_S, 0.0])]))


def main() -> None:
    tcp_port, udp_port, folder, watchdog_s = sys.argv[1:]
    arm = ArmProcess(partial(connect, int(tcp_port), int(udp_port)), watchdog_s=float(watchdog_s))
    print(arm.pid, flush=True)
    try:
        capture(
            Path(folder),
            [TestCard(fps=30)],
            arm=arm,
            trajectory=sideways(),
            settings=CaptureSettings(durable=False),
            tell=print,
        )
    finally:
        arm.close()


if __name__ == "__main__":
    main()
