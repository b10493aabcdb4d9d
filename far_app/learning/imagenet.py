"""torchvision's ResNet-18 (IMAGENET1K_V1) without torchvision: the same state-dict names, from its standard file."""

from __future__ import annotations

import hashlib
import logging
import urllib.error
import urllib.request
from pathlib import Path

from torch import Tensor

from far_app.errors import CheckpointError
from far_app.learning.torch_zip import read_state_dict

log = logging.getLogger(__name__)

NAME = "resnet18-f37072fd.pth"
"""The last part is the beginning of the file's SHA-256."""
URL = f"https://download.pytorch.org/models/{NAME}"
CACHE = Path.home() / ".cache" / "torch" / "hub" / "checkpoints"
"""Where torchvision itself keeps it."""


def resnet18_weights(path: Path | None = None, url: str = URL) -> dict[str, Tensor]:
    """Weights by torchvision's names: from `path`, from torchvision's cache, or downloaded there. Raises
    CheckpointError that says how to proceed where none of these works."""
    file = path or CACHE / NAME
    if not file.exists() and path is None:
        download(url, file)
    if not file.exists():
        raise CheckpointError(f"no ImageNet weights at {file}; download {url} and give --imagenet {NAME}")
    if file.suffix == ".safetensors":
        from safetensors.torch import load_file

        return load_file(file)
    return read_state_dict(file)


def download(url: str, file: Path) -> None:
    """Fetch a file whose name holds the beginning of its hash; whole and checked, or not at all."""
    log.info("downloading %s", url)
    try:
        with urllib.request.urlopen(url, timeout=20) as answer:
            content = answer.read()
    except (urllib.error.URLError, OSError) as error:
        raise CheckpointError(
            f"the ImageNet weights are not at {file} and {url} cannot be reached ({error}); copy {NAME} there, or give "
            "--imagenet FILE"
        ) from error
    wanted = NAME.split("-")[1].removesuffix(".pth")
    if not (found := hashlib.sha256(content).hexdigest()).startswith(wanted):
        raise CheckpointError(f"{url} gave a file of hash {found[:8]}, not {wanted}; try again or give --imagenet FILE")
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(".partial")
    partial.write_bytes(content)
    partial.replace(file)
