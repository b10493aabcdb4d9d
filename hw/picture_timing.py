"""When to take the snapshot, so that its pictures reach the app just before the tick that uses them.

The app's ticks and the servo ticks run on clocks of their own. The lead of a tick is the time from the pictures'
publication to its target's coming, or to its deadline where it is late. A long lead is age that the policy need not
bear, a negative one means the tick before's pictures. Pure; fed by the command thread, obeyed by the servo thread.
"""

from __future__ import annotations

import numpy as np

WINDOW = 15
"""Ticks looked at before a shift: half a second."""
LEAST = 0.004
"""Seconds of lead kept for a picture that takes longer than most, and because a tick begins before its target comes."""
SLACK = 0.001
"""Seconds beyond a servo period before a later snapshot is worth it."""
MISSES = 0.1
"""Share of ticks that may go without the newest pictures before snapshots are taken earlier."""


class PictureTiming:
    def __init__(self, servo_period: float, policy_period: float) -> None:
        self._latest = LEAST + servo_period + SLACK
        self._missed = 0.7 * policy_period
        self._leads: list[float] = []

    def shift(self, lead: float) -> int:
        """+1 or −1 servo tick by which snapshots should move from now on, or 0."""
        self._leads.append(lead)
        if len(self._leads) < WINDOW:
            return 0
        leads, self._leads = np.array(self._leads), []
        if np.median(leads) > self._latest:
            return 1
        if np.mean((leads > self._missed) | (leads < LEAST / 2)) > MISSES:
            return -1
        return 0
