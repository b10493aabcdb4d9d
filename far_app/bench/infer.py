"""`far bench infer`: milliseconds per chunk, encoder and critic included, for each preset on this device.

Random weights: only the architecture counts. Every call sees a new observation, as every tick does.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from far_app.bench.report import write
from far_app.errors import ConfigError
from far_app.noise import keyed_noise
from far_app.protocols import Policy
from far_app.session.statistics import percentiles
from far_app.types import Observation, Pose, RobotMode, RobotStatus

WARM_UP = 10


@dataclass(frozen=True, kw_only=True)
class InferOptions:
    """Milliseconds per chunk by preset."""

    presets: tuple[str, ...] = ("quickstart", "paper")
    calls: int = 200
    device: str = "cpu"
    engine: Literal["auto", "torch", "openvino"] = "auto"
    torch_threads: int = 1
    """Threads of one torch operation; the loop's process has 1."""
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        if self.calls < 1:
            raise ConfigError(f"--calls is {self.calls}, must be at least 1")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(InferOptions, args=list(arguments), prog="far bench infer")
    import torch

    from far_app.cli.assemble import check_device, untrained
    from far_app.learning.engines import chosen
    from far_app.learning.runtime import ActingPolicy

    check_device(options.device)
    torch.set_num_threads(options.torch_threads)
    engine = chosen(options.engine) if options.device == "cpu" else "torch"
    report: dict[str, Any] = {"device": options.device, "engine": engine, "torch_threads": options.torch_threads}
    for preset in options.presets:
        network, critic = untrained(preset, "lift", options.device)
        late = milliseconds(ActingPolicy(network, "bench", critic, options.engine), options.calls)
        report[preset] = {k: v for k, v in percentiles(late).items() if k in ("p50", "p99")}
    write(report, options.json)
    return 0


def milliseconds(policy: Policy, calls: int) -> list[float]:
    """Of each of so many chunks, after a warm-up."""
    rng, spec = np.random.default_rng(0), policy.spec
    history = (observation(rng, spec.cameras, spec.image_size),) * spec.n_obs
    spent = []
    for tick in range(calls + WARM_UP):
        history = (*history[1:], observation(rng, spec.cameras, spec.image_size))
        noise = keyed_noise((0, 0, tick), spec.horizon, spec.action_dim)[None]
        began = time.perf_counter()
        policy.plan([history], [tick], noise)
        spent.append((time.perf_counter() - began) * 1e3)
    return spent[WARM_UP:]


def observation(rng: np.random.Generator, cameras: tuple[str, ...], size: int) -> Observation:
    """Noise in place of pictures."""
    images = {camera: rng.integers(0, 256, (size, size, 3), dtype=np.uint8) for camera in cameras}
    return Observation(
        seq=0, stamp=0.0, eef=Pose(position=rng.normal(size=3), quaternion=np.array([0.0, 1.0, 0.0, 0.0])), gripper=1.0,
        joints=np.zeros(7), images=images, status=RobotStatus(mode=RobotMode.TRACKING),
    )  # fmt: skip
