"""The learning process: makes candidates and updates for an application, one at a time, until it is told to end or the
application is gone. `python -m far_app.learning.apart.server --folder RUN --threads N --torch-threads M`

    main thread    hears what is asked, and what is asked no longer
    work           makes it (making.py), on threads of its own, and tells
"""

from __future__ import annotations

import argparse
import logging
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

import zmq

from far_app.parent import die_with_parent, run_until_told
from far_app.scheduling import BACKGROUND_NICENESS, nice
from far_app.signal_event import SignalSafeEvent

log = logging.getLogger(__name__)

GONE_MS = 1000
"""After which an answer that nobody takes is dropped."""
_POLL_MS = 200


def main(arguments: Sequence[str] | None = None) -> int:
    return run_until_told(options, serve, arguments)


def options(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="far_app.learning.apart.server")
    parser.add_argument("--folder", type=Path, required=True, help="where the application is met")
    parser.add_argument("--threads", type=int, default=1, help="that compute at once")
    parser.add_argument("--torch-threads", type=int, default=1, help="of one torch operation")
    return parser.parse_args(arguments)


def serve(options: argparse.Namespace, ended: SignalSafeEvent) -> None:
    gone = die_with_parent(signal.SIGTERM)
    import torch

    from far_app.learning.apart.making import Making
    from far_app.learning.apart.messages import NoLongerAsked, endpoints, receive

    torch.set_num_threads(options.torch_threads)
    nice(BACKGROUND_NICENESS)
    asked, told = endpoints(options.folder)
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    asks, tells = context.socket(zmq.PULL), context.socket(zmq.PUSH)
    asks.bind(asked)
    tells.bind(told)
    tells.setsockopt(zmq.SNDTIMEO, GONE_MS)
    making: Making | None = None
    log.info("ready")
    while not ended.is_set() and not gone():
        if not asks.poll(_POLL_MS):
            continue
        message, tensors = receive(asks)
        if making is not None and (not isinstance(message, NoLongerAsked) or message.seq == making.seq):
            making.end()
            making = None
        if not isinstance(message, NoLongerAsked):
            making = Making(message, tensors, tells, options.threads)
    if making is not None:
        making.end()
    context.destroy(linger=0)


if __name__ == "__main__":
    sys.exit(main())
