"""The keys of both pages: one table, from which the hotkeys, the hints on the buttons and the list on `?` come.

To give an action a key, add a row; a page binds what `keys_of` names and nothing else. viser's hotkeys know no key-up.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import viser

from far_app.session_states import Intent
from far_app.take_over import Move
from ui.why_state import Press


class Page(StrEnum):
    """Where a key acts."""

    CONSOLE = "console"
    WHY = "why"


HELP = "help"
"""The action that shows and hides the list."""
UNSURE, EARLIER, LATER, UNDO = "mark_unsure", "mark_earlier", "mark_later", "undo_adaptation"
"""Actions of the panels of marks and of policy versions."""


@dataclass(frozen=True, kw_only=True)
class Key:
    """One key of one page."""

    page: Page
    action: str
    """An Intent, a Press, HELP, or a panel's own word; one key an action."""
    hotkey: str
    """As viser's hotkeys name it: a capital, a digit, "space", "arrowleft" …"""
    does: str
    """What it does, for the list."""
    modifier: str | None = None
    """Held with it; None for nothing."""

    @property
    def cap(self) -> str:
        """What is printed on the key."""
        return _CAPS.get(self.hotkey, self.hotkey if len(self.hotkey) == 1 else self.hotkey.capitalize())


_CAPS = {"arrowleft": "←", "arrowright": "→", "arrowup": "↑", "arrowdown": "↓", "space": "Space", "escape": "Esc"}


def _console(action: str, hotkey: str, does: str, modifier: str | None = None) -> Key:
    return Key(page=Page.CONSOLE, action=action, hotkey=hotkey, does=does, modifier=modifier)


def _why(action: str, hotkey: str, does: str, modifier: str | None = None) -> Key:
    return Key(page=Page.WHY, action=action, hotkey=hotkey, does=does, modifier=modifier)


KEYS = (
    _console(Intent.STOP, "space", "STOP: latch the arm at once"),
    _console(Intent.PAUSE, "P", "pause the attempt or the way home; cancels a countdown"),
    _console(Intent.RESUME, "R", "resume after a pause; after a stop or a fault, click it"),
    _console(Intent.MARK_SUCCESS, "S", "mark the attempt a success"),
    _console(Intent.MARK_FAILURE, "F", "mark the attempt a failure"),
    _console(Intent.SKIP_TRIAL, "K", "skip the trial"),
    _console(Intent.SCENE_READY, "N", "the scene is rebuilt and the workspace clear"),
    _console(Intent.TAKE_OVER, "T", "take over: you move the arm, the policy waits"),
    _console(Intent.HAND_BACK, "B", "hand back: the policy goes on from where the arm is"),
    _console(Move.FORWARD, "arrowup", "taken over: 5 mm forward, away from the arm's base"),
    _console(Move.BACK, "arrowdown", "taken over: 5 mm back"),
    _console(Move.LEFT, "arrowleft", "taken over: 5 mm left, seen from the base"),
    _console(Move.RIGHT, "arrowright", "taken over: 5 mm right"),
    _console(Move.UP, "U", "taken over: 5 mm up"),
    _console(Move.DOWN, "J", "taken over: 5 mm down"),
    _console(Move.YAW_PLUS, "Q", "taken over: turn left about the vertical"),
    _console(Move.YAW_MINUS, "E", "taken over: turn right about the vertical"),
    _console(Move.ROLL_PLUS, "1", "taken over: tilt about x"),
    _console(Move.ROLL_MINUS, "2", "taken over: tilt about x, the other way"),
    _console(Move.PITCH_PLUS, "3", "taken over: tilt about y"),
    _console(Move.PITCH_MINUS, "4", "taken over: tilt about y, the other way"),
    _console(Move.OPEN, "O", "taken over: open the hand"),
    _console(Move.CLOSE, "C", "taken over: close the hand"),
    _console(Intent.KEEP, "A", "demonstration: accept it, it goes to the dataset"),
    _console(Intent.RECORD_AGAIN, "G", "demonstration: again, the same scene"),
    _console(Intent.DISCARD, "X", "demonstration: discard it"),
    _console(UNSURE, "Y", "mark the chosen attempt: unsure how it went"),
    _console(EARLIER, ",", "marks: the attempt before"),
    _console(LATER, ".", "marks: the attempt after"),
    _console(UNDO, "Z", "undo the adaptation: the next attempt has the weights before it"),
    _console(HELP, "?", "show or hide this list", "shift"),
    _why(Press.NEXT, "N", "the next flagged chunk"),
    _why(Press.PREVIOUS, "B", "the flagged chunk before"),
    _why(Press.LATER, "arrowright", "one tick later"),
    _why(Press.EARLIER, "arrowleft", "one tick earlier"),
    _why(Press.ATTEMPT_PREVIOUS, "arrowup", "the attempt before"),
    _why(Press.ATTEMPT_NEXT, "arrowdown", "the next attempt"),
    _why(Press.CORRECT, "F", "flag or unflag this chunk"),
    _why(Press.ADAPT, "G", "adapt again from the flagged chunks"),
    _why(Press.MARK_SUCCESS, "S", "mark this attempt: success"),
    _why(Press.MARK_FAILURE, "X", "mark this attempt: failure"),
    _why(Press.MARK_UNSURE, "Y", "mark this attempt: unsure how it went"),
    _why(Press.CRITIC, "C", "V from another critic"),
    _why(Press.RESET, "R", "ρ, horizon and critic as recorded"),
    _why(HELP, "?", "show or hide this list", "shift"),
)
"""In the order of the list."""


def keys_of(page: Page) -> tuple[Key, ...]:
    return tuple(key for key in KEYS if key.page is page)


def key_of(page: Page, action: str) -> Key | None:
    """The key of an action, or None for what must be clicked."""
    return next((key for key in keys_of(page) if key.action == action), None)


def hint(page: Page, action: str) -> str:
    """ "key P" below a button's label; nothing for what must be clicked."""
    key = key_of(page, action)
    return f"key {key.cap}" if key is not None else ""


def add_hotkey(gui: viser.GuiApi, key: Key, label: str, *, disabled: bool = False) -> viser.CommandHandle:
    """The hotkey in a page; what it does is said with Presses.on. It does not fire while a text field has the focus."""
    hotkey: Any = key.hotkey  # viser's type lists no "?", its browser side takes any key
    modifier: Any = key.modifier
    return gui.add_command(label, description=key.does, hotkey=hotkey, modifier=modifier, disabled=disabled)
