"""`far fake-xarm`: the fake controller by hand, and what should go wrong with one that runs.

far fake-xarm                                   serve on 127.0.0.1:15502
far fake-xarm tell error 31                     raise C31
far fake-xarm tell faults latency=0.03 mute=1   change the link
far fake-xarm tell cut | cut reset=1 | restart seconds=3 | press code=2 | release | state
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

PORT = 15502
"""Where it serves in place of 502, which only root may."""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="far fake-xarm", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--address", default="127.0.0.1", help="loopback address; each has report ports of its own")
    parser.add_argument("--port", type=int, default=PORT, help="command port; 502 on a real controller")
    parser.add_argument("tell", nargs="*", help="tell WORD [KEY=VALUE …]: change a running fake")
    options = parser.parse_args(arguments)
    control = options.port + CONTROL_OFFSET
    if options.tell:
        print(json.dumps(_tell(FakeXArm(options.address, control), options.tell)))
        return 0
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    print(
        f"A fake xArm7 controller at {options.address}:{options.port}; run with  "
        f"far run --robot xarm --host {options.address}:{options.port}\nCtrl-C ends it.", flush=True,
    )  # fmt: skip
    real_time_from_here(MESSAGE_PRIORITY)  # it stands for another machine: this one's load is not to slow it
    asyncio.run(_serve(FakeController(options.address, options.port, control)))
    return 0


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
    values = {key: float(value) for key, value in pairs.items()}
    return fake.tell(do="faults", set=values) if what == "faults" else fake.tell(do=what, **values)


if __name__ == "__main__":
    try:
        code = main()
    except FarError as error:
        print(f"fake-xarm: {error}", file=sys.stderr)
        code = 2
    sys.exit(code)
