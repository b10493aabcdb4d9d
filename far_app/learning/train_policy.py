"""Behaviour cloning: the diffusion policy from demonstrations (paper, Training).

A batch is segments of consecutive ticks, so that a light encoder sees each frame once though two histories share it,
and each history is noised `draws` times. Random shifts of a few pixels are the only augmentation. Seeds give
repeatable runs on CPU; a run killed at any moment goes on from its last saved state.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from far_app.errors import ConfigError, PolicyError
from far_app.learning.dataset import Episode
from far_app.learning.policy import DiffusionPolicy, PolicyConfig, save_policy
from far_app.learning.policy_step import FastStep, PlainStep
from far_app.learning.resume import load_state, optimizer_tensors, restore_optimizer, save_state
from far_app.learning.segments import DemonstrationArrays, DeviceDemonstrations

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class PolicyTraining:
    """How to train; the defaults of `paper` are its hyperparameter table."""

    iterations: int = 30_000
    batch: int = 128
    """Histories an iteration."""
    segment: int = 4
    """Consecutive ticks a segment; 1 gives independent histories."""
    draws: int = 1
    """(k, ε) draws for each history."""
    lr: float = 1e-4
    lr_end: float = 1e-5
    warmup: int = 100
    weight_decay: float = 1e-6
    localise: float = 0.0
    """Weight of an auxiliary loss: a linear head on the features says where the objects are relative to the hand (in
    10 cm). It makes a small encoder look at what matters; only demonstrations that know object poses have it, and
    nothing of it is left in the checkpoint."""
    shift: int = 4
    """Largest random shift of the pictures, pixels."""
    ema_power: float = 0.75
    seed: int = 0
    log_every: int = 100
    save_every: int = 500

    def __post_init__(self) -> None:
        if self.batch % self.segment:
            raise ConfigError(f"batch {self.batch} is not a multiple of segment {self.segment}")


TRAININGS = {
    "paper": PolicyTraining(),
    "state": PolicyTraining(iterations=3_000, batch=64, draws=2, lr=5e-4, lr_end=2e-5, shift=0),
    "quickstart": PolicyTraining(iterations=2_000, batch=64, draws=2, lr=5e-4, lr_end=2e-5),
}


def learning_rate(config: PolicyTraining, iteration: int) -> float:
    """Linear warm-up, then cosine from lr to lr_end."""
    if iteration < config.warmup:
        return config.lr * (iteration + 1) / config.warmup
    progress = (iteration - config.warmup) / max(1, config.iterations - config.warmup)
    return config.lr_end + (config.lr - config.lr_end) * 0.5 * (1.0 + math.cos(math.pi * progress))


def train_policy(
    episodes: Sequence[Episode],
    config: PolicyConfig,
    training: PolicyTraining,
    folder: Path,
    device: str = "cpu",
    card: dict[str, object] | None = None,
    imagenet: dict[str, Tensor] | None = None,
    start: DiffusionPolicy | None = None,
    weights: Float[np.ndarray, "N"] | None = None,
    form: type[PlainStep] = FastStep,
) -> Path:
    """Train (or go on training) in a folder; returns the checkpoint (EMA weights). log.jsonl: a line an interval.

    `start`: finetune this policy, its encoder and normaliser frozen, so that a critic on its features keeps its
    meaning. `weights`: of every tick of the episodes, side by side (paper, Eq. awr).
    `form`: of a step (policy_step)."""
    torch.manual_seed(training.seed)
    rng = np.random.default_rng(training.seed)
    generator = torch.Generator().manual_seed(training.seed)
    on_cpu = torch.device(device).type == "cpu"
    arrays = (
        DemonstrationArrays(episodes, config, training.shift)
        if on_cpu or form is PlainStep
        else DeviceDemonstrations(episodes, config, training.shift, device)
    )
    step = begun(form, config, training, arrays, device, imagenet, start)
    policy, ema, locator, optimizer = step.policy, step.ema, step.locator, step.optimizer
    state_path = folder / "state.safetensors"
    done = 0
    if state_path.exists():
        tensors, notes = load_state(state_path)
        if notes["training"] != json.loads(json.dumps(dataclasses.asdict(training))):
            raise ConfigError(f"{folder} holds a run with other settings; choose another --out or delete it")
        policy.load_state_dict({k[7:]: v for k, v in tensors.items() if k.startswith("policy.")})
        if locator is not None:
            locator.load_state_dict({k[8:]: v for k, v in tensors.items() if k.startswith("locator.")})
        ema.load_state_dict({k[4:]: v for k, v in tensors.items() if k.startswith("ema.")})
        restore_optimizer(optimizer, tensors)
        rng.bit_generator.state = notes["rng"]  # type: ignore[assignment]
        generator.set_state(tensors["generator"])
        done = int(notes["iteration"])  # type: ignore[call-overload]
        log.info("going on from iteration %d of %s", done, folder)

    def save(iteration: int) -> None:
        tensors = {f"policy.{k}": v for k, v in policy.state_dict().items()}
        tensors |= {f"ema.{k}": v for k, v in ema.state_dict().items()}
        if locator is not None:
            tensors |= {f"locator.{k}": v for k, v in locator.state_dict().items()}
        tensors |= optimizer_tensors(optimizer) | {"generator": generator.get_state()}
        save_state(state_path, tensors, {
            "iteration": iteration, "rng": rng.bit_generator.state, "training": dataclasses.asdict(training),
        })  # fmt: skip

    folder.mkdir(parents=True, exist_ok=True)
    started, losses = time.monotonic(), []
    bar = tqdm(range(done, training.iterations), initial=done, total=training.iterations, unit="it", desc="policy")
    for iteration in bar:
        lr = learning_rate(training, iteration)
        drawn = arrays.segments(training.batch // training.segment, training.segment, rng)
        weight = None if weights is None else torch.from_numpy(weights[drawn.rows.ravel()]).to(device)
        loss = step.loss(drawn, generator, weight)
        if not torch.isfinite(loss):
            raise PolicyError(
                f"the loss became {loss.item()} at iteration {iteration}; the last good state is {state_path}; "
                "lower --lr and start again"
            )
        step.update(loss, lr, decay=1.0 - (1 + iteration) ** -training.ema_power)
        losses.append(loss.item())
        if (iteration + 1) % training.log_every == 0 or iteration + 1 == training.iterations:
            mean = float(np.mean(losses))
            bar.set_postfix(loss=f"{mean:.4f}")
            line = {"iteration": iteration + 1, "loss": mean, "lr": lr, "seconds": time.monotonic() - started}
            with (folder / "log.jsonl").open("a") as file:
                file.write(json.dumps(line) + "\n")
            losses.clear()
        if (iteration + 1) % training.save_every == 0 or iteration + 1 == training.iterations:
            save(iteration + 1)
    checkpoint = folder / "policy.safetensors"
    save_policy(ema.eval(), checkpoint, (card or {}) | {
        "training": dataclasses.asdict(training), "demonstrations": len(episodes),
        "ticks": int(arrays.lengths.sum()), "seconds": time.monotonic() - started,
    })  # fmt: skip
    return checkpoint


def begun(
    form: type[PlainStep], config: PolicyConfig, training: PolicyTraining, arrays: DemonstrationArrays,
    device: str = "cpu", imagenet: dict[str, Tensor] | None = None, start: DiffusionPolicy | None = None,
) -> PlainStep:  # fmt: skip
    """A step on new weights (or on `start`'s, its encoder and normaliser frozen); torch's seed decides on them."""
    policy = DiffusionPolicy(config)
    if imagenet is not None:
        load_imagenet(policy, imagenet)
    if start is None:
        policy.normalizer.fit(arrays.states)
    else:
        policy.load_state_dict(start.state_dict())
        policy.encoder.requires_grad_(False)
    policy.to(device)
    ema = copy.deepcopy(policy).requires_grad_(False)
    locator = None
    if training.localise > 0 and arrays.offsets is not None:
        locator = torch.nn.Linear(policy.feature_dim, arrays.offsets.shape[1]).to(device)
    return form(
        policy, ema, locator, lr=training.lr, weight_decay=training.weight_decay, draws=training.draws,
        localise=training.localise,
    )  # fmt: skip


def load_imagenet(policy: DiffusionPolicy, weights: dict[str, Tensor]) -> None:
    """Put torchvision's ResNet-18 weights (IMAGENET1K_V1 state-dict names) into every camera's trunk."""
    trunk = {k: v for k, v in weights.items() if not k.startswith("fc.")}
    for nets in policy.encoder.nets.values():
        for net in nets:  # type: ignore[attr-defined]
            own = net.state_dict()
            net.load_state_dict(
                {k: trunk[k] if k in trunk and trunk[k].shape == v.shape else v for k, v in own.items()}
            )
