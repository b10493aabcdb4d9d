"""`far doctor --rig`: what a rig file says, and what differs at the controller; it changes nothing there."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from far_app.cli import main
from far_app.errors import FarError
from hw.fake_xarm.__main__ import main as fake_xarm
from hw.fake_xarm.control import FakeXArm
from hw.fake_xarm.protocol import Function
from hw.rig import RIGS
from tests.hw.conftest import FAKE_PORT, loopback


@pytest.fixture
def fake() -> Iterator[FakeXArm]:
    fake = FakeXArm.start(loopback(), FAKE_PORT)
    yield fake
    fake.close()


def doctor(fake: FakeXArm, rig: str = "xarm7") -> int:
    return main(["doctor", "--rig", rig, "--host", f"{fake.address}:{FAKE_PORT}"])


def test_a_rig_that_fits_its_controller_is_well_and_nothing_is_written(fake: FakeXArm, capsys) -> None:
    assert doctor(fake) == 0
    out = capsys.readouterr().out
    assert "BAD" not in out
    for subject in ("start pose", "tool", "load", "collision", "network", "reports", "gripper"):
        assert f"ok   {subject}" in out
    assert {r["function"] for r in fake.received()} <= {Function.GET_VERSION, Function.GET_ROBOT_SN}


def test_what_differs_is_told_with_both_values(fake: FakeXArm, tmp_path: Path, capsys) -> None:
    fake.tell(do="set", name="sensitivity", value=1)
    fake.error(35)
    rig = tmp_path / "mine.toml"
    rig.write_text(
        (RIGS / "xarm7.toml").read_text().replace("0.172", "0.150").replace("load_mass = 0.82", "load_mass = 1.5")
    )
    assert doctor(fake, str(rig)) == 1
    out = capsys.readouterr().out
    assert "BAD  errors     C35: Safety Boundary Limit" in out
    assert "BAD  tool       rig (0, 0, 150, 0, 0, 0) (mm, rad), controller (0, 0, 172, 0, 0, 0)" in out
    assert "BAD  load       rig 1.5 kg" in out and "controller 0.82 kg" in out
    assert "BAD  collision  sensitivity 1, the rig asks for at least 3" in out
    assert fake.state()["error"] == 35, "a doctor clears nothing"


G2 = 'kind = "g2"\nopen = 84.0\nclosed = 0.0\nspeed = 150.0\nforce = 40.0\n'


def test_a_g2_is_asked_as_one(fake: FakeXArm, tmp_path: Path, capsys) -> None:
    rig = tmp_path / "mine.toml"
    g1 = 'kind = "g1"\nopen = 850.0\nclosed = 0.0\nspeed = 3000.0\n'
    text = (RIGS / "xarm7.toml").read_text()
    assert g1 in text
    rig.write_text(text.replace(g1, G2))
    assert doctor(fake, str(rig)) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "gripper" in line)
    assert line.startswith("ok   gripper    g2 at 8"), "millimetres"


def camera_lines(tmp_path: Path, device: str, capsys) -> list[str]:
    """What a doctor says of a rig with this camera, at an address where no controller is."""
    rig = tmp_path / "mine.toml"
    text = (RIGS / "xarm7.toml").read_text().replace("cameras = []", "")
    rig.write_text(f'{text}\n[camera.front]\ndevice = "{device}"\nwidth = 1344\nheight = 376\neye = "left"\n')
    assert main(["doctor", "--rig", str(rig), "--host", f"{loopback()}:{FAKE_PORT}"]) == 1
    return [line for line in capsys.readouterr().out.splitlines() if line[5:].startswith("camera ")]


def test_a_camera_is_looked_through(tmp_path: Path, capsys) -> None:
    (line,) = camera_lines(tmp_path, "synthetic", capsys)
    assert line.startswith("ok   camera     1344×376, ")
    assert "of 60 asked for; front: left eye, largest centred square" in line


@pytest.mark.parametrize(
    ("device", "says"),
    [
        ("/dev/no-such-camera", "/dev/no-such-camera cannot be opened; is it plugged in"),
        ("synthetic:unplugged@0+9", "is unplugged; plug it in"),
        ("synthetic:frozen@0.2+9", "frozen  → give it a USB controller of its own"),
    ],
)
def test_a_camera_that_gives_nothing_or_too_little_is_named(device: str, says: str, tmp_path: Path, capsys) -> None:
    (line,) = camera_lines(tmp_path, device, capsys)
    assert line.startswith("BAD  camera") and says in line


def test_no_controller_is_one_line(capsys) -> None:
    assert main(["doctor", "--rig", "xarm7", "--host", f"{loopback()}:{FAKE_PORT}"]) == 1
    assert "BAD  controller no xArm controller at" in capsys.readouterr().out


def test_a_running_fake_is_told_from_the_command_line(fake: FakeXArm, capsys) -> None:
    assert fake_xarm(["--address", fake.address, "tell", "error", "31"]) == 0
    assert fake.state()["error"] == 31
    assert fake_xarm(["--address", fake.address, "tell", "faults", "latency=0.01"]) == 0


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["faults", "speed=1"], "unknown fault 'speed'; choose one of: jitter, latency, mute, reports_stalled, stall"),
        (["faults", "mute=yes"], "could not convert string to float: 'yes'; every value is a number"),
        (["error"], "needs a code, as in: far fake-xarm tell error 1"),
        (["explode"], "unknown word 'explode'; choose one of: error, press, release, faults, cut, restart, state"),
    ],
)
def test_what_a_fake_does_not_understand_is_one_line(fake: FakeXArm, words: list[str], says: str) -> None:
    with pytest.raises(FarError, match=re.escape(says)):
        fake_xarm(["--address", fake.address, "tell", *words])


def test_a_fake_on_ports_that_are_taken_never_says_that_it_serves(fake: FakeXArm, capsys) -> None:
    with pytest.raises(FarError, match="cannot serve on"):
        fake_xarm(["--address", fake.address])
    assert "A fake xArm7 controller at" not in capsys.readouterr().out


def test_a_controller_looked_for_on_this_machine_at_the_real_ones_port_tells_of_the_fakes(fake: FakeXArm, capsys):
    assert main(["doctor", "--rig", "xarm7", "--host", fake.address]) == 1
    told = capsys.readouterr().out
    assert f"a fake one (far fake-xarm) listens on port {FAKE_PORT}: {fake.address}:{FAKE_PORT}" in told
