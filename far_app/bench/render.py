"""`far bench render`: milliseconds to draw both cameras of the twin, its thinned meshes beside the whole ones.

Both views are drawn in turns in one process, of the same moments, with the same flags; what differs between their
pictures is told in grey levels.
--pictures keeps some of both.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from far_app.bench.report import write
from far_app.bench.rows import REPEATS, Row, row_of, table, timed_side_by_side
from far_app.errors import ConfigError
from far_app.tasks import task as find_task
from hw.rig import load_rig

TARGETS = {84: 8.0, 240: 12.0}
"""Milliseconds for both cameras, by size."""


@dataclass(frozen=True, kw_only=True)
class RenderOptions:
    """Milliseconds to draw both cameras."""

    task: str = "lift"
    rig: str = "twin"
    sizes: tuple[int, ...] = (84, 240)
    repeats: int = REPEATS
    threads: int = 1
    """Of the software renderer, as the hw server has them."""
    pictures: Path | None = None
    """Keep a picture of each camera and form here."""
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        if self.repeats < 1:
            raise ConfigError(f"--repeats is {self.repeats}, must be at least 1")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(RenderOptions, args=list(arguments), prog="far bench render")
    os.environ["LP_NUM_THREADS"] = str(options.threads)  # before any GL
    write(measure(options), options.json)
    return 0


def measure(options: RenderOptions) -> dict[str, Any]:
    from hw.twin import TwinPlant
    from hw.twin_view import FACE_BUDGET, TwinView

    rig = load_rig(options.rig, options.task)
    plant = TwinPlant(rig, find_task(options.task, rig.arm))
    forms = {
        name: TwinView(plant.model_xml(), plant.base_pose(), plant.cameras(), budget=budget)
        for name, budget in (("plain", None), ("fast", FACE_BUDGET))
    }
    cameras = tuple(plant.cameras())
    plant.reset(0)
    moments = [plant.snapshot()]
    for _ in range(9):  # the arm on its way down, the gripper on the move
        for _ in range(12):
            plant.servo(plant.measure().eef, 1.0 if len(moments) % 4 < 2 else -1.0)
            plant.advance()
        moments.append(plant.snapshot())
    rows: list[Row] = []
    differences: dict[str, Any] = {}
    for size in options.sizes:
        turn = {name: 0 for name in forms}

        def draw(name: str, size: int = size, turn: dict[str, int] = turn) -> None:
            turn[name] += 1
            moment = plant_copy(moments[turn[name] % len(moments)])
            for camera in cameras:
                forms[name].image(moment, camera, size)

        plain, fast = timed_side_by_side(lambda: draw("plain"), lambda: draw("fast"), options.repeats)
        rows.append(row_of(f"{' and '.join(cameras)}, {size} × {size}", fast, plain, TARGETS.get(size)))
        differences[str(size)] = {
            camera: difference(*(forms[name].image(moments[0], camera, size) for name in ("plain", "fast")))
            for camera in cameras
        }
        if options.pictures is not None:
            keep_pictures(options.pictures, forms, moments[0], cameras, size)
    report = {
        "renderer_threads": options.threads, "faces": {name: view.faces for name, view in forms.items()},
        "grey_levels": differences, "rows": table(rows),
    }  # fmt: skip
    for view in forms.values():
        view.close()
    return report


def plant_copy(moment: Any) -> Any:
    """The same moment as a new one: a view draws a moment's bodies once."""
    from dataclasses import replace

    return replace(moment)


def difference(plain: np.ndarray, fast: np.ndarray) -> dict[str, float]:
    """Between two pictures: the mean of all pixels, and the share that differs by more than 16 of 256."""
    apart = np.abs(plain.astype(int) - fast.astype(int)).max(axis=2)
    return {"mean": round(float(apart.mean()), 2), "share_beyond_16": round(float((apart > 16).mean()), 4)}


def keep_pictures(folder: Path, forms: dict[str, Any], moment: Any, cameras: Sequence[str], size: int) -> None:
    import cv2

    folder.mkdir(parents=True, exist_ok=True)
    for name, view in forms.items():
        for camera in cameras:
            cv2.imwrite(str(folder / f"{camera}-{size}-{name}.png"), view.image(moment, camera, size)[:, :, ::-1])
