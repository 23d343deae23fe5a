"""A script for the child's process: what upstream's own image loader makes of photos, and a small network of its kind.

``request["photos"]``: files for the loader. ``request["checkpoint"]``: where to save a small network with random
weights, described and stored as the published one is.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.mast3r_torchvision import stand_in

SMALL_NETWORK = (
    "AsymmetricMASt3R(pos_embed='RoPE100', patch_embed_cls='ManyAR_PatchEmbed', img_size=(64, 64), "
    "head_type='catmlp+dpt', output_mode='pts3d+desc8', depth_mode=('exp', -inf, inf), conf_mode=('exp', 1, inf), "
    "enc_embed_dim=32, enc_depth=1, enc_num_heads=2, dec_embed_dim=32, dec_depth=10, dec_num_heads=2, "
    "two_confs=True, desc_conf_mode=('exp', 0, inf))"
)


def run(request: dict[str, Any], arrays: dict[str, Any], step: Any) -> Any:
    """Upstream's images (N, H, W, 3) from -1 to 1, or a checkpoint at the path that was given."""
    import importlib

    import torch

    from specimap_core.reconstruct.backends.mast3r import checkpoint, child

    stand_in()
    child.use_checkout(Path(request["home"]))
    model = importlib.import_module("mast3r.model")
    if "checkpoint" in request:
        torch.manual_seed(0)
        network = model.AsymmetricMASt3R(**checkpoint.network_arguments(SMALL_NETWORK))
        args = argparse.Namespace(model=SMALL_NETWORK, lr=1e-4)
        state = network.state_dict()
        torch.save({"args": args, "model": state}, request["checkpoint"])
        loaded = checkpoint.build_network(Path(request["checkpoint"]))
        same = all(torch.equal(value, state[name]) for name, value in loaded.state_dict().items())
        state.pop("decoder_embed.weight")
        torch.save({"args": args, "model": state}, request["checkpoint"] + ".part")
        return {}, {"same": same, "training": loaded.training, "tensors": len(loaded.state_dict())}
    images = importlib.import_module("dust3r.utils.image").load_images(request["photos"], size=512, square_ok=True)
    values = {f"image_{k}": image["img"][0].permute(1, 2, 0).numpy() for k, image in enumerate(images)}
    ours = {
        f"ours_{k}": next(child.pairs_of(array[None], [(0, 0)]))[0]["img"][0].permute(1, 2, 0).numpy()
        for k, array in enumerate(arrays.values())
    }
    return {**values, **ours}, {"sizes": [np.shape(v) for v in values.values()]}
