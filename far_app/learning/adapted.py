"""Adapted weights from a recording and the base policy they were made from, as one policy again."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file

from far_app.errors import CheckpointError
from far_app.learning.policy import DiffusionPolicy, fingerprint, load_policy, read_card, save_policy
from far_app.recording.weights_file import Kept


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


def promote(kept: Kept, base: Path, out: Path) -> None:
    """A checkpoint of its own: `far run --policy OUT`."""
    card = {
        **read_card(base), "promoted from": f"{kept.session}, trial {kept.trial}, attempt {kept.attempt}",
        "version": kept.version, "parent": kept.parent, "base": f"{base.name} ({kept.base})", "pairs": kept.pairs,
        "winner_error": kept.winner_error, "loser_error": kept.loser_error,
    }  # fmt: skip
    save_policy(adapted_policy(kept, base), out, card)
