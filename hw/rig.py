"""One rig, one TOML file: limits, start pose, action scale, cameras; what differs at a task's station in its own table.

[station.can]               # for the task `can` this is laid over the file's own settings, key by key
base = [-0.28, -0.08, 0.912]
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from far_app.config import Arm, TaskConfig, from_table
from far_app.errors import ConfigError
from far_app.motion import ActionScale
from hw.camera_config import CameraConfig, cameras_from
from hw.input_device.settings import InputDeviceSettings
from hw.xarm7.settings import XArmSettings

RIGS = Path(__file__).parent / "rigs"


STILL_BY = 0.15
"""Seconds after the last fresh target by which the commanded velocity is zero."""
WATCHDOG = 0.1
"""Seconds after the last fresh target at which the watchdog triggers at the latest."""
MOST = {
    "step_translation": 0.05, "step_rotation": 0.5, "speed": 1.0, "rotation_speed": math.pi, "acceleration": 50.0,
    "rotation_acceleration": 200.0,
}  # fmt: skip
"""What no rig file of a real arm can ask for more of: metres, radians and seconds."""


@dataclass(frozen=True, kw_only=True)
class SafetyLimits:
    """What the safety filter enforces, base frame."""

    box_min: tuple[float, float, float]
    """Metres."""
    box_max: tuple[float, float, float]
    """Metres."""
    step_translation: float = 0.012
    """Largest translation of one target beyond the last sent, metres."""
    step_rotation: float = 0.08
    """Largest rotation of one target beyond the last sent, radians."""
    speed: float = 0.36
    """Metres a second."""
    rotation_speed: float = 2.4
    """Radians a second."""
    acceleration: float = 10.0
    """Metres a second²."""
    rotation_acceleration: float = 70.0
    """Radians a second²."""
    turn: float = math.pi
    """Largest rotation of a target away from the start pose's orientation, radians. Wound up further than half a turn,
    the hand would take the short way home, into a joint's end."""
    upright: tuple[float, float, float, float] | None = None
    """The start pose's orientation (xyzw, base frame); a rig fills it in."""

    def __post_init__(self) -> None:
        if any(low >= high for low, high in zip(self.box_min, self.box_max, strict=True)):
            raise ConfigError(f"safety box_min {self.box_min} must lie below box_max {self.box_max} on every axis")
        for name in MOST:
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"safety {name} is {getattr(self, name)}, must be a number above 0")
        if self.turn > math.pi:
            raise ConfigError(f"safety turn is {self.turn}, must be at most π radians")

    @property
    def braking(self) -> float:
        """Seconds from full speed to rest."""
        return max(self.speed / self.acceleration, self.rotation_speed / self.rotation_acceleration)


@dataclass(frozen=True, kw_only=True)
class HomePath:
    """How fast to go home; where to is the start pose, how to let go is task data."""

    open_seconds: float = 0.5
    speed: float = 0.25
    """Metres a second along the path (peak of a smooth profile)."""
    rotation_speed: float = 1.2
    """Radians a second, peak."""
    tolerance_translation: float = 0.01
    """Metres from the start pose that count as home."""
    tolerance_rotation: float = 0.05
    """Radians."""

    def __post_init__(self) -> None:
        for name in ("open_seconds", "speed", "rotation_speed", "tolerance_translation", "tolerance_rotation"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"home {name} is {getattr(self, name)}, must be above 0")


@dataclass(frozen=True, kw_only=True)
class RigConfig:
    """Everything about one rig that is not the task."""

    name: str
    robot: str
    """"twin" or "xarm"."""
    arm: Arm = "xarm7"
    """Which arm it is, or is the twin of."""
    start_position: tuple[float, float, float]
    """Metres, base frame."""
    start_quaternion: tuple[float, float, float, float]
    """xyzw, base frame."""
    safety: SafetyLimits
    start_joints: tuple[float, ...] = ()
    """The start pose in joint space, radians (twin: where a scene reset puts the arm)."""
    base: tuple[float, ...] = ()
    """Where the twin's arm stands in its world, metres; where robosuite puts it when empty."""
    scale: ActionScale = field(default_factory=ActionScale)
    home: HomePath = field(default_factory=HomePath)
    watchdog: float = 0.1
    """Seconds after the last fresh target until the arm is held."""
    policy_image: int = 84
    """Pixels, square."""
    operator_image: int = 240
    """Pixels, square."""
    operator_rate: float = 12.0
    """Operator pictures a second."""
    cameras: Mapping[str, CameraConfig] | None = None
    """The file's [camera.NAME] tables; empty where it says cameras = [], none on purpose. None: the task's own views,
    which the twin draws."""
    input_device: InputDeviceSettings = field(default_factory=InputDeviceSettings)
    """What a person may move the arm with, at the robot PC."""
    xarm: XArmSettings = field(default_factory=XArmSettings)
    """A real xArm7's controller, tool and gripper."""

    def __post_init__(self) -> None:
        if self.robot not in ("twin", "xarm"):
            raise ConfigError(f"rig {self.name} drives a robot of kind '{self.robot}'; choose one of: twin, xarm")
        if self.robot == "xarm":
            self._check_real()

    def _check_real(self) -> None:
        """Rules that hold for a real arm whatever its rig file says."""
        if self.cameras is None:
            raise ConfigError(f"rig {self.name} names no cameras; say cameras = [] where it has none")
        for name, most in MOST.items():
            if getattr(self.safety, name) > most:
                raise ConfigError(f"safety {name} is {getattr(self.safety, name)}, must be at most {most:g}")
        if not 0.0 < self.watchdog <= WATCHDOG:
            raise ConfigError(f"rig {self.name}: watchdog is {self.watchdog} s, must be above 0 and at most {WATCHDOG}")
        if self.watchdog + self.safety.braking > STILL_BY + 1e-9:
            raise ConfigError(
                f"rig {self.name}: without targets the arm would stand still only "
                f"{1e3 * (self.watchdog + self.safety.braking):.0f} ms after the last (limit {1e3 * STILL_BY:.0f} ms: "
                f"watchdog, then braking for speed / acceleration); lower safety.speed or safety.rotation_speed, or "
                "raise the accelerations"
            )
        ticks = (("speed", self.xarm.servo_step, "m"), ("rotation_speed", self.xarm.servo_turn, "rad"))
        for name, per_tick, unit in ticks:
            asked, allowed = getattr(self.safety, name), 100.0 * per_tick
            if asked > allowed + 1e-9:
                raise ConfigError(
                    f"rig {self.name}: safety.{name} is {asked} {unit}/s, but servo ticks of at most {per_tick:g} "
                    f"{unit} at 100 Hz allow {allowed:g} {unit}/s; lower the one or raise the other"
                )

    def scale_for(self, task: TaskConfig) -> ActionScale:
        """What ±1 means in a tick of the task."""
        return self.scale.repeated(task.repeat)


def load_rig(name_or_path: str, task: str = "") -> RigConfig:
    """A rig by name (hw/rigs/NAME.toml) or by path, at the station of a task when it has one of its own."""
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = RIGS / f"{name_or_path}.toml"
    if not path.exists():
        known = ", ".join(sorted(p.stem for p in RIGS.glob("*.toml")))
        raise ConfigError(f"no rig file {path}; known rigs: {known}; or give the path of a TOML file")
    try:
        table = tomllib.loads(path.read_text())
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"rig file {path} is not valid TOML: {error}") from error
    station = table.pop("station", {}).get(task, {})
    table = laid_over(table, station)
    cameras = cameras_from(table, path.name)
    if cameras is not None:
        table["cameras"] = []  # named; filled in below, where they are no longer a table
    rig = from_table(RigConfig, table, path.name)
    return replace(rig, cameras=cameras, safety=replace(rig.safety, upright=rig.start_quaternion))


def at_address(rig: RigConfig, address: str) -> RigConfig:
    """The rig with its controller at ADDRESS or ADDRESS:PORT; as it is when that is empty."""
    if not address:
        return rig
    if rig.robot != "xarm":
        raise ConfigError(f"rig {rig.name} is a {rig.robot}, it has no controller to be reached at {address}")
    host, _, port = address.partition(":")
    if port and not port.isdigit():
        raise ConfigError(f"'{address}' is not ADDRESS or ADDRESS:PORT")
    return replace(rig, xarm=replace(rig.xarm, address=host, port=int(port) if port else rig.xarm.port))


def laid_over(table: dict[str, Any], station: dict[str, Any]) -> dict[str, Any]:
    """The file's settings with a station's in their place, table by table."""
    both = dict(table)
    for key, value in station.items():
        both[key] = laid_over(table[key], value) if isinstance(value, dict) and key in table else value
    return both
