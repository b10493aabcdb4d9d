"""A session's attempts as the attempt view reads them: one at a time, again when a file has grown, never written to."""

from __future__ import annotations

from pathlib import Path

from far_app.errors import RecordingError
from far_app.marks import Judged, Mark
from far_app.recording.append_file import being_written
from far_app.recording.attempt_reader import read_attempt
from far_app.recording.corrections import CORRECTIONS_FILE, Corrections, corrections
from far_app.recording.judged import judged
from far_app.recording.marks import MARKS_FILE
from far_app.recording.reader import SessionRecording, read_session
from far_app.recording.schema import TRIALS_FILE
from far_app.types import FlagCorrection
from ui.why_model import Case, Setting, case_of


class Sitting:
    """The session of one folder. Raises RecordingError when it holds none."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stamps: tuple[object, ...] = ()
        self._cases: dict[Path, tuple[object, Case | str]] = {}
        self._corrections: Corrections = {}
        self._judged: dict[tuple[int, int], Judged] = {}
        self.session: SessionRecording
        self.problems: tuple[str, ...] = ()
        self.refresh()
        self.setting = Setting.of(self.session.header.info.config, self.session.header.info.rig)

    def refresh(self) -> bool:
        """Look whether something was added; True when so."""
        stamps = tuple(_stamp(self.path / name) for name in (TRIALS_FILE, CORRECTIONS_FILE, MARKS_FILE))
        stamps += (being_written(self.path / TRIALS_FILE),)
        stamps += tuple(_stamp(file) for file in sorted(self.path.glob("trial_*/attempt_*.mcap"))[-2:])
        if stamps == self._stamps:
            return False
        self._stamps = stamps
        self.session = read_session(self.path)
        self._corrections, cut = corrections(self.session)
        self._judged = judged(self.session)
        live = ("the session is still being recorded",) if self.session.live else ()
        ended = any(entry.event == "session_ended" for entry in self.session.log)
        crash = () if ended or self.session.live else ("the session was not closed: its program ended without warning",)
        self.problems = (*live, *crash, *self.session.problems, *cut)
        return True

    @property
    def files(self) -> tuple[Path, ...]:
        return self.session.files

    def case(self, index: int) -> Case | str:
        """The attempt, or why it cannot be read."""
        if not 0 <= index < len(self.files):
            return f"{self.path} holds no attempt yet"
        file = self.files[index]
        stamp = _stamp(file)
        known = self._cases.get(file)
        if known is None or known[0] != stamp:
            try:
                known = (stamp, case_of(read_attempt(file)))
            except RecordingError as error:
                known = (stamp, str(error))
            self._cases = {file: known}  # one at a time: frames are large
        return known[1]

    def place(self, index: int) -> tuple[int, int]:
        """(trial, attempt) of a file, by its name."""
        file = self.files[index]
        numbers = file.parent.name.removeprefix("trial_"), file.stem.removeprefix("attempt_")
        trial, attempt = (int(n) if n.isdigit() else 0 for n in numbers)
        return trial, attempt

    def words(self, index: int) -> tuple[FlagCorrection, ...]:
        """The operator's words on its chunks, oldest first."""
        return self._corrections.get(self.place(index), ())

    def judgment(self, index: int) -> Judged | None:
        """How it was judged, by the program and by people; None of an attempt that has not ended."""
        return self._judged.get(self.place(index)) if 0 <= index < len(self.files) else None

    def marks(self, index: int) -> tuple[Mark, ...]:
        """People's words on it, oldest first."""
        if not 0 <= index < len(self.files):
            return ()
        return tuple(word for word in self.session.words if (word.trial, word.attempt) == self.place(index))

    def newest_failure(self) -> int:
        """The newest attempt that failed and was learnt from or ended; else the newest; 0 of an empty session."""
        marks = self.session.marks
        failed = [i for i in range(len(self.files)) if (o := marks.get(self.place(i))) is not None and not o.success]
        return failed[-1] if failed else max(0, len(self.files) - 1)


def _stamp(file: Path) -> object:
    try:
        status = file.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size
