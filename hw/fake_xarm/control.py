"""The fake controller from outside: start one in its own process, make things go wrong, read what it received."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from typing import Any

from far_app.errors import RobotError
from hw.fake_xarm.protocol import Function

CONTROL_OFFSET = 90
"""The control port lies this far above the command port unless told otherwise."""


class FakeXArm:
    """Talks to a running fake controller's control port; `start` runs one first, which ends with `close`."""

    def __init__(self, address: str, control_port: int, timeout: float = 5.0) -> None:
        self.address = address
        self._process: subprocess.Popen[bytes] | None = None
        deadline = time.monotonic() + timeout
        while True:
            try:
                self._socket = socket.create_connection((address, control_port), timeout=timeout)
                break
            except OSError as error:
                if time.monotonic() > deadline:
                    raise RobotError(
                        f"no fake controller answers at {address}:{control_port} ({error.strerror}); start one with "
                        "far fake-xarm"
                    ) from error
                time.sleep(0.05)
        self._socket.settimeout(timeout)
        self._file = self._socket.makefile("rw")

    @classmethod
    def start(cls, address: str, port: int, timeout: float = 20.0) -> FakeXArm:
        """A fake controller in a process of its own."""
        command = [sys.executable, "-m", "hw.fake_xarm", "--address", address, "--port", str(port)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        try:
            fake = cls(address, port + CONTROL_OFFSET, timeout)
        except RobotError:
            process.kill()
            raise
        fake._process = process
        return fake

    @property
    def pid(self) -> int | None:
        """Of its process, when `start` made it."""
        return self._process.pid if self._process is not None else None

    def tell(self, **words: Any) -> dict[str, Any]:
        """One request; the answer. Raises RobotError where the fake does not understand."""
        self._file.write(json.dumps(words) + "\n")
        self._file.flush()
        reply = json.loads(self._file.readline())
        if "error" in reply and isinstance(reply["error"], str):
            raise RobotError(f"the fake controller refused {words}: {reply['error']}")
        return reply

    def state(self) -> dict[str, Any]:
        """Mode, state, error code, pose (mm), gripper position."""
        return self.tell(do="state")

    def error(self, code: int) -> None:
        """The controller raises an error and stops the arm."""
        self.tell(do="error", code=code)

    def lead(self, x: float, y: float, z: float) -> bool:
        """A person pushes the hand, millimetres; False when the arm does not give way."""
        return bool(self.tell(do="lead", by=[x, y, z])["gave_way"])

    def faults(self, stall_in: float = 1.0, **values: float | bool) -> None:
        """Set fields of hw.fake_xarm.faults.Faults; a stall begins after `stall_in` seconds."""
        self.tell(do="faults", set=values, stall_in=stall_in)

    def received(self) -> list[dict[str, Any]]:
        """What came in since last asked (hw.fake_xarm.received.Received as dicts)."""
        return self.tell(do="received")["received"]

    def servo_targets(self) -> list[dict[str, Any]]:
        """The same, servo targets only."""
        return [r for r in self.received() if r["function"] == Function.MOVE_SERVO_CART_AA]

    def close(self) -> None:
        """End the process when `start` made it."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait(timeout=5)
        self._file.close()
        self._socket.close()
