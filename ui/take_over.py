"""The panel for moving the arm by hand: 5 mm a press, turns, gripper; who has the arm and whether he is heard."""

from __future__ import annotations

from html import escape

from far_app.session_states import State
from far_app.take_over import STEP, TURN, Move, Nudge
from far_app.telemetry import Telemetry
from ui.panels import BLUE, QUIET, Item

_WIDTH, _HEIGHT, _TOP = 7.4, 4.1, 6.4
_PAD: tuple[tuple[Move, str, int, int], ...] = (
    (Move.YAW_PLUS, "Turn left", 0, 0),
    (Move.FORWARD, "Forward", 1, 0),
    (Move.YAW_MINUS, "Turn right", 2, 0),
    (Move.UP, "Up", 3, 0),
    (Move.LEFT, "Left", 0, 1),
    (Move.BACK, "Back", 1, 1),
    (Move.RIGHT, "Right", 2, 1),
    (Move.DOWN, "Down", 3, 1),
    (Move.ROLL_PLUS, "Tilt +x", 0, 2),
    (Move.ROLL_MINUS, "Tilt −x", 1, 2),
    (Move.PITCH_PLUS, "Tilt +y", 2, 2),
    (Move.PITCH_MINUS, "Tilt −y", 3, 2),
    (Move.OPEN, "Open", 0, 3),
    (Move.CLOSE, "Close", 1, 3),
)
"""Move, label, column, row."""
_MOTION = (Move.FORWARD, Move.BACK, Move.LEFT, Move.RIGHT, Move.UP, Move.DOWN)


def cannot_move(telemetry: Telemetry) -> str:
    """Why a step would move nothing; "" when it would."""
    return "" if telemetry.state is State.TAKEN_OVER else "take over first"


class TakeOver:
    """ui.panels.Panel."""

    name, title, height = "steer", "Steer by hand", 25.2

    def __init__(self) -> None:
        self.items = [
            Item(
                label=label, box=(0.8 + 7.9 * column, _TOP + 4.5 * row, _WIDTH, _HEIGHT), reason=cannot_move,
                asks=lambda _telemetry, move=move: Nudge(move=move), action=move,
                color=BLUE if move in _MOTION else QUIET,
            )
            for move, label, column, row in _PAD
        ]  # fmt: skip

    def html(self, telemetry: Telemetry | None) -> str:
        tone, line = said(telemetry)
        steps = f"{1e3 * STEP:g} mm or {57.2958 * TURN:.1f}° a press."
        return f'<p class="far-line tone-{tone}">{escape(f"{line} {steps}")}</p>'


def said(telemetry: Telemetry | None) -> tuple[str, str]:
    """Tone and one sentence: who has the arm."""
    if telemetry is None:
        return "idle", "No word from the app yet."
    now = telemetry.steering
    device = f" {now.device}: {now.trouble}." if now.trouble else f" {now.device} is ready." if now.device else ""
    if now.unavailable:
        return "warn", f"Nobody can take over: {now.unavailable}."
    if now.silent:
        return "bad", f"The arm is held: {now.silent}."
    if telemetry.state is State.TAKEN_OVER:
        who = now.device if now.source == "device" else "this page"
        return "run", f"A person has the arm ({who}), {now.ticks} ticks so far.{device}"
    return "idle", f"The policy has the arm.{device}"
