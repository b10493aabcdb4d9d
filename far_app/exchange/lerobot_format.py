"""LeRobotDataset v3: the names of its files and features, for the one that writes it and the one that reads it.

meta/info.json                              features, counts, rate, where files lie
meta/tasks.parquet                          instruction → task_index
meta/stats.json                             statistics of each feature over everything
meta/episodes/chunk-000/file-000.parquet    a row an episode: length, rows, files, statistics, far/…
data/chunk-000/file-000.parquet             a row a tick: features, PNGs included
far/final.parquet                           ours: the observation after each episode's last tick
"""

from __future__ import annotations

from typing import Any

import pyarrow as pa

VERSION = "v3.0"
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
EPISODES = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
FINAL = "far/final.parquet"
ENV_ARGS = "far_env_args"
"""Our key of info.json: where the episodes come from, as robomimic's env_args and far_app/preflight.py have it."""
CHUNK_SIZE = 1000
"""Files in a folder."""
FILE_MEGABYTES = 100
"""Size at which the next data file begins."""

STATE, ACTION, IMAGE, OURS = "observation.state", "action", "observation.images.", "far."
STATE_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")
ACTION_NAMES = ("dx", "dy", "dz", "rx", "ry", "rz", "gripper")
OBJECT_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")

POSITION: dict[str, Any] = {
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    "frame_index": {"dtype": "int64", "shape": [1], "names": None},
    "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    "index": {"dtype": "int64", "shape": [1], "names": None},
    "task_index": {"dtype": "int64", "shape": [1], "names": None},
}
"""The features every dataset has. `timestamp` is nominal: frame_index / fps."""

PICTURE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])


def arrow_schema(features: dict[str, Any]) -> pa.Schema:
    """A data file's columns."""
    return pa.schema([(name, arrow_type(feature)) for name, feature in features.items()])


def arrow_type(feature: dict[str, Any]) -> pa.DataType:
    if feature["dtype"] == "image":
        return PICTURE
    value = pa.bool_() if feature["dtype"] == "bool" else pa.type_for_alias(feature["dtype"])
    size = feature["shape"][0]
    return value if size == 1 else pa.list_(value, size)


def with_pandas_index(table: pa.Table, index: str) -> pa.Table:
    """What pandas needs to know to take a column as the (nameless) index, as LeRobot writes its tasks."""
    import json

    described = [
        {"name": None if name == index else name, "field_name": name, "metadata": None,
         "pandas_type": "unicode" if pa.types.is_string(kind) else str(kind),
         "numpy_type": "object" if pa.types.is_string(kind) else str(kind)}
        for name, kind in zip(table.schema.names, table.schema.types, strict=True)
    ]  # fmt: skip
    pandas = {"index_columns": [index], "column_indexes": [], "columns": described, "pandas_version": "2.0.0"}
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})
