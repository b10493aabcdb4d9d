"""The arms a twin can have: what differs between robosuite's models of them."""

from __future__ import annotations

from dataclasses import dataclass

from hw.twin_view import CameraPlacement


@dataclass(frozen=True, kw_only=True)
class TwinArm:
    robot: str
    """robosuite's name."""
    fingers: tuple[tuple[str, bool], ...]
    """Position actuators of the gripper; True where the low end of its range is open."""
    finger_joint: str
    """The joint by which the opening is measured."""
    finger_open: float
    """Its position when open, radians or metres."""
    finger_closed: float
    wrist: CameraPlacement
    """The camera on the hand."""


ARMS = {
    "xarm7": TwinArm(
        robot="XArm7", fingers=(("gripper0_right_fingers_actuator", True),),
        finger_joint="gripper0_right_left_driver_joint", finger_open=0.0, finger_closed=0.85,
        wrist=CameraPlacement(
            position=(0.12, 0.0, 0.0), target=(0.015, 0.0, 0.17), up=(1, 0, 0), fovy=80.0,
            body="gripper0_right_xarm_gripper_base_link",
        ),
    ),
    "panda": TwinArm(
        robot="Panda",
        fingers=(("gripper0_right_gripper_finger_joint1", False), ("gripper0_right_gripper_finger_joint2", True)),
        finger_joint="gripper0_right_finger_joint1", finger_open=0.04, finger_closed=0.0,
        wrist=CameraPlacement(
            position=(0.08, 0.0, 0.0), target=(0.01, 0.0, 0.12), up=(1, 0, 0), fovy=80.0,
            body="gripper0_right_right_gripper",
        ),
    ),
}  # fmt: skip
