"""Replay makes what is missing, never a half file, and says plainly when no viewer can open."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from far_app.errors import ConfigError, RecordingError
from far_app.recording.attempt_reader import AttemptRecording
from far_app.recording.replay import lacking_rrd, make_rrd, make_rrds, open_viewer, replay, rrd_path, viewer_command

from . import sessions


def write_steps(recording: AttemptRecording, path: Path) -> None:
    """An .rrd of the values alone; the operator interface's own drawing is tested with it."""
    import rerun as rr

    stream = rr.RecordingStream("far_test", recording_id=recording.path.stem)
    stream.save(path)
    for step in recording.steps:
        stream.set_time("tick", sequence=step.tick)
        stream.log("value", rr.Scalars([step.value]))
    stream.disconnect()


def test_each_attempt_becomes_one_rrd_beside_its_recording(tmp_path: Path) -> None:
    folder = sessions.small_session(tmp_path, steps=3)
    files = [folder / f"trial_0001/attempt_{k}.mcap" for k in (1, 2)]
    assert lacking_rrd(folder) == files
    made = make_rrds(folder, write_steps)
    assert made == [rrd_path(file) for file in files] and all(path.stat().st_size > 100 for path in made)
    assert lacking_rrd(folder) == []
    stamps = [path.stat().st_mtime_ns for path in made]
    assert [path.stat().st_mtime_ns for path in make_rrds(folder, write_steps)] == stamps
    assert make_rrds(files[0], write_steps) == made[:1]


def test_a_failed_conversion_leaves_no_half_file(tmp_path: Path) -> None:
    file = sessions.small_session(tmp_path, steps=2) / "trial_0001/attempt_1.mcap"

    def fail(recording: AttemptRecording, path: Path) -> None:
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    with pytest.raises(RecordingError, match="No space left on device"):
        make_rrd(file, fail)
    assert sorted(path.name for path in file.parent.iterdir()) == ["attempt_1.mcap", "attempt_2.mcap"]


def test_an_attempt_that_is_still_written_waits(tmp_path: Path) -> None:
    writer = sessions.open_writer(tmp_path)
    writer.begin_trial(1, 7)
    writer.begin_attempt(1, "base")
    time.sleep(0.2)
    assert lacking_rrd(writer.folder) == []
    writer.close()
    assert len(lacking_rrd(writer.folder)) == 1


def test_without_a_display_the_error_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    folder = sessions.small_session(tmp_path, steps=2)
    with pytest.raises(ConfigError, match=r"no display .* add --web"):
        replay(folder, write_steps)
    assert rrd_path(folder / "trial_0001/attempt_1.mcap").exists(), "the files are made all the same"


def test_a_port_in_use_is_named(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"port {port} cannot be used: .*choose another with --port"):
            open_viewer([tmp_path / "a.rrd"], web=True, port=port)


def test_the_viewer_listens_on_the_loopback_address_alone(tmp_path: Path) -> None:
    for web_port in (None, 9090):
        command = viewer_command([tmp_path / "a.rrd"], 9876, web_port)
        assert command[command.index("--bind") + 1] == "127.0.0.1"


@pytest.mark.slow
def test_the_web_viewer_opens_and_sigterm_leaves_nothing_behind(tmp_path: Path) -> None:
    rrd = make_rrds(sessions.small_session(tmp_path, steps=3), write_steps)[0]
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    code = (
        "import sys; from pathlib import Path; from far_app.recording.replay import open_viewer; "
        "open_viewer([Path(sys.argv[1])], web=True, port=int(sys.argv[2]), announce=print)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(rrd), str(port)], stdout=subprocess.PIPE, text=True)
    try:
        page = None
        for _ in range(150):
            try:
                page = urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5).read()
                break
            except OSError:
                time.sleep(0.1)
        assert page is not None and b"html" in page
        process.send_signal(signal.SIGTERM)
        assert process.wait(20) == 0
    finally:
        process.kill()
    with socket.socket() as probe:
        assert probe.connect_ex(("127.0.0.1", port)) != 0
    assert os.path.exists(rrd)
