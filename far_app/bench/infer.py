"""`far bench infer`: milliseconds per chunk, encoder and critic included, by preset and engine; and how they grow.

Random weights: only the architecture counts. Every call sees a new observation after the last one, as every tick does
(what an engine has begun for the next tick, it goes on with while the others have their turns). The engines of a
preset take turns, call by call, so that whatever else the machine does falls on all alike; `speedup` is against
`torch`, the plain form, in the same run. `replans` is how many ticks of 30 Hz a chunk takes, its 99th percentile.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from far_app.bench.report import write
from far_app.errors import ConfigError
from far_app.noise import keyed_noise
from far_app.protocols import OWN_STATE, History, Policy

if TYPE_CHECKING:
    from far_app.learning.policy import PolicyConfig

WARM_UP = 5
TICK_MS = 1000 / 30
GROWTH: dict[str, tuple[Any, ...]] = {
    "ddim_steps": (4, 8, 16, 32), "batch": (1, 2, 4, 8), "image_size": (84, 128, 240), "cameras": (1, 2, 3),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class InferOptions:
    """Milliseconds per chunk by preset and engine."""

    presets: tuple[str, ...] = ("state", "quickstart", "paper")
    engines: tuple[str, ...] = ()
    """Engines beside torch; all that run here by default."""
    calls: int = 60
    growth: str = "paper"
    """Preset whose growth with steps, batch, image size and cameras is measured; "" for none."""
    growth_calls: int = 30
    device: str = "cpu"
    torch_threads: int = 1
    """Threads of one torch operation; the loop's process has 1."""
    json: Path | None = None
    """Write the report here."""

    def __post_init__(self) -> None:
        for name in ("calls", "growth_calls"):
            if getattr(self, name) < 1:
                raise ConfigError(f"--{name.replace('_', '-')} is {getattr(self, name)}, must be at least 1")


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(InferOptions, args=list(arguments), prog="far bench infer")
    report = measure(options)
    write(report, options.json)
    print(table(report), flush=True)
    return 0


def measure(options: InferOptions) -> dict[str, Any]:
    """{"device", "torch_threads", "chunks": rows by preset and engine, "growth": rows by what grew}."""
    import torch

    from far_app.cli.assemble import check_device
    from far_app.learning.policy import preset

    check_device(options.device)
    torch.set_num_threads(options.torch_threads)
    chunks = [
        {"preset": name, **row}
        for name in options.presets
        for row in compared(preset(name, "lift"), options, options.calls)
    ]
    growth = []
    for what, values in GROWTH.items() if options.growth else ():
        for value in values:
            config, batch = preset(options.growth, "lift"), 1
            if what == "batch":
                batch = value
            elif what == "cameras":
                config = dataclasses.replace(config, cameras=tuple(f"camera{i}" for i in range(value)))
            else:
                config = dataclasses.replace(config, **{what: value})
            rows = compared(config, options, options.growth_calls, batch)
            growth += [{"preset": options.growth, "grows": what, "to": value, **row} for row in rows]
    return {"device": options.device, "torch_threads": options.torch_threads, "chunks": chunks, "growth": growth}


def compared(config: PolicyConfig, options: InferOptions, calls: int, batch: int = 1) -> list[dict[str, Any]]:
    """A row for each engine that runs this network here, the reference first."""
    import torch

    from far_app.learning.critic import Critic, CriticShape
    from far_app.learning.engines import ENGINES
    from far_app.learning.policy import DiffusionPolicy
    from far_app.learning.runtime import ActingPolicy

    torch.manual_seed(0)
    network = DiffusionPolicy(config).to(options.device).eval().requires_grad_(False)
    shape = CriticShape(
        features=network.feature_dim, horizon=config.horizon, action_dim=network.spec().action_dim
    )  # fmt: skip
    critic = Critic(shape).to(options.device).eval().requires_grad_(False)
    wanted = options.engines or tuple(ENGINES)
    names = ["torch", *(n for n in wanted if n != "torch" and n in ENGINES and not ENGINES[n].unusable(network))]
    policies = {name: ActingPolicy(network, "bench", critic, name) for name in names}
    late = milliseconds(policies, calls, batch)
    plain = float(np.median(late["torch"]))
    return [_row(name, policies[name].runs_on.name, late[name], plain, batch) for name in names]


def _row(asked: str, ran: str, late: Sequence[float], plain: float, batch: int) -> dict[str, Any]:
    p50, p99 = np.percentile(late, (50, 99))
    return {
        "engine": asked if asked == ran else f"{asked} refused, {ran}", "calls": len(late), "p50": round(float(p50), 2),
        "p99": round(float(p99), 2), "each": round(float(p50) / batch, 2), "speedup": round(plain / float(p50), 2),
        "replans": math.ceil(float(p99) / TICK_MS),
    }  # fmt: skip


def milliseconds(policies: Mapping[str, Policy], calls: int, batch: int = 1) -> dict[str, list[float]]:
    """Of each of so many plans, by policy, after a warm-up; all policies see the same."""
    from far_app.learning.engines.taking import noisy_observation

    rng = np.random.default_rng(0)
    spent: dict[str, list[float]] = {name: [] for name in policies}
    spec = next(iter(policies.values())).spec
    objects = [key for key in spec.state_keys if key not in OWN_STATE]

    def seen() -> Any:
        return noisy_observation(rng, spec.cameras, spec.image_size, objects)

    histories: list[History] = [(seen(),) * spec.n_obs for _ in range(batch)]
    for tick in range(calls + WARM_UP):
        histories = [(*h[1:], seen()) for h in histories]
        noise = np.stack([keyed_noise((i, 0, tick), spec.horizon, spec.action_dim) for i in range(batch)])
        for name, policy in policies.items():
            began = time.perf_counter()
            policy.plan(histories, [tick] * batch, noise)
            spent[name].append((time.perf_counter() - began) * 1e3)
    return {name: late[WARM_UP:] for name, late in spent.items()}


def table(report: dict[str, Any]) -> str:
    """The report as Markdown."""
    lines = ["| preset | engine | ms a chunk, p50 | p99 | × torch |", "|---|---|---|---|---|"]
    lines += [f"| {r['preset']} | {r['engine']} | {r['p50']} | {r['p99']} | {r['speedup']} |" for r in report["chunks"]]
    if report["growth"]:
        lines += ["", "| grows | to | engine | ms, p50 | each |", "|---|---|---|---|---|"]
        lines += [f"| {r['grows']} | {r['to']} | {r['engine']} | {r['p50']} | {r['each']} |" for r in report["growth"]]
    return "\n".join(lines)
