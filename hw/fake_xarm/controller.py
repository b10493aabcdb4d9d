"""The sockets of the fake controller: command ports, report ports, and one to be told what should go wrong.

One thread, one event loop. Every request is stamped as it is read, before any injected delay: that is when it was on
the wire. Servo targets are kept with their stamps, so that a test sees step sizes, speeds and pauses as the arm would.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import asdict, fields

import numpy as np

from far_app.errors import RobotError
from hw.fake_xarm.arm import FakeArm
from hw.fake_xarm.commands import answer
from hw.fake_xarm.faults import Faults
from hw.fake_xarm.gripper import FakeGripper
from hw.fake_xarm.protocol import Request, take_request
from hw.fake_xarm.received import ReceivedLog
from hw.fake_xarm.reports import PORTS, RATES, report

log = logging.getLogger(__name__)


class FakeController:
    """Serves until told to end."""

    def __init__(
        self, address: str, port: int, control_port: int, serving: Callable[[str, int], None] = lambda *_: None
    ) -> None:
        """`serving` is called with address and port once all ports are open."""
        self._serving = serving
        self.address, self.port, self.control_port = address, port, control_port
        self.arm, self.gripper, self.faults = FakeArm(), FakeGripper(), Faults()
        self.received = ReceivedLog()
        self._began = self._advanced = time.monotonic()
        self._writers: set[asyncio.StreamWriter] = set()
        self._servers: list[asyncio.Server] = []
        self._connections = 0
        self._ended = asyncio.Event()

    async def run(self) -> None:
        """Serve the arm's ports and the control port until told to end. Raises RobotError where a port is taken."""
        try:
            await self._listen()
            control = await asyncio.start_server(self._control, self.address, self.control_port)
        except OSError as error:
            raise RobotError(
                f"the fake controller cannot serve on {self.address} ({error.strerror}); end what listens there, or "
                "take another loopback address (127.0.0.2 …): the report ports are fixed"
            ) from error
        self._serving(self.address, self.port)
        await self._ended.wait()
        control.close()
        await self._hang_up(reset=False)

    def end(self) -> None:
        """From the event loop's thread: stop serving."""
        self._ended.set()

    async def _listen(self) -> None:
        for port in (self.port, self.port + 1):
            self._servers.append(await asyncio.start_server(self._commands, self.address, port))
        for kind, port in PORTS.items():

            async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, kind: str = kind) -> None:
                await self._reports(kind, writer)

            self._servers.append(await asyncio.start_server(serve, self.address, port))

    async def _hang_up(self, reset: bool) -> None:
        """Stop listening and end every connection, by FIN or by RST."""
        for server in self._servers:
            server.close()
        self._servers.clear()
        self._cut(reset)
        await asyncio.sleep(0)

    def _cut(self, reset: bool) -> None:
        for writer in tuple(self._writers):
            if reset:
                link: socket.socket = writer.get_extra_info("socket")
                link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                writer.transport.abort()
            else:
                writer.close()

    def _advance(self) -> float:
        now = time.monotonic()
        self.arm.advance(now - self._advanced)
        self.gripper.advance(now - self._advanced)
        self._advanced = now
        return now

    async def _stall(self) -> None:
        await asyncio.sleep(self.faults.stalled_for(time.monotonic() - self._began))

    # ── commands ──

    async def _commands(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        self._connections += 1
        number, buffer = self._connections, bytearray()
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            while data := await reader.read(4096):
                buffer += data
                while (request := take_request(buffer)) is not None:
                    await self._serve(request, number, writer)
        except (ConnectionError, TimeoutError, asyncio.CancelledError):
            pass
        finally:
            self._writers.discard(writer)
            writer.close()

    async def _serve(self, request: Request, connection: int, writer: asyncio.StreamWriter) -> None:
        arrived = time.monotonic()
        if self.faults.mute:
            return
        self.received.remember(request, connection, arrived)
        delay = self.faults.delay()
        if delay:
            await asyncio.sleep(delay / 2)
        await self._stall()
        frame = answer(request, self.arm, self.gripper, self._advance())
        if delay:
            await asyncio.sleep(delay / 2)
        if not self.faults.mute:
            writer.write(frame)

    # ── reports ──

    async def _reports(self, kind: str, writer: asyncio.StreamWriter) -> None:
        self._writers.add(writer)
        period = 1.0 / RATES[kind]
        due = time.monotonic()
        try:
            while not writer.is_closing():
                await self._stall()
                self._advance()
                if not self.faults.mute and not self.faults.reports_stalled:
                    writer.write(report(kind, self.arm))
                    await writer.drain()
                due = max(due + period, time.monotonic() - period)
                await asyncio.sleep(max(0.0, due - time.monotonic()))
        except (ConnectionError, TimeoutError, asyncio.CancelledError):
            pass
        finally:
            self._writers.discard(writer)
            writer.close()

    # ── what should go wrong ──

    async def _control(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One line of JSON asks, one answers."""
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            while line := await reader.readline():
                try:
                    reply = await self._told(json.loads(line))
                except (ValueError, KeyError, TypeError, AttributeError) as error:
                    kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
                    reply = {"error": f"{kind}{error}"}
                writer.write(json.dumps(reply).encode() + b"\n")
                await writer.drain()
        writer.close()

    async def _told(self, words: dict) -> dict:
        self._advance()
        match words["do"]:
            case "error":
                self.arm.fail(int(words["code"]))
            case "press":
                self.arm.press_emergency(int(words["code"]))
            case "release":
                self.arm.release_emergency()
            case "faults":
                known = {f.name for f in fields(Faults) if not f.name.startswith("_")}
                for name, value in words["set"].items():
                    if name not in known:
                        raise ValueError(f"unknown fault '{name}'; choose one of: {', '.join(sorted(known))}")
                    setattr(self.faults, name, type(getattr(self.faults, name))(value))
                self._began = time.monotonic() - self.faults.stall_every + float(words.get("stall_in", 1.0))
            case "cut":
                self._cut(reset=bool(words.get("reset")))
            case "restart":
                await self._restart(float(words.get("seconds", 2.0)))
            case "object":
                self.gripper.object = None if words.get("at") is None else float(words["at"])
            case "lead":
                return {**self._state(), "gave_way": self.arm.lead(np.array(words["by"], float))}
            case "set":
                setattr(self.arm, words["name"], words["value"])
            case "received":
                return {"received": [asdict(received) for received in self.received.take()]}
            case "state":
                pass
            case "end":
                self.end()
            case other:
                raise ValueError(
                    f"unknown word '{other}'; choose one of: error, press, release, faults, cut, restart, state"
                )
        return self._state()

    async def _restart(self, seconds: float) -> None:
        """As after its power switch: connections gone, motors off, mode 0; it listens again after a while."""
        await self._hang_up(reset=False)
        old = self.arm
        self.arm = FakeArm(
            position=old.position, quaternion=old.quaternion, tcp_offset=old.tcp_offset, load=old.load,
            sensitivity=old.sensitivity,
        )  # fmt: skip

        async def come_back() -> None:
            await asyncio.sleep(seconds)
            await self._listen()

        self._coming_back = asyncio.create_task(come_back())

    def _state(self) -> dict:
        arm, hand = self.arm, self.gripper
        return {
            "mode": arm.mode, "state": int(arm.state), "error": arm.error, "enabled": arm.enabled,
            "position": arm.position.tolist(), "quaternion": arm.quaternion.tolist(), "gripper": hand.position,
            "gripper_writes": hand.writes, "gripper_speed": hand.speed, "gripper_force": hand.force,
            "connections": len(self._writers), "now": time.monotonic(),
        }  # fmt: skip
