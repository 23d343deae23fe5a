"""MASt3R-SfM in the child's process: network, matching, sparse global alignment; all of it upstream's.

Upstream's modules are imported from the user's checkout; nothing of them is kept here.
"""

from __future__ import annotations

import importlib
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from specimap_core.errors import BackendUnavailableError, DepthNotFoundError, PhotosNotConnectedError
from specimap_core.sandbox.child import Step

STEPS = ("pairs", "views", "coarse", "fine")
"""What upstream's progress bars count, in their order: pairs through the network and matched, canonical views, and the
two optimisations."""
RATES = (0.07, 0.01)
"""Upstream's learning rates, coarse and fine."""


def run(
    request: dict[str, Any], arrays: dict[str, Any], step: Step
) -> tuple[dict[str, NDArray[Any]], dict[str, object]]:
    """Reconstruct.

    ``arrays["images"]`` (N, H, W, 3) uint8. Gives ``focal`` (N,), ``centre`` (N, 2), ``cam_to_world`` (N, 4, 4),
    ``depth`` and ``confidence`` (N, H, W), in network pixels and the network's unit of length.

    Raises:
        BackendUnavailableError: the device or the weights cannot be used.
        PhotosNotConnectedError, DepthNotFoundError: upstream finds no solution.
    """
    started = time.monotonic()
    use_checkout(Path(request["home"]))
    import torch

    torch.manual_seed(request["seed"])
    # Who sets this knows how busy the machine is.
    torch.set_num_threads(max(1, int(os.environ.get("OMP_NUM_THREADS") or request["threads"])))
    device = device_named(request["device"])
    sparse_ga = importlib.import_module("mast3r.cloud_opt.sparse_ga")
    step("load", 0.0)
    network = load_network(request).to(device)
    step("load", 1.0)
    loaded = time.monotonic()
    sparse_ga.tqdm = bars(step)  # type: ignore[attr-defined]
    names = [str(k) for k in range(len(arrays["images"]))]
    coarse, fine = request["schedule"]
    with TypedFailures(request["names"]):
        scene = sparse_ga.sparse_global_alignment(
            names,
            list(pairs_of(arrays["images"], request["pairs"])),
            request["folder"] + "/cache",
            network,
            subsample=request["subsample"],
            device=device,
            shared_intrinsics=True,
            opt_pp=False,
            opt_depth=True,
            matching_conf_thr=0.0,
            lr1=RATES[0],
            niter1=coarse,
            lr2=RATES[1],
            niter2=fine,
        )
        _, depth, confidence = scene.get_dense_pts3d(clean_depth=True, subsample=request["subsample"])
    shape = arrays["images"].shape[1:3]
    found = {
        "focal": _numpy(scene.get_focals()),
        "centre": _numpy(scene.get_principal_points()),
        "cam_to_world": _numpy(scene.get_im_poses()),
        "depth": np.stack([_numpy(d).reshape(shape) for d in depth]),
        "confidence": np.stack([_numpy(c).reshape(shape) for c in confidence]),
    }
    require_finite(found, request["names"])
    step("depth", 1.0)
    name = torch.cuda.get_device_name(device) if device.startswith("cuda") else "CPU"
    memory = torch.cuda.max_memory_allocated(device) if device.startswith("cuda") else 0
    facts = {
        "device": name,
        "torch": torch.__version__,
        "seconds_loading": round(loaded - started, 2),
        "seconds": round(time.monotonic() - loaded, 2),
        "device_memory_bytes": int(memory),
    }
    return found, facts


def use_checkout(home: Path) -> None:
    """Put the checkout first on the module path; it puts its submodules there itself."""
    sys.path.insert(0, str(home))


def load_network(request: dict[str, Any]) -> Any:
    """The network of the weights file."""
    from specimap_core.reconstruct.backends.mast3r.checkpoint import build_network

    return build_network(Path(request["weights"]))


def device_named(name: str) -> str:
    """A device that torch knows; ``auto`` is a GPU where there is one.

    Raises:
        BackendUnavailableError: there is no such GPU.
    """
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda"):
        number = int(name.partition(":")[2] or 0)
        if number >= torch.cuda.device_count():
            raise BackendUnavailableError(
                f"torch finds no GPU {name}.",
                advice="Set SPECIMAP_MAST3R_DEVICE to auto or cpu, or install torch with CUDA for this driver.",
                gpus=torch.cuda.device_count(),
            )
    return name


def pairs_of(images: NDArray[np.uint8], pairs: Iterable[tuple[int, int]]) -> Iterator[tuple[dict[str, Any], ...]]:
    """Pairs in both orders, as upstream's loader would give them: colours from -1 to 1, channels first."""
    import torch

    def view(k: int) -> dict[str, Any]:
        values = torch.from_numpy(np.ascontiguousarray(images[k])).permute(2, 0, 1).contiguous().to(torch.float32)
        image = values.div(255).sub(0.5).div(0.5)[None]
        return {"img": image, "true_shape": np.array([images.shape[1:3]], np.int32), "idx": k, "instance": str(k)}

    views = [view(k) for k in range(len(images))]
    chosen = [tuple(pair) for pair in pairs]
    # Each pair has dictionaries of its own: upstream writes into them.
    for i, j in [*chosen, *((b, a) for a, b in chosen)]:
        yield dict(views[i]), dict(views[j])


def bars(step: Step) -> Callable[..., Any]:
    """What stands in for upstream's progress bars and tells the parent."""
    made: list[str] = []

    class Bar:
        def __init__(self, items: Any = None, total: int | None = None, **_: object) -> None:
            self._items, self._done = items, 0
            self._total = total or (len(items) if items is not None else 1)
            self._name = STEPS[min(len(made), len(STEPS) - 1)]
            made.append(self._name)

        def __iter__(self) -> Iterator[Any]:
            for item in self._items:
                yield item
                self.update(1)

        def __enter__(self) -> Bar:
            return self

        def __exit__(self, *_: object) -> None:
            step(self._name, 1.0)

        def set_postfix_str(self, *_: object) -> None:
            return None

        def update(self, by: int = 1) -> None:
            self._done += by
            step(self._name, self._done / max(self._total, 1))

    return Bar


class TypedFailures:
    """Turn what upstream asserts, or stumbles over, into failures that say what is wrong with the photos."""

    def __init__(self, names: list[str]) -> None:
        self._names = names

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        if not isinstance(error, AssertionError | RuntimeError | ValueError | IndexError):
            return
        text = str(error)
        functions = [frame.name for frame in traceback.extract_tb(trace)]
        photo = self._photo(trace)
        if isinstance(error, AssertionError) and functions[-1] == "anchor_depth_offsets":
            raise DepthNotFoundError(
                f"MASt3R gives {photo or 'a photo'} a depth that is not positive.",
                advice="Leave that photo out, or take it again: sharp, with the specimen in view.",
                **({"photos": [photo]} if photo else {}),
            ) from error
        empty = "numel() == 0" in text or "zero-size" in text or "expected a non-empty list" in text
        if (isinstance(error, AssertionError) and functions[-1] in ("sparse_scene_optimizer", "canonical_view")) or (
            empty and any(name in functions for name in ("sparse_scene_optimizer", "condense_data", "merge_corres"))
        ):
            _unconnected([photo] if photo else [], error)

    def _photo(self, trace: Any) -> str | None:
        """The photo that upstream was at: its variable ``img``, one of our numbers."""
        for frame, _ in reversed(list(traceback.walk_tb(trace))):
            at = frame.f_locals.get("img")
            if isinstance(at, str) and at.isdigit() and int(at) < len(self._names):
                return self._names[int(at)]
        return None


def require_finite(found: dict[str, NDArray[Any]], names: list[str]) -> None:
    """Refuse an answer that is not a number.

    Raises:
        PhotosNotConnectedError: cameras are not finite: the alignment diverged.
        DepthNotFoundError: no photo has depth.
    """
    cameras = np.isfinite(found["cam_to_world"]).all((1, 2)) & np.isfinite(found["focal"]) & (found["focal"] > 0)
    if not cameras.all():
        _unconnected([names[k] for k in np.flatnonzero(~cameras)], None)
    usable = np.isfinite(found["depth"]) & (found["depth"] > 0) & np.isfinite(found["confidence"])
    if not usable.any():
        raise DepthNotFoundError(
            "MASt3R gives no photo a depth.", advice="Take sharper photos, with the specimen in the middle."
        )
    found["depth"] = np.where(usable, found["depth"], 0).astype(np.float32)
    found["confidence"] = np.where(usable, found["confidence"], 0).astype(np.float32)


def _unconnected(photos: list[str], cause: BaseException | None) -> NoReturn:
    raise PhotosNotConnectedError(
        "MASt3R cannot align the photos with each other"
        + (f"; it fails at {', '.join(photos[:5])}." if photos else "."),
        advice="Give the photos of one unmoved scene, each overlapping its neighbours; or raise SPECIMAP_MAST3R_GRAPH.",
        photos=photos,
    ) from cause


def _numpy(tensor: Any) -> NDArray[Any]:
    values: NDArray[Any] = tensor.detach().cpu().numpy()
    return values
