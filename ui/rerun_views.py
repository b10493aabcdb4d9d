"""What rerun shows of an attempt, and in which layout: the same live, after the run, and headless.

    /camera/<name>        frames, a red frame around them while a flagged chunk acts
    /value/V, /value/flagged   V(s_t); dots where flagged
    /change/dV, /change/threshold, /change/flagged
    /flagged              a lane: "flagged" or nothing
    /action/<dimension>   the action sent; /perturbation/<dimension> on retries
    /joints/<j>           radians
    /events               what happened, in words

Timeline `time`: seconds since the log's origin. Imports rerun, which takes long: import it where it is used.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Bool, Float, UInt8

from far_app.recording.attempt_reader import AttemptRecording
from far_app.types import Step
from ui.plot_model import flagged_ticks

APPLICATION = "far"
TIMELINE = "time"
ACTIONS = ("x", "y", "z", "rx", "ry", "rz", "gripper")
RED, BLUE, GREY = (255, 77, 79), (63, 184, 255), (143, 161, 179)
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 92]


def blueprint(cameras: Sequence[str] = ("front", "wrist"), *, live: bool = False) -> rrb.Blueprint:
    """Cameras and events left, curves right, one time axis below."""
    views = [rrb.Spatial2DView(origin=f"/camera/{name}", name=name) for name in cameras]
    left = rrb.Vertical(
        rrb.Horizontal(*views), rrb.TextLogView(origin="/events", name="Events"), row_shares=[3, 2], name="Cameras"
    )
    hidden, corner = rrb.PlotLegend(visible=False), rrb.PlotLegend("RightTop")
    right = rrb.Vertical(
        rrb.TimeSeriesView(origin="/value", name="Value V(s), flagged red", plot_legend=hidden),
        rrb.StateTimelineView(origin="/flagged", name="Flagged chunks"),
        rrb.TimeSeriesView(
            origin="/change", name="Value change ΔV per chunk, flagged at or below red", plot_legend=hidden
        ),
        rrb.TimeSeriesView(origin="/action", name="Action sent", plot_legend=corner),
        rrb.TimeSeriesView(origin="/joints", name="Joints, rad", plot_legend=corner),
        row_shares=[4, 2, 3, 3, 3],
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[2, 3]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following" if live else "paused"),
    )


@dataclass(frozen=True, kw_only=True)
class Curves:
    """An attempt's V, and ΔV with its flags once it has failed."""

    times: Float[np.ndarray, "T"]
    """Seconds on the log's timeline, one a value."""
    values: Float[np.ndarray, "T"]
    changes: Float[np.ndarray, "C"]
    threshold: float
    flagged: tuple[int, ...]
    chunk_horizon: int

    @property
    def covered(self) -> Bool[np.ndarray, "T"]:
        return flagged_ticks(self.flagged, self.chunk_horizon, len(self.values))


def log_styles(recording: rr.RecordingStream) -> None:
    """Once a recording: colours and names of the curves."""

    def style(path: str, archetype: rr.AsComponents) -> None:
        recording.log(path, archetype, static=True)

    style("/value/V", rr.SeriesLines(colors=BLUE, names="V(s)", widths=2.0))
    style("/value/flagged", rr.SeriesPoints(colors=RED, names="flagged", marker_sizes=4.0))
    style("/flagged", rr.StateConfiguration(values=["flagged", ""], colors=[RED, (0, 0, 0)], visible=[True, False]))
    style("/change/dV", rr.SeriesLines(colors=GREY, names="ΔV", widths=1.5))
    style("/change/threshold", rr.SeriesLines(colors=RED, names="threshold", widths=1.0))
    style("/change/flagged", rr.SeriesPoints(colors=RED, names="flagged", marker_sizes=4.0))


def log_values(
    recording: rr.RecordingStream, times: Float[np.ndarray, "N"], values: Float[np.ndarray, "N"], path: str = "/value/V"
) -> None:
    """Scalars at their times; NaN is left out."""
    known = np.isfinite(values)
    if known.any():
        recording.send_columns(
            path,
            indexes=[rr.TimeColumn(TIMELINE, duration=times[known])],
            columns=rr.Scalars.columns(scalars=values[known]),
        )


def log_attribution(recording: rr.RecordingStream, curves: Curves, cameras: Iterable[str] = ()) -> None:
    """ΔV, threshold and flags of a failed attempt; the flagged spans as a lane and around the cameras."""
    changes = curves.changes
    times = curves.times[: len(changes)]
    if len(times) == 0:
        return
    at = np.array([tick for tick in curves.flagged if 0 <= tick < len(changes)], dtype=int)
    log_values(recording, times, changes, "/change/dV")
    log_values(recording, times[at], changes[at], "/change/flagged")
    log_values(recording, times[[0, -1]], np.full(2, curves.threshold), "/change/threshold")
    covered = curves.covered
    log_values(recording, curves.times[covered], curves.values[covered], "/value/flagged")
    for start, end in spans(covered):
        recording.set_time(TIMELINE, duration=float(curves.times[start]))
        recording.log("/flagged", rr.StateChange(state="flagged"))
        for camera in cameras:
            box = rr.Boxes2D(mins=[[1, 1]], sizes=[[82, 82]], colors=RED, radii=1.0, labels=["flagged"])
            recording.log(f"/camera/{camera}/flagged", box)
        recording.set_time(TIMELINE, duration=float(curves.times[min(end, len(curves.times) - 1)]))
        recording.log("/flagged", rr.StateChange(state=""))
        for camera in cameras:
            recording.log(f"/camera/{camera}/flagged", rr.Clear(recursive=False))


def spans(covered: Bool[np.ndarray, "T"]) -> list[tuple[int, int]]:
    """First tick and the tick after the last of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], covered, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def log_steps(recording: rr.RecordingStream, steps: Sequence[Step], origin: float) -> None:
    """Actions sent, perturbations and joints of whole steps."""
    if not steps:
        return
    times = np.array([step.stamp - origin for step in steps])
    sent = np.stack([step.sent for step in steps])
    perturbation = np.stack([step.perturbation for step in steps])
    joints = np.stack([step.observation.joints for step in steps])
    for i, name in enumerate(ACTIONS):
        log_values(recording, times, sent[:, i], f"/action/{name}")
        if perturbation[:, i].any():
            log_values(recording, times, perturbation[:, i], f"/perturbation/{name}")
    for j in range(joints.shape[1]):
        log_values(recording, times, joints[:, j], f"/joints/{j + 1}")


def log_cameras(recording: rr.RecordingStream, steps: Sequence[Step], origin: float) -> None:
    """Every step's frames as JPEG, a column a camera; a frame seen by several ticks is written once."""
    cameras = steps[0].observation.images.keys() if steps else ()
    for camera in cameras:
        seen = [k for k, step in enumerate(steps) if k == 0 or step.stamp != steps[k - 1].stamp]
        frames = [jpeg(steps[k].observation.images[camera]) for k in seen]
        recording.send_columns(
            f"/camera/{camera}",
            indexes=[rr.TimeColumn(TIMELINE, duration=[steps[k].stamp - origin for k in seen])],
            columns=rr.EncodedImage.columns(blob=frames, media_type=["image/jpeg"] * len(frames)),
        )


def log_event(recording: rr.RecordingStream, time: float, text: str, level: str = "INFO") -> None:
    recording.set_time(TIMELINE, duration=time)
    recording.log("/events", rr.TextLog(text, level=level))


def jpeg(image: UInt8[np.ndarray, "H W 3"]) -> bytes:
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), _JPEG)[1].tobytes()


def curves_of(attempt: AttemptRecording, origin: float) -> Curves:
    """From a recording: the adaptation's own V where there is one, else what each step knew."""
    times = [step.stamp - origin for step in attempt.steps]
    values = np.array([step.value for step in attempt.steps], dtype=float)
    if attempt.final is not None:
        times.append(attempt.final.stamp - origin)
        values = np.append(values, np.nan)
    for chunk in attempt.chunks:
        if 0 <= chunk.tick < len(values) and not np.isfinite(values[chunk.tick]):
            values[chunk.tick] = chunk.value
    adaptation = attempt.adaptation
    changes, threshold, flagged = np.zeros(0), float("nan"), ()
    if adaptation is not None and 0 < len(adaptation.values) <= len(times):
        values = np.asarray(adaptation.values, dtype=float)
        changes, threshold, flagged = adaptation.value_changes, adaptation.threshold, adaptation.flagged
    horizon = len(values) - len(changes) if len(changes) else 1
    return Curves(
        times=np.array(times[: len(values)]), values=values, changes=np.asarray(changes), threshold=threshold,
        flagged=tuple(flagged), chunk_horizon=horizon,
    )  # fmt: skip


def log_attempt(recording: rr.RecordingStream, attempt: AttemptRecording, origin: float) -> None:
    """All that a recording holds."""
    log_cameras(recording, attempt.steps, origin)
    log_steps(recording, attempt.steps, origin)
    known = curves_of(attempt, origin)
    log_values(recording, known.times, known.values)
    log_attribution(recording, known, attempt.frames)
    for event in attempt.events:
        log_event(recording, event.stamp - origin, f"{event.event}: {event.text}" if event.text else event.event)
    end = attempt.steps[-1].stamp - origin if attempt.steps else 0.0
    if attempt.outcome is not None:
        word = "success" if attempt.outcome.success else "failure"
        log_event(
            recording, end, f"{word}, judged by {attempt.outcome.judged_by.value}. {attempt.outcome.note}".strip()
        )
    for problem in attempt.problems:
        log_event(recording, end, problem, level="WARN")


def attempt_to_rrd(attempt: AttemptRecording, path: Path) -> None:
    """One attempt as one .rrd with its blueprint; needs no display."""
    header = attempt.header
    name = f"{header.session}, trial {header.trial}, attempt {header.attempt}" if header else attempt.path.stem
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{attempt.path.parent.name}-{attempt.path.stem}")
    recording.save(path, default_blueprint=blueprint(tuple(attempt.frames) or ("front", "wrist")))
    recording.send_recording_name(name)
    log_styles(recording)
    log_attempt(recording, attempt, attempt.steps[0].stamp if attempt.steps else 0.0)
    recording.flush()
    recording.disconnect()
