"""One computation that was asked of the learning process, in a thread of its own, and its answer."""

from __future__ import annotations

import json
import logging
import threading
from typing import Any

import zmq
from torch import Tensor

from far_app.config import FCPAConfig
from far_app.errors import FarError
from far_app.learning.apart.here import WorkHere
from far_app.learning.apart.messages import (
    CandidatesAsked,
    CandidatesMade,
    Progressed,
    UpdateAsked,
    UpdateMade,
    WorkFailed,
    put,
    send,
    weights_of,
)
from far_app.learning.cancellation import AdaptationCancelledError
from far_app.learning.pairs import Pairs
from far_app.learning.preference import Demonstrations
from far_app.learning.unet import ConditionalUnet1d, UnetSizes

log = logging.getLogger(__name__)


class Making:
    """It alone uses the socket until `end`."""

    def __init__(self, asked: Any, tensors: dict[str, Tensor], tells: zmq.Socket[bytes], threads: int) -> None:
        self.seq: int = asked.seq
        self._asked, self._tensors, self._tells = asked, tensors, tells
        self._here = WorkHere(threads)
        self._cancelled = threading.Event()
        self._thread = threading.Thread(target=self._run, name="work")
        self._thread.start()

    def end(self) -> None:
        """Returns once it is at work no more; unanswered if it was not done."""
        self._cancelled.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            send(self._tells, *self._made())
        except (AdaptationCancelledError, zmq.Again):  # nobody waits, or nobody is there any more
            return
        except FarError as error:
            send(self._tells, WorkFailed(seq=self.seq, error=str(error)))
        except Exception as error:
            log.exception("what was asked could not be made")
            send(self._tells, WorkFailed(seq=self.seq, error=f"{type(error).__name__}: {error}"))

    def _made(self) -> tuple[Any, dict[str, Tensor]]:
        asked, t, cancelled = self._asked, self._tensors, self._cancelled.is_set
        denoiser = unet(asked.sizes, t["denoiser"])
        if isinstance(asked, CandidatesAsked):
            chunks = self._here.candidates(denoiser, asked.ddim_steps, t["features"], t["noise"], cancelled)
            return CandidatesMade(seq=self.seq), {"chunks": chunks}
        assert isinstance(asked, UpdateAsked), asked
        pairs = Pairs(
            features=t["features"], negatives=t["negatives"], positives=t["positives"], owner=t["owner"],
            weights=t["weights"],
        )  # fmt: skip
        demonstrations = Demonstrations(features=t["seen"], chunks=t["shown"]) if "seen" in t else None
        update = self._here.update(
            denoiser.requires_grad_(True), pairs, FCPAConfig(**json.loads(asked.config)), asked.key, cancelled,
            lambda step: send(self._tells, Progressed(seq=self.seq, step=step)), demonstrations,
        )  # fmt: skip
        done = UpdateMade(seq=self.seq, status=update.status, changed=update.changed, note=update.note)
        return done, {"denoiser": weights_of(denoiser)}


def unet(sizes: UnetSizes, weights: Tensor) -> ConditionalUnet1d:
    """A denoiser of its own."""
    made = ConditionalUnet1d(
        sizes.action_dim, sizes.features, widths=sizes.widths, kernel=sizes.kernel, step_dim=sizes.step_dim,
        groups=sizes.groups,
    )  # fmt: skip
    put(weights, made)
    return made.requires_grad_(False).eval()
