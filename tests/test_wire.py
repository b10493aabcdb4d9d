"""The wire: what is packed comes back the same, whatever it is made of; what is not ours is refused."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
import pytest

from far_app.session_states import Intent, State
from far_app.take_over import Source, Steering
from far_app.telemetry import LogLine, LoopHealth, OperatorIntent, Telemetry, TrialRow
from far_app.types import TICK_STAGES, AdaptationStep, RobotMode, RobotStatus
from far_app.wire import Packer, WireError, pack, unpack
from tests.recording import values


def snapshot() -> Telemetry:
    row = TrialRow(trial=1, scene_seed=7, attempts=2, success=True, judged_by="twin", flagged=3, seconds=4.5)
    return Telemetry(
        seq=3, stamp=1.5, state=State.RUNNING, values=np.array([0.5, np.nan]), flagged=(3, 4), threshold=float("nan"),
        robot=RobotStatus(mode=RobotMode.TRACKING, scene_seed=None), eef=values.pose(0.3), history=(row,) * 3,
        adaptation=(AdaptationStep(step=1, steps=2, loss=0.7, winner_error=1.0, loser_error=float("inf")),),
        loop=LoopHealth(hz=30.0, stages=np.ones((4, len(TICK_STAGES)), np.float32)), allowed=(Intent.STOP,),
        log=(LogLine(stamp=0.0, level="info", text="µ"),),
    )  # fmt: skip


@pytest.mark.parametrize("message", [
    values.observation(3, 10.0), values.chunk(2, candidates=4), snapshot(),
    replace(snapshot(), state=State.TAKEN_OVER, steering=Steering(source=Source.DEVICE, ticks=3)),
    replace(values.observation(0, 1.0), images={}), OperatorIntent(intent=Intent.PAUSE, operator="ä"),
], ids=lambda m: type(m).__name__)  # fmt: skip
def test_what_is_packed_comes_back(message):
    assert values.same(unpack(pack(message)), message)


def test_a_packer_packs_a_stream_as_pack_does():
    """Whatever changes from one message to the next, and whatever stays the same object."""
    packer, first = Packer(), snapshot()
    line = LogLine(stamp=1.0, level="error", text="b")
    stream = [
        first, first, replace(first, seq=4), replace(first, log=(*first.log, line)), replace(first, history=()), first,
        replace(first, robot=None, eef=values.pose(0.4)), values.chunk(2, candidates=4), first,
    ]  # fmt: skip
    for message in stream:
        assert packer.pack(message) == pack(message)


def test_numpys_numbers_travel_as_numbers():
    numbers = {"attempts": np.int64(2), "success": np.bool_(True), "seconds": np.float64(4.5)}
    row = unpack(pack(replace(snapshot().history[0], **numbers)))
    assert (type(row.attempts), type(row.success), type(row.seconds)) == (int, bool, float)


def test_a_word_that_is_not_registered_is_refused_where_it_is_packed():
    """Not where it is read: there a whole telemetry would be lost for it."""

    class Unknown(StrEnum):
        WORD = "word"

    with pytest.raises(WireError, match="Unknown is not registered"):
        pack(Unknown.WORD)


def test_a_kind_that_is_not_registered_is_refused():
    @dataclass(frozen=True)
    class Pose:  # of the name of one that is
        position: float

    for stranger, why in ((Pose(1.0), "Pose is not registered"), ({1, 2}, "set does not travel"),
                          (np.zeros(2, np.complex64), "complex64 do not travel")):  # fmt: skip
        with pytest.raises(WireError, match=why):
            pack(stranger)
