"""IQL on the policy's frozen features: V and Q from demonstrations, and from the policy's own attempts where given.

Features are computed once; an iteration is then a few small matrix products. Batches are keyed by (seed, iteration),
so a run killed at any moment goes on from its last saved state and ends with the very same weights (on CPU).
"""

from __future__ import annotations

import dataclasses
import json
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from far_app.errors import ConfigError, PolicyError
from far_app.learning.critic import Critic, CriticShape, iql_losses
from far_app.learning.critic_file import encoder_fingerprint, save_critic
from far_app.learning.dataset import Episode
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.resume import load_state, optimizer_tensors, restore_optimizer, save_state
from far_app.learning.train_policy import segment_features
from far_app.learning.transitions import EncodedEpisode, RewardKind, Transitions, joined, transitions
from far_app.seeding import generator

log = logging.getLogger(__name__)


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
    polyak: float = 0.005
    """ρ of the target networks."""
    reward: RewardKind = "shaped"
    hidden: tuple[int, ...] = (256, 256)
    seed: int = 0
    log_every: int = 500
    save_every: int = 2_000

    def __post_init__(self) -> None:
        if not 0 < self.expectile < 1:
            raise ConfigError(f"expectile is {self.expectile}, must be between 0 and 1")
        if not 0 <= self.gamma <= 1:
            raise ConfigError(f"gamma is {self.gamma}, must be in [0, 1]")


def encoded(policy: DiffusionPolicy, episode: Episode, ticks_at_once: int = 64) -> EncodedEpisode:
    """An episode of N observed ticks as N − 1 transitions: a reward and a success belong to the action before them."""
    n_obs, ticks = policy.config.n_obs, len(episode)
    parts = []
    for start in range(0, ticks, ticks_at_once):
        end = min(start + ticks_at_once, ticks)
        frames = np.clip(np.arange(start - n_obs + 1, end), 0, None)
        images = {c: torch.from_numpy(episode.images[c][frames])[None] for c in policy.config.cameras}
        with torch.no_grad():
            parts.append(segment_features(policy, images, torch.from_numpy(episode.states[frames])[None]).numpy())
    return EncodedEpisode(
        features=np.concatenate(parts), actions=episode.actions[:-1], rewards=episode.rewards[1:],
        success=episode.successes[1:],
    )  # fmt: skip


def dataset(
    policy: DiffusionPolicy, demonstrations: Sequence[Episode], attempts: Sequence[Episode], reward: RewardKind
) -> Transitions:
    """D_exp ∪ D_succ ∪ D_fail as transitions."""
    if not demonstrations:
        raise ConfigError("no demonstrations to train a critic on; make some with `far demo`")
    episodes = tqdm([*demonstrations, *attempts], unit="episode", desc="features", leave=False)
    return joined([transitions(encoded(policy, e), policy.config.horizon, reward) for e in episodes if len(e) > 1])


def fit(critic: Critic, data: Transitions, training: CriticTraining, folder: Path, stamp: str = "") -> dict[str, float]:
    """Train (or go on training) on transitions; returns the last interval's means. `stamp` names what the features
    were made with: a saved state with another is refused."""
    if not len(data):
        raise ConfigError("no transitions to train a critic on")
    tensors = [torch.from_numpy(np.ascontiguousarray(a)) for a in (
        data.features, data.chunks, data.rewards, data.next_features, data.done
    )]  # fmt: skip
    optimizer = torch.optim.AdamW(
        [p for p in critic.parameters() if p.requires_grad], lr=training.lr, weight_decay=0.0, foreach=True
    )
    state_path = folder / "critic_state.safetensors"
    notes: dict[str, object] = {
        "training": json.loads(json.dumps(dataclasses.asdict(training))),
        "stamp": stamp,
        "size": len(data),
    }
    done = resume(critic, optimizer, state_path, notes)
    if not done:
        critic.standardise(tensors[0])
    folder.mkdir(parents=True, exist_ok=True)
    started, means, interval = time.monotonic(), {}, []
    bar = tqdm(range(done, training.iterations), initial=done, total=training.iterations, unit="it", desc="critic")
    for iteration in bar:
        rows = torch.from_numpy(generator("critic", training.seed, iteration).integers(len(data), size=training.batch))
        features, chunks, rewards, next_features, done_mask = (t[rows] for t in tensors)
        value_loss, q_loss = iql_losses(
            critic, features, chunks, rewards, next_features, done_mask, training.expectile, training.gamma
        )
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
            means = {"value_loss": v, "q_loss": q} | statistics(critic, tensors[0], tensors[1])
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
def statistics(critic: Critic, features: Tensor, chunks: Tensor) -> dict[str, float]:
    """Where V and Q stand on a spread of the training states."""
    rows = slice(None, None, max(1, len(features) // 2048))
    values, q = critic.value(features[rows]), critic.q(features[rows], chunks[rows])
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
    c = policy.config
    critic = Critic(CriticShape(
        features=policy.feature_dim, horizon=c.horizon, action_dim=demonstrations[0].actions.shape[1],
        hidden=training.hidden,
    ))  # fmt: skip
    started = time.monotonic()
    data = dataset(policy, demonstrations, attempts, training.reward)
    means = fit(critic, data, training, folder, stamp=encoder_fingerprint(policy))
    checkpoint = folder / "critic.safetensors"
    save_critic(critic, policy, checkpoint, (card or {}) | {
        "training": dataclasses.asdict(training), "demonstrations": len(demonstrations),
        "attempts": len(attempts), "failed_attempts": sum(not e.success for e in attempts),
        "transitions": len(data), "seconds": time.monotonic() - started, "final": means,
    })  # fmt: skip
    return checkpoint
