"""`diffcloud capture`: record a raw episode with depth cameras and an arm."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from diffcloud.cli.console import JsonFlag, errors, finish, named_serials, show_checks, warn, whole_numbers
from diffcloud.errors import ConfigError, DiffCloudError, LimitError, unknown_name
from diffcloud.hardware import (
    ArmLimits,
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
from diffcloud.hardware.camera_settings import CameraSettings, Pace
from diffcloud.hardware.devices import Camera
from diffcloud.hardware.installed import Check
from diffcloud.hardware.kinova import KinovaArm
from diffcloud.hardware.motion import plan_motion
from diffcloud.hardware.realsense import RealSenseCamera
from diffcloud.hardware.trajectory import check_control_rate
from diffcloud.io.calibrations import read_calibration
from diffcloud.io.raw_episodes import exists_already
from diffcloud.sensing.robot import Robot, gen3

_BOX = ",".join(f"{value:g}" for value in (*Limits.box_low_m, *Limits.box_high_m))
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


def record(
    out: Annotated[
        Path | None, typer.Option(help="Folder of the episode, such as raw/episodes/lift/tan1; must not exist.")
    ] = None,
    camera: Annotated[list[str] | None, typer.Option(help="NAME=SERIAL; one or more.")] = None,
    trajectory: Annotated[
        Path | None, typer.Option(help="CSV (t_s, x, y, z[, gripper]) or NPY [T, 3]: tool in the base frame, metres.")
    ] = None,
    arm: Annotated[str | None, typer.Option(help="Address of the arm.")] = None,
    arm_driver: Annotated[
        str | None, typer.Option(help="module:Class of the driver, if the arm is not a Gen3 (docs/drivers.md).")
    ] = None,
    camera_driver: Annotated[
        str | None, typer.Option(help="module:Class of the driver, if the cameras are not RealSense (docs/drivers.md).")
    ] = None,
    check_arm: Annotated[
        bool, typer.Option("--check-arm", help="Record nothing; move the arm a little, check what a capture relies on.")
    ] = False,
    check_cameras: Annotated[
        bool, typer.Option("--check-cameras", help="Record nothing; check what the cameras deliver.")
    ] = False,
    seconds: Annotated[float | None, typer.Option(help="How long to record without an arm, s.")] = None,
    rate_hz: Annotated[float, typer.Option("--rate", help="Hz, of control, frames, and keyframes without times.")] = 10.0,
    fps: Annotated[int, typer.Option(help="Frame rate of the cameras; frames beyond --rate are not written.")] = 30,
    size: Annotated[str, typer.Option(help="Size of the images, WIDTHxHEIGHT.")] = "640x480",
    preset: Annotated[
        str | None, typer.Option(help="Visual preset of RealSense depth sensors, such as high_accuracy.")
    ] = None,
    laser: Annotated[float | None, typer.Option(help="Power of RealSense projectors, mW; 0 is off.")] = None,
    master: Annotated[
        str | None, typer.Option(help="Name of the RealSense camera whose trigger the others follow (sync cable).")
    ] = None,
    auto_exposure: Annotated[
        bool, typer.Option("--auto-exposure", help="Do not hold exposure, gain and white balance while recording.")
    ] = False,
    calibration: Annotated[Path | None, typer.Option(help="Calibration file; its poses go into camera.json.")] = None,
    box: Annotated[
        str | None, typer.Option(help=f"Workspace: x0,y0,z0,x1,y1,z1 in metres, in the base frame; {_BOX} if not given.")
    ] = None,
    speed: Annotated[float, typer.Option(help="Limit of the tool's speed, m/s.")] = Limits.speed_m_s,
    acceleration: Annotated[float, typer.Option(help="Limit of its acceleration, m/s².")] = Limits.acceleration_m_s2,
    force: Annotated[float, typer.Option(help="Limit of the change of the force at the tool, N.")] = Limits.force_N,
    torque: Annotated[float, typer.Option(help="Limit of the change of the torque, N·m.")] = Limits.torque_Nm,
    preload: Annotated[
        float, typer.Option(help="Limit of the force at rest, N; the torque's, N·m, is a third of it.")
    ] = Limits.preload_N,
    table: Annotated[float, typer.Option(help="Height of the table in the base frame, m; no link may be lower.")] = (
        ArmLimits.table_m
    ),
    arm_margin: Annotated[
        float, typer.Option(help="How far links may reach beyond the workspace box and the base, m.")
    ] = ArmLimits.margin_m,
    urdf: Annotated[
        Path | None, typer.Option(help="Description of the arm with its tool; without it, a Gen3 with a 2F-85.")
    ] = None,
    stretch_time: Annotated[float, typer.Option(help="Factor on the trajectory's times; 2 is half as fast.")] = 1.0,
    home: Annotated[bool, typer.Option(help="Move to the arm's home position first.")] = False,
    clear_faults: Annotated[bool, typer.Option(help="Clear the arm's faults first.")] = False,
    keep_recording: Annotated[bool, typer.Option(help="Also keep the SDK's own .db3 beside the episode.")] = False,
    scenario: Annotated[str | None, typer.Option(help="Name that is kept in episode.json.")] = None,
    fabric: Annotated[str | None, typer.Option(help="Name that is kept in episode.json.")] = None,
    dry_run: Annotated[bool, typer.Option(help="Check the plan; open nothing. With --check-arm: move nothing.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before the arm moves, nor for a pulled cable.")] = False,
    json: JsonFlag = False,
) -> None:
    """Drive the arm along a trajectory and record cameras and arm, writing to disk while it runs.

    The arm is stopped whatever ends the capture: the trajectory's end, a limit, a fault, a lost camera, Ctrl-C or Ctrl-Z,
    even if this process is killed. What was recorded so far stays.
    """
    limits = _limits(
        box,
        speed_m_s=speed,
        acceleration_m_s2=acceleration,
        force_N=force,
        torque_Nm=torque,
        preload_N=preload,
        preload_Nm=preload * Limits.preload_Nm / Limits.preload_N,
    )
    arm_limits = ArmLimits(table_m=table, margin_m=arm_margin)
    robot = None if urdf is None else Robot.from_urdf(urdf)
    path = None if trajectory is None else read_trajectory(trajectory, rate_hz=rate_hz, stretch_time=stretch_time)
    serials = named_serials(camera or [], "--camera")
    width, height = whole_numbers(size, "--size")
    if not rate_hz > 0:
        raise ConfigError(f"--rate is in Hz, above 0, got {rate_hz:g}.")
    options: dict[str, Any] = {"width": width, "height": height, "fps": fps}
    of_realsense = any(option is not None for option in (preset, laser, master)) or auto_exposure or keep_recording
    if camera_driver is not None and of_realsense:
        raise ConfigError(
            "--preset, --laser, --master, --auto-exposure and --keep-recording are for RealSense cameras, without "
            "--camera-driver."
        )
    if master is not None and master not in serials:
        raise ConfigError(unknown_name("--master", master, serials))

    def camera_of(name: str, record_to: Path | None = None) -> Camera:
        asked = CameraSettings(not auto_exposure, preset, laser, None if master is None else _pace(name, master))
        return make_camera(name, serials[name], camera_driver, record_to=record_to, settings=asked, **options)

    if check_arm or check_cameras:
        if check_arm and arm is None:
            raise ConfigError("--check-arm needs the arm's address: --arm.")
        if check_cameras and not serials:
            raise ConfigError("--check-cameras needs cameras: --camera NAME=SERIAL.")
        cameras = [camera_of(name) for name in serials] if check_cameras else []
        checker = ArmChecker(robot or gen3(), limits, arm_limits) if check_arm else None
        connect = partial(open_arm, arm or "", arm_driver)
        _check(cameras, checker, connect, path, move=not dry_run, ask=not yes, json=json)
        return
    if out is None or not serials:
        raise ConfigError("A capture needs --out, the folder of the episode, and at least one --camera NAME=SERIAL.")
    if out.exists():
        raise exists_already(out)
    calibrated = {} if calibration is None else read_calibration(calibration).cameras
    for name, serial in serials.items():
        if calibration is not None and serial not in calibrated:
            warn(f"{calibration} has no camera {name} ({serial}); its pose is left open.")
    plan = _plan(path, serials, arm, limits)
    if path is not None:
        check_trajectory(path, limits)
        check_control_rate(rate_hz)
    if dry_run:
        errors.print("Dry run: nothing was opened, nothing moved.")
        finish({"dry_run": True, "plan": plan}, json)
        return
    if arm is not None and not yes:
        typer.confirm(_CLEAR, abort=True, err=True)
    cameras = [camera_of(name, out.parent / f"{out.name}_{name}.db3" if keep_recording else None) for name in serials]
    settings = CaptureSettings(rate_hz=rate_hz, frames_hz=rate_hz, go_home=home)
    opened = None if arm is None else open_arm(arm, arm_driver)
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
            meta={key: value for key, value in (("scenario", scenario), ("fabric", fabric)) if value is not None}
            | ({"trajectory": trajectory.name} if trajectory is not None else {}),
            T_world_camera={serial: entry.T_world_camera for serial, entry in calibrated.items()},
            tell=errors.print,
        )
    except BaseException:
        if (out / "episode.json").is_file():
            errors.print(f"What was recorded so far is in {out!s}; check it with: diffcloud episode validate {out!s}")
        raise
    finally:
        if opened is not None:
            opened.close()
    dropped = {camera.name: getattr(camera, "dropped", 0) for camera in cameras}  # not all drivers count them
    if any(dropped.values()):
        warn(f"Frames that the cameras lost: {dropped}. Use USB 3, a controller for each camera, or a lower --fps.")
    errors.print(f"{report.frames} frames and {report.robot_rows} robot rows in {report.seconds:.1f} s to {out!s}.")
    result = {"out": str(out), "frames": report.frames, "robot_rows": report.robot_rows, "seconds": report.seconds}
    finish(result | {"largest_error_m": report.largest_error_m, "dropped": dropped}, json)


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


def _pace(name: str, master: str) -> Pace:
    return "master" if name == master else "slave"


def _limits(box: str | None, **values: float) -> Limits:
    limits = Limits(**values)  # type: ignore[arg-type]  # the box, the only field that is no number, comes below
    if box is None:
        return limits
    try:
        x0, y0, z0, x1, y1, z1 = map(float, box.split(","))
    except ValueError as error:
        raise ConfigError(f"--box takes x0,y0,z0,x1,y1,z1 in metres, got {box!r}.") from error
    return replace(limits, box_low_m=(x0, y0, z0), box_high_m=(x1, y1, z1))


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
