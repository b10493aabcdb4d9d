"""What a recording holds: the records beside the core's own values, the topics of an attempt's file, their schemas.

recordings/README.md is this module in words; `describe()` writes the part of it that must never drift.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from far_app.recording.codec import Json, codec
from far_app.types import ActionChunk, Adaptation, AdaptationStep, Observation, Outcome, Step, TickTimes

SCHEMA_NAME = "far-recording"
SCHEMA_VERSION = 2
"""Rises when an older reader would misread a newer file; a field added with a default does not raise it by itself.
Older files are read through migrations.py, which also says what each version brought."""

SESSION_FILE = "session.json"
TRIALS_FILE = "trials.jsonl"


@dataclass(frozen=True, kw_only=True)
class SessionInfo:
    """What whoever starts a session knows about it."""

    task: str
    method: str
    config: Mapping[str, Any] = field(default_factory=dict)
    """The resolved configuration, whole."""
    rig: Mapping[str, Any] = field(default_factory=dict)
    """The rig's data: arm or twin, action scale, home pose, limits."""
    policy: str = ""
    """The policy's name and checkpoint."""
    cameras: tuple[str, ...] = ()
    rate: float = 30.0
    """Policy ticks a second."""
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class SessionHeader:
    """session.json: written once, atomically, before anything else of the session."""

    schema: str
    """Always "far-recording"."""
    schema_version: int
    session: str
    """The session's id and folder name."""
    started: str
    """Wall clock at the start, ISO 8601 with the offset to UTC."""
    wall_minus_monotonic: float
    """Seconds to add to a monotonic stamp of this session to get seconds since 1970 UTC."""
    code_version: str
    """Package version, commit when known, "-dirty" when files differed from it."""
    host: Mapping[str, Any]
    """Machine, CPUs, Python and package versions."""
    info: SessionInfo


@dataclass(frozen=True, kw_only=True)
class LogEntry:
    """One line of trials.jsonl."""

    event: str
    stamp: float
    """Monotonic seconds."""
    wall: str
    """ISO 8601 with the offset to UTC."""
    trial: int = 0
    """1-based; 0 outside a trial."""
    attempt: int = 0
    """1-based; 0 outside an attempt."""
    text: str = ""
    """For people."""
    detail: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class AttemptHeader:
    """The first message of an attempt's file: where it belongs."""

    schema_version: int
    session: str
    task: str
    method: str
    trial: int
    attempt: int
    scene_seed: int
    policy_version: str
    previous: str
    """File of the attempt before on the same scene, relative to the session's folder; "" for the first."""
    wall_minus_monotonic: float
    """As in session.json."""


@dataclass(frozen=True, kw_only=True)
class RecordedEvent:
    """Something that happened during the attempt or while the arm went home after it."""

    stamp: float
    """Monotonic seconds."""
    event: str
    text: str = ""
    detail: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class CompressedImage:
    """foxglove.CompressedImage; the message's sequence number is the frame's number, from 0 on."""

    timestamp: CompressedImageTime
    frame_id: str
    """The camera's name."""
    data: str
    """The PNG, base64."""
    format: str
    """"png": lossless at the policy's size."""


@dataclass(frozen=True, kw_only=True)
class CompressedImageTime:
    """Seconds since 1970 UTC."""

    sec: int
    nsec: int


@dataclass(frozen=True, kw_only=True)
class Topic:
    name: str
    record: type
    schema_name: str
    what: str


TOPICS = (
    Topic(
        name="/attempt",
        record=AttemptHeader,
        schema_name="far.AttemptHeader",
        what="Once, first: session, trial, attempt, scene, policy version and the file of the attempt before.",
    ),
    Topic(
        name="/step",
        record=Step,
        schema_name="far.Step",
        what="Every tick, two ticks late, complete with what was sent. `observation.images` is replaced by "
        "`observation.frames`: camera name to frame number on `/camera/<name>`.",
    ),
    Topic(name="/chunk", record=ActionChunk, schema_name="far.ActionChunk", what="Every chunk that became ready."),
    Topic(
        name="/tick_times",
        record=TickTimes,
        schema_name="far.TickTimes",
        what="Every tick of the real-time loop, a few ticks late: the seconds it spent on each stage. Older recordings "
        "and those made in lockstep have none.",
    ),
    Topic(
        name="/camera/<name>",
        record=CompressedImage,
        schema_name="foxglove.CompressedImage",
        what="A frame, written once however many ticks saw it.",
    ),
    Topic(name="/event", record=RecordedEvent, schema_name="far.RecordedEvent", what="Pauses, faults, marks, notes."),
    Topic(
        name="/final",
        record=Observation,
        schema_name="far.Observation",
        what="Once, at the attempt's end: the observation after the last step, s_T, with `frames` as in `/step`.",
    ),
    Topic(
        name="/outcome",
        record=Outcome,
        schema_name="far.Outcome",
        what="Success or failure and who judged it. The last one counts; the first is the program's own.",
    ),
    Topic(
        name="/adaptation_step",
        record=AdaptationStep,
        schema_name="far.AdaptationStep",
        what="Each gradient step as it happened (a killed adaptation keeps them).",
    ),
    Topic(
        name="/adaptation",
        record=Adaptation,
        schema_name="far.Adaptation",
        what="Attribution and adaptation after a failure: V, ΔV, threshold, flagged, pairs, l⁺ and l⁻, seconds.",
    ),
)
"""Every topic of an attempt's file, in the order of their channels."""

CAMERA_TOPIC = "/camera/"

LINES = {
    "session_started": "the writer is ready",
    "trial_started": "`detail.scene_seed`; in a plan also `detail.method`, `detail.label` (what the operator was told),"
    " `detail.scene`, `detail.repetition`, `detail.max_attempts`, `detail.policy`",
    "scene_matched": "a plan's real scene was ready: `detail.scene`, `detail.scores` by camera (none: the scene's "
    "first start, which later ones are held against), `detail.limit`, `detail.pictures` by camera",
    "attempt_started": "`detail.file`, `detail.scene_seed`, `detail.policy_version`, `detail.previous`",
    "attempt_ended": "`detail.success`, `detail.judged_by`, `detail.note`, `detail.steps`; its steps are on the disk",
    "attempt_abandoned": "the attempt ended without an outcome; `text` says why, `detail.steps`",
    "adapted": "`detail.status`, `detail.base_version`, `detail.version`, `detail.flagged`, `detail.pairs`",
    "weights_kept": "`detail.file`, `detail.version`, `detail.parent`, `detail.bytes`: what the adaptation made",
    "outcome_marked": "someone's word on an attempt: `detail.success`, `detail.judged_by`, `detail.note`",
    "flag_corrected": "the operator's word on a chunk: `detail.trial`, `detail.attempt`, `detail.tick`, "
    "`detail.flagged`, `detail.by`, `detail.used` (it came in time for the adaptation)",
    "attempt_marked": "a person's word on an attempt: `detail.trial`, `detail.attempt`, `detail.verdict` (success, "
    "failure, unsure, or empty for a note alone), `detail.note`, `detail.by`; of a closed session it is a line of "
    "marks.jsonl",
    "policy_undone": "the next attempt acts with `detail.version`, from before an adaptation; `detail.by`",
    "policy_restored": "the next attempt acts with `detail.version`; `detail.by`",
    "policy_kept": "the next trials begin with `detail.version`; `detail.by`",
    "taken_over": "a person has the arm from here on: `detail.source` (page or device)",
    "handed_back": "the policy has it again; `detail.ticks` of this attempt were a person's",
    "trial_ended": "`detail.success`, `detail.attempts`",
    "recording_failed": "the writer gave up; `text` says why",
    "recorder_late": "the writer was more than 1 s behind the loop; `detail.seconds`",
    "session_ended": "the session was closed in order",
}
"""Events of trials.jsonl that the recorder itself writes, and what each carries; other names are the session's own."""


@lru_cache(maxsize=1)
def json_schemas() -> dict[str, dict[str, Json]]:
    """Topic name to the JSON Schema of its messages."""
    schemas = {topic.name: {**codec(topic.record).schema, "title": topic.schema_name} for topic in TOPICS}
    frames = {
        "type": "object",
        "properties": {},
        "additionalProperties": {"type": "integer"},
        "description": "Camera name to frame number on /camera/<name>.",
    }
    schemas["/final"] = _with_frames(schemas["/final"], frames)
    step = schemas["/step"]
    observation = _with_frames(step["properties"]["observation"], frames)
    schemas["/step"] = {**step, "properties": {**step["properties"], "observation": observation}}
    image = schemas["/camera/<name>"]["properties"]
    image["data"] = {**image["data"], "contentEncoding": "base64"}
    return schemas


def _with_frames(observation: dict[str, Json], frames: Json) -> dict[str, Json]:
    properties = {name: p for name, p in observation["properties"].items() if name != "images"}
    return {**observation, "properties": {**properties, "frames": frames}}


def describe() -> str:
    """The generated part of recordings/README.md: session.json, trials.jsonl and every topic, field by field."""
    parts = ["### session.json", "", _table(codec(SessionHeader).schema), "", "`info`:", ""]
    parts += [_table(codec(SessionInfo).schema), "", "### A line of trials.jsonl", "", _table(codec(LogEntry).schema)]
    parts += ["", "| event | carries |", "|---|---|"]
    parts += [f"| `{event}` | {what} |" for event, what in LINES.items()]
    schemas = json_schemas()
    for topic in TOPICS:
        parts += ["", f"### {topic.name} ({topic.schema_name})", "", topic.what, "", _table(schemas[topic.name])]
    parts += ["", "### Values within the messages", ""]
    for name, nested in sorted(_nested(schemas).items()):
        parts += [f"**{name}**: {nested['description']}".removesuffix(": "), "", _table(nested), ""]
    return "\n".join(parts).rstrip() + "\n"


def _table(schema: dict[str, Json]) -> str:
    rows = ["| field | type | meaning |", "|---|---|---|"]
    for name, part in schema["properties"].items():
        meaning = part.get("description", "").replace("|", "\\|")
        rows.append(f"| `{name}` | {_type_name(part)} | {meaning} |")
    return "\n".join(rows)


def _type_name(part: dict[str, Json]) -> str:
    kind = part.get("title") or part.get("type", "any")
    if kind == "array":
        return f"list of {_type_name(part['items'])}"
    if kind == "object" and "additionalProperties" in part:
        return f"object of {_type_name(part['additionalProperties'])}"
    if kind == "object" and set(part["properties"]) == {"shape", "values"}:
        return "2-d array"
    if kind == "object" and set(part["properties"]) == {"dtype", "shape", "data"}:
        return "packed array"
    if "enum" in part and "title" not in part:
        return " / ".join(json.dumps(word) for word in part["enum"])
    return kind


def _nested(schemas: dict[str, dict[str, Json]]) -> dict[str, dict[str, Json]]:
    found: dict[str, dict[str, Json]] = {}

    def visit(part: Json) -> None:
        if not isinstance(part, dict):
            return
        inner = [*part.get("properties", {}).values(), part.get("items"), part.get("additionalProperties")]
        for child in inner:
            if isinstance(child, dict):
                if "title" in child:
                    found[child["title"]] = child
                visit(child)

    for schema in schemas.values():
        visit(schema)
    return found
