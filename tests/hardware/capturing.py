"""A capture in a process of its own, for tests that suspend, kill or interrupt it.

    python -m tests.hardware.capturing TCP_PORT UDP_PORT FOLDER WATCHDOG_S

The tool moves sideways by 0.3 m, a little slower than the default limit of 0.1 m/s.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np

from diffcloud.hardware import ArmProcess, CaptureSettings, ToolTrajectory, capture
from tests.hardware.kortex.opening import connect
from tests.hardware.kortex.server import HOME_M
from tests.hardware.simulated import TestCard

SPEED_M_S = 0.1
ROOT = Path(__file__).parents[2]


def sideways() -> ToolTrajectory:
    return ToolTrajectory(np.array([0.0, 3.01]), np.stack([HOME_M, np.add(HOME_M, [0.0, 3.0 * SPEED_M_S, 0.0])]))


class Capture:
    """A capture in a session of its own, as a terminal starts it; entered once the arm is at full speed."""

    def __init__(self, server, folder, watchdog_s):
        self._server = server
        arguments = [str(server.tcp_port), str(server.udp_port), str(folder), str(watchdog_s)]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.hardware.capturing", *arguments],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def __enter__(self):
        self.arm_pid = int(self.process.stdout.readline())
        end = time.monotonic() + 60
        while not self._server.twist_times and time.monotonic() < end and self.process.poll() is None:
            time.sleep(0.02)
        time.sleep(0.5)
        return self

    def signal(self, number):
        """As a terminal sends it, to all processes of the foreground; where the tool was then."""
        before = self._server.position
        os.killpg(self.process.pid, number)
        return before

    def end(self):
        """(status, output, errors)."""
        output, errors = self.process.communicate(timeout=30)
        return self.process.returncode, output, errors

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self.process.stdout.close()
        self.process.stderr.close()


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
