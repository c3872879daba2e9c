"""Connects to a loopback arm, in whichever process: what an `ArmProcess` is given in the tests."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

from diffcloud.errors import HardwareError
from diffcloud.hardware import ArmProcess
from diffcloud.hardware.kinova import KinovaArm, Kortex, load_kortex
from tests.hardware.kortex.client import MINIMAL


@cache
def client() -> Kortex:
    """Kinova's own library where it is installed, and otherwise the minimal one."""
    try:
        return load_kortex()
    except HardwareError:
        return MINIMAL


def connect(tcp_port: int, udp_port: int, *, address: str = "127.0.0.1", **options: Any) -> KinovaArm:
    return KinovaArm(address, kortex=client(), tcp_port=tcp_port, udp_port=udp_port, **options)


def in_process(server: Any, *, address: str = "127.0.0.1", **options: Any) -> ArmProcess:
    """The server's arm, in a process of its own."""
    return ArmProcess(partial(connect, server.tcp_port, server.udp_port, address=address), **options)
