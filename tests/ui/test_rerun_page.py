"""rerun's viewer in a real headless Chromium, on an address that asks for a token: it comes up, its data come through
the same door, and it asks nothing of the outside."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from ui_process import wait_until
from ui_stage import Stage

from ui.access import Access

sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright (the dev extra)")
CHROMIUM = Path("/usr/bin/chromium")
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader"]
ARGUMENTS += ["--enable-unsafe-swiftshader"]
TOKEN = "a-token-of-enough-length"

pytestmark = [
    pytest.mark.page,
    pytest.mark.slow,
    pytest.mark.skipif(not CHROMIUM.exists(), reason="no /usr/bin/chromium: apt-get install chromium"),
]


def test_the_viewer_reads_its_data_with_the_token_and_asks_nobody_else(
    stage: Stage, folder: Path, tmp_path: Path
) -> None:
    file = folder / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    command = [sys.executable, "-m", "ui.rerun_live", "--run-folder", str(folder), "--recordings", str(tmp_path)]
    live = subprocess.Popen([*command, "--host", "0.0.0.0", "--token", str(file)], stdout=subprocess.PIPE, text=True)
    try:
        assert live.stdout is not None
        printed = json.loads(live.stdout.readline())["viewer"]
        url = Access(host="0.0.0.0", token=TOKEN).seen_from(printed, "127.0.0.1")
        here = f"http://{urlsplit(url).netloc}/"
        with sync_api.sync_playwright() as playwright:
            chromium = playwright.chromium.launch(executable_path=str(CHROMIUM), args=ARGUMENTS)
            refused = chromium.new_page().goto(here)
            assert refused is not None and refused.status == 403
            page = chromium.new_page()
            requests: list[tuple[str, str]] = []
            answers: list[int] = []
            page.on("request", lambda request: requests.append((request.method, request.url)))
            page.on("response", lambda answer: answers.append(answer.status) if "ReadMessages" in answer.url else None)
            page.goto(url)

            def read() -> bool:
                page.wait_for_timeout(200)
                return answers == [200]

            assert wait_until(read, 90.0)
            assert all(u.startswith((here, "data:", "blob:")) for _, u in requests)
            chromium.close()
    finally:
        live.terminate()
        assert live.wait(timeout=20) == 0
