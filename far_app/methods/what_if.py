"""Answers the attempt view's questions about a recorded attempt: V under a critic, positives, the adaptation once more.

The very code that learns during a session runs here, on a recorded attempt and with the chunks the operator names;
without gradient steps where only positives are wanted. Called by `far replay`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from far_app.config import RetryConfig
from far_app.errors import FarError
from far_app.learning.cancellation import AdaptationCancelledError, Cancelled
from far_app.learning.critic import Critic
from far_app.learning.memory import FeatureMemory
from far_app.learning.policy import DiffusionPolicy
from far_app.learning.preference import Demonstrations
from far_app.methods import evidence
from far_app.methods.retry import Ingredients, RetryMethod
from far_app.protocols import PolicySpec
from far_app.recording.attempt_reader import AttemptRecording
from far_app.seeding import generator
from far_app.types import Adaptation, AdaptationStep, Attempt, FlagCorrection, Judge, Outcome
from far_app.what_if import RECORDED, Answer, Moved, Question

SAMPLES = 4
"""Chunks sampled at each flagged state before and after the adaptation, for the eye."""


@dataclass(frozen=True, kw_only=True)
class Networks:
    """What answers: the recorded session's policy, one critic, and the settings it learnt with."""

    policy: DiffusionPolicy
    critic: Critic
    retry: RetryConfig
    demonstrations: Demonstrations | None = None
    """The bc guard needs them."""


@dataclass(frozen=True)
class _Actor:
    """A policy that never acts; RetryMethod asks it for no more than this."""

    spec: PolicySpec
    version: str


def answer(
    question: Question, recording: AttemptRecording, networks: Networks, cancelled: Cancelled,
    tell: Callable[[Answer], None],
) -> None:  # fmt: skip
    """Tell what is found, stage by stage; the last Answer has no stage. Nothing more is told once cancelled."""
    known = Answer(number=question.number, file=question.file, critic=question.critic)

    def say(**changes: object) -> None:
        nonlocal known
        known = replace(known, **changes)  # type: ignore[arg-type]
        if not cancelled():
            tell(known)

    try:
        attempt = whole_part(recording)
        if question.critic != RECORDED:
            attempt = replace(attempt, steps=tuple(replace(s, value=float("nan")) for s in attempt.steps))
        say(stage="computing V", note=_caveat(recording))
        eyes = evidence.Eyes(policy=networks.policy, critic=networks.critic, memory=FeatureMemory())
        values = evidence.values(eyes, attempt, cancelled)
        say(values=values, stage="drawing better chunks" if question.ticks else "")
        if question.ticks:
            _learn(question, attempt, networks, eyes, cancelled, say)
        say(stage="")
    except AdaptationCancelledError:
        return
    except FarError as error:
        say(stage="", error=str(error))
    except (KeyError, IndexError) as error:
        say(stage="", error=f"{recording.path} lacks what this policy looks at ({error}): frames or steps are missing")


def _learn(
    question: Question, attempt: Attempt, networks: Networks, eyes: evidence.Eyes, cancelled: Cancelled,
    say: Callable[..., None],
) -> None:  # fmt: skip
    """The lesson of the named chunks: positives, and with `adapt` the gradient steps and what they moved."""
    spec = networks.policy.spec()
    config, steps = networks.retry, networks.retry.fcpa.steps
    if config.fcpa.objective == "awr" and not question.adapt:
        config = replace(config, fcpa=replace(config.fcpa, objective="pairwise"))
    fcpa = replace(config.fcpa, steps=steps if question.adapt else 0, hedge=False)
    method = RetryMethod(
        "fcpa",
        Ingredients(
            network=networks.policy, critic=networks.critic, demonstrations=networks.demonstrations, memory=eyes.memory,
            config=replace(config, fcpa=fcpa), act=lambda network, version, steering=None: _Actor(spec, version),  # type: ignore[arg-type, return-value]
        ),
        adapts=True, perturbs=False,
    )  # fmt: skip
    wanted, chunks = set(question.ticks), len(attempt.steps) + 1 - spec.horizon
    named = tuple(FlagCorrection(tick=t, flagged=t in wanted) for t in range(chunks))
    history: list[AdaptationStep] = []

    def hear(news: AdaptationStep | Adaptation) -> None:
        if isinstance(news, Adaptation):
            say(contrasts=news.contrasts)
        elif question.adapt:
            history.append(news)
            say(history=tuple(history), stage="updating the policy")

    method.begin(attempt.scene_seed)
    adaptation = method.adapt(replace(attempt, corrections=named), cancelled, hear)
    if adaptation.status == "cancelled":
        raise AdaptationCancelledError
    if adaptation.status == "failed":
        raise FarError(f"the adaptation failed: {adaptation.note}")
    say(contrasts=adaptation.contrasts)
    if question.adapt:
        say(stage="sampling before and after", **({"note": adaptation.note} if adaptation.note else {}))
        say(moved=_moved(adaptation.flagged, attempt, eyes, method.acting, cancelled))


def _moved(
    ticks: tuple[int, ...], attempt: Attempt, eyes: evidence.Eyes, after: DiffusionPolicy, cancelled: Cancelled
) -> tuple[Moved, ...]:
    """The same noise through both policies at each flagged state."""
    found, before = [], eyes.policy
    shape = (SAMPLES, before.config.horizon, before.spec().action_dim)
    for tick in ticks:
        features = eyes.own(attempt, [tick], cancelled).expand(SAMPLES, -1)
        rng = generator("candidates", attempt.scene_seed, attempt.index, tick)
        noise = torch.from_numpy(rng.standard_normal(shape, dtype=np.float32)).to(features.device)
        old, new = (policy.sample(features, noise).cpu().numpy() for policy in (before, after))
        found.append(Moved(tick=tick, before=old, after=new))
    return tuple(found)


def whole_part(recording: AttemptRecording) -> Attempt:
    """The attempt up to the first step that is missing. One that was cut off ends with its last observation, which has
    no step of its own then. Raises FarError when nothing is left."""
    steps = recording.steps
    gap = next((i for i, step in enumerate(steps) if step.tick != i), None)
    final = recording.final if gap is None else None
    steps = steps[:gap]
    if final is None and steps:
        steps, final = steps[:-1], steps[-1].observation
    if not steps or final is None:
        raise FarError(f"{recording.path} holds no steps from the attempt's start on; choose another attempt")
    header = recording.header
    return Attempt(
        index=header.attempt if header else 1, scene_seed=header.scene_seed if header else 0, steps=steps, final=final,
        outcome=recording.outcome or Outcome(success=False, judged_by=Judge.HORIZON, note="cut off"),
        policy_version=header.policy_version if header else "",
    )  # fmt: skip


def _caveat(recording: AttemptRecording) -> str:
    version = recording.header.policy_version if recording.header else ""
    if version in ("", "base"):
        return ""
    return f"{version} acted; this is computed with the base policy"
