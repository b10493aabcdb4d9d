"""torchvision's ResNet-18 (IMAGENET1K_V1) without torchvision: the same state-dict names, from a file or its home."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from far_app.errors import CheckpointError

URL = "https://download.pytorch.org/models/resnet18-f37072fd.pth"
NAME = "resnet18-f37072fd.safetensors"
CACHE = Path.home() / ".cache" / "far"


def resnet18_weights(path: Path | None) -> dict[str, Tensor]:
    """Weights by torchvision's names. A .pth file is a pickle and is not loaded: it is to be converted once, where
    torchvision is installed; the message says how."""
    from safetensors.torch import load_file

    file = path or CACHE / NAME
    if not file.exists():
        raise CheckpointError(
            f"no ImageNet weights at {file}; convert torchvision's once with: python -c \"import torch, "
            f"safetensors.torch as s; s.save_file(torch.hub.load_state_dict_from_url('{URL}'), '{NAME}')\" "
            f"and give --imagenet {NAME}"
        )
    if file.suffix != ".safetensors":
        raise CheckpointError(f"{file} is not a safetensors file; pickled weights are never loaded, convert it first")
    return load_file(file)
