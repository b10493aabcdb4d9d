"""A page without a browser: connects like one, reads everything, may press what it sees. For benchmarks and tests.

python -m ui.raw_client http://127.0.0.1:8080 --seconds 60    one client that looks at it all along
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any
from urllib.parse import urlsplit

import msgspec.msgpack
import viser
import zstandard
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect


class RawClient:
    """Follows the page's widgets by id: their properties as last sent."""

    def __init__(self, url: str, origin: str | None = None, cookie: str = "") -> None:
        """`cookie`: what a page beyond loopback gave for its token."""
        at = urlsplit(url)
        self._socket: ClientConnection = connect(
            f"ws://{at.netloc}",
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            origin=origin,  # type: ignore[arg-type]
            additional_headers={"Cookie": cookie} if cookie else {},
            max_size=None,
            compression=None,
        )
        self.widgets: dict[str, dict[str, Any]] = {}
        self.nodes: set[str] = set()
        """Names in the 3D scene."""
        self.windows = 0
        self.bytes = 0

    def read(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Take in what comes for so long, or until the condition holds; True when it does."""
        end = time.monotonic() + seconds
        while not until():
            left = end - time.monotonic()
            if left <= 0:
                return False
            try:
                raw = self._socket.recv(timeout=left)
            except TimeoutError:
                return until()
            assert isinstance(raw, bytes)
            self._take(raw)
        return True

    def _take(self, raw: bytes) -> None:
        self.windows += 1
        self.bytes += len(raw)
        size = int.from_bytes(raw[8:16], "little")
        window = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(raw[16 : 16 + size]))
        for message in window["messages"]:
            if "uuid" not in message:
                if "props" in message and "name" in message:
                    self.nodes.add(message["name"])
                continue
            if "props" in message:
                self.widgets[message["uuid"]] = {"type": message["type"], **message["props"]}
            elif message["type"] == "GuiUpdateMessage":
                self.widgets.setdefault(message["uuid"], {}).update(message["updates"])

    def find(self, start: str) -> str | None:
        """Id of the button or command whose label starts so."""
        for uuid, props in self.widgets.items():
            if str(props.get("label") or "").startswith(start):
                return uuid
        return None

    def html(self, mark: str) -> str:
        """The fragment that holds the mark, or nothing."""
        return next((str(p["content"]) for p in self.widgets.values() if mark in str(p.get("content", ""))), "")

    def press(self, uuid: str) -> None:
        """Click a button, disabled or not."""
        self.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": True}})

    def look(self) -> None:
        """Tell of a camera, as a browser does once it shows the page; until then nobody counts as looking at it."""
        self.send({
            "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 1.0, 1.0), "fov": 1.0,
            "near": 0.01, "far": 100.0, "image_height": 600, "image_width": 800, "look_at": (0.0, 0.0, 0.0),
            "up_direction": (0.0, 0.0, 1.0),
        })  # fmt: skip

    def send(self, message: dict[str, Any]) -> None:
        self._socket.send(msgspec.msgpack.encode(message))

    def close(self) -> None:
        self._socket.close()


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m ui.raw_client", description="One connected client, no browser.")
    parser.add_argument("url")
    parser.add_argument("--seconds", type=float, default=60.0)
    options = parser.parse_args(arguments)
    try:
        client = RawClient(options.url)
        client.look()
        print("looking", flush=True)
        client.read(options.seconds)
        client.close()
    except (OSError, WebSocketException) as error:
        sys.stderr.write(f"the page at {options.url} is gone: {error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
