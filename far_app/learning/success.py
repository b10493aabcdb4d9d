"""Success seen by a small head on the frozen policy encoder's features.

    score(s_t)   logit that s_t is a success                      MLP on the features of [s_{t−1}, s_t]
    w_t          min(score(s_{t−k+1}), …, score(s_t))             k consecutive frames agree
    success      w_t > threshold                                  ends the attempt
    unsure       lower ≤ max_t w_t ≤ threshold at the horizon     the operator is asked; a failure without a word

`threshold` is split-conformal: of n held-out failed attempts with scores max_t w_t it is the ⌈(n+1)(1−α)⌉-th smallest,
so that a new failed attempt is taken for a success with probability at most α (attempts exchangeable).
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from far_app.errors import CheckpointError, ConfigError
from far_app.learning.critic import mlp
from far_app.learning.critic_file import encoder_fingerprint
from far_app.learning.policy import DiffusionPolicy
from far_app.types import Judge, Observation, Outcome

FORMAT = "far-success-1"


@dataclass(frozen=True, kw_only=True)
class SuccessRule:
    """From scores to a verdict."""

    consecutive: int = 5
    """k."""
    threshold: float = math.inf
    """Logit; above it an attempt is a success."""
    lower: float = math.inf
    """Logit; from here to the threshold the detector is unsure."""
    false_success: float = 0.01
    """α that the threshold was calibrated to, per failed attempt."""


class SuccessHead(nn.Module):
    """Features to a logit, on inputs standardised by fixed statistics."""

    mean: Tensor
    std: Tensor

    def __init__(self, features: int, hidden: tuple[int, ...] = (64,)) -> None:
        super().__init__()
        self.features, self.hidden = features, hidden
        self.net = mlp(features, hidden, 1)
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("std", torch.ones(features))

    def forward(self, features: Float[Tensor, "B F"]) -> Float[Tensor, "B"]:
        return self.net((features - self.mean) / self.std).squeeze(-1)


class LearnedDetector:
    """far_app.protocols.SuccessDetector. Looks at every observation it is given, in the caller's thread (a few ms)."""

    def __init__(self, policy: DiffusionPolicy, head: SuccessHead, rule: SuccessRule, wait: float = 0.0) -> None:
        """`wait`: seconds the operator is given when the detector is unsure."""
        self.policy, self.head, self.rule, self.wait = policy, head, rule, wait
        self._history: deque[Observation] = deque(maxlen=policy.config.n_obs)
        self._scores: deque[float] = deque(maxlen=rule.consecutive)
        self.best = -math.inf
        """max_t w_t of the attempt so far."""

    @property
    def patience(self) -> float:
        return self.wait if self.rule.lower <= self.best <= self.rule.threshold else 0.0

    def begin(self) -> None:
        self._history.clear()
        self._scores.clear()
        self.best = -math.inf

    def judge(self, observation: Observation) -> Outcome | None:
        self._history.extend([observation] * (1 if self._history else self.policy.config.n_obs))
        with torch.inference_mode():
            self._scores.append(float(self.head(self.policy.encode([tuple(self._history)]))))
        if len(self._scores) < self.rule.consecutive:
            return None
        agreed = min(self._scores)
        self.best = max(self.best, agreed)
        if agreed <= self.rule.threshold:
            return None
        note = f"score {agreed:.2f} over {self.rule.consecutive} frames, threshold {self.rule.threshold:.2f}"
        return Outcome(success=True, judged_by=Judge.DETECTOR, note=note)


def agreed(scores: Float[np.ndarray, "T"], consecutive: int) -> Float[np.ndarray, "T+1-k"]:
    """w_t of every whole window of an attempt's scores; empty for an attempt shorter than one."""
    if len(scores) < consecutive:
        return np.zeros(0)
    return np.lib.stride_tricks.sliding_window_view(scores, consecutive).min(axis=1)


def best(scores: Float[np.ndarray, "T"], consecutive: int) -> float:
    """max_t w_t."""
    return float(max(agreed(scores, consecutive), default=-math.inf))


def conformal_threshold(failures: Float[np.ndarray, "n"], alpha: float) -> float:
    """The ⌈(n+1)(1−α)⌉-th smallest score of held-out failures. Raises ConfigError where n is too small for α."""
    rank = math.ceil((len(failures) + 1) * (1.0 - alpha) - 1e-9)
    if rank > len(failures):
        needed = math.ceil(1.0 / alpha - 1e-9) - 1
        raise ConfigError(
            f"a false-success rate of {alpha:g} needs at least {needed} failed attempts to calibrate on, there are "
            f"{len(failures)}; record more, or ask for a higher rate"
        )
    return float(np.sort(failures)[rank - 1])


def conformal_lower(successes: Float[np.ndarray, "n"], missed: float) -> float:
    """The score that a new success falls below with probability at most `missed`; −inf where n is too small."""
    rank = math.floor((len(successes) + 1) * missed)
    return float(np.sort(successes)[rank - 1]) if rank >= 1 else -math.inf


def save_detector(
    head: SuccessHead, rule: SuccessRule, policy: DiffusionPolicy, path: Path, card: dict[str, object]
) -> None:
    """Write a detector made for this policy's features, whole or not at all."""
    header = {
        "format": FORMAT, "task": policy.config.task, "encoder": encoder_fingerprint(policy), "card": json.dumps(card),
        "shape": json.dumps([head.features, head.hidden]), "rule": json.dumps(dataclasses.asdict(rule)),
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    save_file({k: v.detach().cpu().contiguous() for k, v in head.state_dict().items()}, partial, header)
    partial.replace(path)


def load_detector(path: Path, policy: DiffusionPolicy, wait: float = 0.0) -> LearnedDetector:
    """Read a detector; CheckpointError when it is missing, damaged, or made for another policy's features."""
    remedy = "train it for this policy with `far train success`"
    if not path.exists():
        raise CheckpointError(f"no success detector at {path}; {remedy}")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is truncated or not a safetensors file ({error}); {remedy}") from error
    if header.get("format") != FORMAT:
        raise CheckpointError(f"{path} holds format {header.get('format')!r}, a success detector has {FORMAT!r}")
    if (header["task"], header["encoder"]) != (policy.config.task, encoder_fingerprint(policy)):
        raise CheckpointError(
            f"{path} was trained for task '{header['task']}' on the features of encoder {header['encoder']}, this "
            f"policy is for '{policy.config.task}' with encoder {encoder_fingerprint(policy)}; {remedy}"
        )
    features, hidden = json.loads(header["shape"])
    head = SuccessHead(features, tuple(hidden))
    head.load_state_dict(weights)
    device = next(policy.parameters()).device
    return LearnedDetector(
        policy, head.to(device).eval().requires_grad_(False), SuccessRule(**json.loads(header["rule"])), wait
    )


def read_card(path: Path) -> dict[str, object]:
    """The model card stored with a detector."""
    with safe_open(path, framework="pt") as file:
        return json.loads((file.metadata() or {}).get("card", "{}"))
