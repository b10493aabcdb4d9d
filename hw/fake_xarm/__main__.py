"""`far fake-xarm`: the fake controller by hand, and what should go wrong with one that runs.

far fake-xarm                                    serve on 127.0.0.1:15502
far fake-xarm tell error 31                      raise C31
far fake-xarm tell press 1                       the emergency stop (1, 2 or 3) …
far fake-xarm tell release                       … and its release
far fake-xarm tell faults latency=0.03 jitter=0.01         seconds a call takes, and how they vary
far fake-xarm tell faults stall=0.19 stall_every=10        everything stops for 190 ms every ten seconds
far fake-xarm tell faults mute=1                 a cut cable
far fake-xarm tell faults reports_stalled=1      calls are answered, reports do not come
far fake-xarm tell cut [reset=1]                 every connection ends, by FIN or by RST
far fake-xarm tell restart [seconds=3]           its power switch
far fake-xarm tell state                         what it stands at

A fault set to 0 is over.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import signal
import sys
from collections.abc import Sequence

from far_app.errors import ConfigError, FarError
from far_app.scheduling import MESSAGE_PRIORITY, real_time_from_here
from hw.fake_xarm.control import CONTROL_OFFSET, FakeXArm
from hw.fake_xarm.controller import FakeController
from hw.xarm7.settings import FAKE_PORT


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="far fake-xarm", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--address", default="127.0.0.1", help="loopback address; each has report ports of its own")
    parser.add_argument("--port", type=int, default=FAKE_PORT, help="command port; 502 on a real controller")
    parser.add_argument("tell", nargs="*", help="tell WORD [KEY=VALUE …]: change a running fake")
    options = parser.parse_args(arguments)
    control = options.port + CONTROL_OFFSET
    if options.tell:
        print(json.dumps(_tell(FakeXArm(options.address, control), options.tell)))
        return 0
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    real_time_from_here(MESSAGE_PRIORITY)  # it stands for another machine: this one's load is not to slow it
    asyncio.run(_serve(FakeController(options.address, options.port, control, _say_how)))
    return 0


def _say_how(address: str, port: int) -> None:
    print(
        f"A fake xArm7 controller at {address}:{port}; run with\n"
        f"  far run --robot xarm --host {address}:{port} --policy test:wander      (no network, no cameras needed)\n"
        f"  far run --rig rehearsal --host {address}:{port} --accept-differences   (the shipped model, shown test "
        "pictures)\nCtrl-C ends it.", flush=True,
    )  # fmt: skip


async def _serve(controller: FakeController) -> None:
    ended = asyncio.create_task(controller.run())
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, controller.end)
    await ended


def _tell(fake: FakeXArm, words: list[str]) -> dict[str, object]:
    if words[0] != "tell" or len(words) < 2:
        raise ConfigError("say: far fake-xarm tell WORD [KEY=VALUE …], as in: far fake-xarm tell error 31")
    what, rest = words[1], words[2:]
    if what in ("error", "press") and rest and "=" not in rest[0]:
        rest = [f"code={rest[0]}"]
    pairs = dict(pair.split("=", 1) for pair in rest if "=" in pair)
    try:
        values = {key: float(value) for key, value in pairs.items()}
    except ValueError as error:
        raise ConfigError(f"far fake-xarm tell {what} {' '.join(rest)}: {error}; every value is a number") from error
    if what in ("error", "press") and "code" not in values:
        raise ConfigError(f"far fake-xarm tell {what} needs a code, as in: far fake-xarm tell {what} 1")
    return fake.tell(do="faults", set=values) if what == "faults" else fake.tell(do=what, **values)


if __name__ == "__main__":
    try:
        code = main()
    except FarError as error:
        print(f"fake-xarm: {error}", file=sys.stderr)
        code = 2
    sys.exit(code)
