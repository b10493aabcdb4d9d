"""An intent reaches an app that has just begun to listen, and is told to be lost where none does."""

from __future__ import annotations

import threading
from pathlib import Path

from far_app.endpoints import Endpoints
from far_app.session.inbox import IntentInbox
from far_app.session_states import Intent
from ui.feeds import Feeds


def test_a_press_right_after_the_app_began_to_listen_is_not_lost(tmp_path: Path):
    endpoints = Endpoints.in_folder(tmp_path)
    feeds = Feeds(endpoints)
    inboxes: list[IntentInbox] = []
    begins = threading.Timer(0.05, lambda: inboxes.append(IntentInbox(endpoints.intents)))
    try:
        assert not feeds.send(Intent.PAUSE, "nobody"), "dropped, never sent late"
        begins.start()
        assert feeds.send(Intent.SCENE_READY, "operator")
        begins.join()
        heard: list[Intent] = []
        for _ in range(100):
            heard += inboxes[0].drain()
            if heard:
                break
            threading.Event().wait(0.02)
        assert heard == [Intent.SCENE_READY]
    finally:
        feeds.close()
        for inbox in inboxes:
            inbox.close()
