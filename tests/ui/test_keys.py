"""The keys table: no key does two things, and the pages bind exactly what the list on `?` says."""

from __future__ import annotations

from collections import Counter

import pytest

from far_app.session_states import Intent
from ui.keys import KEYS, Page, hint, key_of, keys_of


@pytest.mark.parametrize("page", Page)
def test_a_key_does_one_thing_and_an_action_has_one_key(page: Page) -> None:
    keys = keys_of(page)
    assert max(Counter((key.hotkey.lower(), key.modifier) for key in keys).values()) == 1
    assert max(Counter(key.action for key in keys).values()) == 1


def test_every_key_says_what_it_does_in_a_few_words() -> None:
    assert all(key.does and len(key.does) < 70 for key in KEYS)


def test_stop_is_on_space_and_ending_the_session_has_no_key() -> None:
    stop = key_of(Page.CONSOLE, Intent.STOP)
    assert stop is not None and stop.cap == "Space"
    assert hint(Page.CONSOLE, Intent.QUIT) == ""
