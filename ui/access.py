"""Who may open a page at all: on loopback any browser of this machine, elsewhere only one that shows the token.

A page shows the token once, in its address (`/?token=…`), and gets it back as a cookie that scripts cannot read and
other sites do not send; the websocket's handshake carries it. Foreign Origins are refused on every address. The token
travels unencrypted: on a network that others share, use `ssh -L` instead.
"""

from __future__ import annotations

import contextlib
import hmac
import http
import http.cookies
import ipaddress
import os
import re
import secrets
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from far_app.errors import ConfigError

Doors = Callable[[str], str | None]
"""Name of a page beside this one to its address; None while it does not run."""

SHORTEST = 16
"""Characters of a token at least."""


@dataclass(frozen=True, kw_only=True)
class Access:
    """The address a page is served on and what it asks of those who come."""

    host: str = "127.0.0.1"
    token: str = ""
    """What a browser must show; "" on loopback, where none is asked for."""

    def __post_init__(self) -> None:
        if self.loopback or len(self.token) >= SHORTEST:
            return
        lack = "no token" if not self.token else f"a token of {len(self.token)} characters, fewer than {SHORTEST}"
        raise ConfigError(
            f"the page's host is {self.host}, which others can reach, with {lack}: give --page-token FILE (made where "
            "it is missing), or stay on 127.0.0.1 and run on the other machine: ssh -L 8080:127.0.0.1:8080 THIS_HOST"
        )

    @classmethod
    def at(cls, host: str, token_file: Path | None) -> Access:
        """With the token of a file, which is made where it is missing. Raises ConfigError."""
        return cls(host=host, token=read_token(token_file) if token_file is not None else "")

    @property
    def address(self) -> str:
        return "127.0.0.1" if self.host == "localhost" else self.host

    @property
    def loopback(self) -> bool:
        with contextlib.suppress(ValueError):
            return ipaddress.ip_address(self.address).is_loopback
        return False

    @property
    def name(self) -> str:
        """What stands for the host in addresses; of a page on every address, this machine's name."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        return f"[{host}]" if ":" in host else host

    def url(self, port: int) -> str:
        """Where the page is, with the token where one is asked for: for those who may have it."""
        base = f"http://{self.name}:{port}"
        return f"{base}/?token={self.token}" if self.token else base

    def seen_from(self, url: str, host_header: str) -> str:
        """An address of ours by the name under which somebody asked: theirs may be another than `name`."""
        asked = urlsplit(f"//{host_header}").hostname or self.name
        asked = f"[{asked}]" if ":" in asked else asked
        return re.sub(rf"(//|%2F%2F){re.escape(self.name)}(:|%3A)", rf"\g<1>{asked}\g<2>", url)

    def listen(self, port: int) -> socket.socket:
        """A socket on exactly this address and port; 0 lets the system choose. Raises ConfigError."""
        listener = socket.socket(socket.AF_INET6 if ":" in self.address else socket.AF_INET, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((self.address, port))
            listener.listen(64)
        except OSError as error:
            listener.close()
            raise ConfigError(
                f"port {port} on {self.host} is not free ({error.strerror}): another program, perhaps another run, "
                f"listens there, or the address is not this machine's; stop it or choose another port with --port"
            ) from error
        return listener

    def answer(
        self, path: str, headers: Mapping[str, str], port: int
    ) -> tuple[http.HTTPStatus, str, dict[str, str]] | None:
        """None to go on; else the status, words and headers to answer with. `path` as requested, with its query."""
        if not self._own(headers.get("Origin"), headers.get("Host", ""), port):
            return http.HTTPStatus.FORBIDDEN, "a page from elsewhere may not talk to this one", {}
        if not self.token:
            return None
        at = urlsplit(path)
        shown = parse_qs(at.query).get("token", [""])[0]
        name = f"far_{port}"
        if shown and hmac.compare_digest(shown.encode(), self.token.encode()):
            cookie = f"{name}={self.token}; HttpOnly; SameSite=Lax; Path=/"
            rest = "&".join(part for part in at.query.split("&") if not part.startswith("token="))
            return http.HTTPStatus.SEE_OTHER, "", {"Location": f"./{f'?{rest}' if rest else ''}", "Set-Cookie": cookie}
        cookies: http.cookies.SimpleCookie = http.cookies.SimpleCookie()
        with contextlib.suppress(http.cookies.CookieError):
            cookies.load(headers.get("Cookie", ""))
        kept = cookies[name].value if name in cookies else ""
        if hmac.compare_digest(kept.encode(), self.token.encode()):
            return None
        return http.HTTPStatus.FORBIDDEN, "open the whole address that far run printed, token included", {}

    def respond(self, request: Request, port: int, doors: Doors) -> Response | None:
        """`answer` for a websocket server, page and handshake alike; /go/NAME leads on to a page beside this one."""
        said = self.answer(request.path, request.headers, port)
        if said is None and request.path.startswith("/go/"):
            url = doors(request.path.removeprefix("/go/"))
            said = http.HTTPStatus.NOT_FOUND, "it does not run now; go back", {}
            if url is not None:
                said = http.HTTPStatus.SEE_OTHER, "", {"Location": self.seen_from(url, request.headers.get("Host", ""))}
        if said is None:
            return None
        status, words, headers = said
        body = words.encode()
        common = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
        return Response(status, status.phrase, Headers(**common, **headers), body)

    def _own(self, origin: str | None, host: str, port: int) -> bool:
        """No browser, or a page from this very port: by any of loopback's names, or by the name it was asked under."""
        if origin is None:
            return True
        if self.loopback:
            return re.fullmatch(rf"https?://(localhost|127\.\d+\.\d+\.\d+|\[::1\]):{port}", origin) is not None
        return origin == f"http://{host}"


def read_token(file: Path) -> str:
    """The token of a file; a new one, readable by its owner alone, where there is none. Raises ConfigError."""
    try:
        with contextlib.suppress(FileExistsError):
            descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "w", encoding="ascii") as new:
                new.write(secrets.token_urlsafe(24) + "\n")
        if file.stat().st_mode & 0o077:
            raise ConfigError(f"{file} can be read by others (mode {file.stat().st_mode & 0o777:o}): chmod 600 {file}")
        token = file.read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"the token file {file} cannot be used: {error}") from error
    if not re.fullmatch(r"[A-Za-z0-9_-]*", token):
        raise ConfigError(f"the token in {file} holds other characters than letters, digits, - and _")
    return token
