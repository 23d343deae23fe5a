"""The three transforms of torchvision that upstream's image loader builds when it is imported.

A stand-in, so that upstream's own code can be tested on machines without a GPU, for whose torch no torchvision is at
hand. It is put in place only where torchvision itself does not import.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def stand_in() -> None:
    """Let ``import torchvision.transforms`` succeed."""
    try:
        importlib.import_module("torchvision.transforms")
        return
    except Exception:  # a torchvision for another torch raises RuntimeError
        for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
            del sys.modules[name]
    package, transforms = ModuleType("torchvision"), ModuleType("torchvision.transforms")
    for part in (_compose, _to_tensor, _normalize):
        setattr(transforms, part.__doc__ or "", part)
    package.transforms = transforms  # type: ignore[attr-defined]
    sys.modules |= {"torchvision": package, "torchvision.transforms": transforms}


def _compose(steps: list[Callable[[Any], Any]]) -> Callable[[Any], Any]:
    """Compose"""

    def run(value: Any) -> Any:
        for step in steps:
            value = step(value)
        return value

    return run


def _to_tensor() -> Callable[[Any], Any]:
    """ToTensor"""
    import numpy as np
    import torch

    return lambda image: torch.from_numpy(np.array(image)).permute(2, 0, 1).contiguous().to(torch.float32).div(255)


def _normalize(mean: tuple[float, ...], std: tuple[float, ...]) -> Callable[[Any], Any]:
    """Normalize"""
    return lambda tensor: tensor.sub(mean[0]).div(std[0])
