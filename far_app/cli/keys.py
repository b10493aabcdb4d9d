"""`far keys`: CURVE keys for two machines, the arm's and the GPU's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from far_app.keys import CLIENT, PUBLIC, SECRET, SERVER, make_keys


@dataclass(frozen=True, kw_only=True)
class KeysOptions:
    """Make the keys that let one GPU PC, and nobody else, talk to the hw server on the robot PC."""

    out: Path
    """Folder for the four files; made where it does not exist."""
    overwrite: bool = False
    """Replace keys that lie there already: machines that use them are locked out."""


def main(arguments: Sequence[str]) -> int:
    options = tyro.cli(KeysOptions, args=list(arguments), prog="far keys")
    make_keys(options.out, options.overwrite)
    print(
        f"Keys in {options.out}, readable by you alone. Over a way you trust (scp, a stick), copy\n"
        f"  {SERVER}{SECRET} and {CLIENT}{PUBLIC} to the robot PC (far hw-server --bind … --keys FOLDER)\n"
        f"  {CLIENT}{SECRET} and {SERVER}{PUBLIC} to the GPU PC (far run --hw … --keys FOLDER)\n"
        f"and delete them here. Another GPU PC: its public key as NAME{PUBLIC} into the robot PC's folder."
    )
    return 0
