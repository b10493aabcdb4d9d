"""A LeRobotDataset v3 as episodes: our own exports whole again, other programs' as far as they fit."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from far_app.errors import ConfigError, RecordingError
from far_app.exchange import foreign
from far_app.exchange import lerobot_format as v3
from far_app.exchange.foreign import Foreign
from far_app.exchange.lerobot import column_array
from far_app.exchange.video import VideoFrames
from far_app.learning.dataset import Episode
from far_app.recording.images import decode_png
from far_app.tasks import TASKS

CAMERAS = {
    "front": (*(v3.IMAGE + name for name in ("front", "image", "top", "agentview")), "observation.image"),
    "wrist": (*(v3.IMAGE + name for name in ("wrist", "wrist_image", "image2", "hand")), "observation.wrist_image"),
}
SUCCESS, REWARD = ("far.task_success", "next.success"), ("far.reward", "next.reward")
"""Ours are of the observation itself."""
_DAMAGE = (OSError, KeyError, ValueError, pa.ArrowException, RecordingError)


def read_lerobot(
    root: Path, options: Foreign, say: Callable[[str], None]
) -> tuple[dict[str, object], Iterator[Episode]]:
    """env_args and the episodes, one at a time; a damaged episode is left out with a word. Raises ConfigError when
    something needed cannot be mapped, RecordingError when it is no such dataset."""
    info = _info(root)
    features: dict[str, Any] = info["features"]
    seen = _cameras(root, features, options)
    _check_state(root, features)
    mapping = [f"{camera} camera ← {key} ({features[key]['dtype']})" for camera, key in seen.items()]
    mapping += [f"hand's pose and gripper ← {v3.STATE}", f"actions ← {v3.ACTION} (as they are)"]
    if "far.task_success" not in features:
        mapping.append(
            "rewards and success ← next.reward, next.success"
            if "next.success" in features
            else "every episode counts as a success at its last tick: the file has no next.success"
        )
    used = [
        *seen.values(),
        v3.STATE,
        v3.ACTION,
        *v3.POSITION,
        *(f for f in features if f.startswith(("far.", "next."))),
    ]
    for line in [*mapping, *foreign.unused(features, used)]:
        say(line)
    rows = list(_episode_rows(root))
    env_args = info.get(v3.ENV_ARGS) or foreign_env_args(info, rows[0])
    return env_args, _episodes(root, info, rows, seen, options, say)


def foreign_env_args(info: dict[str, Any], row: dict[str, Any]) -> dict[str, object]:
    """Where a dataset of other programs comes from, as far as it says."""
    name = (row["tasks"] or ["unknown"])[0]
    environment = TASKS[name].environment if name in TASKS else name
    return {"env_name": environment, "type": 1, "env_kwargs": {"robots": info.get("robot_type")}}


def _info(root: Path) -> dict[str, Any]:
    try:
        info = json.loads((root / v3.INFO).read_text())
        version = str(info["codebase_version"])
        if not version.startswith("v3."):
            raise RecordingError(
                f"{root} is a LeRobotDataset {version}, this program reads v3; convert it with LeRobot's "
                "lerobot.datasets.v30.convert_dataset_v21_to_v30"
            )
        missing = {"features", "data_path", "fps"} - set(info)
        if missing:
            raise ValueError(f"{', '.join(sorted(missing))} missing")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RecordingError(f"{root} is no LeRobotDataset v3: {v3.INFO} cannot be read ({error!r})") from error
    return info


def _cameras(root: Path, features: dict[str, Any], options: Foreign) -> dict[str, str]:
    there = [name for name, feature in features.items() if feature["dtype"] in ("image", "video")]
    known = {name: (*keys, v3.IMAGE + name) for name, keys in CAMERAS.items()}
    mine = [name for name in there if name.startswith(v3.IMAGE)] if "far.stamp" in features else []
    return foreign.cameras(options.cameras or {k.removeprefix(v3.IMAGE): k for k in mine}, known, there)


def _check_state(root: Path, features: dict[str, Any]) -> None:
    """ConfigError unless the state is a hand's pose and gripper, by its names."""
    for key in (v3.STATE, v3.ACTION):
        if key not in features:
            raise ConfigError(f"{root} has no {key}; its features are {', '.join(features)}")
    names = features[v3.STATE].get("names")
    flat = [n for part in names.values() for n in part] if isinstance(names, dict) else list(names or ())
    if tuple(flat) != v3.STATE_NAMES:
        raise ConfigError(
            f"{root}: {v3.STATE} is {flat or features[v3.STATE]['shape']}, needed is {', '.join(v3.STATE_NAMES)} "
            "(metres, xyzw, 0 closed to 1 open); a state of joints cannot be imported"
        )


def _episode_rows(root: Path) -> Iterator[dict[str, Any]]:
    files = sorted(root.glob("meta/episodes/*/*.parquet"))
    try:
        for file in files:
            names = [n for n in pq.read_schema(file).names if not n.startswith("stats/")]
            yield from pq.read_table(file, columns=names).to_pylist()
    except _DAMAGE as error:
        raise RecordingError(f"{root}: the list of episodes cannot be read: {error}") from error
    if not files:
        raise RecordingError(
            f"{root} has no meta/episodes: the dataset was not finished (finalize) when it was written"
        )


def _episodes(
    root: Path,
    info: dict[str, Any],
    rows: list[dict[str, Any]],
    seen: dict[str, str],
    options: Foreign,
    say: Callable[[str], None],
) -> Iterator[Episode]:
    videos = {key: VideoFrames() for key in seen.values() if info["features"][key]["dtype"] == "video"}
    for row in rows:
        number = row["episode_index"]
        try:
            path = root / info["data_path"].format(
                chunk_index=row["data/chunk_index"], file_index=row["data/file_index"]
            )
            table = pq.read_table(path, filters=[("episode_index", "=", number)])
            if len(table) != row["length"]:
                raise RecordingError(f"{len(table)} of {row['length']} rows are there")
            images = {}
            for camera, key in seen.items():
                if key in videos:
                    begin = round(row[f"videos/{key}/from_timestamp"] * info["fps"])
                    file = root / info["video_path"].format(
                        video_key=key, chunk_index=row[f"videos/{key}/chunk_index"],
                        file_index=row[f"videos/{key}/file_index"],
                    )  # fmt: skip
                    frames = videos[key].read(file, begin, len(table))
                else:
                    frames = np.stack([decode_png(p["bytes"]) for p in table[key].to_pylist()])
                images[camera] = foreign.pictures(frames, options.image_size, f"{root} {key}")
            yield _episode(root, table, images, row, _final(root, number) if "far/id" in row else None)
        except ConfigError:
            raise
        except _DAMAGE as error:
            say(f"{root}: episode {number} is left out: {error}")


def _episode(
    root: Path, table: pa.Table, images: dict[str, np.ndarray], row: dict[str, Any], final: dict[str, Any] | None
) -> Episode:
    """The rows of a table, and s_T where it is known."""
    column = {name: column_array(table[name]) for name in table.column_names if name != "task" and name not in images
              and not pa.types.is_struct(table.schema.field(name).type)}  # fmt: skip
    count = len(table)
    success = next((column[name] for name in SUCCESS if name in column), np.arange(count) == count - 1).astype(bool)
    reward = next((column[name] for name in REWARD if name in column), success).astype(np.float32)
    actions = foreign.actions(column[v3.ACTION], f"{root} {v3.ACTION}")
    states, objects = column[v3.STATE].astype(np.float32), column.get("far.objects")
    if final is not None:
        actions = np.concatenate([actions, actions[-1:]])
        states = np.concatenate([states, np.array([final["state"]], np.float32)])
        reward = np.append(reward, np.float32(final["reward"]))
        success = np.append(success, final["task_success"])
        objects = None if objects is None else np.concatenate([objects, np.array([final["objects"]], np.float32)])
        images = {c: np.concatenate([f, decode_png(final[f"image.{c}"])[None]]) for c, f in images.items()}
    return Episode(
        images=images, states=states, actions=actions, rewards=reward, successes=success.astype(bool),
        success=bool(row.get("far/success", success.any())),
        seed=int(row.get("far/scene_seed", foreign.FIRST_SCENE + row["episode_index"])), objects=objects,
    )  # fmt: skip


def _final(root: Path, number: int) -> dict[str, Any] | None:
    file = root / v3.FINAL
    if not file.exists():
        return None
    rows = pq.read_table(file, filters=[("episode_index", "=", number)]).to_pylist()
    return rows[0] if rows else None
