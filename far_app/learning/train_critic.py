"""IQL: V and Q from demonstrations, and from the policy's own attempts where given.

By default on the policy's frozen features, computed once: an iteration is then a few small matrix products. Batches
are keyed by (seed, iteration), so a run killed at any moment goes on from its last saved state and ends with the very
same weights (on CPU).
"""

from __future__ import annotations

import dataclasses
import json
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from tqdm import tqdm

from far_app.errors import ConfigError, PolicyError
from far_app.learning.attribution import value_change
from far_app.learning.critic import Critic, CriticShape, eyes_of, iql_losses
from far_app.learning.critic_file import encoder_fingerprint, save_critic
from far_app.learning.critic_source import Features, Pictures, Source, encoded, policy_features
from far_app.learning.dataset import Episode
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.preference import Demonstrations
from far_app.learning.resume import load_state, optimizer_tensors, restore_optimizer, save_state
from far_app.learning.transitions import Backup, RewardKind
from far_app.seeding import generator

log = logging.getLogger(__name__)

PROBE = 2048
"""Transitions, spread over all, on which V and Q are reported."""
KEPT_CHUNKS = 512
"""Demonstration chunks kept beside a critic for the bc guard."""


@dataclass(frozen=True, kw_only=True)
class CriticTraining:
    """How to train a critic; defaults are the paper's hyperparameter table where it speaks."""

    iterations: int = 20_000
    """Paper: 15,000 to 30,000."""
    batch: int = 128
    lr: float = 1e-4
    expectile: float = 0.7
    """τ."""
    gamma: float = 0.99
    """γ, one tick."""
    backup: int = 1
    """Ticks of reward in Q's target before V takes over: 1 is the paper's, H (the chunk's horizon) shows Q what the
    whole chunk led to."""
    polyak: float = 0.005
    """ρ of the target networks."""
    reward: RewardKind = "shaped"
    encoder: Literal["shared", "own"] = "shared"
    """See through the policy's frozen encoder (features computed once), or through an own one that begins as its copy
    and is trained too (the paper's form; far slower)."""
    hidden: tuple[int, ...] = (256, 256)
    seed: int = 0
    log_every: int = 500
    save_every: int = 2_000

    def __post_init__(self) -> None:
        if not 0 < self.expectile < 1:
            raise ConfigError(f"expectile is {self.expectile}, must be between 0 and 1")
        if not 0 <= self.gamma <= 1:
            raise ConfigError(f"gamma is {self.gamma}, must be in [0, 1]")
        if self.backup < 1:
            raise ConfigError(f"backup is {self.backup}, must be at least 1 tick")


def fit(
    critic: Critic, source: Source, training: CriticTraining, folder: Path, stamp: str = "", standardise: bool = True
) -> dict[str, float]:
    """Train (or go on training) on transitions; returns the last interval's means. `stamp` names what the features
    were made with: a saved state with another is refused. A critic that was trained before keeps its inputs'
    statistics (`standardise` False)."""
    optimizer = torch.optim.AdamW(
        [p for p in critic.parameters() if p.requires_grad], lr=training.lr, weight_decay=0.0, foreach=True
    )
    state_path = folder / "critic_state.safetensors"
    notes: dict[str, object] = {
        "training": json.loads(json.dumps(dataclasses.asdict(training))), "stamp": stamp, "size": len(source),
    }  # fmt: skip
    done = resume(critic, optimizer, state_path, notes)
    probe = np.arange(0, len(source), max(1, len(source) // PROBE))
    if not done and standardise:
        with torch.no_grad():
            critic.standardise(source.batch(critic, probe)[0])
    folder.mkdir(parents=True, exist_ok=True)
    started, means, interval = time.monotonic(), {}, []
    bar = tqdm(range(done, training.iterations), initial=done, total=training.iterations, unit="it", desc="critic")
    for iteration in bar:
        rows = generator("critic", training.seed, iteration).integers(len(source), size=training.batch)
        value_loss, q_loss = iql_losses(critic, *source.batch(critic, rows), training.expectile)
        optimizer.zero_grad(set_to_none=True)
        (value_loss + q_loss).backward()
        optimizer.step()
        critic.follow(training.polyak)
        interval.append(torch.stack([value_loss.detach(), q_loss.detach()]))
        last = iteration + 1 == training.iterations
        if (iteration + 1) % training.log_every == 0 or last:
            v, q = torch.stack(interval).mean(0).tolist()
            interval.clear()
            if not np.isfinite(v + q):
                raise PolicyError(
                    f"the critic's loss became {v} (V), {q} (Q) by iteration {iteration + 1}; the last good state is "
                    f"{state_path}; lower --lr and start again"
                )
            means = {"value_loss": v, "q_loss": q} | statistics(critic, source, probe)
            bar.set_postfix(V=f"{v:.4g}", Q=f"{q:.4g}")
            line = {"iteration": iteration + 1, "seconds": time.monotonic() - started} | means
            with (folder / "critic_log.jsonl").open("a") as file:
                file.write(json.dumps(line) + "\n")
        if (iteration + 1) % training.save_every == 0 or last:
            saved = {f"critic.{k}": v for k, v in critic.state_dict().items()} | optimizer_tensors(optimizer)
            save_state(state_path, saved, notes | {"iteration": iteration + 1})
    return means


def resume(critic: Critic, optimizer: torch.optim.Optimizer, path: Path, notes: dict[str, object]) -> int:
    """Iterations already done; the critic and the optimizer are put back to where they were."""
    if not path.exists():
        return 0
    tensors, found = load_state(path)
    differing = [k for k, v in notes.items() if found.get(k) != v]
    if differing:
        raise ConfigError(
            f"{path.parent} holds a critic run with another {', '.join(differing)}; choose another --out or delete it"
        )
    critic.load_state_dict({k.removeprefix("critic."): v for k, v in tensors.items() if k.startswith("critic.")})
    restore_optimizer(optimizer, tensors)
    log.info("going on from iteration %s of %s", found["iteration"], path)
    return int(found["iteration"])  # type: ignore[call-overload]


@torch.no_grad()
def statistics(critic: Critic, source: Source, rows: np.ndarray) -> dict[str, float]:
    """Where V and Q stand on a spread of the training states."""
    features, chunks, *_ = source.batch(critic, rows)
    values, q = critic.value(features), critic.q(features, chunks)
    return {"value_mean": float(values.mean()), "value_std": float(values.std()), "q_mean": float(q.mean())}


def train_critic(
    demonstrations: Sequence[Episode],
    attempts: Sequence[Episode],
    policy: DiffusionPolicy,
    training: CriticTraining,
    folder: Path,
    card: dict[str, object] | None = None,
) -> Path:
    """Train (or go on training) a critic for this policy in a folder; returns the checkpoint. `attempts` are the
    policy's own rollouts, failed and successful: trained on successes alone, V knows little of failure."""
    torch.manual_seed(training.seed)
    started = time.monotonic()
    backup = Backup(ticks=training.backup, gamma=training.gamma)
    data, shown = policy_features(policy, demonstrations, attempts, training.reward, backup)
    own = training.encoder == "own"
    shape = CriticShape(
        features=policy.feature_dim, horizon=policy.config.horizon, action_dim=data.chunks.shape[2],
        hidden=training.hidden, own_eyes=own,
    )  # fmt: skip
    critic = Critic(shape, eyes_of(policy).requires_grad_(True) if own else None)
    source = Pictures([*demonstrations, *attempts], shape.horizon, training.reward, backup) if own else Features(data)
    means = fit(critic, source, training, folder, stamp=encoder_fingerprint(policy))
    kept = generator("demonstration chunks", training.seed).permutation(shown)[:KEPT_CHUNKS]
    expert = Demonstrations(features=torch.from_numpy(data.features[kept]), chunks=torch.from_numpy(data.chunks[kept]))
    checkpoint = folder / "critic.safetensors"
    save_critic(critic, policy, checkpoint, (card or {}) | {
        "training": dataclasses.asdict(training), "demonstrations": len(demonstrations),
        "attempts": len(attempts), "failed_attempts": sum(not e.success for e in attempts),
        "transitions": len(data), "seconds": time.monotonic() - started, "final": means,
        "demonstration_value_change_percentiles": value_change_percentiles(critic, policy, demonstrations),
    }, expert)  # fmt: skip
    return checkpoint


@torch.no_grad()
def value_change_percentiles(
    critic: Critic, policy: DiffusionPolicy, demonstrations: Sequence[Episode]
) -> dict[str, float]:
    """ΔV on the demonstrations, by percentile: what to choose attribution.threshold from."""
    seen = [torch.from_numpy(encoded(critic.eyes or policy, e).features) for e in demonstrations]
    changes = np.concatenate([value_change(critic.value(f).numpy(), policy.config.horizon) for f in seen])
    return {f"{p:g}": float(np.percentile(changes, p)) for p in (1, 5, 10, 25, 50)} if len(changes) else {}
