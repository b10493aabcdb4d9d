"""robomimic HDF5 as episodes: our own exports whole again, other programs' as far as they fit."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from far_app.errors import ConfigError, RecordingError
from far_app.exchange import foreign
from far_app.exchange.foreign import Foreign
from far_app.learning.dataset import Episode

CAMERAS = {
    "front": ("front_image", "agentview_image", "frontview_image"),
    "wrist": ("wrist_image", "robot0_eye_in_hand_image"),
}
"""Our camera to the keys it usually has, ours first."""
POSE = ("robot0_eef_pos", "robot0_eef_quat")
GRIPPERS = ("robot0_gripper", "robot0_gripper_qpos")


def read_robomimic(
    path: Path, options: Foreign, say: Callable[[str], None]
) -> tuple[dict[str, object], Iterator[Episode]]:
    """env_args and the episodes, one at a time; a damaged demo is left out with a word. Raises ConfigError when
    something needed cannot be mapped, RecordingError when it is no such file."""
    env_args, names, keys = _head(path)
    mapped, lines = _mapping(path, options, env_args, keys)
    for line in lines:
        say(line)

    def episodes() -> Iterator[Episode]:
        with h5py.File(path, "r") as file:
            for name in names:
                try:
                    group: Any = file["data"][name]  # pyright: ignore[reportIndexIssue]
                    yield _episode(group, mapped, options, f"{path}:{name}", int(name.removeprefix("demo_")))
                except ConfigError:
                    raise
                except (KeyError, OSError, ValueError, RecordingError) as error:
                    say(f"{path}:{name} is left out: {error}")

    return env_args, episodes()


def _head(path: Path) -> tuple[dict[str, object], list[str], list[str]]:
    """env_args, the demos in order, the observations' keys."""
    try:
        with h5py.File(path, "r") as file:
            data: Any = file["data"]
            raw = data.attrs.get("env_args", "{}")
            names = sorted((n for n in data if n.startswith("demo_")), key=lambda n: int(n.removeprefix("demo_")))
            keys = list(data[names[0]]["obs"]) if names else []
    except (OSError, KeyError, ValueError) as error:
        raise RecordingError(f"{path} is truncated or no robomimic HDF5 with data/demo_0/obs: {error}") from error
    if not names:
        raise RecordingError(f"{path} holds no demonstration (data/demo_0)")
    return json.loads(raw), names, keys


def _mapping(
    path: Path, options: Foreign, env_args: dict[str, Any], keys: list[str]
) -> tuple[dict[str, Any], list[str]]:
    """What is taken from where, and that in words."""
    missing = [key for key in POSE if key not in keys]
    gripper = next((key for key in GRIPPERS if key in keys), None)
    if missing or gripper is None:
        lacking = [*missing, *([] if gripper else [" or ".join(GRIPPERS)])]
        raise ConfigError(f"{path} has no {', '.join(lacking)} among its observations: {', '.join(keys)}")
    seen = foreign.cameras(options.cameras, CAMERAS, [k for k in keys if k.endswith("_image")])
    limits = options.gripper
    if gripper == "robot0_gripper":
        limits = limits or (0.0, 1.0)
    elif limits is None and "panda" in str(env_args.get("env_kwargs", {}).get("robots")).lower():
        limits = (0.0, foreign.PANDA_OPEN)
    ours = gripper == "robot0_gripper"
    lines = [f"{camera} camera ← obs/{key}" for camera, key in seen.items()]
    lines += [
        f"hand's pose ← obs/{POSE[0]}, obs/{POSE[1]} (as they are: metres and xyzw in the file's frame)",
        f"gripper opening ← obs/{gripper}" + ("" if limits in (None, (0.0, 1.0)) else f", {limits} to 0…1"),
        "actions ← actions (as they are: their scale is the file's controller's)",
    ]
    objects = "object" in keys and ours
    if objects:
        lines.append("objects' poses ← obs/object")
    lines += foreign.unused(keys, [*seen.values(), *POSE, gripper, *["object"] * objects])
    return {"cameras": seen, "gripper": gripper, "limits": limits, "objects": objects}, lines


def _episode(group: Any, mapped: dict[str, Any], options: Foreign, what: str, number: int) -> Episode:
    following = "next_obs" in group
    done, rewards = group["dones"][:].astype(bool), group["rewards"][:].astype(np.float32)
    actions = foreign.actions(group["actions"][:], f"{what} actions")

    def rows(key: str) -> np.ndarray:
        """N + 1 rows where the observation after the last action is there, N where not."""
        seen = group["obs"][key][:]
        return np.concatenate([seen, group["next_obs"][key][-1:]]) if following else seen

    states = [*(rows(key) for key in POSE), foreign.opening(rows(mapped["gripper"]), mapped["limits"], what)]
    if following:
        actions = np.concatenate([actions, actions[-1:]])
        rewards = np.concatenate([group["first_reward"][:] if "first_reward" in group else [0.0], rewards])
        done = np.concatenate([group["first_done"][:].astype(bool) if "first_done" in group else [False], done])
    episode = Episode(
        images={c: foreign.pictures(rows(key), options.image_size, f"{what} {key}")
                for c, key in mapped["cameras"].items()},
        states=np.concatenate(states, axis=1).astype(np.float32), actions=actions,
        rewards=rewards.astype(np.float32), successes=done.astype(bool),
        success=bool(group.attrs["success"]) if "success" in group.attrs else bool(done.any()),
        seed=int(group.attrs["seed"]) if "seed" in group.attrs else foreign.FIRST_SCENE + number,
        objects=rows("object").astype(np.float32) if mapped["objects"] else None,
    )  # fmt: skip
    lengths = {len(episode.states), len(episode.rewards), *(len(frames) for frames in episode.images.values())}
    if lengths != {len(episode)}:
        raise RecordingError(f"its arrays are of different lengths: {sorted({*lengths, len(episode)})}")
    return episode
