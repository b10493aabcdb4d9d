"""CURVE keys of two machines: who may talk to the arm, encrypted. Files in pyzmq's format, made by `far keys`.

    server.key   server.key_secret      the robot PC's pair; the GPU PC needs the first
    client.key   client.key_secret      the GPU PC's pair; the robot PC needs the first

A server admits the clients whose public keys (any NAME.key but server.key) lie in its folder, and nobody else.
"""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zmq
import zmq.auth
import zmq.utils.z85

from far_app.errors import ConfigError

SERVER, CLIENT = "server", "client"
PUBLIC, SECRET = ".key", ".key_secret"
DOMAIN = "far"
"""ZAP domain of the hw server's sockets."""
PRIVATE = 0o600


@dataclass(frozen=True, kw_only=True)
class ServerKeys:
    public: bytes
    secret: bytes
    admitted: frozenset[bytes]
    """Public keys of the clients that are let in."""

    def secure(self, context: zmq.Context[Any]) -> None:
        """Every socket that the context makes from now on serves holders of admitted keys only (see Gate)."""
        context.setsockopt(zmq.CURVE_SERVER, 1)
        context.setsockopt(zmq.CURVE_PUBLICKEY, self.public)
        context.setsockopt(zmq.CURVE_SECRETKEY, self.secret)
        context.setsockopt(zmq.ZAP_DOMAIN, DOMAIN.encode())


@dataclass(frozen=True, kw_only=True)
class ClientKeys:
    public: bytes
    secret: bytes
    server: bytes
    """The only server that is believed."""

    def secure(self, context: zmq.Context[Any]) -> None:
        """Every socket that the context makes from now on speaks with that server only."""
        context.setsockopt(zmq.CURVE_PUBLICKEY, self.public)
        context.setsockopt(zmq.CURVE_SECRETKEY, self.secret)
        context.setsockopt(zmq.CURVE_SERVERKEY, self.server)


class Gate:
    """A context's doorkeeper (ZeroMQ's ZAP, RFC 27): answers for each new connection whether its key is admitted.

    libzmq asks over inproc within one context, so every context with server sockets needs its own, before they bind."""

    def __init__(self, context: zmq.Context[Any], admitted: frozenset[bytes]) -> None:
        self._admitted = admitted
        self.refused = 0
        self._closing = False
        self._socket = context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.bind("inproc://zeromq.zap.01")
        self._thread = threading.Thread(target=self._run, name="gate", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing = True
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        while not self._closing:
            if not self._socket.poll(100):
                continue
            version, number, domain, _, _, mechanism, *credentials = self._socket.recv_multipart()
            key = zmq.utils.z85.encode(credentials[0]) if mechanism == b"CURVE" and credentials else b""
            welcome = domain == DOMAIN.encode() and key in self._admitted
            self.refused += not welcome
            status, text = (b"200", b"OK") if welcome else (b"400", b"this client's key is not admitted")
            self._socket.send_multipart([version, number, status, text, key if welcome else b"", b""])
        self._socket.close()


def make_keys(folder: Path, overwrite: bool = False) -> list[Path]:
    """Both pairs as files only their owner may read. Raises ConfigError where a key lies there already."""
    paths = [folder / f"{name}{kind}" for name in (SERVER, CLIENT) for kind in (PUBLIC, SECRET)]
    if there := [path.name for path in paths if path.exists() and not overwrite]:
        raise ConfigError(
            f"{', '.join(there)} in {folder} would be lost, and with it the machines that use it; choose another "
            "folder, or say --overwrite and copy the new keys to both machines"
        )
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    for name in (SERVER, CLIENT):
        public, secret = zmq.curve_keypair()
        _write(folder / f"{name}{PUBLIC}", f'metadata\ncurve\n    public-key = "{public.decode()}"\n')
        _write(
            folder / f"{name}{SECRET}",
            f'metadata\ncurve\n    public-key = "{public.decode()}"\n    secret-key = "{secret.decode()}"\n',
        )
    return paths


def server_keys(folder: Path) -> ServerKeys:
    """The robot PC's keys and the clients it admits. Raises ConfigError."""
    public, secret = _pair(folder, SERVER)
    others = sorted(path for path in folder.glob(f"*{PUBLIC}") if path.name != SERVER + PUBLIC)
    if not others:
        raise ConfigError(
            f"{folder} holds no client's public key, so nobody could connect; copy {CLIENT}{PUBLIC} there from where "
            "`far keys` made it"
        )
    return ServerKeys(public=public, secret=secret, admitted=frozenset(_public(path) for path in others))


def client_keys(folder: Path) -> ClientKeys:
    """The GPU PC's keys and the server it trusts. Raises ConfigError."""
    public, secret = _pair(folder, CLIENT)
    return ClientKeys(public=public, secret=secret, server=_public(folder / f"{SERVER}{PUBLIC}"))


def _pair(folder: Path, name: str) -> tuple[bytes, bytes]:
    path = folder / f"{name}{SECRET}"
    public, secret = _load(path)
    mode = path.stat().st_mode & 0o777
    if mode & 0o077:
        raise ConfigError(f"{path} may be read by others (mode {mode:03o}, at most 600); say: chmod 600 {path}")
    if secret is None:
        raise ConfigError(f"{path} holds no secret key; copy the whole file from where `far keys` made it")
    return public, secret


def _public(path: Path) -> bytes:
    return _load(path)[0]


def _load(path: Path) -> tuple[bytes, bytes | None]:
    try:
        return zmq.auth.load_certificate(path)
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"no key in {path} ({error}); make both machines' keys with `far keys --out FOLDER` and copy them"
        ) from error


def _write(path: Path, text: str) -> None:
    path.unlink(missing_ok=True)
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, PRIVATE), "w") as file:
        file.write(f"# FAR: made by `far keys`\n{text}")
