"""The diffusion policy as a network: encoder, normaliser, denoiser, presets, checkpoint file.

`DiffusionPolicy` is weights and maths; `far_app/learning/runtime.py` wraps it as the Policy that acts.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from far_app.errors import CheckpointError, ConfigError
from far_app.learning.diffusion import ddim_sample
from far_app.learning.encoder import ObservationEncoder
from far_app.learning.state import state_dim, state_of
from far_app.learning.unet import ConditionalUnet1d
from far_app.picture import Framing
from far_app.preflight import Setup, setup_from
from far_app.protocols import OWN_STATE, History, PolicySpec
from far_app.tasks import TASKS
from far_app.types import ACTION_DIM

FORMAT = "far-policy-1"


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """Architecture and sampling; sizes from the paper's appendix, silent places from its neighbours' defaults."""

    preset: str
    task: str
    encoder: str
    """"light", "resnet18", or "none" for a policy without cameras."""
    norm: str = "group"
    """Normalisation in a ResNet: "group" (16 channels a group) or "batch"."""
    cameras: tuple[str, ...] = ("front", "wrist")
    image_size: int = 84
    objects: tuple[str, ...] = ()
    """Whose poses are part of the state: the task's, in the `state` preset."""
    n_obs: int = 2
    """[s_{t−1}, s_t] (paper, Network Architecture)."""
    horizon: int = 8
    """H."""
    widths: tuple[int, ...] = (64, 128, 256)
    kernel: int = 3
    step_dim: int = 16
    ddim_steps: int = 16


PRESETS: dict[str, dict[str, Any]] = {
    "state": {"encoder": "none", "cameras": (), "widths": (32, 64, 128), "ddim_steps": 8},
    "quickstart": {"encoder": "light", "widths": (64, 128, 256), "ddim_steps": 8},
    "paper": {"encoder": "resnet18", "widths": (64, 128, 256), "ddim_steps": 16},
}


def preset(name: str, task: str) -> PolicyConfig:
    """A preset for a task, or an error that lists the presets."""
    if name not in PRESETS:
        raise ConfigError(f"unknown preset '{name}'; choose one of: {', '.join(PRESETS)}")
    chosen = dict(PRESETS[name])
    if not chosen.get("cameras", True):
        chosen["objects"] = tuple(name for name, _ in TASKS[task].objects)
    return PolicyConfig(preset=name, task=task, **chosen)


class Normalizer(nn.Module):
    """State to [−1, 1] by the demonstrations' range; the hand's quaternion is flipped to their hemisphere."""

    low: Tensor
    high: Tensor
    hemisphere: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("low", torch.full((dim,), -1.0))
        self.register_buffer("high", torch.full((dim,), 1.0))
        self.register_buffer("hemisphere", torch.tensor([0.0, 1.0, 0.0, 0.0]))

    def fit(self, states: Float[np.ndarray, "N D"]) -> None:
        """Ranges from the demonstrations; a component that hardly moves keeps a range of at least 0.02."""
        self.hemisphere.copy_(torch.as_tensor(states[0, 3:7]))
        upright = self.aligned(torch.as_tensor(states))
        low, high = upright.amin(0), upright.amax(0)
        middle, half = (low + high) / 2, ((high - low) / 2).clamp_min(0.01)
        self.low.copy_(middle - half)
        self.high.copy_(middle + half)

    def aligned(self, state: Float[Tensor, "*B D"]) -> Float[Tensor, "*B D"]:
        sign = torch.where((state[..., 3:7] * self.hemisphere).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        return torch.cat([state[..., :3], sign * state[..., 3:7], state[..., 7:]], dim=-1)

    def forward(self, state: Float[Tensor, "*B D"]) -> Float[Tensor, "*B D"]:
        return (2.0 * (self.aligned(state) - self.low) / (self.high - self.low) - 1.0).clamp(-1.5, 1.5)


class DiffusionPolicy(nn.Module):
    """π_θ(a_{t:t+H−1} | s_{t−1}, s_t)."""

    def __init__(self, config: PolicyConfig) -> None:
        super().__init__()
        self.config = config
        self.normalizer = Normalizer(state_dim(config.objects))
        self.encoder = ObservationEncoder(
            config.encoder, config.cameras, config.image_size, config.n_obs, state_dim(config.objects), config.norm
        )
        self.denoiser = ConditionalUnet1d(
            ACTION_DIM, self.encoder.dim, widths=config.widths, kernel=config.kernel, step_dim=config.step_dim
        )

    @property
    def feature_dim(self) -> int:
        return self.encoder.dim

    def spec(self) -> PolicySpec:
        c = self.config
        return PolicySpec(
            name=f"{c.preset}-{c.task}", task=c.task, horizon=c.horizon, n_obs=c.n_obs, action_dim=ACTION_DIM,
            cameras=c.cameras, image_size=c.image_size if c.cameras else 0, state_keys=(*OWN_STATE, *c.objects),
        )  # fmt: skip

    def features(
        self, images: dict[str, UInt8[Tensor, "B T S S 3"]], state: Float[Tensor, "B T D"]
    ) -> Float[Tensor, "B F"]:
        """The condition of the denoiser and the input of the critic."""
        return self.encoder(images, self.normalizer(state))

    def encode(self, histories: Sequence[History]) -> Float[Tensor, "B F"]:
        """Features of observation histories (oldest first), on the network's device, without gradients."""
        device = self.normalizer.low.device
        images = {
            c: torch.from_numpy(np.stack([np.stack([o.images[c] for o in h]) for h in histories])).to(device)
            for c in self.config.cameras
        }
        state = self.states(histories)
        with torch.no_grad():
            return self.features(images, state)

    def states(self, histories: Sequence[History]) -> Float[Tensor, "B T D"]:
        """What the policy sees beside pictures, not yet normalised."""
        stacked = np.stack([np.stack([state_of(o, self.config.objects) for o in h]) for h in histories])
        return torch.from_numpy(stacked).to(self.normalizer.low.device)

    def sample(self, features: Float[Tensor, "B F"], noise: Float[Tensor, "B H A"]) -> Float[Tensor, "B H A"]:
        """Chunks in [−1, 1], denoised from the given noise."""
        with torch.no_grad():
            return ddim_sample(self.denoiser, features, noise, self.config.ddim_steps)


def fingerprint(module: nn.Module) -> str:
    """Eight hex digits of the weights' hash."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:8]


def save_policy(policy: DiffusionPolicy, path: Path, card: dict[str, object] | None = None) -> None:
    """Write a checkpoint (safetensors): weights, architecture, and whatever the model card should say."""
    metadata = {
        "format": FORMAT,
        "config": json.dumps(dataclasses.asdict(policy.config)),
        "card": json.dumps(card or {}),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    save_file({k: v.detach().cpu().contiguous() for k, v in policy.state_dict().items()}, partial, metadata)
    partial.replace(path)


def _tupled(value: Any) -> Any:
    """JSON's lists are the configuration's tuples."""
    return tuple(value) if isinstance(value, list) else value


def load_policy(path: Path, task: str | None = None, device: str = "cpu") -> DiffusionPolicy:
    """Read a checkpoint; CheckpointError when it is missing, truncated, of another kind or for another task."""
    if not path.exists():
        raise CheckpointError(f"no policy checkpoint at {path}; train one with `far train policy`, or give --policy")
    try:
        with safe_open(path, framework="pt", device=device) as file:
            metadata = file.metadata() or {}
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(
            f"{path} is truncated or not a safetensors file ({error}); copy or train it again"
        ) from error
    if metadata.get("format") != FORMAT:
        raise CheckpointError(f"{path} holds format {metadata.get('format')!r}, a policy has {FORMAT!r}")
    raw: dict[str, Any] = json.loads(metadata["config"])
    config = PolicyConfig(**{k: _tupled(v) for k, v in raw.items()})
    if task is not None and config.task != task:
        raise CheckpointError(f"{path} was trained for task '{config.task}', this run is '{task}'; give its checkpoint")
    policy = DiffusionPolicy(config)
    try:
        policy.load_state_dict(weights)
    except RuntimeError as error:
        raise CheckpointError(f"{path} does not fit the architecture it names ({config.preset}): {error}") from error
    return policy.to(device).eval().requires_grad_(False)


def read_card(path: Path) -> dict[str, object]:
    """The model card stored with a checkpoint; for one made before cards told of the setup, with what a NAMEsetup.json
    beside its NAMEpolicy.safetensors adds."""
    beside = path.with_name(path.name.removesuffix("policy.safetensors") + "setup.json")
    added = json.loads(beside.read_text()) if beside != path and beside.exists() else {}
    with safe_open(path, framework="pt") as file:
        return added | json.loads((file.metadata() or {}).get("card", "{}"))


def trained_setup(path: Path) -> Setup | None:
    """What a policy's data were made on; None where its card does not say."""
    return setup_from(read_card(path).get("setup"))


def trained_framings(path: Path) -> dict[str, Framing]:
    """How the cameras of a policy's data were cut, by view; empty where its card does not say."""
    setup = trained_setup(path)
    return {name: view.framing for name, view in setup.views.items()} if setup is not None else {}
