"""A critic on disk: safetensors weights, with its shape, its task and the encoder it was trained on in the header.

Beside the weights lie a few hundred demonstration chunks with the policy's features, for the bc guard of FCPA.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from far_app.errors import CheckpointError
from far_app.learning.critic import Critic, CriticShape, eyes_of
from far_app.learning.policy import DiffusionPolicy, fingerprint
from far_app.learning.preference import Demonstrations

FORMAT = "far-critic-1"
DEMONSTRATIONS = "demonstrations."
"""Prefix of the tensors that are not the critic's own."""


def encoder_fingerprint(policy: DiffusionPolicy) -> str:
    """Hash of everything between an observation and its features."""
    return fingerprint(policy.encoder) + fingerprint(policy.normalizer)


def save_critic(
    critic: Critic,
    policy: DiffusionPolicy,
    path: Path,
    card: dict[str, object] | None = None,
    demonstrations: Demonstrations | None = None,
) -> None:
    """Write a critic made for this policy's features, whole or not at all."""
    header = {
        "format": FORMAT, "task": policy.config.task, "encoder": encoder_fingerprint(policy),
        "shape": json.dumps(dataclasses.asdict(critic.shape)), "card": json.dumps(card or {}),
    }  # fmt: skip
    tensors = dict(critic.state_dict())
    if demonstrations is not None:
        tensors[f"{DEMONSTRATIONS}features"] = demonstrations.features
        tensors[f"{DEMONSTRATIONS}chunks"] = demonstrations.chunks
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    save_file({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, partial, header)
    partial.replace(path)


def load_critic(path: Path, policy: DiffusionPolicy) -> Critic:
    """Read a critic; CheckpointError when it is missing, truncated, of another kind, or made for other features."""
    remedy = "train it for this policy with `far train critic`"
    if not path.exists():
        raise CheckpointError(f"no critic checkpoint at {path}; {remedy}, or give --critic")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"{path} is truncated or not a safetensors file ({error}); copy it again or {remedy}"
        ) from error
    if header.get("format") != FORMAT:
        raise CheckpointError(f"{path} holds format {header.get('format')!r}, a critic has {FORMAT!r}")
    if header["task"] != policy.config.task:
        raise CheckpointError(f"{path} was trained for task '{header['task']}', the policy's is '{policy.config.task}'")
    if header["encoder"] != encoder_fingerprint(policy):
        raise CheckpointError(
            f"{path} was trained on the features of encoder {header['encoder']}, this policy has encoder "
            f"{encoder_fingerprint(policy)}: its values would mean nothing; {remedy}"
        )
    raw = json.loads(header["shape"])
    shape = CriticShape(**(raw | {"hidden": tuple(raw["hidden"])}))
    critic = Critic(shape, eyes_of(policy) if shape.own_eyes else None)
    try:
        critic.load_state_dict({k: v for k, v in weights.items() if not k.startswith(DEMONSTRATIONS)})
    except RuntimeError as error:
        raise CheckpointError(f"{path} does not fit the shape it names ({critic.shape}): {error}") from error
    return critic.to(next(policy.parameters()).device).eval().requires_grad_(False)


def load_demonstrations(path: Path, policy: DiffusionPolicy) -> Demonstrations | None:
    """The demonstration chunks beside a critic that load_critic accepts; None when it has none."""
    with safe_open(path, framework="pt") as file:
        names = [f"{DEMONSTRATIONS}{name}" for name in ("features", "chunks")]
        if not set(names) <= set(file.keys()):
            return None
        features, chunks = (file.get_tensor(name).to(next(policy.parameters()).device) for name in names)
    return Demonstrations(features=features, chunks=chunks)


def read_card(path: Path) -> dict[str, object]:
    """The model card stored with a critic."""
    with safe_open(path, framework="pt") as file:
        return json.loads((file.metadata() or {}).get("card", "{}"))
