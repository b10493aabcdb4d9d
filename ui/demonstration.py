"""The panel for a demonstration that has ended: keep it, discard it, record it again. It opens by itself then."""

from __future__ import annotations

from html import escape

from far_app.session_states import Intent, State
from far_app.telemetry import Telemetry
from ui.panels import AMBER, GREEN, QUIET, Item

_BUTTONS = (
    (Intent.KEEP, "Keep it", GREEN, 0.8),
    (Intent.RECORD_AGAIN, "Record again", AMBER, 11.4),
    (Intent.DISCARD, "Discard it", QUIET, 22.0),
)


class Demonstration:
    """ui.panels.Panel."""

    name, title, height = "demo", "Demonstration", 11.8

    def __init__(self) -> None:
        self.items = [
            Item(
                label=label, box=(left, 6.7, 10.2, 4.3), color=color, action=intent,
                reason=lambda t, intent=intent: cannot(t, intent), asks=lambda _t, intent=intent: intent,
            )
            for intent, label, color, left in _BUTTONS
        ]  # fmt: skip

    def html(self, telemetry: Telemetry | None) -> str:
        waits = telemetry is not None and telemetry.state is State.REVIEWING
        line = telemetry.reason if telemetry is not None and waits else "far demo --teleop records demonstrations here."
        return f'<p class="far-line tone-{"warn" if waits else "idle"}">{escape(line)}</p>'


def cannot(telemetry: Telemetry, intent: Intent) -> str:
    """Why a word on a demonstration does not apply; "" when it does."""
    if intent in telemetry.allowed:
        return ""
    waits = telemetry.state is State.REVIEWING and intent is Intent.KEEP
    return "no success: mark it one first" if waits else "no demonstration waits"
