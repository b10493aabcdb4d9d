"""The seams of the program: robot, camera, policy, critic, method, success detector. At most five methods each."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from far_app.types import ActionChunk, Adaptation, AdaptationStep, AdaptedWeights, Attempt, Observation, Outcome, Target


@dataclass(frozen=True, kw_only=True)
class Reset:
    """Put the scene as the seed says (twin) and the arm at its start pose; on hardware the operator does it."""

    seed: int


@dataclass(frozen=True, kw_only=True)
class Home:
    """Open the hand, retreat, go to the start pose; objects stay where they are."""


@dataclass(frozen=True, kw_only=True)
class Hold:
    """Stop moving and keep the pose. A latching hold refuses everything but Resume."""

    reason: str
    latch: bool = False


@dataclass(frozen=True, kw_only=True)
class Resume:
    """Operator only: leave the latch; the one thing that clears an error of a real arm. The next motion starts from the
    measured pose."""


@dataclass(frozen=True, kw_only=True)
class Heartbeat:
    """The app lives; stands for targets while homing, and while a person leads the arm."""


@dataclass(frozen=True, kw_only=True)
class Guide:
    """A person leads the arm by hand (on), or not any more. Targets are refused meanwhile, and heartbeats keep it so;
    without them the arm is held. Refused by an arm that cannot be led."""

    on: bool
    gripper: float = -1.0
    """−1 opens, +1 closes; may be asked for anew while it is led."""


Request = Reset | Home | Hold | Resume | Heartbeat | Guide


@runtime_checkable
class Robot(Protocol):
    """An arm with its cameras, real or twin, near or behind a socket."""

    def observe(self) -> Observation:
        """The newest observation; blocks at most a few ms (never for a new one). Acknowledgments are handed out once:
        observe from one place. Raises RobotError when none came for a second."""
        ...

    def send(self, target: Target) -> None:
        """Hand over a target without waiting; its Ack arrives in a later Observation.acks."""
        ...

    def request(self, request: Request) -> None:
        """Ask for a change of mode; returns once accepted (≤ 1 s; Reset ≤ 10 s; Resume of a real arm, which is cleared,
        enabled and if need be connected anew by it, ≤ 40 s), raises RobotError if refused.
        Progress shows in Observation.status."""
        ...

    def close(self) -> None:
        """Hold the arm and let go of it."""
        ...


@runtime_checkable
class Distant(Protocol):
    """A Robot that a target reaches after a while."""

    @property
    def on_the_way(self) -> float:
        """Seconds from a target's sending to its arrival, as far as is known."""
        ...


@dataclass(frozen=True, kw_only=True)
class Frame:
    """One picture of one camera."""

    image: np.ndarray
    """RGB uint8, height × width × 3."""
    stamp: float
    """Capture time, monotonic seconds."""
    seq: int


@runtime_checkable
class Camera(Protocol):
    """A source of RGB frames."""

    name: str
    height: int
    width: int

    def frame(self) -> Frame:
        """The newest frame; never waits for the next one. Raises RobotError when the camera is lost."""
        ...

    def close(self) -> None: ...


History = tuple[Observation, ...]
"""The last n_obs observations, oldest first; the first is repeated at an attempt's start."""


OWN_STATE = ("eef_position", "eef_quaternion", "gripper")
"""What every policy sees of the arm itself."""


@dataclass(frozen=True, kw_only=True)
class PolicySpec:
    """What a policy needs to see and what it gives; compared with the robot before the first motion."""

    name: str
    """Preset and task, for people."""
    task: str
    horizon: int
    """H."""
    n_obs: int
    action_dim: int
    cameras: tuple[str, ...]
    image_size: int
    """Pixels, square; 0 for policies that see state only."""
    state_keys: tuple[str, ...]
    """OWN_STATE, and the names of objects whose poses it sees."""


@runtime_checkable
class Policy(Protocol):
    """Chunks from observation histories. Local network and remote server are one type."""

    spec: PolicySpec
    version: str

    def plan(
        self, histories: Sequence[History], ticks: Sequence[int], noise: Float[np.ndarray, "B H A"]
    ) -> list[ActionChunk]:
        """One chunk per history, denoised from the given noise; with V(s_t) when a critic is attached.
        Raises PolicyError on a non-finite result."""
        ...


@dataclass(frozen=True, kw_only=True)
class EngineReport:
    """What runs a policy's network, for people."""

    name: str
    why: str = ""
    """Why this one."""
    refused: tuple[str, ...] = ()
    """Engines that should have been taken and could not be: each "name: error"."""


@runtime_checkable
class RunsOnEngine(Protocol):
    """A policy that can tell what runs it."""

    @property
    def runs_on(self) -> EngineReport: ...


@dataclass(frozen=True, kw_only=True)
class PlanRequest:
    """What a planner may yield to the driver of a trial, so that many trials share one batch."""

    history: History
    tick: int
    noise_key: tuple[int, int, int]
    """(scene, attempt, tick): diffusion noise is drawn from this key, for every method alike."""
    policy: Policy


@runtime_checkable
class Planner(Protocol):
    """Where chunks come from during an attempt: at once (lockstep), a worker thread (real time), a shared batch."""

    def begin(self, policy: Policy) -> None:
        """A new attempt under this policy; everything older is forgotten."""
        ...

    def plan(
        self, history: History, tick: int, noise_key: tuple[int, int, int]
    ) -> Generator[PlanRequest, Any, Sequence[ActionChunk]]:
        """Hand over the tick's observations, return the chunks that became ready since the last call. A PlanRequest
        that it yields is answered with its ActionChunk. Never waits in real time."""
        ...


Progress = Callable[[AdaptationStep | Adaptation], None]
"""Hears of each gradient step, and of the adaptation as far as it is known (attribution, then pairs)."""


@runtime_checkable
class Method(Protocol):
    """How to retry: nr, far, bgr … A trial calls begin once, adapt after each failure that has a retry left."""

    name: str

    @property
    def policy(self) -> Policy:
        """The policy that acts now; its version changes after an adaptation."""
        ...

    def begin(self, scene_seed: int) -> None:
        """A new trial: the base policy returns, memories are cleared."""
        ...

    def adapt(
        self,
        attempt: Attempt,
        cancelled: Callable[[], bool],
        progress: Progress,
    ) -> Adaptation:
        """Learn from a failed attempt. Runs in a background thread; looks at `cancelled` between batches."""
        ...

    def perturb(self, attempt_index: int, scene_seed: int) -> Callable[[int], Float[np.ndarray, "A"]]:
        """δ by tick for one attempt (zeros on the first)."""
        ...


@runtime_checkable
class KeepsWeights(Protocol):
    """A method whose adaptations make weights that are worth keeping."""

    @property
    def adapted(self) -> AdaptedWeights | None:
        """Those of the version that acts now; None while that is the base policy."""
        ...


@runtime_checkable
class ChangesWeights(Protocol):
    """A method that can be told which version to act with."""

    @property
    def policy(self) -> Policy: ...

    def use(self, weights: AdaptedWeights | None, version: str, *, base: bool) -> None:
        """From now on act with these weights, None for the policy it was made with; `base`: trials begin with them.
        Between attempts only; may take as long as making a policy does. Raises FarError where they do not fit."""
        ...


class Person(Protocol):
    """Somebody who may take the arm from the policy during an attempt."""

    @property
    def steers(self) -> bool:
        """The person has the arm."""
        ...

    def action(self, observation: Observation) -> Float[np.ndarray, "A"] | None:
        """The coming tick's action, like a policy's; None while the policy acts. Asked once a tick; never waits."""
        ...


class Nobody:
    """far_app.protocols.Person where none is there."""

    steers = False

    def action(self, observation: Observation) -> None:
        return None


NOBODY = Nobody()


@runtime_checkable
class SuccessDetector(Protocol):
    """Says when an attempt is over."""

    @property
    def patience(self) -> float:
        """Seconds to wait for the operator's word, the arm held, when the horizon is over and nobody has said anything;
        without one it is a failure. 0: it is a failure at once."""
        ...

    def begin(self) -> None:
        """A new attempt."""
        ...

    def judge(self, observation: Observation) -> Outcome | None:
        """Called once a tick; an Outcome ends the attempt."""
        ...
