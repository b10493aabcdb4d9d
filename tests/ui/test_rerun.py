"""What rerun is told: V without gaps or repeats, flags where they are, a page that cannot talk to the outside."""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from ui_stage import HORIZON, H, Stage, adapting, running

from far_app.recording.attempt_reader import AttemptRecording
from far_app.recording.schema import AttemptHeader, RecordedEvent
from far_app.telemetry import LogLine
from far_app.types import ACTION_DIM, Adaptation, Judge, Observation, Outcome, Pose, RobotMode, RobotStatus, Step
from ui.rerun_live import LiveLog
from ui.rerun_views import attempt_to_rrd, spans
from ui.rerun_web import POLICY


def step(tick: int) -> Step:
    image = np.full((84, 84, 3), tick, np.uint8)
    observation = Observation(
        seq=tick, stamp=100 + tick / 30, eef=Pose(position=np.zeros(3), quaternion=np.array([0, 0, 0, 1.0])),
        gripper=1.0, joints=np.arange(7.0), images={"front": image, "wrist": image},
        status=RobotStatus(mode=RobotMode.TRACKING),
    )  # fmt: skip
    zeros = np.zeros(ACTION_DIM)
    return Step(
        tick=tick, seq=tick, stamp=observation.stamp, deadline=observation.stamp, observation=observation, action=zeros,
        perturbation=zeros, commanded=zeros, sent=zeros if tick else np.full(ACTION_DIM, math.nan), chunk_tick=tick,
        starved=False, policy_version="p", value=math.nan if tick == 3 else tick / 30, reward=0.0, success=False,
    )  # fmt: skip


def failed_attempt(path: Path) -> AttemptRecording:
    steps = tuple(step(k) for k in range(30))
    values = np.concatenate([np.linspace(0, 1, 20), np.linspace(1, 0, 11)])
    adaptation = Adaptation(
        status="adapted", base_version="p", version="p+1", values=values, value_changes=values[H:] - values[:-H],
        threshold=-0.5, flagged=(18, 19, 20),
    )  # fmt: skip
    header = AttemptHeader(
        schema_version=1, session="s", task="lift", method="far", trial=1, attempt=1, scene_seed=7, policy_version="p",
        previous="", wall_minus_monotonic=0.0,
    )  # fmt: skip
    return AttemptRecording(
        path=path, header=header, steps=steps, chunks=(), tick_times=(),
        final=replace(steps[-1].observation, stamp=101.0),
        events=(RecordedEvent(stamp=100.5, event="note", text="a note"),),
        outcomes=(Outcome(success=False, judged_by=Judge.HORIZON),), adaptation_steps=(), adaptation=adaptation,
        frames={"front": 30, "wrist": 30}, abandoned="", closed=True, damaged=False, problems=(), size=0,
    )  # fmt: skip


def columns(path: Path) -> dict[str, list[pa.RecordBatch]]:
    """Entity to its chunks."""
    found: dict[str, list[pa.RecordBatch]] = {}
    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found


def rows(batches: list[pa.RecordBatch]) -> int:
    return sum(batch.num_rows for batch in batches)


def scalars(batches: list[pa.RecordBatch]) -> list[float]:
    """All finite scalars of an entity, in the order of their time (NaN only breaks a line)."""
    pairs = []
    for batch in batches:
        value = next(name for name in batch.schema.names if "calar" in name)
        times = batch.column("time").cast(pa.int64()).to_pylist()
        pairs += list(zip(times, (row[0] for row in batch.column(value).to_pylist()), strict=True))
    return [value for _, value in sorted(pairs) if math.isfinite(value)]


def test_an_attempt_s_rrd_holds_what_the_blueprint_shows(tmp_path: Path) -> None:
    attempt = failed_attempt(tmp_path / "trial_0001" / "attempt_1.mcap")
    attempt_to_rrd(attempt, tmp_path / "a.rrd")
    found = columns(tmp_path / "a.rrd")
    assert rows(found["/camera/front"]) == rows(found["/camera/wrist"]) == 30
    assert attempt.adaptation is not None
    np.testing.assert_allclose(scalars(found["/value/V"]), attempt.adaptation.values)
    np.testing.assert_allclose(scalars(found["/change/dV"]), attempt.adaptation.value_changes)
    assert len(scalars(found["/change/flagged"])) == 3
    assert scalars(found["/change/threshold"]) == [-0.5, -0.5]
    assert rows(found["/flagged"]) == 2
    assert rows(found["/camera/front/flagged"]) == 2
    assert len(scalars(found["/action/gripper"])) == 29  # the first was never acknowledged
    assert len(scalars(found["/joints/7"])) == 30
    assert rows(found["/events"]) == 2


def test_a_damaged_attempt_still_becomes_an_rrd(tmp_path: Path) -> None:
    path = tmp_path / "trial_0001" / "attempt_1.mcap"
    nothing = replace(
        failed_attempt(path), header=None, steps=(), final=None, outcomes=(), adaptation=None, events=(), frames={},
        problems=("the header is missing",),
    )  # fmt: skip
    attempt_to_rrd(nothing, tmp_path / "a.rrd")
    assert rows(columns(tmp_path / "a.rrd")["/events"]) == 1


def test_without_an_adaptation_each_step_s_own_value_is_shown(tmp_path: Path) -> None:
    attempt = replace(failed_attempt(tmp_path / "t" / "a.mcap"), adaptation=None)
    attempt_to_rrd(attempt, tmp_path / "a.rrd")
    found = columns(tmp_path / "a.rrd")
    assert len(scalars(found["/value/V"])) == 29
    assert "/change/dV" not in found


def test_spans_are_runs_of_flags() -> None:
    assert spans(np.array([True, True, False, True])) == [(0, 2), (3, 4)]
    assert spans(np.zeros(5, dtype=bool)) == []


def test_the_live_log_has_each_tick_s_value_once_and_each_event_once(tmp_path: Path) -> None:
    recording = rr.RecordingStream("test", recording_id="live")
    recording.save(tmp_path / "live.rrd")
    live = LiveLog(recording)
    late = running(20).values.copy()
    late[12] = np.nan
    line = LogLine(stamp=50.0, level="info", text="once")
    shown = [replace(running(10), stamp=50.0), replace(running(20), values=late, stamp=50.4), running(20)]
    for i, telemetry in enumerate(shown):
        live.show(replace(telemetry, seq=i, stamp=50 + i / 5, log=(line,)))
    failed = replace(adapting(), attempt=1, log=(line,))
    live.show(replace(failed, stamp=55.0))
    live.show(replace(failed, stamp=55.1))
    live.show(replace(running(3, 2), stamp=60.0, log=(line,)))
    recording.disconnect()
    found = columns(tmp_path / "live.rrd")
    assert len(scalars(found["/value/V"])) == HORIZON + 1 + 4
    assert len(scalars(found["/change/dV"])) == HORIZON + 1 - H
    assert len(scalars(found["/change/flagged"])) == len(failed.flagged)
    assert rows(found["/events"]) == 1


def test_the_viewer_s_page_may_only_talk_to_this_run() -> None:
    directives = dict(part.strip().split(" ", 1) for part in POLICY.split(";"))
    assert not re.findall(r"https?:", POLICY)
    assert directives["connect-src"] == "'self' data: blob:"


@pytest.mark.slow
def test_the_live_process_serves_a_sealed_viewer_and_ends_cleanly(stage: Stage, folder: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "ui.rerun_live", "--run-folder", str(folder), "--recordings", str(tmp_path)]
    live = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert live.stdout is not None
        url = json.loads(live.stdout.readline())["viewer"]
        with urllib.request.urlopen(url, timeout=30) as page:
            assert "connect-src 'self'" in page.headers["Content-Security-Policy"]
            assert b"https://fonts" not in page.read()
        with urllib.request.urlopen(url.split("?")[0] + "re_viewer_bg.wasm", timeout=30) as wasm:
            assert wasm.headers["Content-Type"] == "application/wasm"
        where = urlsplit(url)
        assert parse_qs(where.query)["url"] == [f"rerun+http://{where.netloc}/proxy"], "the data come the same way"
        call = "/rerun.sdk_comms.v1alpha1.MessageProxyService/ReadMessages"
        headers = {"Content-Type": "application/grpc-web+proto", "X-Grpc-Web": "1"}
        request = urllib.request.Request(f"http://{where.netloc}{call}", data=bytes(5), headers=headers)
        with urllib.request.urlopen(request, timeout=30) as answer:
            assert answer.headers["Content-Type"].startswith("application/grpc-web") and answer.read(5)
        for path, headers in ((call, {"Origin": "http://evil.example"}), ("/../etc/passwd", {})):
            request = urllib.request.Request(f"http://{where.netloc}{path}", data=bytes(5), headers=headers)
            with pytest.raises(urllib.error.HTTPError):
                urllib.request.urlopen(request, timeout=30)
        live.send_signal(signal.SIGTERM)
        assert live.wait(timeout=20) == 0
        assert not (folder / "rerun_web").exists()
    finally:
        live.kill()
        live.wait()
