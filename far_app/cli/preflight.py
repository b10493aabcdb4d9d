"""The preflight of `far run`: what far_app/preflight.py finds, as a refusal, a warning, or nothing."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

from far_app.cli.assemble import UNTRAINED, checkpoints
from far_app.errors import ConfigError
from far_app.preflight import Setup, differences, look, setup_from
from far_app.protocols import PolicySpec
from far_app.types import Observation

log = logging.getLogger(__name__)


def policy_card(task: str, policy: str | None) -> Mapping[str, object] | None:
    """The model card of `--policy`, the shipped one's by default; None for a policy that no data made."""
    if policy is not None and policy.startswith((UNTRAINED, "test:")):
        return None
    from far_app.learning.policy import read_card

    return read_card(checkpoints(task, Path(policy) if policy else None, None)[0])


def preflight(
    spec: PolicySpec, card: Mapping[str, object] | None, here: Setup, observation: Observation, accepted: bool
) -> None:
    """What differs between the policy's data and this rig, before the first motion. Raises ConfigError unless it was
    accepted; a card that does not tell is reason enough on a real arm."""
    if card is None:
        return
    cameras = spec.cameras
    trained = setup_from(card.get("setup"))
    found = look(observation, cameras, card.get("colours"))
    if trained is not None:
        found = differences(trained, here, cameras) + found
    else:
        unknown = "its card does not say on which robot, with which views and action scale it learnt: cannot compare"
        if here.robot == "twin":
            log.warning("policy %s: %s", spec.name, unknown)
        else:
            found.insert(0, unknown)
    words = "; ".join(f"({i}) {text}" for i, text in enumerate(found, 1))
    if found and not accepted:
        raise ConfigError(
            f"policy {spec.name} does not fit what is here: {words}. Set the rig right or give the checkpoint "
            "that belongs to it; --shadow shows what it would do with the arm held; --accept-differences goes on"
        )
    if found:
        log.warning("policy %s does not fit what is here, and goes on: %s", spec.name, words)
