"""A rig and a task as datasets, cards and the preflight know them."""

from __future__ import annotations

from far_app.config import TaskConfig
from far_app.preflight import SeenView, Setup
from hw.rig import RigConfig


def setup_of(rig: RigConfig, task: TaskConfig) -> Setup:
    """What there is to compare of a rig at a task."""
    views = {camera: SeenView() for camera in task.cameras}
    if rig.cameras:
        views = {
            view: SeenView(framing=framing, width=config.width, height=config.height)
            for name, config in rig.cameras.items()
            for view, framing in config.views(name).items()
        }
    scale = rig.scale_for(task)
    return Setup(
        robot=rig.robot, arm=rig.arm, rate=task.rate, translation=scale.translation, rotation=scale.rotation,
        image_size=rig.policy_image, views=views,
    )  # fmt: skip
