"""Where chunks come from during an attempt: at once (lockstep), or from a worker thread (real time)."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Mapping, Sequence
from typing import Any

import numpy as np

from far_app.errors import PolicyError
from far_app.noise import keyed_noise
from far_app.protocols import History, PlanRequest, Policy
from far_app.scheduling import PROMPT_NICENESS, nice
from far_app.types import ActionChunk

NoiseKey = tuple[int, int, int]


def plan_one(request: PlanRequest) -> ActionChunk:
    """The chunk of one request, with the noise its key names."""
    return plan_together({0: request})[0]


def plan_together(requests: Mapping[int, PlanRequest]) -> dict[int, ActionChunk]:
    """The chunk of every request, those of one policy in one batch. Raises PolicyError on a non-finite action."""
    batches: dict[int, list[int]] = {}
    for name, request in requests.items():
        batches.setdefault(id(request.policy), []).append(name)
    chunks: dict[int, ActionChunk] = {}
    for names in batches.values():
        some = [requests[name] for name in names]
        policy, spec = some[0].policy, some[0].policy.spec
        noise = np.stack([keyed_noise(r.noise_key, spec.horizon, spec.action_dim) for r in some])
        planned = policy.plan([r.history for r in some], [r.tick for r in some], noise)
        for name, request, chunk in zip(names, some, planned, strict=True):
            if chunk.policy_version != policy.version:
                raise PolicyError(
                    f"policy {policy.version} was asked at tick {request.tick} of attempt {request.noise_key[1]}, "
                    f"but the weights of {chunk.policy_version} answered; start the run again with --engine torch"
                )
            if not np.all(np.isfinite(chunk.actions)):
                raise PolicyError(
                    f"policy {chunk.policy_version} planned a non-finite action at tick {request.tick} of attempt "
                    f"{request.noise_key[1]}; check its training or go back to another checkpoint"
                )
            chunks[name] = chunk
    return chunks


class LockstepPlanner:
    """Asks the driver for every tick's chunk; it takes effect `delay_ticks` later, as if inference took so long."""

    def __init__(self, delay_ticks: int = 0) -> None:
        self.delay_ticks = delay_ticks
        self._policy: Policy | None = None
        self._pending: list[ActionChunk] = []

    def begin(self, policy: Policy) -> None:
        self._policy, self._pending = policy, []

    def plan(
        self, history: History, tick: int, noise_key: NoiseKey
    ) -> Generator[PlanRequest, Any, Sequence[ActionChunk]]:
        assert self._policy is not None, "begin comes first"
        chunk = yield PlanRequest(history=history, tick=tick, noise_key=noise_key, policy=self._policy)
        self._pending.append(chunk)
        ready = [c for c in self._pending if c.tick + self.delay_ticks <= tick]
        self._pending = [c for c in self._pending if c.tick + self.delay_ticks > tick]
        return ready


class ThreadedPlanner:
    """A worker thread that always plans from the newest history; what it could not keep up with is dropped.

    It begins on a history when the driver says `go`, once the tick's target is on its way: inference must not fight
    for the interpreter with the few lines between a deadline and its target. Chunks older than the last `begin` or
    `prime` are forgotten. A failure of the policy ends planning until the next `begin` or `prime` and is kept in
    `failure` for the driver.
    """

    def __init__(self) -> None:
        self.failure: PolicyError | None = None
        self.seconds = 0.0
        """Duration of the last inference."""
        self._spent = 0
        """Nanoseconds of inference since `spent` was last asked."""
        self._changed = threading.Condition()
        self._policy: Policy | None = None
        self._request: tuple[int, PlanRequest] | None = None
        self._waiting: tuple[int, PlanRequest] | None = None
        self._ready: list[ActionChunk] = []
        self._handed_out: list[ActionChunk] = []
        self._primed_tick = -1
        self._primed = False
        self._epoch = 0
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="inference", daemon=True)
        self._thread.start()

    def prime(self, request: PlanRequest, timeout: float = 5.0) -> None:
        """Forget all plans and wait for the chunk of a tick that is about to begin; the arm must be held."""
        with self._changed:
            self._forget(request.policy)
            self._primed, self._primed_tick = True, request.tick
            self._request = (self._epoch, request)
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._ready or self.failure or self._closing, timeout)

    def begin(self, policy: Policy) -> None:
        with self._changed:
            if not self._primed or self._policy is not policy:
                self._forget(policy)
            self._primed = False

    def plan(
        self, history: History, tick: int, noise_key: NoiseKey
    ) -> Generator[PlanRequest, Any, Sequence[ActionChunk]]:
        yield from ()
        with self._changed:
            assert self._policy is not None, "begin comes first"
            if tick != self._primed_tick and self.failure is None:
                request = PlanRequest(history=history, tick=tick, noise_key=noise_key, policy=self._policy)
                self._waiting = (self._epoch, request)
            ready, self._ready = self._ready, []
        self._handed_out += ready
        return ready

    def go(self) -> None:
        """Plan from the history that the last `plan` handed over."""
        with self._changed:
            if self._waiting is not None:
                self._request, self._waiting = self._waiting, None
                self._changed.notify_all()

    def handed_out(self) -> list[ActionChunk]:
        """The chunks that the trial took since the last call (for the page and the recording); the loop's thread."""
        handed_out, self._handed_out = self._handed_out, []
        return handed_out

    def spent(self) -> int:
        """Nanoseconds of the inferences that ended since the last call."""
        with self._changed:
            spent, self._spent = self._spent, 0
        return spent

    def close(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(timeout=30.0)  # a thread inside torch at the interpreter's end would abort it

    def _forget(self, policy: Policy) -> None:
        self._policy, self._ready, self.failure = policy, [], None
        self._request = self._waiting = None
        self._primed_tick = -1
        self._epoch += 1

    def _work(self) -> None:
        nice(PROMPT_NICENESS)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._request is not None or self._closing)
                if self._closing:
                    return
                assert self._request is not None
                (epoch, request), self._request = self._request, None
            chunk, failure = None, None
            begun = time.perf_counter_ns()
            try:
                chunk = plan_one(request)
            except PolicyError as error:
                failure = error
            except Exception as error:
                failure = PolicyError(f"the policy failed at tick {request.tick}: {type(error).__name__}: {error}")
                failure.__cause__ = error
            with self._changed:
                took = time.perf_counter_ns() - begun
                self.seconds, self._spent = took / 1e9, self._spent + took
                if epoch == self._epoch:
                    if chunk is not None:
                        self._ready.append(chunk)
                    self.failure = failure
                    self._changed.notify_all()
