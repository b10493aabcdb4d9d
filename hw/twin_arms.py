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
    finger_joints: tuple[tuple[str, float, float], ...]
    """The joints by whose mean the opening is measured: name, position when closed and when open, radians or metres."""
    elbow_stop: float
    """Where joint 4 stops, radians: just short of the stretched arm. Beyond it the elbow bends the other way, and the
    way home leads into the joint's own end."""
    wrist: CameraPlacement
    """The camera on the hand."""


ARMS = {
    "xarm7": TwinArm(
        robot="XArm7", fingers=(("gripper0_right_fingers_actuator", True),),
        finger_joints=(("gripper0_right_left_driver_joint", 0.85, 0.0),), elbow_stop=2.65,
        wrist=CameraPlacement(
            position=(0.12, 0.0, 0.0), target=(0.015, 0.0, 0.17), up=(1, 0, 0), fovy=80.0,
            body="gripper0_right_xarm_gripper_base_link",
        ),
    ),
    "panda": TwinArm(
        robot="Panda",
        fingers=(("gripper0_right_gripper_finger_joint1", False), ("gripper0_right_gripper_finger_joint2", True)),
        finger_joints=(("gripper0_right_finger_joint1", 0.0, 0.04), ("gripper0_right_finger_joint2", 0.0, -0.04)),
        elbow_stop=-0.55,
        wrist=CameraPlacement(
            position=(0.08, 0.0, 0.0), target=(0.01, 0.0, 0.12), up=(1, 0, 0), fovy=80.0,
            body="gripper0_right_right_gripper",
        ),
    ),
}  # fmt: skip
