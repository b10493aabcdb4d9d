"""A page that died while a real arm moved: what its successor says, and Resume pressed there (far bench faults)."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

import numpy as np

from far_app.bench.servo_trace import MOVED
from hw.fake_xarm.control import FakeXArm
from ui.raw_client import RawClient

SAYS = "nobody has had the page open"
PATIENCE = 20.0
"""Seconds for the new page to be there, and for the arm to move after Resume."""


@dataclass(frozen=True, kw_only=True)
class NewPage:
    client: RawClient
    words: str
    """Why the arm is held, as it says."""


def read_new_page(url: str) -> NewPage | None:
    """The page that was started in the dead one's place, once it says why the arm is held; None when it never does."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError):
            client = RawClient(url)
            client.look()
            if client.read(3.0, lambda client=client: bool(_reason(client))):
                return NewPage(client=client, words=_reason(client))
            client.close()
        time.sleep(0.2)
    return None


def resume_there(page: NewPage, fake: FakeXArm) -> float | None:
    """Press Resume; how far from where the arm stood the first target lay, millimetres; None where it never moved."""
    client, stood = page.client, np.array(fake.state()["position"])
    fake.received()
    button = client.find("Resume")
    if button is None:
        return None
    client.press(button)
    deadline = time.monotonic() + PATIENCE
    path = np.zeros((0, 3))
    while time.monotonic() < deadline and not (np.linalg.norm(np.diff(path, axis=0), axis=1) > MOVED).any():
        client.read(0.2)
        targets = fake.servo_targets()
        path = np.concatenate([path, np.array([t["pose"][:3] for t in targets]).reshape(-1, 3)])
    client.close()
    return float(np.linalg.norm(path[0] - stood)) if len(path) else None


def _reason(client: RawClient) -> str:
    texts = " ".join(str(p.get("content", "")) for p in client.widgets.values())
    start = texts.find(SAYS)
    return texts[start : texts.find("<", start)] if start >= 0 else ""
