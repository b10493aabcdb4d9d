"""Enough of torchvision for LeRobot's loader and robomimic's to be imported where the real one cannot be installed (it
must fit the torch at hand, build for build): ToTensor is written out, everything else is an empty name."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import sys
import types

import numpy as np
import torch


class _Names(types.ModuleType):
    def __getattr__(self, name: str) -> type:
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


class ToTensor:
    """A picture as float32 C × H × W in [0, 1]."""

    def __call__(self, picture: object) -> torch.Tensor:
        return torch.from_numpy(np.array(picture)).permute(2, 0, 1).float() / 255


def torchvision_or_stand_in() -> None:
    """Makes `import torchvision` work."""
    if importlib.util.find_spec("torchvision") is not None:
        return
    print("torchvision is not installed: a stand-in takes its place")
    for name in ("torchvision", "torchvision.transforms", "torchvision.transforms.v2", "torchvision.models",
                 "torchvision.transforms.v2.functional", "torchvision.transforms.functional"):  # fmt: skip
        module = _Names(name)
        module.__spec__, module.__path__ = importlib.machinery.ModuleSpec(name, None), []
        sys.modules[name] = module
        parent, _, leaf = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], leaf, module)
    sys.modules["torchvision.transforms"].ToTensor = ToTensor
