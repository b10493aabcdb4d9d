"""The command line: quick help without torch, and one clear line for bad input."""

from __future__ import annotations

import socket
import statistics
import subprocess
import sys
from pathlib import Path

import pytest

from far_app.cli import COMMANDS, main

FAR = Path(sys.executable).parent / "far"


def far(*words: str, timeout: float = 120, **kwargs) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(FAR), *words],
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
        stdin=subprocess.DEVNULL,
        **kwargs,
    )


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    """The single line on stderr of a command that failed as it should."""
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("far: "), done.stderr
    return lines[0]


def test_help_lists_every_command_and_loads_no_torch():
    code = "import sys; from far_app.cli import main; main(['--help']); assert 'torch' not in sys.modules; " \
        "assert 'numpy' not in sys.modules, 'not even numpy is needed'"  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 0, done.stderr
    assert all(f"far {name}" in done.stdout for name in COMMANDS)


def test_help_costs_little_processor_time():
    """0.7 s is the promise on an idle machine; processor time is what a busy one can still measure."""
    code = "import resource, subprocess, sys; subprocess.run([sys.argv[1], '--help'], stdout=subprocess.DEVNULL); " \
        "u = resource.getrusage(resource.RUSAGE_CHILDREN); print(u.ru_utime + u.ru_stime)"  # fmt: skip
    seconds = [
        float(subprocess.run([sys.executable, "-c", code, str(FAR)], capture_output=True, text=True, check=True).stdout)
        for _ in range(3)
    ]
    assert statistics.median(seconds) < 0.7


@pytest.mark.parametrize("name", ["run", "train policy", "train critic", "inspect", "bench loop", "doctor"])
def test_every_command_explains_itself_without_torch(name):
    code = f"import sys; from far_app.cli import main\ntry:\n    main({name.split()!r} + ['--help'])\n" \
        "except SystemExit as end:\n    assert not end.code\nassert 'torch' not in sys.modules"  # fmt: skip
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert "--" in done.stdout


def test_an_unknown_command_names_the_known_ones(capsys):
    assert main(["fly"]) == 2
    assert "unknown command 'fly'" in capsys.readouterr().err
    assert main(["train", "dragon"]) == 2
    error = capsys.readouterr().err
    assert "train policy" in error and "doctor" not in error


BAD_RUNS = {
    "task": (["--task", "fold"], ["unknown task 'fold'", "lift"]),
    "method": (["--method", "hope"], ["unknown method 'hope'", "far"]),
    "rig": (["--rig", "spaceship"], ["spaceship.toml", "twin"]),
    "seed": (["--seed", "-1"], ["--seed is -1", "at least 0"]),
    "port": (["--port", "70000"], ["port is 70000", "65535"]),
    "checkpoint": (["--policy", "nowhere.safetensors"], ["no policy checkpoint at nowhere.safetensors", "far train"]),
    "device": (["--device", "cuda"], ["device 'cuda'", "--device cpu"]),
    "setting": (["--retry.attribution.rho", "120"], ["attribution.rho is 120", "(0, 100]"]),
    "summary": (["--summary-json", "/nowhere/at/all.json"], ["/nowhere/at/all.json", "does not exist"]),
}


@pytest.mark.parametrize("what", BAD_RUNS)
def test_bad_input_is_one_line_that_says_what_and_what_to_do(what, tmp_path, capsys):
    words, expected = BAD_RUNS[what]
    if what == "device":
        import torch

        if torch.cuda.is_available():
            pytest.skip("this machine has a GPU")
    assert main(["run", "--trials", "1", "--port", "0", "--recordings", str(tmp_path / "r"), *words]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("far: ") and all(e in line for e in expected), line
    assert not (tmp_path / "r").exists(), "nothing was begun"


def test_a_truncated_checkpoint_is_named(tmp_path, capsys):
    broken = tmp_path / "policy.safetensors"
    broken.write_bytes(b"\x10\x00\x00\x00\x00\x00\x00\x00{}")
    assert main(["run", "--headless", "--policy", str(broken)]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert str(broken) in line and "truncated" in line


def test_a_port_in_use_is_named_before_anything_starts():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        line = one_line(far("run", "--port", str(port), "--policy", "test:still"))
    assert f"port {port}" in line and "--port" in line


@pytest.mark.parametrize("words", [
    ["train", "policy", "--preset", "nope", "--out", "o"],
    ["train", "policy", "--task", "fold", "--out", "o"],
    ["train", "policy", "--data", "nowhere.hdf5", "--out", "o"],
    ["train", "critic", "--policy", "nowhere.safetensors", "--out", "o"],
    ["inspect", "nowhere"],
], ids=" ".join)  # fmt: skip
def test_bad_input_of_other_commands_is_one_line_too(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    (line,) = [x for x in capsys.readouterr().err.strip().splitlines() if x]
    assert line.startswith("far: ")


def test_debug_shows_the_traceback():
    done = far("run", "--task", "fold", "--debug")
    assert done.returncode == 1 and "Traceback" in done.stderr and "ConfigError" in done.stderr
