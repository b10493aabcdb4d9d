"""One Observation from what the arm measures, what the controller says and what the cameras saw."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from far_app.device_input import DeviceInput
from far_app.types import Ack, Observation, RobotStatus
from hw.plant import Measured


def observation(
    seq: int, stamp: float, measured: Measured, status: RobotStatus, acks: tuple[Ack, ...],
    images: Mapping[str, np.ndarray], device: DeviceInput | None = None,
) -> Observation:  # fmt: skip
    """`stamp` is the capture time of the images, or of the state where there are none."""
    return Observation(
        seq=seq, stamp=stamp, eef=measured.eef, gripper=measured.gripper, joints=measured.joints, images=images,
        status=status, acks=acks, objects=measured.objects, success=measured.success, reward=measured.reward,
        device=device,
    )  # fmt: skip
