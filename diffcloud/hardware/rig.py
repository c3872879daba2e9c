"""The set-up of a lab, which rig.yaml describes: cameras, arm, limits of a motion, calibration board.

`capture` and `calibrate` read it. Paths in the file are relative to the file's folder.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import BeforeValidator, Field, ValidationError, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.hardware.arm_limits import ArmLimits
from diffcloud.hardware.camera_settings import CameraSettings, Pace
from diffcloud.hardware.trajectory import Limits
from diffcloud.io.files import read_yaml
from diffcloud.io.schema import explain
from diffcloud.sensing.calibration.charuco import CharucoBoard
from diffcloud.settings import Name, Pixels, Section


def _serial(value: object) -> object:
    """Return a serial number without quotes as text. The reader of YAML files keeps leading zeros."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Serial = Annotated[str, BeforeValidator(_serial), Field(min_length=1, max_length=1000)]
CameraName = Annotated[str, Field(pattern=r"^\w[\w.-]*$", max_length=200)]
"""The name of the camera's folder in the episode."""
_Metres = Annotated[float, Field(ge=-10, le=10)]
"""A coordinate within ten metres of the base. Larger numbers are millimetres."""
_Corner = tuple[_Metres, _Metres, _Metres]


def _refuse(message: str) -> PydanticCustomError:
    """Return an error that shows the message as it is."""
    return PydanticCustomError("rig", "{message}", {"message": message})


class BoardSettings(Section):
    """The printed ChArUco board, for `diffcloud data calibrate`."""

    squares: tuple[Annotated[int, Field(ge=3, le=100)], Annotated[int, Field(ge=3, le=100)]] = (
        CharucoBoard.columns,
        CharucoBoard.rows,
    )
    """Columns and rows of squares."""
    square_m: Annotated[float, Field(gt=0, lt=1)] = CharucoBoard.square_m
    """Side of a square, measured with a calliper."""
    marker_m: Annotated[float, Field(gt=0, lt=1)] = CharucoBoard.marker_m
    """Side of a marker, measured with a calliper; smaller than the square's."""
    dictionary: Name = CharucoBoard.dictionary
    """Dictionary of the markers, as OpenCV names it."""

    def charuco(self) -> CharucoBoard:
        """Return the board."""
        return CharucoBoard(*self.squares, self.square_m, self.marker_m, self.dictionary)

    @field_validator("marker_m")
    @classmethod
    def _inside_its_square(cls, marker_m: float, info: ValidationInfo) -> float:
        square_m = info.data.get("square_m")
        if square_m is not None and marker_m >= square_m:
            raise _refuse(f"A marker must be smaller than its square of {square_m:g} m. Measure both sides")
        return marker_m

    @field_validator("dictionary")
    @classmethod
    def _is_known(cls, dictionary: str) -> str:
        import cv2  # imported here, because only few files need it

        known = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
        if dictionary not in known:
            raise _refuse(unknown_name("dictionary", dictionary, known).rstrip("."))
        return dictionary


class RigSettings(Section):
    """The set-up of a lab, for `diffcloud data capture` and `diffcloud data calibrate`."""

    cameras: dict[CameraName, Serial] = Field(default_factory=dict, max_length=64)
    """Name of each camera and its serial number; a driver of your own may read something else than a serial number."""
    arm: Name | None = None
    """Address of the arm, such as 192.168.1.10."""
    arm_driver: Name | None = None
    """Driver of an arm that is not a Gen3, as module:Class."""
    image_size: tuple[Pixels, Pixels] = (640, 480)
    """Width and height of the images in pixels."""
    camera_rate_hz: Annotated[int, Field(ge=1, le=1000)] = 30
    """Frames per second that the cameras deliver; frames beyond `control_rate_hz` are not written."""
    control_rate_hz: Annotated[float, Field(gt=0, le=1000)] = 10.0
    """Rate of velocity commands, of written frames, and of keyframes without times."""
    preset: Name | None = None
    """Visual preset of RealSense depth sensors, such as high_accuracy; null leaves the camera's own."""
    laser_power_mw: Annotated[float, Field(ge=0, le=10_000)] | None = None
    """Power of RealSense projectors in milliwatts; 0 switches them off, null leaves the camera's own."""
    master: Name | None = None
    """Name of the RealSense camera whose trigger the others follow over a sync cable."""
    auto_exposure: bool = False
    """Whether RealSense cameras keep adjusting exposure, gain and white balance while they record."""
    camera_driver: Name | None = None
    """Driver of cameras that are not RealSense, as module:Class."""
    calibration: Path | None = None
    """Calibration file of `diffcloud data calibrate`, whose poses go into camera.json."""
    workspace_m: tuple[_Corner, _Corner] = (Limits.box_low_m, Limits.box_high_m)
    """Lowest and highest corner of the box in the base frame that the tool must not leave."""
    table_height_m: _Metres = ArmLimits.table_m
    """Height of the table in the base frame; no moving link may be lower."""
    speed_m_s: Annotated[float, Field(gt=0, le=10)] = Limits.speed_m_s
    """Limit of the tool's speed."""
    acceleration_m_s2: Annotated[float, Field(gt=0, le=100)] = Limits.acceleration_m_s2
    """Limit of the tool's acceleration."""
    force_n: Annotated[float, Field(gt=0, le=1000)] = Limits.force_N
    """Limit of the change of the force at the tool while it moves."""
    torque_nm: Annotated[float, Field(gt=0, le=1000)] = Limits.torque_Nm
    """Limit of the change of the torque at the tool while it moves."""
    static_force_n: Annotated[float, Field(gt=0, le=1000)] = Limits.preload_N
    """Limit of the force at rest; the limit of the torque at rest, in N·m, is a third of this number."""
    link_margin_m: Annotated[float, Field(gt=0, le=10)] = ArmLimits.margin_m
    """How far links may reach beyond the workspace box and the base."""
    urdf: Path | None = None
    """Description of the arm with its tool; null is a Gen3 with a 2F-85."""
    time_scale: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """Factor on the times of trajectories; 2 is half as fast."""
    board: BoardSettings = BoardSettings()

    def limits(self) -> Limits:
        """Return the limits of the tool."""
        low, high = self.workspace_m
        return Limits(
            low, high, self.speed_m_s, self.acceleration_m_s2, self.force_n, self.torque_nm,
            preload_N=self.static_force_n,
            preload_Nm=self.static_force_n * Limits.preload_Nm / Limits.preload_N,
        )  # fmt: skip

    def arm_limits(self) -> ArmLimits:
        """Return the limits of joints and links."""
        return ArmLimits(table_m=self.table_height_m, margin_m=self.link_margin_m)

    def camera_settings(self, name: str) -> CameraSettings:
        """Return what a RealSense camera of this name is set to."""
        pace: Pace | None = None if self.master is None else "master" if name == self.master else "slave"
        return CameraSettings(not self.auto_exposure, self.preset, self.laser_power_mw, pace)

    def relative_to(self, folder: Path) -> Self:
        """Return the settings with paths that begin at `folder`."""
        paths = {"calibration": self.calibration, "urdf": self.urdf}
        return self.model_copy(update={key: folder / path for key, path in paths.items() if path is not None})

    @field_validator("cameras")
    @classmethod
    def _each_serial_once(cls, cameras: dict[str, str]) -> dict[str, str]:
        serials = list(cameras.values())
        doubled = sorted({serial for serial in serials if serials.count(serial) > 1})
        if doubled:
            raise _refuse(f"Two cameras have the serial number {doubled[0]}. Give each camera its own")
        return cameras

    @field_validator("master")
    @classmethod
    def _is_a_camera(cls, master: str | None, info: ValidationInfo) -> str | None:
        cameras = info.data.get("cameras")
        if master is not None and cameras is not None and master not in cameras:
            raise _refuse(unknown_name("camera", master, cameras).rstrip("."))
        return master

    @field_validator("camera_driver")
    @classmethod
    def _has_its_own_settings(cls, driver: str | None, info: ValidationInfo) -> str | None:
        given = [name for name in ("preset", "laser_power_mw", "master") if info.data.get(name) is not None]
        given += ["auto_exposure"] if info.data.get("auto_exposure") else []
        if driver is not None and given:
            raise _refuse(f"{', '.join(given)} are for RealSense cameras. Remove them, or remove camera_driver")
        return driver

    @field_validator("workspace_m")
    @classmethod
    def _has_volume(cls, corners: tuple[_Corner, _Corner]) -> tuple[_Corner, _Corner]:
        low, high = corners
        if not all(a < b for a, b in zip(low, high, strict=True)):
            raise _refuse("The first corner must be lower than the second on each axis")
        return corners


def read_rig(path: Path) -> RigSettings:
    """Read rig.yaml.

    Raises:
        ConfigError: an unreadable file, an unknown key, or a value that is not allowed; names the file and the key.
    """
    path = Path(path)
    data = read_yaml(path, error=ConfigError, kind="description of the rig")
    try:
        return RigSettings.model_validate({} if data is None else data).relative_to(path.parent)
    except ValidationError as error:
        raise explain(path, error, ConfigError) from error
