"""Beyond loopback a page is for those who show its token; foreign Origins are refused everywhere."""

from __future__ import annotations

import http.client
import urllib.error
import urllib.request
from collections.abc import Callable
from http.cookies import SimpleCookie
from pathlib import Path

import pytest
from ui_process import PageProcess
from ui_stage import Stage
from websockets.exceptions import InvalidStatus

from far_app.errors import ConfigError
from ui.access import Access, read_token
from ui.raw_client import RawClient

Start = Callable[..., PageProcess]
TOKEN = "a-token-of-enough-length"
HERE = "0.0.0.0"
"""Not loopback, so the rules of other machines hold; the tests reach it by 127.0.0.1."""


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "::", "example.org"])
def test_an_address_that_others_reach_is_refused_without_a_token(host: str) -> None:
    with pytest.raises(ConfigError, match="--page-token"):
        Access(host=host)
    with pytest.raises(ConfigError, match="fewer than 16"):
        Access(host=host, token="short")


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "127.3.2.1"])
def test_loopback_needs_none(host: str) -> None:
    assert Access(host=host).url(80) == f"http://{'[::1]' if ':' in host else host}:80"


def test_a_token_is_made_once_and_is_for_its_owner_alone(tmp_path: Path) -> None:
    file = tmp_path / "token"
    token = read_token(file)
    assert len(token) >= 16 and read_token(file) == token
    file.chmod(0o644)
    with pytest.raises(ConfigError, match="chmod 600"):
        read_token(file)
    file.chmod(0o600)
    file.write_text("has spaces; and more of the kind")
    with pytest.raises(ConfigError, match="other characters"):
        read_token(file)


@pytest.fixture
def page(start_page: Start, stage: Stage, folder: Path) -> PageProcess:
    """On an address that others reach."""
    file = folder / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    return start_page("--host", HERE, "--token", str(file))


def ask(page: PageProcess, path: str, **headers: str) -> http.client.HTTPResponse:
    """One GET, no redirect followed."""
    connection = http.client.HTTPConnection("127.0.0.1", int(page.url.rsplit(":", 1)[1]), timeout=10)
    connection.request("GET", path, headers=headers)
    return connection.getresponse()


def test_neither_page_nor_websocket_open_without_the_token(page: PageProcess) -> None:
    for path in ("/", "/?token=", "/?token=wrong", "/index.html", f"/?nottoken={TOKEN}"):
        answer = ask(page, path)
        assert answer.status == 403 and b"far run printed" in answer.read()
    with pytest.raises(urllib.error.HTTPError):
        urllib.request.urlopen(page.url, timeout=10)
    with pytest.raises(InvalidStatus):
        RawClient(page.url)
    with pytest.raises(InvalidStatus):
        RawClient(page.url, cookie=f"far_{page.url.rsplit(':', 1)[1]}=wrong")


def test_the_token_in_the_address_becomes_a_cookie_that_opens_both(page: PageProcess) -> None:
    answer = ask(page, f"/?token={TOKEN}&keep=1")
    assert (answer.status, answer.headers["Location"]) == (303, "./?keep=1")
    said = answer.headers["Set-Cookie"]
    assert "HttpOnly" in said and "SameSite=Lax" in said
    cookie = "; ".join(f"{name}={morsel.value}" for name, morsel in SimpleCookie(said).items())
    assert ask(page, "/", Cookie=cookie).status == 200
    client = RawClient(page.url, cookie=cookie)
    assert client.read(20, lambda: 'data-state="RUNNING"' in client.html("op-state"))
    client.close()


def test_a_foreign_origin_is_refused_though_it_has_the_cookie(page: PageProcess) -> None:
    port = page.url.rsplit(":", 1)[1]
    cookie = f"far_{port}={TOKEN}"
    for origin in ("http://evil.example", f"http://evil.example:{port}", "null", f"http://127.0.0.1:{int(port) + 1}"):
        with pytest.raises(InvalidStatus):
            RawClient(page.url, origin=origin, cookie=cookie)
    RawClient(page.url, origin=page.url, cookie=cookie).close()


def test_a_link_leads_to_the_page_beside_it_by_the_name_that_was_asked_for() -> None:
    access = Access(host="0.0.0.0", token=TOKEN)
    url = f"http://{access.name}:81/?token={TOKEN}&url=rerun%2Bhttp%3A%2F%2F{access.name}%3A81%2Fproxy"
    seen = access.seen_from(url, "192.168.1.5:8080")
    assert seen == f"http://192.168.1.5:81/?token={TOKEN}&url=rerun%2Bhttp%3A%2F%2F192.168.1.5%3A81%2Fproxy"


def test_a_link_to_what_does_not_run_says_so(start_page: Start, stage: Stage) -> None:
    page = start_page()
    for name in ("rerun", "why", "elsewhere", "../x"):
        answer = ask(page, f"/go/{name}")
        assert answer.status == 404 and answer.headers["Location"] is None
