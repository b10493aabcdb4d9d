"""What the controller moves: an arm at servo rate, real or simulated, and what may be looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, UInt8

from far_app.telemetry import SceneGeometry
from far_app.types import Pose


@dataclass(frozen=True, kw_only=True)
class Measured:
    """The arm's own word, at one servo tick."""

    eef: Pose
    """Base frame."""
    joints: Float[np.ndarray, "J"]
    """Radians."""
    gripper: float
    """Opening: 0 closed, 1 open."""
    error: str = ""
    """The arm's fault, in words; empty when well."""
    objects: Mapping[str, Pose] = field(default_factory=dict)
    """Base frame; twin only."""
    success: bool | None = None
    """The twin's own check, now."""
    reward: float = 0.0
    """The twin's shaped reward, in [0, 1]."""
    age: float = 0.0
    """Seconds since the arm told this; the twin's is always of this moment."""
    stalled: bool = False
    """No command reached the arm for a while: it stands at the last one, and motion must start anew from there."""


class Plant(Protocol):
    """Called from one thread, the servo thread; `halt` from any."""

    servo_hz: int
    """Servo ticks a second; a multiple of the policy's rate for the twin (120)."""

    def measure(self) -> Measured: ...

    def servo(self, pose: Pose, gripper: float) -> None:
        """Command an absolute pose (base frame) and the gripper (−1 opens, +1 closes) for the coming servo period."""
        ...

    def advance(self) -> None:
        """Let one servo period pass: the twin simulates it, an arm only moves on by itself (no-op)."""
        ...

    def reset(self, seed: int) -> None:
        """Twin: objects as the seed says, arm at the start pose, at rest. Hardware: the scene is the operator's and the
        way to the start pose is Home's, so nothing happens."""
        ...

    def halt(self) -> None:
        """STOP, from any thread, also while another call hangs: stop the arm by its fastest path. Returns at once,
        never raises. Until `rearm` nothing more is sent. The twin's latch is enough: no-op."""
        ...

    def rearm(self) -> bool:
        """The operator pressed Resume: clear the arm's errors and be ready for commands from where it stands, without
        moving. True where it was stopped by other means than its command, and stands where it says. May block for
        seconds; raises RobotError saying what is still wrong. Twin: no-op, False: it follows the command all along."""
        ...

    guided: bool
    """A person may lead the arm by hand: it is compliant, and `servo` moves its gripper alone."""

    def guide(self, on: bool) -> None:
        """Make the arm compliant, or stiff again where it stands. May block for a second; raises RobotError where it
        cannot. The twin never can."""
        ...

    def close(self) -> None:
        """Let go of the arm."""
        ...

    def snapshot(self) -> Any:
        """A copy of what a PlantView needs to draw this moment; cheap, may be handed to another thread."""
        ...


class SimulatedPlant(Plant, Protocol):
    """A Plant whose arm can be put somewhere else at no cost."""

    def free(self) -> None:
        """The arm at its start pose, at rest, hand open; the objects stay where they are."""
        ...


class PlantView(Protocol):
    """Draws snapshots; lives in the camera thread, which owns its GL context (make it there)."""

    def image(self, snapshot: Any, camera: str, size: int) -> UInt8[np.ndarray, "size size 3"]: ...

    def body_poses(self, snapshot: Any) -> Float[np.ndarray, "B 7"]: ...

    def geometry(self) -> SceneGeometry: ...

    def close(self) -> None: ...
