"""What `diffcloud data capture` does: check, plan, ask, record."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import typer

from diffcloud.console import errors, finish, show_checks, warn
from diffcloud.errors import ConfigError, DiffCloudError, LimitError
from diffcloud.hardware import (
    ArmProcess,
    CaptureSettings,
    Limits,
    ToolTrajectory,
    capture,
    check_trajectory,
    conformance,
    drivers,
    read_trajectory,
)
from diffcloud.hardware.arm_limits import ArmChecker
from diffcloud.hardware.camera_settings import CameraSettings
from diffcloud.hardware.devices import Camera
from diffcloud.hardware.installed import Check
from diffcloud.hardware.kinova import KinovaArm
from diffcloud.hardware.motion import plan_motion
from diffcloud.hardware.realsense import RealSenseCamera
from diffcloud.hardware.rig import RigSettings, read_rig
from diffcloud.hardware.trajectory import check_control_rate
from diffcloud.io.calibrations import read_calibration
from diffcloud.io.labels import read_labels
from diffcloud.io.raw_episodes import exists_already
from diffcloud.sensing.robot import Robot, gen3

_CLEAR = "Is the workspace clear, and a hand on the emergency stop? The arm will move"


def open_arm(address: str, driver: str | None = None) -> ArmProcess:
    """The arm at an address; a Gen3's user and password come from DIFFCLOUD_ARM_USER and DIFFCLOUD_ARM_PASSWORD."""
    if driver is not None:
        return drivers.open_arm(driver, address)
    user, password = (os.environ.get(f"DIFFCLOUD_ARM_{name}", "admin") for name in ("USER", "PASSWORD"))
    return ArmProcess(partial(KinovaArm, address, username=user, password=password))


def make_camera(
    name: str,
    serial: str,
    driver: str | None = None,
    *,
    record_to: Path | None = None,
    settings: CameraSettings | None = None,
    **options: Any,
) -> Camera:
    """A camera, not yet open.

    Args:
        record_to: of a RealSense, where its own SDK records too.
        settings: of a RealSense.
        options: width, height and fps.
    """
    if driver is not None:
        return drivers.make_camera(driver, name, serial, **options)
    return RealSenseCamera(name, serial, record_to=record_to, warm_up=options["fps"] // 2, settings=settings, **options)


def run_capture(
    out: Path | None,
    *,
    rig: Path | None,
    trajectory: Path | None,
    seconds: float | None,
    check: Literal["arm", "cameras", "all"] | None,
    dry_run: bool,
    yes: bool,
    label: list[str] | None,
    home: bool,
    clear_faults: bool,
    keep_recording: bool,
    json: bool,
) -> None:
    """Do what `diffcloud data capture` was asked for; its options say what each is.

    Raises:
        ConfigError, LimitError, DiffCloudError: what contradicts, what is out of limits, what fails on the way.
    """
    setup = RigSettings() if rig is None else read_rig(rig)
    limits, arm_limits = setup.limits(), setup.arm_limits()
    labels = read_labels(label or [])
    robot = None if setup.urdf is None else Robot.from_urdf(setup.urdf)
    path = None
    if trajectory is not None:
        path = read_trajectory(trajectory, rate_hz=setup.control_rate_hz, stretch_time=setup.time_scale)
    if setup.camera_driver is not None and keep_recording:
        raise ConfigError(
            f"--keep-recording is for RealSense cameras, and {rig} names a camera_driver. Leave --keep-recording out."
        )

    def camera_of(name: str, record_to: Path | None = None) -> Camera:
        width, height = setup.image_size
        options = {"width": width, "height": height, "fps": setup.camera_rate_hz}
        asked = setup.camera_settings(name)
        return make_camera(name, setup.cameras[name], setup.camera_driver, record_to=record_to, settings=asked, **options)

    if check is not None:
        with_arm, with_cameras = check in ("arm", "all"), check in ("cameras", "all")
        if with_arm and setup.arm is None:
            raise ConfigError(f"--check {check} needs the arm's address: `arm` in the file that --rig names.")
        if with_cameras and not setup.cameras:
            raise ConfigError(f"--check {check} needs cameras: `cameras` in the file that --rig names.")
        cameras = [camera_of(name) for name in setup.cameras] if with_cameras else []
        checker = ArmChecker(robot or gen3(), limits, arm_limits) if with_arm else None
        connect = partial(open_arm, setup.arm or "", setup.arm_driver)
        _check(cameras, checker, connect, path, move=not dry_run, ask=not yes, json=json)
        return
    if out is None or not setup.cameras:
        raise ConfigError(
            "A capture needs --out, the folder of the episode, and --rig, a file whose `cameras` names at least one camera."
        )
    if out.exists():
        raise exists_already(out)
    arm = _moved_arm(setup, path, seconds, rig, readied=home or clear_faults)
    calibrated = {} if setup.calibration is None else read_calibration(setup.calibration).cameras
    for name, serial in setup.cameras.items():
        if setup.calibration is not None and serial not in calibrated:
            warn(f"{setup.calibration} has no camera {name} ({serial}); its pose is left open.")
    plan = _plan(path, setup.cameras, arm, limits)
    if path is not None:
        check_trajectory(path, limits)
        check_control_rate(setup.control_rate_hz)
    if dry_run:
        errors.print("Dry run: nothing was opened, nothing moved.")
        finish({"dry_run": True, "plan": plan}, json)
        return
    if arm is not None and not yes:
        typer.confirm(_CLEAR, abort=True, err=True)
    cameras = [camera_of(name, out.parent / f"{out.name}_{name}.db3" if keep_recording else None) for name in setup.cameras]
    settings = CaptureSettings(rate_hz=setup.control_rate_hz, frames_hz=setup.control_rate_hz, go_home=home)
    opened = None if arm is None else open_arm(arm, setup.arm_driver)
    try:
        if opened is not None and clear_faults:
            opened.clear_faults()
        report = capture(
            out,
            cameras,
            arm=opened,
            trajectory=path,
            limits=limits,
            arm_limits=arm_limits,
            robot=robot,
            settings=settings,
            seconds=seconds,
            meta=labels | ({"trajectory": trajectory.name} if trajectory is not None else {}),
            T_world_camera={serial: entry.T_world_camera for serial, entry in calibrated.items()},
            tell=errors.print,
        )
    except BaseException:
        if (out / "episode.json").is_file():
            errors.print(f"What was recorded so far is in {out!s}; check it with: diffcloud data check {out!s}")
        raise
    finally:
        if opened is not None:
            opened.close()
    dropped = {camera.name: getattr(camera, "dropped", 0) for camera in cameras}  # not all drivers count them
    if any(dropped.values()):
        warn(
            f"Frames that the cameras lost: {dropped}. Use USB 3, a controller for each camera, or a lower camera_rate_hz "
            f"in {rig}."
        )
    errors.print(f"{report.frames} frames and {report.robot_rows} robot rows in {report.seconds:.1f} s to {out!s}.")
    result = {"out": str(out), "frames": report.frames, "robot_rows": report.robot_rows, "seconds": report.seconds}
    finish(result | {"largest_error_m": report.largest_error_m, "dropped": dropped}, json)


def _moved_arm(
    setup: RigSettings, path: ToolTrajectory | None, seconds: float | None, rig: Path | None, *, readied: bool
) -> str | None:
    """Return the address of the arm that a capture moves, or None if it records cameras alone.

    Args:
        readied: whether --home or --clear-faults is given.

    Raises:
        ConfigError: neither a trajectory nor a time, both, or options of an arm that does not move.
    """
    if path is None:
        if not (seconds is not None and seconds > 0):
            raise ConfigError(
                "A capture ends with its trajectory or after a time, and neither was given. Give --trajectory to move the "
                "arm, or --seconds, above 0, to record cameras alone."
            )
        if readied:
            raise ConfigError("Without --trajectory the arm is not opened. Leave --home and --clear-faults out.")
        return None
    if seconds is not None:
        raise ConfigError("A trajectory has a duration of its own. Give --trajectory or --seconds, not both.")
    if setup.arm is None:
        raise ConfigError(f"A trajectory needs an arm, and {rig} names none. Add its address: `arm: 192.168.1.10`.")
    return setup.arm


def _check(
    cameras: Sequence[Camera],
    checker: ArmChecker | None,
    connect: Callable[[], ArmProcess],
    path: ToolTrajectory | None,
    *,
    move: bool,
    ask: bool,
    json: bool,
) -> None:
    """Check cameras and arm and print the results; exit status 1 if something is wrong. The arm is read but moves only if
    `move` is set."""
    checks: list[Check] = []
    for camera in cameras:
        checks += [replace(one, name=f"camera {camera.name}: {one.name}") for one in conformance.check_camera(camera)]
    failure: DiffCloudError | typer.Abort | None = None
    if checker is not None:
        try:
            if path is not None:
                check_trajectory(path, checker.limits)
                with closing(connect()) as arm:
                    checks.append(_planned(arm, checker, path))
            if ask and move:
                typer.confirm(_CLEAR, abort=True, err=True)
            for one in conformance.check_arm(connect, checker, move=move, say=errors.print, ask=_request if ask else None):
                checks.append(replace(one, name=f"arm: {one.name}"))
        except (DiffCloudError, typer.Abort) as error:  # what was found before it is printed first
            failure = error
    show_checks(checks, json)
    wrong = [one.name for one in checks if one.state != "ok"]
    finish({"checks": [asdict(one) for one in checks], "wrong": wrong}, json)
    if failure is not None:
        raise failure
    if wrong:
        raise typer.Exit(1)


def _request(text: str) -> None:
    typer.prompt(text, default="", show_default=False, err=True)


def _planned(arm: ArmProcess, checker: ArmChecker, path: ToolTrajectory) -> Check:
    """Whether the arm, from where it is, may go along the trajectory: joints, singularity, links, table."""
    try:
        plan_motion(checker, path, arm.read(), speed_m_s=CaptureSettings.approach_speed_m_s)
    except LimitError as error:
        return Check("arm: trajectory", "wrong", str(error))
    return Check("arm: trajectory", "ok", f"{len(path.times)} keyframes within joints, reach and box, above the table")


def _plan(path: ToolTrajectory | None, serials: dict[str, str], arm: str | None, limits: Limits) -> dict[str, Any]:
    """Print and return what is going to happen."""
    plan: dict[str, Any] = {"cameras": serials, "arm": arm}
    errors.print(f"Cameras: {', '.join(f'{name} ({serial})' for name, serial in serials.items())}. Arm: {arm or 'none'}.")
    if path is not None:
        plan |= {
            "keyframes": len(path.times),
            "seconds": path.duration_s,
            "low_m": path.positions.min(axis=0).tolist(),
            "high_m": path.positions.max(axis=0).tolist(),
            "speed_m_s": float(np.linalg.norm(path.velocities, axis=1).max()),
            "acceleration_m_s2": float(np.linalg.norm(path.accelerations, axis=1).max()),
        }
        errors.print(
            f"{plan['keyframes']} keyframes in {plan['seconds']:.1f} s from {path.positions[0].round(3).tolist()} to "
            f"{path.positions[-1].round(3).tolist()} m, within {np.round(plan['low_m'], 3).tolist()} to "
            f"{np.round(plan['high_m'], 3).tolist()} (box {limits.box_low_m} to {limits.box_high_m}); at most "
            f"{plan['speed_m_s']:.2f} of {limits.speed_m_s:g} m/s, {plan['acceleration_m_s2']:.2f} of "
            f"{limits.acceleration_m_s2:g} m/s²; stopped beyond {limits.force_N:g} N or {limits.torque_Nm:g} N·m.",
            soft_wrap=True,
        )
    return plan
