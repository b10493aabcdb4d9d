"""The first engine that can be built here and is what the reference is.

Called where a policy begins to act: for the base policy, and for each adapted version, whose denoiser is checked again
with its own weights. Why an engine was refused is kept, for the log and the operator's page.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from far_app.errors import ConfigError, FarError
from far_app.learning.engines.protocol import Engine, EngineError
from far_app.learning.engines.reference import ReferenceEngine
from far_app.learning.policy import DiffusionPolicy
from far_app.protocols import EngineReport, History
from far_app.types import Observation, Pose, RobotMode, RobotStatus

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which engines to try, in this order; the reference comes last of all."""

    order: tuple[str, ...]
    why: str = ""


@dataclass(frozen=True, kw_only=True)
class Taken:
    engine: Engine
    report: EngineReport


def order_of(name: str, network: DiffusionPolicy) -> Choice:
    """What a name asks for: itself first, and for "auto" every engine that may run this network by itself, in the order
    of ENGINES; the latter also follow a name, should it be refused. ConfigError where it is unknown or cannot run the
    network here."""
    from far_app.learning.engines import ENGINES

    usable = tuple(e.name for e in ENGINES.values() if e.automatic and not e.unusable(network))
    if name == "auto":
        return Choice(order=usable, why="the first that runs this policy here")
    if name not in ENGINES:
        raise ConfigError(f"unknown engine '{name}'; choose one of: auto, {', '.join(ENGINES)}")
    if why := ENGINES[name].unusable(network):
        raise ConfigError(f"engine {name} was asked for, but {why}; leave --engine out")
    return Choice(order=tuple(dict.fromkeys((name, *usable))), why="asked for")


def take(
    network: DiffusionPolicy, version: str, choice: Choice, each_alone: bool = False, batch: int = 1,
    base: Taken | None = None,
) -> Taken:  # fmt: skip
    """The first engine of the choice that builds and passes its check, for plans in batches of `batch`. With `base`,
    the engine of an earlier version of the same policy, that one's own successor is tried first, and what was refused
    then is not tried again. Never raises for an engine's sake: the reference itself always runs."""
    from far_app.learning.engines import ENGINES

    reference = ReferenceEngine(network, version, each_alone)
    refused = list(base.report.refused) if base is not None else []
    names = (base.engine.name, *choice.order) if base is not None else choice.order
    known_bad = {text.split(":")[0] for text in refused}
    for name in dict.fromkeys(names):
        if name == reference.name:
            break
        if name in known_bad:
            continue
        try:
            successor = base is not None and name == base.engine.name
            engine = (
                base.engine.adapted(network, version)
                if base is not None and successor
                else ENGINES[name].make(network, version, each_alone)
            )
            check(engine, reference, ENGINES[name].tolerance, batch, denoiser_only=successor)
        except (FarError, RuntimeError) as error:
            refused.append(f"{name}: {error}")
            log.warning("engine %s is refused for policy %s: %s; the next one is taken", name, version, error)
            continue
        return Taken(engine=engine, report=EngineReport(name=name, why=choice.why, refused=tuple(refused)))
    return Taken(engine=reference, report=EngineReport(name=reference.name, why=choice.why, refused=tuple(refused)))


def check(
    engine: Engine, reference: ReferenceEngine, tolerance: float, batch: int = 1, denoiser_only: bool = False
) -> None:
    """Compare with the reference on noise in place of pictures, one plan and one batch of `batch`; with `denoiser_only`
    on noise in place of features, for the encoder has not changed. EngineError where the weights are of another version
    or a result is further off than the tolerance."""
    if engine.version != reference.version:
        raise EngineError(f"it holds the weights of version {engine.version}, not of {reference.version}")
    for size in sorted({1, batch}):
        histories, noise = probe(reference.network, size)
        if denoiser_only:
            features = torch.randn(size, reference.network.feature_dim, generator=torch.Generator().manual_seed(0))
            features = features.to(noise.device)
            _compare("chunk", engine.sample(features, noise), reference.sample(features, noise), tolerance)
            continue
        expected, chunks = reference.plan(histories, noise)
        features, found = engine.plan(histories, noise)
        _compare("features", features, expected, tolerance * max(1.0, float(expected.abs().max())))
        _compare("chunk", found, chunks, tolerance)


def _compare(what: str, found: Tensor, expected: Tensor, limit: float) -> None:
    apart = float((found - expected).abs().max())
    if not apart <= limit:
        raise EngineError(f"its {what} differs from the reference by {apart:.2g}, the limit is {limit:.2g}")


def probe(network: DiffusionPolicy, batch: int) -> tuple[list[History], Float[Tensor, "B H A"]]:
    """Histories and noise to compare engines on, always the same."""
    rng, spec = np.random.default_rng(0), network.spec()
    histories: list[History] = [
        tuple(noisy_observation(rng, spec.cameras, spec.image_size, network.config.objects) for _ in range(spec.n_obs))
        for _ in range(batch)
    ]
    noise = rng.standard_normal((batch, spec.horizon, spec.action_dim), dtype=np.float32)
    return histories, torch.from_numpy(noise).to(network.normalizer.low.device)


def noisy_observation(
    rng: np.random.Generator, cameras: Sequence[str], size: int, objects: Sequence[str] = ()
) -> Observation:
    """Noise in place of pictures, and poses within a metre."""

    def pose() -> Pose:
        return Pose(position=rng.uniform(-1, 1, 3), quaternion=np.array([0.0, 1.0, 0.0, 0.0]))

    return Observation(
        seq=0, stamp=0.0, eef=pose(), gripper=float(rng.random()), joints=np.zeros(7),
        images={c: rng.integers(0, 256, (size, size, 3), dtype=np.uint8) for c in cameras},
        status=RobotStatus(mode=RobotMode.TRACKING), objects={name: pose() for name in objects},
    )  # fmt: skip
