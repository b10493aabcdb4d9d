"""Takes every picture of the pages anew, from real runs in a headless Chromium: python docs/screenshots.py [PART...]

Parts: twin (a session on the twin with the shipped model), why (the sample session in the attempt view), arm (states
that only a real arm has, on the fake controller), trials (a plan's scene built again, the cameras' pictures from the
sample session), demo (a demonstration to be kept or not). Writes docs/screens/*.jpg; takes about five minutes on two
cores.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from playwright.sync_api import Error, sync_playwright

from far_app.recording.attempt_reader import read_attempt

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "docs/screens"
FAR = [sys.executable, "-u", "-c", "import sys; from far_app.cli import main; sys.exit(main(sys.argv[1:]))"]
CHROMIUM = "/usr/bin/chromium"
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader"]
ARGUMENTS += ["--enable-unsafe-swiftshader"]
PATIENCE = 120_000
"""Milliseconds for a state to come."""


@contextlib.contextmanager
def program(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A command of far, and the address it printed."""
    process = subprocess.Popen([*FAR, *words], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        said = (word for line in process.stdout for word in line.split())
        url = next((word.rstrip(";") for word in said if word.startswith("http")), None)
        if url is None:
            raise SystemExit(f"far {words[0]} ended without a page (status {process.wait()})")
        yield process, url
    finally:
        process.send_signal(signal.SIGCONT)
        process.send_signal(signal.SIGINT)
        try:
            process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class Camera:
    """One open page and its pictures."""

    def __init__(self, browser: Any, url: str, width: int = 1280, height: int = 720) -> None:
        self.page = browser.new_page(viewport={"width": width, "height": height})
        self.page.goto(url)

    def until(self, selector: str) -> None:
        try:
            self.page.wait_for_selector(selector, timeout=PATIENCE)
        except Error as error:
            shown = self.page.inner_text(".far-head").split("\n")
            raise SystemExit(f"{selector} never came; the page shows {shown}") from error

    def shows(self, mark: str) -> bool:
        """Now."""
        return self.page.locator(f"#op-state{mark}").count() > 0

    def state(self, word: str, more: str = "") -> None:
        self.until(f"#op-state[data-state='{word}']{more}")

    def take(self, name: str, settle: float = 0.7) -> None:
        self.page.wait_for_timeout(1000 * settle)
        OUT.mkdir(exist_ok=True)
        self.page.screenshot(path=OUT / f"{name}.jpg", type="jpeg", quality=82)
        print(f"docs/screens/{name}.jpg", flush=True)

    def press(self, label: str) -> None:
        self.page.locator(f"button:has-text('{label}'):not(:disabled)").first.click(timeout=PATIENCE)


TWIN = {
    "running": "[data-state='RUNNING'][data-attempt='1']",
    "learning": "[data-state='LEARNING']",
    "retry": "[data-state='RUNNING']:not([data-attempt='1'])",
}
"""Pictures of what goes by: taken whenever the page shows it, in whatever order it comes. What lasts a second only is
taken on the fake arm, whose page has no 3D view to draw."""
SOLVED = "[data-state='SET THE SCENE']:has-text('solved')"
LIVE_PATIENCE = 200.0
"""Seconds for all of them."""


def twin(browser: Any, recordings: Path) -> None:
    """A session on the twin, from its start to the loss of the page."""
    words = ("run", "--trials", "99", "--seed", "7", "--port", "0", "--no-rerun")
    with program(*words, "--recordings", str(recordings / "twin")) as (process, url):
        camera = Camera(browser, url)
        camera.until("#op-state:not([data-state='WAITING'])")
        take_what_goes_by(camera, TWIN, {}, settle=0.8)
        pause_an_attempt(camera)
        camera.take("paused", settle=2.0)
        camera.page.keyboard.press("t")
        camera.state("TAKEN OVER")
        camera.take("taken_over", settle=2.0)
        camera.page.keyboard.press("Space")
        camera.state("STOPPED")
        camera.take("stopped", settle=2.0)
        camera.page.keyboard.press("?")
        camera.until("#op-keys.on")
        camera.take("keys")
        camera.page.keyboard.press("?")
        other = Camera(browser, url)
        other.state("STOPPED")
        other.take("viewer", settle=3.0)
        other.page.close()
        camera.page.set_viewport_size({"width": 768, "height": 1024})
        camera.take("tablet_upright", settle=3.0)
        camera.page.set_viewport_size({"width": 1024, "height": 768})
        camera.take("tablet", settle=3.0)
        camera.page.set_viewport_size({"width": 1280, "height": 720})
        process.send_signal(signal.SIGSTOP)
        camera.state("APP SILENT")
        camera.take("app_silent")
        process.send_signal(signal.SIGCONT)
        camera.state("STOPPED")
        process.send_signal(signal.SIGINT)
        dead = "() => getComputedStyle(document.querySelector('#op-dead')).opacity === '1'"
        camera.page.wait_for_function(dead, timeout=PATIENCE)
        camera.take("page_lost")
        camera.page.close()


def pause_an_attempt(camera: Camera) -> None:
    """Held within an attempt, not on the way home, where a slow browser's key may arrive."""
    while True:
        camera.state("RUNNING")
        camera.page.keyboard.press("p")
        camera.state("PAUSED")
        camera.page.wait_for_timeout(1500)
        if camera.page.locator("button:has-text('Take over'):not(:disabled)").count():
            return
        camera.page.keyboard.press("r")


def take_what_goes_by(camera: Camera, marks: dict[str, str], keys: dict[str, str], settle: float) -> None:
    """All of `marks`. A picture counts when the page shows the state before and after it. `keys`: what to press in
    which state meanwhile."""
    wanted, began = dict(marks), time.monotonic()
    while wanted:
        if time.monotonic() - began > LIVE_PATIENCE:
            raise SystemExit(f"{', '.join(wanted)} did not come within {LIVE_PATIENCE:.0f} s; try a quieter machine")
        for name, mark in list(wanted.items()):
            if not camera.shows(mark):
                continue
            camera.take(name, settle)
            if camera.shows(mark):
                del wanted[name]
        for state, key in keys.items():
            if camera.shows(f"[data-state='{state}']"):
                camera.page.keyboard.press(key)
        if set(wanted) == {"running"} and camera.shows("[data-state='RUNNING']:not([data-attempt='1'])"):
            camera.page.keyboard.press("k")  # on to another trial's first attempt
        camera.page.wait_for_timeout(50)


def why(browser: Any, recordings: Path) -> None:
    """The session that comes with the program, in the attempt view."""
    session = shutil.copytree(ROOT / "recordings/sample", recordings / "sample")
    with program("replay", str(session), "--port", "0", "--operator", "ada") as (_, url):
        camera = Camera(browser, url)
        camera.until("#why-numbers tr.sent")
        camera.take("why", settle=2.0)
        camera.page.keyboard.press("f")
        camera.until("#why-numbers .word")
        camera.take("why_corrected")
        camera.page.keyboard.press("f")
        camera.until("#why-numbers[data-flagged='1']")
        camera.page.keyboard.press("g")
        camera.until("#why-lesson[data-stage='']:not([data-steps='0'])")
        camera.take("why_adapted", settle=2.0)
        camera.page.set_viewport_size({"width": 768, "height": 1024})
        camera.take("why_tablet", settle=2.0)
        camera.page.set_viewport_size({"width": 1280, "height": 720})
        camera.page.click("#far-tab-marks summary")
        camera.page.keyboard.press("y")
        camera.until("#why-state[data-outcome='UNSURE']")
        camera.take("why_marked", settle=2.0)
        camera.page.close()


AT_FAKE = ("--robot", "xarm", "--host", "127.0.0.1:15502", "--port", "0")


@contextlib.contextmanager
def fake_controller() -> Iterator[None]:
    fake = subprocess.Popen([*FAR, "fake-xarm"], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert fake.stdout is not None
    fake.stdout.readline()
    try:
        yield
    finally:
        fake.terminate()
        fake.wait(timeout=20)


def arm(browser: Any, recordings: Path) -> None:
    """What only a real arm's session has, on the fake controller."""
    words = ("run", *AT_FAKE, "--policy", "test:wander", "--no-scene3d", "--no-rerun")
    with fake_controller(), program(*words, "--recordings", str(recordings / "arm")) as (_, url):
        camera = Camera(browser, url)
        camera.state("SET THE SCENE")
        camera.take("set_the_scene", settle=2.0)
        camera.page.keyboard.press("n")
        camera.until("#op-state:has-text(' in 3 s'), #op-state:has-text(' in 2 s')")
        camera.take("countdown", settle=0.2)
        take_what_goes_by(camera, {"solved": SOLVED}, {"RUNNING": "s"}, settle=1.0)
        take_what_goes_by(camera, {"start": "[data-state='GOING HOME']"}, {"SET THE SCENE": "n", "RUNNING": "s"}, 0.0)
        take_what_goes_by(camera, {"arm_running": "[data-state='RUNNING']"}, {"SET THE SCENE": "n"}, 1.0)
        subprocess.run([*FAR, "fake-xarm", "tell", "error", "31"], cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        camera.state("FAULT")
        camera.take("fault")
        camera.page.close()


PLAN = """task = "lift"
max_attempts = 1
repetitions = 2
blind = true
[[method]]
name = "patient"
method = "nr"
policy = "test:still"
[[method]]
name = "restless"
method = "nr"
policy = "test:wander"
[[scene]]
name = "cube on the left"
"""


def trials(browser: Any, recordings: Path) -> None:
    """A plan on the fake controller: a scene is to look as the sample session began, its cameras show how that one's
    second attempt began, with the cube elsewhere."""
    sample = ROOT / "recordings/sample"
    plan, rig = recordings / "cubes.toml", recordings / "cell.toml"
    cell = (ROOT / "hw/rigs/xarm7.toml").read_text().replace("cameras = []", "")
    for name, picture in read_attempt(sample / "trial_0001/attempt_2.mcap").steps[0].observation.images.items():
        film = cv2.VideoWriter(str(recordings / f"{name}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30, (240, 240))
        for seed in range(30):
            film.write(seen(picture, seed))
        film.release()
        cell += f'[camera.{name}]\ndevice = "file:{recordings}/{name}.avi"\nwidth = 240\nheight = 240\nrate = 30.0\n'
    plan.write_text(f'{PLAN}recording = "{sample}"\ntrial = 1\n')
    rig.write_text(cell)
    words = ("trials", str(plan), *AT_FAKE, "--rig", str(rig), "--no-scene3d", "--no-rerun", "--full-speed")
    with fake_controller(), program(*words, "--recordings", str(recordings / "trials")) as (_, url):
        camera = Camera(browser, url)
        camera.until("#op-scene:has-text('not yet')")
        camera.page.keyboard.press("n")
        camera.until("#op-scene .why")
        camera.take("trials", settle=2.0)
        camera.page.close()


def seen(picture: Any, seed: int) -> np.ndarray:
    """BGR of a camera's size, with a sensor's noise: a camera that shows one picture for ever counts as lost."""
    large = cv2.resize(np.asarray(picture), (240, 240), interpolation=cv2.INTER_CUBIC)
    noisy = large + np.random.default_rng(seed).normal(0, 2, large.shape)
    return cv2.cvtColor(noisy.clip(0, 255).astype(np.uint8), cv2.COLOR_RGB2BGR)


def demo(browser: Any, recordings: Path) -> None:
    """A person's demonstration, once it has ended."""
    words = ("demo", "--teleop", *AT_FAKE, "--n", "3", "--recordings", str(recordings / "demo"))
    with fake_controller(), program(*words, "--out", str(recordings / "demo.hdf5")) as (_, url):
        camera = Camera(browser, url)
        camera.state("SET THE SCENE")
        camera.page.keyboard.press("n")
        camera.state("TAKEN OVER")
        for key in ("ArrowUp", "ArrowUp", "j", "j"):
            camera.page.keyboard.press(key)
            camera.page.wait_for_timeout(400)
        camera.page.keyboard.press("s")
        camera.state("KEEP IT?")
        camera.take("keep_it", settle=2.0)
        camera.page.close()


PARTS: dict[str, Callable[[Any, Path], None]] = {"twin": twin, "why": why, "arm": arm, "trials": trials, "demo": demo}


def main(parts: list[str]) -> int:
    unknown = sorted(set(parts) - set(PARTS))
    if unknown:
        print(f"no part is called {', '.join(unknown)}; there are {', '.join(PARTS)}", file=sys.stderr)
        return 2
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="far-screens-") as recordings, sync_playwright() as playwright:
        last = Path(recordings) / "chromium"  # draws in software here: it must not take the cores from the loop
        last.write_text(f'#!/bin/sh\nexec nice -n 10 {CHROMIUM} "$@"\n')
        last.chmod(0o755)
        browser = playwright.chromium.launch(executable_path=str(last), args=ARGUMENTS)
        for part in parts or PARTS:
            PARTS[part](browser, Path(recordings))
        browser.close()
    print(f"{time.monotonic() - began:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
