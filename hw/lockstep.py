"""The robot in the same process on a simulated clock: for training, evaluation, benchmarks and tests.

Nothing happens by itself. `advance` lets exactly one policy tick pass; between two of them requests and targets act at
once and the world stands still. Expiry and watchdog go by the simulated clock, which `advance` returns and which the
driver hands to the trial as the tick's deadline.
"""

from __future__ import annotations

from far_app.config import TaskConfig
from far_app.errors import RobotError
from far_app.protocols import Guide, Home, Request, Reset, Resume
from far_app.types import Observation, RobotMode, Target
from hw.controller import ArmController
from hw.observing import observation
from hw.plant import PlantView, SimulatedPlant
from hw.rig import RigConfig


class LockstepRobot:
    """far_app.protocols.Robot around a plant whose time is simulated."""

    def __init__(
        self,
        plant: SimulatedPlant,
        view: PlantView | None,
        rig: RigConfig,
        task: TaskConfig,
        render_homing: bool = False,
    ) -> None:
        """Without a view observations hold no images. Unless render_homing, none are drawn while the arm goes home.
        The view stays its maker's (several robots of one rig and task may share one)."""
        self.plant, self.view, self.rig, self.task = plant, view, rig, task
        self.scale = rig.scale_for(task)
        self.render_homing = render_homing
        self.controller = ArmController(rig, task, plant.servo_hz, plant.measure())
        self.servo_ticks = max(1, round(plant.servo_hz / task.rate))
        self._ticks = 0
        self._seq = 0
        self._observation: Observation | None = None
        self._closed = False

    @property
    def now(self) -> float:
        """Simulated seconds since this robot was made."""
        return self._ticks / self.plant.servo_hz

    def advance(self) -> float:
        """Let one policy tick pass; returns the new time."""
        for _ in range(self.servo_ticks):
            self.plant.servo(*self.controller.tick(self.now, self.plant.measure()))
            self.plant.advance()
            self._ticks += 1
        self.controller.measured = self.plant.measure()
        self._observation = None
        return self.now

    def observe(self) -> Observation:
        """This moment; drawn at the first call after each advance. The same object again, acknowledgments included,
        until something happens."""
        if self._closed:
            raise RobotError("this robot was closed; make another")
        if self._observation is None:
            status = self.controller.status()
            images = {}
            if self.view is not None and (self.render_homing or status.mode is not RobotMode.HOMING):
                snapshot = self.plant.snapshot()
                images = {c: self.view.image(snapshot, c, self.rig.policy_image) for c in self.task.cameras}
            self._seq += 1
            self._observation = observation(
                self._seq, self.now, self.controller.measured, status, self.controller.take_acks(), images
            )
        return self._observation

    def send(self, target: Target) -> None:
        self.controller.offer(target, self.now)

    def request(self, request: Request) -> None:
        if isinstance(request, Reset):
            self.controller.refuse_latched("Reset")
            self.plant.reset(request.seed)
            self.controller.reset(self.plant.measure(), request.seed)
        elif isinstance(request, Guide) and request.on:
            self.plant.guide(True)
        else:
            self.controller.request(request, self.now)
        self._observation = None

    def free(self) -> bool:
        """What an operator does with an arm that latched: takes it out of what it is caught in, puts it at its start
        pose, resumes and sends it home; the objects stay. False when it was not latched."""
        if self.controller.status().mode is not RobotMode.LATCHED:
            return False
        self.request(Resume())
        self.plant.free()
        self.controller.reset(self.plant.measure(), self.controller.scene_seed)
        self.request(Home())
        return True

    def close(self) -> None:
        self._closed = True
