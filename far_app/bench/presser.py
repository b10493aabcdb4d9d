"""Somebody at the page who presses STOP, for benchmarks: a process of its own, as the page is, whose line to the hw
server stands before anything is pressed.

`python -m far_app.bench.presser FOLDER` presses once for each line on its standard input and answers with a line of
JSON: when it pressed, when the hw server heard it, and how late a bare sleeper woke meanwhile on this machine.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from far_app.bench.waiting import came_true
from far_app.endpoints import Endpoints
from far_app.scheduling import STOP_PRIORITY, real_time
from ui.stop import StopLine

PERIOD = 0.001
"""Seconds for which the sleeper sleeps."""
AROUND = 0.01
"""Seconds before and after a press for which its lateness counts."""


@dataclass(frozen=True, kw_only=True)
class Press:
    pressed: float
    """Monotonic seconds."""
    heard: float | None
    """When the hw server heard of it, by its own word and clock; None without one."""
    floor: float
    """Seconds by which a sleeper of STOP's own priority woke late around the press, at most: the machine's doing."""


class Presser:
    """That process, from outside."""

    def __init__(self, folder: Path) -> None:
        command = [sys.executable, "-m", "far_app.bench.presser", str(folder)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._read()  # its line stands

    def press(self) -> Press:
        """Returns once the hw server confirmed, or after a second."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        return Press(**json.loads(self._read()))

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(timeout=5.0)

    def _read(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()


def main() -> None:
    line = StopLine(Endpoints.in_folder(Path(sys.argv[1])))
    late: deque[tuple[float, float]] = deque(maxlen=round(2.0 / PERIOD))
    threading.Thread(target=_sleep, args=(late,), name="floor", daemon=True).start()
    time.sleep(0.3)  # for the line's handshake
    print("ready", flush=True)
    for _ in sys.stdin:
        before = line.result
        line.press("bench")
        came_true(lambda before=before: line.result not in (None, before) and bool(line.result.latched), 1.0)
        time.sleep(AROUND)
        result = line.result
        assert result is not None, "a line that was pressed has a result"
        end = (result.heard if result.latched else time.monotonic()) + AROUND
        floor = max((lag for woke, lag in tuple(late) if result.pressed - AROUND < woke < end), default=0.0)
        press = {"pressed": result.pressed, "heard": result.heard if result.latched else None, "floor": floor}
        print(json.dumps(press), flush=True)
    line.close()


def _sleep(late: deque[tuple[float, float]]) -> None:
    real_time(STOP_PRIORITY)
    while True:
        due = time.monotonic() + PERIOD
        time.sleep(PERIOD)
        now = time.monotonic()
        late.append((now, now - due))


if __name__ == "__main__":
    main()
