"""The preflight of `far run`: what far_app/preflight.py finds, as a refusal, a warning, or nothing."""

from __future__ import annotations

import logging

from far_app.cli.assemble import Parts
from far_app.errors import ConfigError
from far_app.preflight import Setup, differences, look, setup_from
from far_app.types import Observation

log = logging.getLogger(__name__)


def preflight(parts: Parts, here: Setup, observation: Observation, accepted: bool) -> None:
    """What differs between the policy's data and this rig, before the first motion. Raises ConfigError unless it was
    accepted; a card that does not tell is reason enough on a real arm."""
    if parts.card is None:
        return
    cameras = parts.method.policy.spec.cameras
    trained = setup_from(parts.card.get("setup"))
    found = look(observation, cameras, parts.card.get("colours"))
    if trained is not None:
        found = differences(trained, here, cameras) + found
    else:
        unknown = "its card does not say on which robot, with which views and action scale it learnt: cannot compare"
        if here.robot == "twin":
            log.warning("policy %s: %s", parts.policy_name, unknown)
        else:
            found.insert(0, unknown)
    words = "; ".join(f"({i}) {text}" for i, text in enumerate(found, 1))
    if found and not accepted:
        raise ConfigError(
            f"policy {parts.policy_name} does not fit what is here: {words}. Set the rig right or give the checkpoint "
            "that belongs to it; --shadow shows what it would do with the arm held; --accept-differences goes on"
        )
    if found:
        log.warning("policy %s does not fit what is here, and goes on: %s", parts.policy_name, words)
