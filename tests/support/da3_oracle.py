"""Scripts that stand in for the network of Depth Anything 3, and random weights for the real one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from specimap_core.geometry.cameras import View
from specimap_core.reconstruct.backends.da3.prepare import plan_preparation
from specimap_core.sandbox.process import run_child
from specimap_validation.phantom import Phantom, PhantomSettings
from tests.support.true_depth import true_depth

EDGE_PX, NOISE_PX = 1.0, 20.0
FACTS = '{"variant": "oracle", "device": "cpu", "torch": "none", "seconds": 0.0}'
RANDOM_WEIGHTS = """
import importlib
import torch
from pathlib import Path
from safetensors.torch import save_model


def run(request, arrays, step):
    torch.manual_seed(0)
    cfg = importlib.import_module("depth_anything_3.cfg")
    config = cfg.load_config(str(Path(cfg.__file__).parent / "configs" / "da3-small.yaml"))
    wrapper = torch.nn.Module()
    wrapper.model = cfg.create_object(config).half()
    save_model(wrapper, request["target"])
    return {}, {}
"""


def write_script(folder: Path, body: str, name: str = "script.py") -> Path:
    """A child script whose ``run`` has ``body``."""
    script = folder / name
    lines = "".join(f"    {line}\n" for line in body.splitlines())
    script.write_text(f"import os\nimport time\n\nimport numpy as np\n\n\ndef run(request, arrays, step):\n{lines}")
    return script


def oracle(
    folder: Path, settings: PhantomSettings, size_px: int, *, noise: float = 0.0, lost: tuple[int, ...] = ()
) -> Path:
    """A script that answers the depth of all photos as a good network would, each in a unit of its own.

    Like a network's, the depth runs smoothly over edges, and it is off by what changes slowly over the picture:
    ``noise`` is its sd, as a share. Of photos ``lost`` it knows nothing.
    """
    phantom = Phantom(settings)
    rng = np.random.default_rng(0)
    depths = []
    for k, view in enumerate(phantom.views):
        seen = View(plan_preparation(view.intrinsics, size_px).intrinsics, view.cam_from_world)
        depth = true_depth(phantom.scene, seen)
        wave = gaussian_filter(rng.standard_normal(depth.shape), NOISE_PX)
        depth = gaussian_filter(depth, EDGE_PX) * (1 + noise * wave / wave.std()) * np.exp(rng.uniform(-3, 3))
        depths.append(rng.uniform(0.5, 1.5, depth.shape) if k in lost else depth)
    np.save(folder / "depth.npy", np.stack(depths).astype(np.float32))
    return write_script(
        folder,
        f"""depth = np.load({str(folder / "depth.npy")!r})
assert arrays["images"].shape == (*depth.shape, 3)
for done, window in enumerate(request["windows"]):
    assert np.allclose(arrays["poses"][window[0]], np.eye(4))
    step("depth", (done + 1) / len(request["windows"]))
return {{"depth": depth}}, {FACTS}""",
    )


def random_weights(folder: Path, home: Path) -> Path:
    """DA3-SMALL with random weights, saved as upstream publishes it; the folder."""
    script = folder / "make_weights.py"
    script.write_text(RANDOM_WEIGHTS)
    target = folder / "model.safetensors"
    run_child(
        script,
        {"target": str(target)},
        {},
        name="weights",
        steps={},
        progress=lambda share: None,
        extra_path=[home / "src"],
    )
    return folder
