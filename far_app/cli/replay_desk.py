"""The app's side of `far replay`: answers the attempt view's questions, keeps what is said there. No robot, no session.

One thread listens and publishes, one computes; a newer question cancels the one under way.
"""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zmq

from far_app.cli.assemble import checkpoints
from far_app.config import RetryConfig, from_table
from far_app.endpoints import Endpoints
from far_app.errors import ConfigError, FarError
from far_app.marks import MarkAttempt
from far_app.recording import corrections
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.judged import mark_closed
from far_app.recording.reader import SessionRecording, read_session
from far_app.what_if import RECORDED, Answer, Answerer, CorrectFlag, Question
from far_app.wire import WireError, pack, unpack

if TYPE_CHECKING:
    from far_app.methods.what_if import Networks

log = logging.getLogger(__name__)

SHIPPED = "shipped: "
Load = Callable[[str], "Networks"]
"""The networks for one of the critics' names; slow, called in the computing thread. Raises FarError."""


class Desk:
    """Serves one page until `ended`."""

    def __init__(self, run_folder: Path, session: SessionRecording, critics: Sequence[str], load: Load) -> None:
        self._session, self._critics, self._load = session, tuple(critics), load
        at = Endpoints.in_folder(run_folder)
        self._context: zmq.Context[Any] = zmq.Context()
        self._pull = self._context.socket(zmq.PULL)
        self._pub = self._context.socket(zmq.PUB)
        for socket, endpoint in ((self._pull, at.intents), (self._pub, at.telemetry)):
            socket.setsockopt(zmq.LINGER, 0)
            socket.bind(endpoint)
        self._answers: queue.SimpleQueue[Answer] = queue.SimpleQueue()
        self._questions: queue.SimpleQueue[Question | None] = queue.SimpleQueue()
        self._newest = 0
        self._said = ""
        self._worker = threading.Thread(target=self._compute, name="what-if", daemon=True)
        self._worker.start()

    def serve(self, ended: Callable[[], bool]) -> None:
        due = 0.0
        while not ended():
            if self._pull.poll(50):
                self._hear(self._pull.recv())
                due = 0.0
            while not self._answers.empty():
                answer = self._answers.get_nowait()
                if answer.number == self._newest:
                    self._pub.send(pack(answer))
            if time.monotonic() > due:
                due = time.monotonic() + 0.5
                self._pub.send(pack(Answerer(critics=self._critics, said=self._said)))

    def close(self) -> None:
        self._newest = -1
        self._questions.put(None)
        self._worker.join(timeout=5)
        self._context.destroy(linger=0)

    def _hear(self, raw: bytes) -> None:
        try:
            message = unpack(raw)
        except WireError as error:
            log.warning("a message was dropped: %s", error)
            return
        if isinstance(message, Question):
            self._newest = message.number
            self._questions.put(message)
        elif isinstance(message, CorrectFlag | MarkAttempt):
            self._keep(message)

    def _keep(self, asked: CorrectFlag | MarkAttempt) -> None:
        """A word on a chunk or on an attempt, beside the recording."""
        if asked.session != self._session.header.session:
            self._said = f"a word on session {asked.session} is not stored in {self._session.header.session}"
            return
        try:
            if isinstance(asked, MarkAttempt):
                mark_closed(read_session(self._session.path), asked.mark)
            else:
                word = corrections.Word(trial=asked.trial, attempt=asked.attempt, correction=asked.correction)
                corrections.append(self._session.path, word)
        except FarError as error:
            self._said = str(error)
            log.warning("%s", error)
        else:
            self._said = ""

    def _compute(self) -> None:
        networks: dict[str, Networks] = {}
        while (question := self._questions.get()) is not None:
            if question.number != self._newest:
                continue
            try:
                self._answer(question, networks)
            except FarError as error:
                self._tell(question, error=str(error))
            except Exception as error:
                log.exception("a question could not be answered")
                self._tell(question, error=f"{type(error).__name__}: {error}")

    def _answer(self, question: Question, networks: dict[str, Networks]) -> None:
        from far_app.methods.what_if import answer

        files = {str(file.relative_to(self._session.path)): file for file in self._session.files}
        if question.file not in files or question.critic not in self._critics:
            known = ", ".join(self._critics)
            raise ConfigError(f"'{question.file}' under '{question.critic}' is not known here; critics: {known}")
        if question.critic not in networks:
            self._tell(question, stage="loading the policy and the critic")
            networks[question.critic] = self._load(question.critic)
        answer(
            question, read_attempt(files[question.file]), networks[question.critic],
            lambda: question.number != self._newest, self._answers.put,
        )  # fmt: skip

    def _tell(self, question: Question, *, stage: str = "", error: str = "") -> None:
        self._answers.put(
            Answer(number=question.number, file=question.file, critic=question.critic, stage=stage, error=error)
        )


def recorded_retry(config: Mapping[str, Any]) -> RetryConfig:
    """The settings a session learnt with. Raises ConfigError when they are not there or of another version."""
    run = config.get("run")
    retry = run.get("retry") if isinstance(run, Mapping) else None
    if not isinstance(retry, Mapping):
        raise ConfigError("the recording does not tell its settings (config.run.retry); they are the defaults here")
    return from_table(RetryConfig, _known(retry), "config.run.retry")


def _known(value: Any) -> Any:
    """NaN is null on the disk."""
    if isinstance(value, Mapping):
        return {key: _known(item) for key, item in value.items()}
    return math.nan if value is None else value


def loader(
    session: SessionRecording, policy: Path | None, critics: Sequence[Path], device: str = "cpu"
) -> tuple[tuple[str, ...], Load]:
    """The critics that can be chosen, and how each is loaded: V as recorded (with the session's own critic for what
    the recording lacks), and every file given."""
    info = session.header.info
    recorded = Path(info.policy) if info.policy and not info.policy.startswith(SHIPPED) else None
    policy_file, beside = checkpoints(info.task, policy or recorded, None)
    files = {str(file): file for file in critics} or {beside.name: beside}
    names = (RECORDED, *files)

    def load(name: str) -> Networks:
        from far_app.learning.critic_file import load_critic, load_demonstrations
        from far_app.learning.policy import load_policy
        from far_app.methods.what_if import Networks

        if not policy_file.exists():
            raise ConfigError(f"the policy '{info.policy}' of this session is not at {policy_file}; give --policy FILE")
        file = next(iter(files.values())) if name == RECORDED else files[name]
        try:
            retry = recorded_retry(info.config)
        except ConfigError as error:
            log.warning("%s", error)
            retry = RetryConfig()
        network = load_policy(policy_file, info.task, device)
        critic = load_critic(file, network)
        demonstrations = load_demonstrations(file, network) if retry.fcpa.guard == "bc" else None
        return Networks(policy=network, critic=critic, retry=retry, demonstrations=demonstrations)

    return names, load
