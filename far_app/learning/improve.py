"""One epoch's learning of continual policy improvement (paper, Continual Policy Improvement).

    critic: IQL on D_exp ∪ D_succ ∪ D_fail
    policy: L = E_{D_exp ∪ D_succ} [ w(s, a) ‖ε − ε_θ(a_k, s, k)‖² ],   w = exp((Q(s, a) − V(s)) / η) ≤ 100   (Eq. awr)

Both go on from their present weights. The encoder stays as it is, so that the critic's features keep their meaning;
w is divided by its mean, so that the step size does not depend on the rewards' scale. Called by far_app/cli/improve.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from far_app.learning.critic import Critic
from far_app.learning.critic_file import encoder_fingerprint, load_critic, load_demonstrations, save_critic
from far_app.learning.critic_source import Features, encoded, policy_features
from far_app.learning.dataset import Episode
from far_app.learning.pairs import AWR_INVERSE_TEMPERATURE, AWR_WEIGHT_LIMIT
from far_app.learning.policy import DiffusionPolicy, load_policy, read_card
from far_app.learning.train_critic import CriticTraining, fit
from far_app.learning.train_policy import TRAININGS, PolicyTraining, train_policy
from far_app.learning.transitions import Backup, chunked


@dataclass(frozen=True, kw_only=True)
class Experience:
    """What there is to learn from."""

    demonstrations: Sequence[Episode]
    """D_exp."""
    succeeded: Sequence[Episode]
    """D_succ."""
    failed: Sequence[Episode]
    """D_fail."""


def finetuning(preset: str, iterations: int, seed: int) -> PolicyTraining:
    """A preset's own recipe at the end of its learning rate's way, where a policy can move without forgetting."""
    usual = TRAININGS[preset]
    rate = (usual.lr * usual.lr_end) ** 0.5
    return replace(usual, iterations=iterations, lr=rate, lr_end=rate, warmup=0, localise=0.0, seed=seed)


def learn(
    policy_path: Path,
    critic_path: Path,
    experience: Experience,
    critic_training: CriticTraining,
    policy_training: PolicyTraining,
    folder: Path,
) -> tuple[Path, Path]:
    """Both models after an epoch, in its folder; a second call goes on where the first one stopped. Raises ConfigError
    when the folder holds another run, PolicyError when a loss is not finite (the last good state is kept)."""
    policy = load_policy(policy_path)
    critic = load_critic(critic_path, policy)
    better = folder / "critic.safetensors"
    if not better.exists():
        for head in (critic.v, critic.q1, critic.q2):
            head.requires_grad_(True)
        backup = Backup(ticks=critic_training.backup, gamma=critic_training.gamma)
        tried = [*experience.succeeded, *experience.failed]
        data, _ = policy_features(policy, experience.demonstrations, tried, critic_training.reward, backup)
        source = Features(data)
        torch.manual_seed(critic_training.seed)
        fit(critic, source, critic_training, folder, stamp=encoder_fingerprint(policy), standardise=False)
        save_critic(critic.requires_grad_(False), policy, better, {}, load_demonstrations(critic_path, policy))
    critic = load_critic(better, policy)
    shown = [*experience.demonstrations, *experience.succeeded]
    weights = np.concatenate([advantage_weights(policy, critic, e) for e in shown])
    known = {k: v for k, v in read_card(policy_path).items() if k in ("setup", "colours")}
    path = train_policy(
        shown, policy.config, policy_training, folder, start=policy, weights=weights / weights.mean(),
        card=known | {"improved from": policy_path.name, "demonstrations": len(experience.demonstrations),
              "successes": len(experience.succeeded), "failures": len(experience.failed)},
    )  # fmt: skip
    return path, better


@torch.no_grad()
def advantage_weights(policy: DiffusionPolicy, critic: Critic, episode: Episode) -> Float[np.ndarray, "N"]:
    """w(s_t, a_{t:t+H−1}) of every tick of an episode, float32."""
    features = torch.from_numpy(encoded(policy, episode).features)
    chunks = torch.from_numpy(chunked(episode.actions.astype(np.float32), policy.config.horizon))
    advantages = critic.q(features, chunks) - critic.value(features)
    return (advantages * AWR_INVERSE_TEMPERATURE).exp().clamp(max=AWR_WEIGHT_LIMIT).numpy()
