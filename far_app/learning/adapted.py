"""Adapted weights from a recording and the base policy they were made from, as one policy again."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import nn

from far_app.errors import CheckpointError
from far_app.learning.policy import DiffusionPolicy, fingerprint, load_policy, read_card, save_policy
from far_app.recording.weights_file import Kept
from far_app.types import AdaptedWeights


def adapted_policy(kept: Kept, base: Path) -> DiffusionPolicy:
    """The policy that acted. Raises CheckpointError when the base is another one or the weights do not fit."""
    policy = load_policy(base, kept.task)
    there = fingerprint(policy)
    if there != kept.base:
        raise CheckpointError(
            f"{kept.trial}:{kept.version} was adapted from a policy with fingerprint {kept.base}, {base} has {there}; "
            "give the checkpoint the session ran with: --base"
        )
    try:
        policy.denoiser.load_state_dict(load_file(kept.path))
    except (SafetensorError, OSError, RuntimeError) as error:
        raise CheckpointError(f"{kept.path} is damaged or does not fit {base}: {error}") from error
    return policy


def denoiser_of(weights: AdaptedWeights, base: DiffusionPolicy, known_as: str) -> nn.Module:
    """A denoiser of its own with these weights; `known_as`: the base's fingerprint. Raises CheckpointError."""
    if weights.base != known_as:
        raise CheckpointError(
            f"{weights.version} was adapted from a policy with fingerprint {weights.base}, this one has {known_as}"
        )
    denoiser = copy.deepcopy(base.denoiser)
    try:
        denoiser.load_state_dict({name: torch.from_numpy(np.array(t)) for name, t in weights.tensors.items()})
    except RuntimeError as error:
        raise CheckpointError(f"the weights of {weights.version} do not fit this policy: {error}") from error
    return denoiser.requires_grad_(False)


def promote(kept: Kept, base: Path, out: Path) -> None:
    """A checkpoint of its own: `far run --policy OUT`."""
    card = {
        **read_card(base), "promoted from": f"{kept.session}, trial {kept.trial}, attempt {kept.attempt}",
        "version": kept.version, "parent": kept.parent, "base": f"{base.name} ({kept.base})", "pairs": kept.pairs,
        "winner_error": kept.winner_error, "loser_error": kept.loser_error,
    }  # fmt: skip
    save_policy(adapted_policy(kept, base), out, card)
