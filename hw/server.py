"""The hw server: the process that owns the arm and the cameras. `python -m hw.server --folder F --parent PID` beside
the app, `far hw-server --bind tcp://ADDRESS:PORT` on a machine of its own.

    servo thread     plant, controller, safety filter, watchdog; nothing else touches the arm
    camera thread    draws; View to the page
    input device     reads a SpaceMouse or gamepad, where the rig has one
    publisher        Observation to the app
    command thread   targets, heartbeats, requests, geometry, what this station is and its clock
    stop thread      STOP, on its own context

One line of JSON on standard output says {"ready": …}, or {"error": …, "kind": …} before a non-zero exit; in words when
it was started by a person. Ends by SIGTERM or SIGINT, and by itself when its parent dies; the arm is held first.
"""

from __future__ import annotations

import argparse
import gc
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

os.environ.setdefault("LP_NUM_THREADS", "1")  # before any GL: software drawing would take every core
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import zmq

from far_app.config import TaskConfig
from far_app.endpoints import Endpoints
from far_app.errors import FarError, RobotError
from far_app.protocols import Hold
from far_app.scheduling import (
    HARDWARE_PRIORITY,
    PROMPT_NICENESS,
    SWITCH_INTERVAL,
    nice,
    prompt_context,
    real_time_from_here,
)
from far_app.signal_event import SignalSafeEvent
from far_app.station import Station
from far_app.tasks import task as task_named
from hw.camera_config import with_views
from hw.camera_thread import CameraThread
from hw.command_thread import CommandThread
from hw.controller import ArmController
from hw.hardware_view import HardwareView
from hw.input_device.reader import InputReader
from hw.lease import claim
from hw.picture_timing import PictureTiming
from hw.places import in_folder, to_machines
from hw.plant import Plant, PlantView
from hw.publisher_thread import PublisherThread
from hw.rig import RigConfig, at_address, load_rig
from hw.servo_thread import ServoThread
from hw.stop_thread import StopThread

log = logging.getLogger(__name__)

LOOK = 0.1
"""Seconds between looks at the parent and the threads."""
BRAKING = 0.3
"""Seconds given to the arm to stand still before the process goes."""


def make_plant(rig: RigConfig, task: TaskConfig) -> tuple[Plant, Callable[[], PlantView]]:
    """The plant of a rig, and how to make its view (in the camera thread)."""
    if rig.robot == "xarm":
        from hw.xarm7.blind import BlindView
        from hw.xarm7.plant import XArmPlant

        claim(rig.xarm.address, rig.xarm.port)
        return XArmPlant(rig, task), BlindView
    from hw.twin import TwinPlant
    from hw.twin_view import TwinView

    plant = TwinPlant(rig, task)
    xml, base, cameras = plant.model_xml(), plant.base_pose(), plant.cameras()
    return plant, lambda: TwinView(xml, base, cameras)


class Server:
    """All threads of the hw server around one plant."""

    def __init__(self, rig: RigConfig, task: TaskConfig, endpoints: Endpoints) -> None:
        self.context = prompt_context()
        self.gate = endpoints.secure(self.context)
        self.plant, make_bodies = make_plant(rig, task)
        cameras = rig.cameras
        make_view = (lambda: HardwareView(make_bodies(), cameras)) if cameras else make_bodies
        controller = ArmController(rig, task, self.plant.servo_hz, self.plant.measure(), time.perf_counter)
        self.servo = ServoThread(self.plant, controller, camera_rate=task.rate)
        self.device = InputReader(rig.input_device) if rig.input_device.kind else None
        self.publisher = PublisherThread(
            self.servo, self.context, endpoints.observations, task.rate,
            self.device.newest if self.device is not None else lambda: None,
        )  # fmt: skip
        self.cameras = CameraThread(
            make_view, rig, task, self.servo, self.context, endpoints.view, self.publisher.pictures, self._lost
        )
        timing = PictureTiming(1.0 / self.plant.servo_hz, 1.0 / task.rate)
        self.commands = CommandThread(
            self.servo, self.publisher, lambda: self.cameras.geometry, timing, self.context, endpoints,
            Station(rig=asdict(rig), task=task.name),
        )  # fmt: skip
        self.stop = StopThread(self.servo, endpoints)

    def _lost(self, reason: str) -> None:
        with self.servo.locked() as controller:
            controller.fail(reason)

    def start(self) -> None:
        """Returns when everything runs; raises a FarError where it cannot."""
        self.stop.start()
        self.cameras.start()  # first: setting up GL holds the interpreter for a second or two
        self.servo.start()
        self.publisher.start()
        if self.device is not None:
            self.device.start()
        self.commands.start()

    def close(self, reason: str) -> None:
        """Hold the arm, give it time to stand still, end the threads."""
        with self.servo.locked() as controller:
            controller.request(Hold(reason=reason), time.monotonic())
        if self.servo.alive:
            time.sleep(BRAKING)
        if self.device is not None:
            self.device.close()
        for part in (self.commands, self.cameras, self.publisher, self.stop, self.servo, self.plant):
            part.close()
        if self.gate is not None:
            self.gate.close()
        self.context.destroy(linger=0)
        log.info("%s", self.servo.report())
        log.info("cameras: %d moments, %.1f ms each", self.cameras.drawn, self.cameras.milliseconds)


class Ending:
    """Why to end: a signal, or the parent's death. Listens from its construction."""

    def __init__(self, parent: int | None) -> None:
        self._parent = parent
        self._told = SignalSafeEvent()
        self._reasons: list[str] = []
        signal.signal(signal.SIGTERM, self._on_signal)
        signal.signal(signal.SIGINT, self._on_signal)

    def wait(self) -> str:
        """Sleeps until then; returns why."""
        while not self._told.wait(LOOK):
            if self._parent is not None and os.getppid() != self._parent:
                return "the app is gone"
        return self._reasons[0]

    def _on_signal(self, number: int, frame: object) -> None:
        self._reasons.append(f"the hw server was told to end ({signal.Signals(number).name})")
        self._told.set()


def serve(
    endpoints: Endpoints, rig_name: str, task_name: str, parent: int | None, say: Callable[[dict[str, object]], None],
    controller: str = "",
) -> None:  # fmt: skip
    """Runs the server to its end."""
    began = time.monotonic()
    try:
        rig = at_address(load_rig(rig_name, task_name), controller)
        if rig.robot == "xarm":
            real_time_from_here(HARDWARE_PRIORITY)  # no thread may wait for a core while it holds STOP's interpreter
        task = with_views(task_named(task_name, rig.arm), rig.cameras)
        server = Server(rig, task, endpoints)
        server.start()
        freeze()
    except zmq.ZMQError as error:
        raise RobotError(f"cannot serve at {endpoints.commands}: {error}; choose another place") from error
    ending = Ending(parent)
    say({
        "ready": True, "pid": os.getpid(), "servo_hz": server.plant.servo_hz, "cameras": list(task.cameras),
        "scheduling": server.servo.scheduling, "seconds": round(time.monotonic() - began, 2),
    })  # fmt: skip
    why = ending.wait()
    log.info("ending: %s", why)
    server.close(why)


def freeze() -> None:
    """What is loaded by now is out of the collector's sight: a full collection, ten milliseconds with the interpreter
    held, would make STOP wait; of what comes later there is little."""
    gc.collect()
    gc.freeze()


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m hw.server", description="Own the arm and its cameras.")
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--folder", type=Path, help="where the ipc endpoints lie")
    where.add_argument("--bind", help="tcp://ADDRESS:PORT for an app on another machine")
    parser.add_argument("--keys", type=Path, default=None, help="folder of the CURVE keys for --bind")
    parser.add_argument("--rig", default="twin", help="a rig's name or the path of its TOML file")
    parser.add_argument("--task", default="lift")
    parser.add_argument("--address", default="", help="ADDRESS[:PORT] of a real arm's controller, over the rig file's")
    parser.add_argument("--parent", type=int, default=None, help="end when this process is no longer our parent")
    options = parser.parse_args(arguments)
    handshake = os.fdopen(os.dup(1), "w")  # standard output stays ours; what libraries print goes to standard error
    os.dup2(2, 1)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    sys.setswitchinterval(SWITCH_INTERVAL)
    nice(PROMPT_NICENESS)  # inherited by every thread that does not ask for its own
    cv2.setNumThreads(1)

    def say(words: dict[str, object]) -> None:
        handshake.write((_for_a_person(words, options.bind) if options.bind else json.dumps(words)) + "\n")
        handshake.flush()

    try:
        endpoints = in_folder(options.folder) if options.folder else to_machines(options.bind, options.keys)
        serve(endpoints, options.rig, options.task, options.parent, say, options.address)
    except FarError as error:
        log.error("%s", error)
        say({"error": str(error), "kind": type(error).__name__})
        return 2
    return 0


def _for_a_person(words: dict[str, object], address: str) -> str:
    if "error" in words:
        return f"far: {words['error']}"
    there = address.replace("//0.0.0.0:", "//THIS-MACHINE:")
    return f"Ready at {address}: on the other machine say  far run --hw {there} …\nCtrl-C ends it; the arm is held."


if __name__ == "__main__":
    code = main()
    logging.shutdown()
    os._exit(code)  # daemon threads inside a GL driver must not delay the end
