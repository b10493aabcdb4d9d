"""Rollouts as robomimic HDF5, one at a time. Called by far_app/cli/export.py.

data/demo_N                 attrs: num_samples, seed, success, far (JSON: where it belongs)
    actions (N, 7)   rewards (N,)   dones (N,)   states (N, D)
    obs/…            front_image, wrist_image, robot0_eef_pos, robot0_eef_quat (xyzw), robot0_gripper, object
    next_obs/…       the same a tick later
    far/…            what else is known of a tick
mask/successes, failures, recoveries, human     names of demos

rewards and dones are those of the observation that the action led to.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from far_app.errors import ConfigError
from far_app.exchange.rollout import Rollout
from far_app.exchange.target import whole


def write_robomimic(path: Path, rollouts: Iterable[Rollout], env_args: Mapping[str, Any], overwrite: bool) -> int:
    """The number of episodes. Raises ConfigError when there are none, or when two differ in what they hold."""
    masks: dict[str, list[str]] = {"successes": [], "failures": [], "recoveries": [], "human": []}
    first: dict[str, tuple[int, ...]] = {}
    total = count = 0
    with whole(path, overwrite) as half:
        with h5py.File(half, "w") as file:
            data = file.create_group("data")
            data.attrs["env_args"] = json.dumps(env_args)
            for count, rollout in enumerate(rollouts, start=1):
                shapes = {name: array.shape[1:] for name, array in observations(rollout).items()}
                first = first or shapes
                if shapes != first:
                    raise ConfigError(
                        f"{rollout.provenance.id} holds {shapes}, the episodes before it {first}; export them apart"
                    )
                name = f"demo_{count - 1}"
                write_demo(data.create_group(name), rollout)
                total += len(rollout)
                for mask in masks_of(rollout):
                    masks[mask].append(name)
            data.attrs["total"] = total
            for mask, names in masks.items():
                if names:
                    file[f"mask/{mask}"] = np.array(names, dtype="S")
        if not count:
            raise ConfigError("no attempt to export; far inspect lists what the sessions hold, --only filters it")
    return count


def observations(rollout: Rollout) -> dict[str, np.ndarray]:
    """T + 1 rows each."""
    episode = rollout.episode
    obs = {f"{camera}_image": frames for camera, frames in episode.images.items()}
    obs |= {
        "robot0_eef_pos": episode.states[:, :3], "robot0_eef_quat": episode.states[:, 3:7],
        "robot0_gripper": episode.states[:, 7:],
    }  # fmt: skip
    return obs if episode.objects is None else obs | {"object": episode.objects.astype(np.float32)}


def write_demo(group: h5py.Group, rollout: Rollout) -> None:
    episode, count = rollout.episode, len(rollout)
    group.attrs.update({
        "num_samples": count, "seed": episode.seed, "success": episode.success,
        "far": json.dumps({"id": rollout.provenance.id, **asdict(rollout.provenance)}),
    })  # fmt: skip
    group["actions"] = episode.actions[:count].astype(np.float32)
    group["rewards"] = episode.rewards[1:]
    group["dones"] = episode.successes[1:].astype(np.int8)
    group["states"] = episode.states[:count]
    group["first_reward"], group["first_done"] = episode.rewards[:1], episode.successes[:1].astype(np.int8)
    for name, rows in observations(rollout).items():
        for where, part in (("obs", rows[:count]), ("next_obs", rows[1:])):
            options = {"chunks": (1, *rows.shape[1:]), "compression": "gzip", "compression_opts": 1}
            group.create_dataset(f"{where}/{name}", data=part, **(options if rows.ndim == 4 else {}))
    for name, column in rollout.columns.items():
        group[f"far/{name}"] = column


def masks_of(rollout: Rollout) -> list[str]:
    known = rollout.provenance
    helped = bool(rollout.columns["intervention"].any())
    return [
        "successes" if known.success else "failures",
        *["recoveries"] * (known.success and (helped or bool(known.previous))),
        *["human"] * helped,
    ]
