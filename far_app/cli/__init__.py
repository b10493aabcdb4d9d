"""The console script `far`: one line per subcommand here, each in its own module, imported only when it is called."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

from far_app.errors import FarError

COMMANDS: dict[str, tuple[str, str]] = {
    "run": ("far_app.cli.run", "supervised trials: try, notice failure, learn, retry; with the operator page"),
    "trials": ("far_app.cli.trials", "a plan of trials: methods × scenes, compared fairly; goes on where it stopped"),
    "hw-server": ("far_app.cli.hw_server", "own the arm on a machine of its own, for far run --hw on another"),
    "keys": ("far_app.cli.keys", "make the keys with which two machines trust each other"),
    "demo": ("far_app.cli.demo", "make demonstrations with the scripted expert"),
    "train policy": ("far_app.cli.train_policy", "train the diffusion policy on demonstrations"),
    "train critic": ("far_app.cli.train_critic", "train the IQL critic on demonstrations"),
    "train success": ("far_app.cli.train_success", "train and calibrate a detector of success on outcomes alone"),
    "train alarm": ("far_app.cli.train_alarm", "calibrate an alarm that ends hopeless attempts early"),
    "eval": ("far_app.cli.evaluate", "compare ways to retry, in lockstep, over many scenes"),
    "study": ("far_app.cli.study", "tasks × training seeds × methods from one file: models, episodes, tables"),
    "improve": ("far_app.cli.improve", "collect with retries, learn from successes and failures, again and again"),
    "report": (
        "far_app.cli.report",
        "tables and a picture of results, or a page on recorded sessions",
    ),
    "inspect": ("far_app.cli.inspect", "what a recorded session holds, and what is missing or damaged"),
    "replay": ("far_app.cli.replay", "why did it fail: a recorded session in the attempt view, or in rerun"),
    "export": ("far_app.cli.export", "recorded attempts as a LeRobot, robomimic or rerun dataset"),
    "import": ("far_app.cli.import_demos", "robomimic or LeRobot demonstrations as ours"),
    "mark": ("far_app.cli.mark", "your word on a recorded attempt: success, failure, unsure, a note"),
    "policy list": ("far_app.cli.policy_list", "the adapted policy versions a session kept, and their lineage"),
    "policy promote": ("far_app.cli.policy_promote", "an adapted version as a checkpoint of its own"),
    "bench loop": ("far_app.bench.loop", "lateness of the 30 Hz loop, idle and adapting"),
    "bench render": ("far_app.bench.render", "milliseconds to draw the twin's cameras"),
    "bench page": ("far_app.bench.page", "what open pages cost: the loop's lateness, the page's memory over a day"),
    "bench infer": ("far_app.bench.infer", "milliseconds per chunk, by preset and engine, and how they grow"),
    "bench precision": ("far_app.bench.precision", "does an engine of lower precision cost successes"),
    "bench train": ("far_app.bench.train", "gradient steps a second, plain and fast"),
    "bench evaluate": ("far_app.bench.evaluate", "policy ticks a second of lockstep trials, and where the time goes"),
    "bench start": ("far_app.bench.start", "seconds to the list of commands and to the first motion"),
    "bench all": ("far_app.bench.everything", "every benchmark of speed, and docs/performance.md made of them"),
    "bench adapt": ("far_app.bench.adapt", "seconds from a failed attempt to a new policy version, by stage"),
    "bench critic": ("far_app.bench.critic", "can Q rank what the policy would do: before trusting FAR with a model"),
    "bench success": ("far_app.bench.success", "a success detector against the twin's own check, on held-out attempts"),
    "bench alarm": ("far_app.bench.alarm", "what an early failure alarm would have saved and lost"),
    "bench faults": ("far_app.bench.faults", "a real arm's faults on the fake controller: held, told, resumed"),
    "bench link": ("far_app.bench.link", "two machines: offset of clocks, holds and jumps on a slow, stalling link"),
    "fake-xarm": ("hw.fake_xarm.__main__", "a controller that speaks an xArm7's protocols: try a real arm's path"),
    "doctor": ("far_app.cli.doctor", "what this machine has, and what to do about what it lacks"),
}


def usage() -> str:
    lines = [f"  far {name:<14} {summary}" for name, (_, summary) in COMMANDS.items()]
    return "\n".join(
        [
            "FAR: supervised trials of learned robot policies that notice failure, learn from it and try again.",
            "",
            *lines,
            "",
            "far COMMAND --help lists a command's options. --debug shows the traceback of an error.",
        ]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 2 an error in one line on stderr, 130 interrupted."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [w for w in words if w != "--debug"]
    name = next((n for n in (" ".join(words[:2]), " ".join(words[:1])) if n in COMMANDS), None)
    if name is None:
        if not words or words[0] in ("-h", "--help", "help"):
            print(usage())
            return 0
        group = [n for n in COMMANDS if n.startswith(f"{words[0]} ")]
        known = ", ".join(group or COMMANDS)
        print(f"far: unknown command '{' '.join(words[:2] if group else words[:1])}'; choose: {known}", file=sys.stderr)
        return 2
    try:
        module = importlib.import_module(COMMANDS[name][0])
        return int(module.main(words[len(name.split()) :]) or 0)
    except FarError as error:
        if debug:
            raise
        print(f"far: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of our output (head, less) has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        if debug:
            raise
        print("far: interrupted", file=sys.stderr)
        return 130
