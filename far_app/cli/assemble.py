"""Puts a method together from its parts: checkpoints, critic, device, retry settings. The CLI alone composes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from far_app.config import RetryConfig, TaskConfig
from far_app.errors import CheckpointError, ConfigError
from far_app.protocols import OWN_STATE, Method, PolicySpec
from far_app.types import Observation

if TYPE_CHECKING:
    from far_app.learning.apart.protocol import Work
    from far_app.learning.critic import Critic
    from far_app.learning.engines import Choice
    from far_app.learning.memory import FeatureMemory
    from far_app.learning.policy import DiffusionPolicy
    from far_app.learning.runtime import ActingPolicy
    from far_app.learning.steering import Steering
    from far_app.methods.retry import Act

UNTRAINED = "untrained:"
"""--policy untrained:PRESET gives random weights."""
THRESHOLD_PERCENTILE = "5"
"""Of the demonstrations' ΔV: attribution's threshold where its rule is one and none is given."""
CHECKPOINTS = Path(__file__).parent.parent / "checkpoints"
"""The shipped quickstart model: {task}.policy.safetensors and {task}.critic.safetensors."""


@dataclass(frozen=True, kw_only=True)
class Parts:
    """A method ready to run."""

    method: Method
    policy_name: str
    """Checkpoint, for people and the recording."""
    max_attempts: int | None
    """Attempts a trial where the method fixes them."""
    checkpoint: str | None
    """As it was asked for; None for the shipped one."""
    another: Callable[[], Method]
    """One more method of the same parts, for a trial beside; the base policy is shared, so that they plan together."""


def shipped(task: str, kind: str) -> Path:
    """Where the quickstart model of a task lies; kind is "policy" or "critic"."""
    return CHECKPOINTS / f"{task}.{kind}.safetensors"


def checkpoints(task: str, policy: Path | None, critic: Path | None) -> tuple[Path, Path]:
    """The files of a model: those given, the critic beside a policy that was given, else the shipped ones."""
    beside = policy.with_name("critic.safetensors") if policy is not None else shipped(task, "critic")
    return policy or shipped(task, "policy"), critic or beside


@dataclass(frozen=True, kw_only=True)
class Model:
    """A base policy and its critic, loaded once for every method that is made from them."""

    network: DiffusionPolicy
    critic: Critic | None
    critic_file: Path | None
    """None where the weights are random."""
    name: str
    checkpoint: str | None
    """As it was asked for; None for the shipped one."""
    act: Act
    """Makes acting policies; the base policy is one object for all, so that trials plan together."""
    base: ActingPolicy
    memory: FeatureMemory
    """What they have seen."""


def assemble(
    method: str,
    task: TaskConfig,
    policy: str | None,
    critic: Path | None,
    device: str,
    retry: RetryConfig,
    engine: str = "auto",
    lanes: int | None = None,
    threads: int = 1,
    work: Callable[[], Work] | None = None,
) -> Parts:
    """Load what a method needs and warm it up; `lanes`: trials that will share the base policy's batches; `threads`: of
    one torch operation; `work`: where a method that learns does so, on a CPU. Raises ConfigError or
    CheckpointError."""
    if policy is not None and policy.startswith("test:"):
        from far_app.cli._scripted import ScriptedMethod

        scripted = ScriptedMethod(policy.removeprefix("test:"))
        return Parts(
            method=scripted, policy_name=policy, max_attempts=None, checkpoint=policy, another=lambda: scripted
        )
    model = load_model(policy, critic, task.name, device, [method], engine, lanes, threads)
    return equip(model, method, retry, work)


def check_methods(methods: Sequence[str]) -> None:
    """ConfigError for a name that is no method's."""
    from far_app.methods import METHODS

    if unknown := [m for m in methods if m not in METHODS]:
        raise ConfigError(f"unknown method '{unknown[0]}'; choose one of: {', '.join(METHODS)}")


def load_model(
    policy: str | None,
    critic: Path | None,
    task: str,
    device: str,
    methods: Sequence[str],
    engine: str = "auto",
    lanes: int | None = None,
    threads: int = 1,
) -> Model:
    """The networks that these methods need. "auto" takes the fastest engine of this machine, and with `lanes` the first
    that runs, for comparisons must repeat. Raises ConfigError or CheckpointError."""
    from far_app.learning.memory import FeatureMemory
    from far_app.learning.runtime import ActingPolicy
    from far_app.methods import METHODS
    from far_app.methods.retry import BASE_VERSION

    check_methods(methods)
    check_device(device)
    if policy is not None and policy.startswith(UNTRAINED):
        name, beside = policy, None
        network, critic_network = untrained(policy.removeprefix(UNTRAINED), task, device)
    else:
        path = Path(policy) if policy is not None else shipped(task, "policy")
        beside = critic or (shipped(task, "critic") if policy is None else path.with_name("critic.safetensors"))
        name = f"shipped: {path.name}" if policy is None else str(path)
        needed = any(METHODS[m].needs_critic for m in methods)
        network, critic_network = trained(path, beside, task, device, needed)
    memory, choice = FeatureMemory(), engine_choice(engine, network, lanes, threads)
    base = ActingPolicy(network, BASE_VERSION, critic_network, choice, batch=lanes, memory=memory)

    def act(network: DiffusionPolicy, version: str, steering: Steering | None = None) -> ActingPolicy:
        if version == BASE_VERSION:
            return base
        return ActingPolicy(network, version, critic_network, choice, steering, memory=memory, base=base)

    return Model(
        network=network, critic=critic_network, critic_file=beside, name=name, checkpoint=policy, act=act,
        memory=memory, base=base,
    )  # fmt: skip


def engine_choice(engine: str, network: DiffusionPolicy, lanes: int | None, threads: int) -> Choice:
    """Engines to try for this network. Raises ConfigError."""
    from far_app.learning.engines import order_of
    from far_app.learning.engines.choice import fastest

    return fastest(network, threads) if engine == "auto" and lanes is None else order_of(engine, network)


def equip(model: Model, method: str, retry: RetryConfig, work: Callable[[], Work] | None = None) -> Parts:
    """One method of a loaded model, with its settings; on a CPU it learns where `work` says, else here on one thread.
    Raises ConfigError or CheckpointError."""
    from far_app.learning.apart.here import WorkHere
    from far_app.learning.critic_file import load_demonstrations
    from far_app.methods import METHODS, Ingredients
    from far_app.methods import method as make_method

    entry, demonstrations = METHODS[method], None
    if model.critic is not None and model.critic_file is not None:
        if retry.fcpa.guard == "bc" or entry.needs_demonstrations:
            demonstrations = load_demonstrations(model.critic_file, model.network)
        retry = with_threshold(retry, model.critic_file)
    on_cpu = model.network.normalizer.low.device.type == "cpu"
    ingredients = Ingredients(
        network=model.network, critic=model.critic, config=retry, demonstrations=demonstrations, act=model.act,
        memory=model.memory, encoder=model.base.another_encoder, work=work if work is not None and on_cpu else WorkHere,
    )  # fmt: skip
    return Parts(
        method=make_method(method, ingredients), policy_name=model.name, max_attempts=entry.attempts,
        checkpoint=model.checkpoint, another=lambda: make_method(method, ingredients),
    )  # fmt: skip


def with_threshold(retry: RetryConfig, critic: Path) -> RetryConfig:
    """The settings with the model's own threshold of attribution, where the rule wants one and none was given."""
    from far_app.learning.critic_file import read_card

    rule = retry.attribution
    if rule.rule != "threshold" or not math.isnan(rule.threshold):
        return retry
    percentiles = read_card(critic).get("demonstration_value_change_percentiles")
    if not isinstance(percentiles, dict) or THRESHOLD_PERCENTILE not in percentiles:
        raise ConfigError(f"{critic} does not tell its demonstrations' ΔV; give --retry.attribution.threshold")
    return replace(retry, attribution=replace(rule, threshold=float(percentiles[THRESHOLD_PERCENTILE])))


def trained(
    policy: Path, critic: Path, task: str, device: str, needs_critic: bool
) -> tuple[DiffusionPolicy, Critic | None]:
    """Networks from checkpoints; the critic where it is needed or there. Raises CheckpointError."""
    from far_app.learning.critic_file import load_critic
    from far_app.learning.policy import load_policy

    network = load_policy(policy, task, device)
    return network, load_critic(critic, network).to(device) if needs_critic or critic.exists() else None


def untrained(preset: str, task: str, device: str) -> tuple[DiffusionPolicy, Critic]:
    """Networks of a preset's architecture with random weights, the same each time: for measurements, where only the
    arithmetic counts."""
    import torch

    from far_app.learning.critic import Critic, CriticShape
    from far_app.learning.policy import DiffusionPolicy
    from far_app.learning.policy import preset as preset_config

    torch.manual_seed(0)
    network = DiffusionPolicy(preset_config(preset, task)).to(device).eval().requires_grad_(False)
    shape = CriticShape(
        features=network.feature_dim, horizon=network.config.horizon, action_dim=network.spec().action_dim
    )
    return network, Critic(shape).to(device).eval().requires_grad_(False)


def check_device(device: str) -> None:
    """Raises ConfigError when torch has no such device."""
    import torch

    if device != "cpu" and not (device.startswith("cuda") and torch.cuda.is_available()):
        raise ConfigError(
            f"device '{device}' was asked for, but torch {torch.__version__} sees no CUDA GPU; use --device cpu, or "
            "install a CUDA build of torch and NVIDIA's driver"
        )


def check_observation(spec: PolicySpec, observation: Observation) -> None:
    """What the policy needs to see against what the robot shows, before the first motion. Raises CheckpointError."""
    unseen = [key for key in spec.state_keys if key not in OWN_STATE and key not in observation.objects]
    if unseen:
        raise CheckpointError(
            f"policy {spec.name} sees the pose of {', '.join(unseen)}, the robot tells of "
            f"{', '.join(observation.objects) or 'no objects'}; give a policy that looks through cameras"
        )
    for camera in spec.cameras:
        image = observation.images.get(camera)
        if image is None:
            raise CheckpointError(
                f"policy {spec.name} looks through camera '{camera}', the robot shows "
                f"{', '.join(observation.images) or 'none'}; give the checkpoint or the rig that belongs to it"
            )
        if image.shape[:2] != (spec.image_size, spec.image_size):
            raise CheckpointError(
                f"policy {spec.name} was trained on {spec.image_size}×{spec.image_size} pictures, camera '{camera}' "
                f"gives {image.shape[1]}×{image.shape[0]}; set policy_image in the rig file or give another checkpoint"
            )
