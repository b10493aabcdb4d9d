"""A robot PC for benchmarks and tests: fake controller, hw server with a clock of its own, and a bad cable to it.

Between two network namespaces of this machine, joined by a veth pair, and with a time namespace for the hw server,
where the system permits them (root, or unprivileged user namespaces): then its monotonic clock differs for real. Else
on loopback, with an hw server whose time.monotonic is moved.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from far_app.endpoints import HARDWARE
from far_app.errors import FarError
from far_app.keys import make_keys
from hw.fake_xarm.control import CONTROL_OFFSET, FakeXArm

AHEAD = 36_000
"""Seconds by which the hw server's clock is ahead."""
ROBOT, GPU, LOOPBACK = "10.77.0.1", "10.77.0.2", "127.0.0.1"
SERVED, RELAYED = 5600, 5700
CONTROLLER = "127.0.0.81"
CONTROLLER_PORT = 15502
FAR = "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))"
MOVED_CLOCK = f"import time; real = time.monotonic; time.monotonic = lambda: real() + {AHEAD}.0; {FAR}"
PATIENCE = 60.0


@dataclass(kw_only=True)
class RobotPC:
    """The other machine, as seen from this one."""

    fake: FakeXArm
    address: str
    """For far run --hw."""
    keys: Path
    apart: str
    """What stands between: "network namespaces" or "loopback"."""
    relay: subprocess.Popen[str]
    stalls: list[float] = field(default_factory=list)
    """When each stall of the cable began."""

    def __post_init__(self) -> None:
        threading.Thread(target=self._listen, daemon=True).start()

    def tell(self, words: str) -> None:
        """Change the cable (see far_app.bench.relay)."""
        assert self.relay.stdin is not None
        self.relay.stdin.write(words + "\n")
        self.relay.stdin.flush()

    def _listen(self) -> None:
        assert self.relay.stdout is not None
        self.stalls.extend(float(line) for line in self.relay.stdout)


def separable() -> list[str]:
    """The command that puts a program into a network namespace of its own; empty where that is not permitted."""
    tools = all(shutil.which(tool) for tool in ("unshare", "nsenter", "ip"))
    for command in (["unshare", "-n"], ["unshare", "-rn"]):
        made = "ip link add far0 type veth peer name far1 && unshare -n -T --monotonic 1 --fork true"
        if tools and subprocess.run([*command, "sh", "-c", made], check=False, capture_output=True).returncode == 0:
            return command
    return []


@contextlib.contextmanager
def robot_pc(folder: Path, namespaces: bool, delay: float) -> Iterator[RobotPC]:
    """Everything of the other machine, started and ended. With `namespaces` this process is to be in one of its own."""
    keys = folder / "keys"
    make_keys(keys)
    with contextlib.ExitStack() as stack:

        def start(words: Sequence[str], **settings: object) -> subprocess.Popen[str]:
            process = subprocess.Popen(list(words), text=True, **settings)  # type: ignore[call-overload]
            stack.callback(_end, process)
            return process

        inside, other_clock, host, code = [], [], LOOPBACK, MOVED_CLOCK
        holder = None
        if namespaces:
            holder = start(["unshare", "-n", "sleep", "infinity"])
            _join(holder.pid)
            inside, host, code = ["nsenter", "-t", str(holder.pid), "-n"], ROBOT, FAR
            other_clock = [
                "unshare",
                "-T",
                "--monotonic",
                str(AHEAD),
                "--boottime",
                str(AHEAD),
                "--fork",
                "--kill-child",
            ]
        start([*inside, sys.executable, "-m", "hw.fake_xarm", "--address", CONTROLLER], stdout=subprocess.DEVNULL)
        fake = _control(holder.pid if holder else None)
        stack.callback(fake.close)
        served = f"tcp://{host}:{SERVED}"
        words = ["hw-server", "--bind", served, "--keys", str(keys), "--robot", "xarm"]
        words += ["--host", f"{CONTROLLER}:{CONTROLLER_PORT}"]
        log = stack.enter_context((folder / "hw-server.log").open("w"))
        server = start(
            [*inside, *other_clock, sys.executable, "-c", code, *words], stdout=subprocess.PIPE, stderr=log
        )  # fmt: skip
        _wait_for(server, "Ready")
        words = ["--host", host, "--port", str(RELAYED), "--to-host", host, "--to-port", str(SERVED)]
        relay = start(
            [*inside, sys.executable, "-m", "far_app.bench.relay", *words, "--count", str(len(HARDWARE)),
             "--delay", str(delay)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        )  # fmt: skip
        _wait_for(relay, "ready")
        yield RobotPC(
            fake=fake, address=f"tcp://{host}:{RELAYED}", keys=keys, relay=relay,
            apart="network namespaces" if namespaces else "loopback",
        )  # fmt: skip


def _join(pid: int) -> None:
    """A cable between our network namespace and another process's."""
    deadline = time.monotonic() + 5.0
    while os.readlink(f"/proc/{pid}/ns/net") == os.readlink("/proc/self/ns/net"):
        if time.monotonic() > deadline:
            raise FarError(f"process {pid} made no network namespace within 5 s; say --loopback")
        time.sleep(0.01)
    there = ["nsenter", "-t", str(pid), "-n"]
    for command in (
        ["ip", "link", "set", "lo", "up"],
        ["ip", "link", "add", "far0", "type", "veth", "peer", "name", "far1", "netns", str(pid)],
        ["ip", "addr", "add", f"{GPU}/24", "dev", "far0"],
        ["ip", "link", "set", "far0", "up"],
        [*there, "ip", "link", "set", "lo", "up"],
        [*there, "ip", "addr", "add", f"{ROBOT}/24", "dev", "far1"],
        [*there, "ip", "link", "set", "far1", "up"],
    ):
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        if done.returncode:
            raise FarError(f"{' '.join(command)} failed: {done.stderr.strip()}; say --loopback")


def _control(pid: int | None) -> FakeXArm:
    """The fake controller's control connection, made from within the other namespace."""
    made: list[FakeXArm] = []

    def connect() -> None:
        if pid is not None:
            with open(f"/proc/{pid}/ns/net") as namespace:
                if ctypes.CDLL(None, use_errno=True).setns(namespace.fileno(), 0):
                    raise OSError(ctypes.get_errno(), "setns")
        made.append(FakeXArm(CONTROLLER, CONTROLLER_PORT + CONTROL_OFFSET, timeout=20.0))

    thread = threading.Thread(target=connect)
    thread.start()
    thread.join()
    if not made:
        raise FarError("the fake controller in the other network namespace did not answer; say --loopback")
    return made[0]


def _wait_for(process: subprocess.Popen[str], word: str) -> None:
    assert process.stdout is not None
    line = process.stdout.readline()
    if word not in line:
        raise FarError(f"{process.args} did not come up: {line.strip() or 'it said nothing'}")


def _end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.wait(3.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
