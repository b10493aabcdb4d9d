"""Rollouts as a LeRobotDataset v3, one at a time. Pictures are PNGs in the data files: lossless, and every version of
the loader reads them without a video decoder. Called by far_app/cli/export.py.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from far_app.errors import ConfigError
from far_app.exchange import lerobot_format as v3
from far_app.exchange.feature_stats import Stats, array_stats, histogram, image_stats
from far_app.exchange.rollout import Rollout
from far_app.exchange.target import whole
from far_app.recording.images import encode_png

_EPISODES_AT_ONCE = 200
"""Rows of the episodes' table that wait to be written together."""


def write_lerobot(
    path: Path,
    rollouts: Iterable[Rollout],
    fps: float,
    env_args: dict[str, Any],
    instruction: Callable[[str], str],
    overwrite: bool,
) -> int:
    """The number of episodes. `env_args`: where they come from, as robomimic has it; `instruction` words a task. Raises
    ConfigError when there are none, or when two differ in what they hold."""
    with whole(path, overwrite) as half:
        dataset = _Dataset(half, fps, env_args)
        for rollout in rollouts:
            dataset.add(rollout, instruction(rollout.provenance.task))
        return dataset.finish()


class _Dataset:
    """A dataset that grows by whole episodes."""

    def __init__(self, root: Path, fps: float, env_args: dict[str, Any]) -> None:
        self.root, self.fps, self.env_args = root, int(fps) if float(fps).is_integer() else fps, env_args
        self.features: dict[str, Any] = {}
        self.tasks: dict[str, int] = {}
        self.frames = self.episodes = 0
        self._waiting: list[dict[str, Any]] = []
        self._finals: list[dict[str, Any]] = []
        self._histograms: dict[str, np.ndarray] = {}
        self._data: pq.ParquetWriter | None = None
        self._table: pq.ParquetWriter | None = None
        self._final: pq.ParquetWriter | None = None
        self._file, self._bytes = 0, 0

    def add(self, rollout: Rollout, task: str) -> None:
        features = features_of(rollout)
        if self.features and features != self.features:
            differ = sorted(k for k in {*features, *self.features} if features.get(k) != self.features.get(k))
            raise ConfigError(
                f"{rollout.provenance.id} differs from the episodes before it in {', '.join(differ)}; "
                "a dataset holds one kind of robot, cameras and objects: export them apart"
            )
        self.features = features
        count, number = len(rollout), self.episodes
        columns = columns_of(rollout)
        columns |= {
            "timestamp": (np.arange(count) / self.fps).astype(np.float32),
            "frame_index": np.arange(count), "episode_index": np.full(count, number),
            "index": self.frames + np.arange(count),
            "task_index": np.full(count, self.tasks.setdefault(task, len(self.tasks))),
        }  # fmt: skip
        stats = {name: array_stats(column) for name, column in columns.items()}
        pictures = {}
        for camera, frames in rollout.episode.images.items():
            name, counts = v3.IMAGE + camera, histogram(frames[:count])
            self._histograms[name] = self._histograms.get(name, 0) + counts
            stats[name] = image_stats(counts, count)
            pictures[name] = [{"bytes": encode_png(frame), "path": f"{camera}-{number:06d}-{k:06d}.png"}
                              for k, frame in enumerate(frames[:count])]  # fmt: skip
        place = self._write_data(columns, pictures)
        self._waiting.append(
            {"episode_index": number, "tasks": [task], "length": count, **place, "dataset_from_index": self.frames,
             "dataset_to_index": self.frames + count, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
            | {"far/id": rollout.provenance.id}
            | {f"far/{name}": value for name, value in asdict(rollout.provenance).items()}
            | {f"stats/{feature}/{name}": value.tolist() for feature, of in stats.items() for name, value in of.items()}
        )  # fmt: skip
        self._finals.append(final_of(rollout, number))
        self.frames += count
        self.episodes += 1
        if len(self._waiting) >= _EPISODES_AT_ONCE:
            self._write_episodes()

    def finish(self) -> int:
        if not self.episodes:
            raise ConfigError("no attempt to export; far inspect lists what the sessions hold, --only filters it")
        self._write_episodes()
        for writer in (self._data, self._table, self._final):
            if writer is not None:
                writer.close()
        names = pa.table({"task_index": list(self.tasks.values()), "__index_level_0__": list(self.tasks)})
        pq.write_table(v3.with_pandas_index(names, "__index_level_0__"), self.root / v3.TASKS)
        stats = {name: self._stats(name) for name in self.features}
        plain = {name: {key: value.tolist() for key, value in of.items()} for name, of in stats.items()}
        (self.root / v3.STATS).write_text(json.dumps(plain, indent=1, allow_nan=False))
        info = {
            "codebase_version": v3.VERSION, "robot_type": self.env_args["env_kwargs"]["robots"],
            "total_episodes": self.episodes,
            "total_frames": self.frames, "total_tasks": len(self.tasks), "chunks_size": v3.CHUNK_SIZE,
            "data_files_size_in_mb": v3.FILE_MEGABYTES, "video_files_size_in_mb": 200, "fps": self.fps,
            "splits": {"train": f"0:{self.episodes}"}, "data_path": v3.DATA, "video_path": None,
            "features": self.features, v3.ENV_ARGS: self.env_args,
        }  # fmt: skip
        (self.root / v3.INFO).write_text(json.dumps(info, indent=1))
        return self.episodes

    def _write_data(self, columns: dict[str, np.ndarray], pictures: dict[str, list[Any]]) -> dict[str, int]:
        """Where the episode's rows are."""
        if self._data is not None and self._bytes >= v3.FILE_MEGABYTES * 10**6:
            self._data.close()
            self._data, self._file, self._bytes = None, self._file + 1, 0
        place = {"chunk_index": self._file // v3.CHUNK_SIZE, "file_index": self._file % v3.CHUNK_SIZE}
        schema = v3.arrow_schema(self.features)
        if self._data is None:
            path = self.root / v3.DATA.format(**place)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._data = pq.ParquetWriter(path, schema)
        arrays = [
            pa.array(pictures[f.name] if f.name in pictures else _rows(columns[f.name]), type=f.type) for f in schema
        ]
        table = pa.table(arrays, schema=schema)
        self._bytes += table.nbytes
        self._data.write_table(table)
        return {f"data/{key}": value for key, value in place.items()}

    def _write_episodes(self) -> None:
        """Both tables that have a row an episode."""
        if not self._waiting:
            return
        for rows, name in ((self._waiting, "_table"), (self._finals, "_final")):
            table = pa.Table.from_pylist(rows)
            if getattr(self, name) is None:
                place = v3.FINAL if name == "_final" else v3.EPISODES.format(chunk_index=0, file_index=0)
                (self.root / place).parent.mkdir(parents=True, exist_ok=True)
                setattr(self, name, pq.ParquetWriter(self.root / place, table.schema))
            writer = getattr(self, name)
            writer.write_table(table.cast(writer.schema))
            rows.clear()

    def _stats(self, name: str) -> Stats:
        """Of a feature over the whole dataset; numbers are read back, one feature at a time."""
        if name in self._histograms:
            return image_stats(self._histograms[name], self.frames)
        files = sorted(self.root.glob("data/*/*.parquet"))
        column = pa.chunked_array([c for f in files for c in pq.read_table(f, columns=[name])[name].chunks])
        return array_stats(column_array(column))


def column_array(column: pa.ChunkedArray) -> np.ndarray:
    """A parquet column of numbers or equally long lists as an array, row by row."""
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):
        array = pa.concat_arrays(array.chunks) if array.num_chunks else pa.array([], column.type.value_type)
    if not pa.types.is_nested(array.type):
        return array.to_numpy(zero_copy_only=False)
    values = array.flatten().to_numpy(zero_copy_only=False)
    return values.reshape(len(array), -1)


def features_of(rollout: Rollout) -> dict[str, Any]:
    """meta/info.json's features."""
    features: dict[str, Any] = {
        v3.IMAGE + camera: {"dtype": "image", "shape": list(frames.shape[1:]), "names": ["height", "width", "channels"]}
        for camera, frames in rollout.episode.images.items()
    }
    named = {v3.STATE: list(v3.STATE_NAMES), v3.ACTION: list(v3.ACTION_NAMES)}
    for name, column in columns_of(rollout).items():
        size = 1 if column.ndim == 1 else column.shape[1]
        features[name] = {"dtype": column.dtype.name, "shape": [size], "names": named.get(name)}
    return features | v3.POSITION


def columns_of(rollout: Rollout) -> dict[str, np.ndarray]:
    """Every feature but pictures and positions; names that begin with `far.` are ours, for LeRobot's policies take
    whatever begins with `observation` or `action` as input and output."""
    episode, count = rollout.episode, len(rollout)
    last = np.arange(count) == count - 1
    columns = {
        v3.STATE: episode.states[:count], v3.ACTION: episode.actions[:count],
        "next.reward": episode.rewards[1:], "next.done": last, "next.success": episode.successes[1:],
        "far.reward": episode.rewards[:count], "far.task_success": episode.successes[:count],
    }  # fmt: skip
    if episode.objects is not None:
        columns["far.objects"] = episode.objects[:count].astype(np.float32)
    return columns | {v3.OURS + name: column for name, column in rollout.columns.items()}


def final_of(rollout: Rollout, number: int) -> dict[str, Any]:
    """s_T, which a row a tick has no place for."""
    episode = rollout.episode
    objects = [] if episode.objects is None else episode.objects[-1].astype(np.float32).tolist()
    return {
        "episode_index": number, "state": episode.states[-1].tolist(), "objects": objects,
        "reward": float(episode.rewards[-1]), "task_success": bool(episode.successes[-1]),
        **{f"image.{camera}": encode_png(frames[-1]) for camera, frames in episode.images.items()},
    }  # fmt: skip


def _rows(column: np.ndarray) -> Any:
    return column if column.ndim == 1 else list(column)
