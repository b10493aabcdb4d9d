"""What can be made to go wrong between the controller and its clients."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field


@dataclass(kw_only=True)
class Faults:
    """Changed at any moment from outside (hw/fake_xarm/control.py)."""

    latency: float = 0.0
    """Seconds a request and its answer take on the way, together."""
    jitter: float = 0.0
    """Seconds by which that varies, uniformly, either way."""
    stall: float = 0.0
    """Seconds for which everything stops (0.19 was seen on real controllers) …"""
    stall_every: float = 10.0
    """… each time so many seconds have passed."""
    mute: bool = False
    """A cut cable: what comes in is lost, nothing goes out, the connections stay."""
    reports_stalled: bool = False
    """Commands are served, reports are not sent."""
    _random: random.Random = field(default_factory=lambda: random.Random(0), repr=False)

    def delay(self) -> float:
        """Seconds for this one request."""
        if self.latency <= 0.0 and self.jitter <= 0.0:
            return 0.0
        return max(0.0, self.latency + self._random.uniform(-self.jitter, self.jitter))

    def stalled_for(self, since_start: float) -> float:
        """Seconds until a running stall is over; 0 outside of one. The first begins one period after the start."""
        if self.stall <= 0.0 or since_start < self.stall_every:
            return 0.0
        return max(0.0, self.stall - math.fmod(since_start, self.stall_every))
