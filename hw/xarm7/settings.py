"""The [xarm] table of a rig file: what a real xArm7 needs beyond what every rig has."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from far_app.errors import ConfigError

RANGES = {
    "g1": {"open": (-10.0, 850.0), "closed": (-10.0, 850.0), "speed": (1000.0, 5000.0)},
    "g2": {"open": (0.0, 84.0), "closed": (0.0, 84.0), "speed": (15.0, 225.0), "force": (1.0, 100.0)},
}
"""What each hand takes (vendor)."""
FAKE_PORT = 15502
"""Where the fake controller (hw/fake_xarm/) serves in place of 502, which only root may."""
REACH = 0.5
"""Metres from the flange within which a tool centre point or a load's centre can lie: more was meant in millimetres."""


@dataclass(frozen=True, kw_only=True)
class GripperSettings:
    """The hand."""

    kind: Literal["g1", "g2", "none"] = "g1"
    open: float = 850.0
    """Position when open: G1 −10 to 850 (vendor), G2 millimetres, 0 to 84."""
    closed: float = 0.0
    """Position when closed; short of the mechanical end when nothing thick is ever held."""
    speed: float = 3000.0
    """G1 1000 to 5000 r/min, G2 15 to 225 mm/s (vendor)."""
    force: float = 50.0
    """G2 only, 1 to 100 (vendor)."""
    period: float = 0.1
    """Least seconds between two requests on the RS485 line."""
    hysteresis: float = 0.05
    """Share of the stroke by which a command must change before it is sent."""

    def __post_init__(self) -> None:
        if self.kind == "none":
            return
        for name, (low, high) in RANGES[self.kind].items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"xarm.gripper.{name} is {value:g}, a {self.kind}'s must be {low:g} to {high:g}")
        if self.open == self.closed:
            raise ConfigError(f"xarm.gripper open and closed are both {self.open:g}; they must differ")
        if self.period < 0.1:
            raise ConfigError(f"xarm.gripper.period is {self.period} s, must be at least 0.1: the line is slow")
        if not 0.0 <= self.hysteresis <= 0.5:
            raise ConfigError(f"xarm.gripper.hysteresis is {self.hysteresis}, must be 0 to 0.5 of the stroke")


@dataclass(frozen=True, kw_only=True)
class XArmSettings:
    """How to reach the controller, what hangs on the arm, and how finely it is led."""

    address: str = ""
    """IPv4 address of the controller; `far run --host` overrides it."""
    port: int = 502
    """Command port; only a fake controller has another."""
    tcp_offset: tuple[float, ...] = (0.0, 0.0, 0.172, 0.0, 0.0, 0.0)
    """Tool centre point on the flange: metres x, y, z and radians roll, pitch, yaw. G1: 172 mm (vendor)."""
    load_mass: float = 0.82
    """Kilograms; G1 0.82 (vendor), more with a camera on the hand. Wrong, it makes collision detection wrong."""
    load_center: tuple[float, ...] = (0.0, 0.0, 0.048)
    """Metres, flange frame."""
    collision_sensitivity: int = 3
    """Least sensitivity the controller must have, 1 to 5; it is compared, never changed, and never 0."""
    servo_step: float = 0.0025
    """Metres of one servo tick (100 Hz) at most; the vendor's limit is 0.010."""
    servo_turn: float = 0.025
    """Radians of one servo tick at most."""
    call_timeout: float = 0.1
    """Seconds a servo call waits for its answer."""
    connect_timeout: float = 10.0
    """Seconds until a controller that does not answer is an error."""
    latency_limit: float = 0.015
    """Seconds of a servo call's round trip, median of half a second, above which the arm is held."""
    gripper: GripperSettings = field(default_factory=GripperSettings)

    def __post_init__(self) -> None:
        limits = (
            ("port", self.port, 1, 65535), ("collision_sensitivity", self.collision_sensitivity, 1, 5),
            ("servo_step", self.servo_step, 1e-5, 0.010), ("servo_turn", self.servo_turn, 1e-4, 0.1),
            ("call_timeout", self.call_timeout, 0.02, 1.0), ("connect_timeout", self.connect_timeout, 1.0, 120.0),
            ("load_mass", self.load_mass, 0.0, 3.5), ("latency_limit", self.latency_limit, 0.001, 0.05),
        )  # fmt: skip
        for name, value, low, high in limits:
            if not low <= value <= high:
                raise ConfigError(f"xarm.{name} is {value}, must be {low} to {high}")
        if len(self.tcp_offset) != 6 or len(self.load_center) != 3:
            raise ConfigError("xarm.tcp_offset takes 6 values (metres, radians), xarm.load_center 3 (metres)")
        for name, lengths in (("tcp_offset", self.tcp_offset[:3]), ("load_center", self.load_center)):
            if not all(abs(length) <= REACH for length in lengths):
                raise ConfigError(f"xarm.{name} is {lengths}, must be within {REACH} m of the flange; it is in metres")
