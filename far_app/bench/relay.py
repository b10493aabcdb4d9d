"""A bad cable (`python -m far_app.bench.relay`): passes TCP connections on, late by a delay, now and then not at all.

Everything arrives, in order, as TCP promises; a stall or a cut only makes it wait. Lines on standard input change the
link: `delay 0.005`, `stall 0.2 5` (seconds, each so many seconds; 0 ends it), `cut`, `mend`. Each stall's beginning is
printed, monotonic seconds.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import sys
import time
from collections.abc import Sequence

from far_app.scheduling import MESSAGE_PRIORITY, real_time


class Cable:
    """What the link is like now."""

    def __init__(self, delay: float) -> None:
        self.delay = delay
        self.open = asyncio.Event()
        self.open.set()
        self._stalls: asyncio.Task[None] | None = None

    def told(self, words: Sequence[str]) -> None:
        """One line of the control."""
        match words:
            case ["delay", seconds]:
                self.delay = float(seconds)
            case ["cut"]:
                self.open.clear()
            case ["mend"]:
                self.open.set()
            case ["stall", seconds, every]:
                if self._stalls is not None:
                    self._stalls.cancel()
                    self.open.set()
                if float(seconds):
                    self._stalls = asyncio.create_task(self._stall(float(seconds), float(every)))
            case _:
                print(f"relay: what is {' '.join(words)!r}?", file=sys.stderr, flush=True)

    async def _stall(self, seconds: float, every: float) -> None:
        while True:
            await asyncio.sleep(every - seconds)
            print(f"{time.monotonic():.6f}", flush=True)
            self.open.clear()
            await asyncio.sleep(seconds)
            self.open.set()

    async def carry(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        """One direction of one connection, until it ends."""
        under_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(maxsize=1024)

        async def take() -> None:
            chunk = b"-"
            while chunk:
                chunk = await source.read(65536)
                await under_way.put((time.monotonic() + self.delay, chunk))

        taking = asyncio.create_task(take())
        try:
            while True:
                due, chunk = await under_way.get()
                await asyncio.sleep(max(0.0, due - time.monotonic()))
                await self.open.wait()
                if not chunk:
                    return
                sink.write(chunk)
                await sink.drain()
        finally:
            taking.cancel()
            sink.close()


async def relay(host: str, port: int, to_host: str, to_port: int, count: int, delay: float) -> None:
    """Carries `count` ports from `port` on to those from `to_port` on, until standard input ends."""
    cable = Cable(delay)

    def at(to: int):
        async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            with contextlib.suppress(OSError):
                far_reader, far_writer = await asyncio.open_connection(to_host, to)
                carried = (cable.carry(reader, far_writer), cable.carry(far_reader, writer))
                await asyncio.gather(*carried, return_exceptions=True)
            writer.close()

        return connected

    for i in range(count):
        await asyncio.start_server(at(to_port + i), host, port + i)
    print("ready", flush=True)
    control = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(control), sys.stdin)
    while line := await control.readline():
        cable.told(line.decode().split())


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m far_app.bench.relay", description=__doc__)
    for name, kind in (("host", str), ("port", int), ("to-host", str), ("to-port", int), ("count", int)):
        parser.add_argument(f"--{name}", type=kind, required=True)
    parser.add_argument("--delay", type=float, default=0.005, help="seconds, each way")
    options = parser.parse_args()
    real_time(MESSAGE_PRIORITY)
    asyncio.run(relay(**vars(options)))


if __name__ == "__main__":
    main()
