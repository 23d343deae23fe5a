"""Depth by the network of Depth Anything 3; run by :mod:`specimap_core.reconstruct.backends.da3.backend` in a process
of its own, see :mod:`specimap_core.sandbox.child`.

Upstream's ``api`` module needs packages that depth does not (gradio, moviepy, torchvision); the network is built from
upstream's own configuration instead, and its weights are read from safetensors, which hold no code.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from specimap_core.errors import BackendUnavailableError

STEP = "depth"
VARIANTS = {384: "da3-small", 768: "da3-base"}
"""Upstream's configuration by the width of the weights' patch embedding."""
EMBEDDING = "backbone.pretrained.patch_embed.proj.weight"
MEAN, SD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet's colours, by which upstream normalises."""


def refuse(message: str) -> BackendUnavailableError:
    """The error for weights that cannot be used."""
    return BackendUnavailableError(
        message, advice="Name the published weights of DA3-SMALL or DA3-BASE in SPECIMAP_DA3_WEIGHTS."
    )


def variant_of(weights: Path) -> tuple[str, str]:
    """Which network the weights are of, and what its names start with in the file.

    Raises:
        BackendUnavailableError: the file does not read, or is of another network.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(weights, framework="np") as stored:
            named = [key for key in stored.keys() if key.endswith(EMBEDDING)]  # noqa: SIM118
            width = stored.get_slice(named[0]).get_shape()[0] if named else 0
    except (SafetensorError, OSError) as error:
        raise refuse(f"The weights file {weights.name} does not read: {error}.") from error
    if not named or width not in VARIANTS:
        found = f"a network of width {width}" if named else "another network"
        raise refuse(f"The weights are of {found}; DA3-SMALL (384) and DA3-BASE (768) are supported.")
    return VARIANTS[width], named[0].removesuffix(EMBEDDING)


def load_network(weights: Path) -> tuple[Any, str]:
    """The network, ready on the CPU, and its variant's name.

    Raises:
        BackendUnavailableError: the weights do not fit.
        ImportError: a module is missing.
    """
    import torch
    from safetensors.torch import load_model

    variant, prefix = variant_of(weights)
    cfg: Any = importlib.import_module("depth_anything_3.cfg")
    network = cfg.create_object(cfg.load_config(str(Path(cfg.__file__).parent / "configs" / f"{variant}.yaml")))
    holder = network
    # Published weights are those of a wrapper of upstream's, which keeps the network under a name of its own.
    for name in reversed(prefix.rstrip(".").split(".") if prefix else []):
        outer = torch.nn.Module()
        outer.add_module(name, holder)
        holder = outer
    try:
        missing, _ = load_model(holder, weights, strict=False)
    except RuntimeError as error:
        raise refuse(f"The weights do not fit {variant}: {str(error)[:300]}.") from error
    if missing:
        raise refuse(f"The weights lack {len(missing)} of {variant}'s tensors, {min(missing)} among them.")
    return network.eval(), variant


def run(
    request: dict[str, Any], arrays: dict[str, Any], step: Callable[[str, float], None]
) -> tuple[dict[str, NDArray[np.float32]], dict[str, object]]:
    """Depths (N, h, w), each of a scale of its own, of ``images`` (N, h, w, 3) sRGB with intrinsics ``K`` (N, 3, 3).

    ``request["windows"]``: the photos that go through the network together; ``poses`` (N, 4, 4): each in its window's
    frame, see :func:`specimap_core.reconstruct.backends.da3.prepare.conditioning`.
    """
    import torch

    start = time.perf_counter()
    if request["device"] != "auto":
        device = torch.device(request["device"])
    else:
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    torch.set_num_threads(max(1, int(request["workers"])))
    network, variant = load_network(Path(request["weights"]))
    network = network.to(device)
    step(STEP, 0.1)
    images, depth = arrays["images"], np.zeros(arrays["images"].shape[:3], np.float32)
    done = 0
    for window in request["windows"]:
        depth[window] = infer(network, device, images[window], arrays["K"][window], arrays["poses"][window])
        done += len(window)
        step(STEP, 0.1 + 0.9 * done / len(images))
    facts = {
        "variant": variant,
        "device": str(device),
        "torch": torch.__version__,
        "seconds": round(time.perf_counter() - start, 1),
    }
    return {"depth": depth}, facts


def infer(
    network: Any, device: Any, images: NDArray[np.uint8], K: NDArray[np.float64], poses: NDArray[np.float64]
) -> NDArray[np.float32]:
    """One pass over photos (n, h, w, 3) that see each other; depths (n, h, w)."""
    import torch

    x = torch.from_numpy(np.ascontiguousarray(images.transpose(0, 3, 1, 2))).to(device).float() / 255
    mean, sd = (torch.tensor(v, device=device).view(1, 3, 1, 1) for v in (MEAN, SD))
    given = [torch.from_numpy(a.astype(np.float32)).to(device)[None] for a in (poses, K)]
    # Half precision on a GPU, as upstream does; a CPU is no faster by it.
    on_gpu = device.type == "cuda"
    half = torch.bfloat16 if on_gpu and torch.cuda.is_bf16_supported() else torch.float16
    with torch.inference_mode(), torch.autocast(device.type, dtype=half, enabled=on_gpu):
        found = network(((x - mean) / sd)[None], *given)["depth"]
    return np.asarray(found.float().cpu().numpy()).reshape(images.shape[:3])
