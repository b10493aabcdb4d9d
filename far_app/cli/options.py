"""What `far run` can be told; the benchmarks are told a part of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from far_app.cli.settings import Settings
from far_app.config import RetryConfig
from far_app.errors import ConfigError
from far_app.scheduling import learning_threads
from hw.rig import RigConfig, at_address, load_rig

EngineName = Literal["auto", "torch", "arranged", "openvino", "openvino-bf16", "cuda-graph"]


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Supervised trials: the policy tries, the app judges, learns from failure and retries; you watch."""

    trials: int = 0
    """Trials to run; 0 goes on until you quit."""
    seed: int = 0
    """Scene seed of the first trial; the next trial has the next."""
    headless: bool = False
    """No page; a fault ends the run with an error."""
    summary_json: Path | None = None
    """Write the summary here at the end."""
    method: str = "far"
    """How to retry: dp, nr, perturb, fcpa, far, bgr, rerank, fcpa-rerank, negative-guidance."""
    task: str = "lift"
    """lift, stack, door, bread, can or square."""
    robot: Literal["twin", "xarm"] | None = None
    """twin simulates, xarm is a real xArm7; the rig file's own when it is not given."""
    rig: str | None = None
    """Name below hw/rigs, or the path of a rig's TOML file; the robot's own by default (twin, xarm7)."""
    host: str = ""
    """ADDRESS[:PORT] of a real arm's controller, over the rig file's."""
    hw: str = ""
    """tcp://HOST:PORT of `far hw-server` on another machine; started here when empty."""
    keys: Path | None = None
    """Folder of the CURVE keys for --hw (see far keys)."""
    full_speed: bool = False
    """Real arm: the session's first attempt too runs at the policy's own speed."""
    policy: str | None = None
    """Policy checkpoint; the shipped quickstart model by default. Without a network or cameras: test:still stands
    still, test:wander draws circles."""
    critic: Path | None = None
    """Critic checkpoint; the one beside the policy by default."""
    device: str = "cpu"
    """cpu or cuda."""
    engine: EngineName = "auto"
    """What runs the policy; auto takes the fastest of this machine (`far doctor` says which), torch is the
    reference."""
    max_attempts: int | None = None
    """Attempts a trial; the task's by default."""
    port: int = 8080
    """The page's port; 0 takes a free one."""
    operator: str = "operator"
    """Your name, stored with what you say on attempts and chunks."""
    page_host: str = "127.0.0.1"
    """Address the page binds to; any but loopback needs --page-token."""
    page_token: Path | None = None
    """File of the token that a browser must show to open the page; made where it is missing."""
    rerun: bool = True
    """Show the session live in a rerun viewer too."""
    scene3d: bool = True
    """Show the arm in 3D on the page."""
    recordings: Path = Path("recordings")
    """Folder of the sessions."""
    torch_threads: int = 1
    """Threads of one torch operation in the loop's process."""
    learning_threads: int = field(default_factory=learning_threads)
    """Threads that learn from a failure at once; by default one for each core, up to four."""
    learning_apart: bool = True
    """On a CPU, learn in a process of its own, in which nobody waits for the control loop nor the loop for it."""
    settings: Settings = "model"
    """Begin from what the checkpoint's makers recommend (the retry.toml beside it), or from the paper's settings."""
    retry: RetryConfig = field(default_factory=RetryConfig)
    """Settings of the method."""
    detector: Path | None = None
    """Success detector (`far train success`) in place of the twin's own check or a person."""
    alarm: Path | None = None
    """Early failure alarm (`far train alarm`): ends attempts that get nowhere before their horizon."""
    judge_wait: float = 30.0
    """Seconds to wait for your word on an attempt that nobody could judge; then it is a failure. Headless: none."""
    shadow: bool = False
    """The policy runs and its path is shown, with the arm held: nothing that moves it leaves the app."""
    accept_differences: bool = False
    """Go on though the rig differs from what the policy's data were made on; the preflight says in what."""
    verbose: bool = False
    """Log every phase change to the terminal."""

    @property
    def rig_file(self) -> str:
        """Name or path of the rig."""
        return self.rig or {"xarm": "xarm7"}.get(self.robot or "", "twin")

    def load_rig(self) -> RigConfig:
        """The rig as these options have it, at the task's station. Raises ConfigError."""
        rig = at_address(load_rig(self.rig_file, self.task), self.host)
        if self.robot not in (None, rig.robot):
            raise ConfigError(f"--robot is {self.robot}, but rig {rig.name} ({self.rig_file}) is a {rig.robot}")
        if not self.hw:
            self.refuse_unwatched(rig)
        return rig

    def refuse_unwatched(self, rig: RigConfig) -> None:
        """Raise ConfigError where nobody would watch a real arm."""
        if self.headless and rig.robot == "xarm" and not rig.xarm.address.startswith("127."):
            raise ConfigError(
                f"--headless is for the twin and the fake controller: a real arm (at {rig.xarm.address}) needs "
                "somebody who watches its page"
            )

    def __post_init__(self) -> None:
        limits = {"trials": 0, "seed": 0, "torch_threads": 1, "learning_threads": 1, "max_attempts": 1}
        for name, least in limits.items():
            value = getattr(self, name)
            if value is not None and value < least:
                raise ConfigError(f"--{name.replace('_', '-')} is {value}, must be at least {least}")
        if self.hw and self.host:
            raise ConfigError(
                f"--host {self.host} is where the hw server finds the arm's controller; with --hw {self.hw} that is "
                "said on the other machine: far hw-server --host …"
            )
        if self.keys is not None and not self.hw:
            raise ConfigError("--keys are for a hw server on another machine; say --hw tcp://HOST:PORT as well")
