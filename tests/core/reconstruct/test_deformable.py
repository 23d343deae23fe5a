"""Deformable convolution in torch's own operations, and the stand-in for torchvision."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest

from specimap_core.arrays import Array, Floats

torch = pytest.importorskip("torch", reason="the packages of specimap[learned] are not installed")
deformable = importlib.import_module("specimap_core.reconstruct.features.deformable")

B, C, D, H, W = 2, 3, 4, 9, 11
ROUNDING = 2e-5
"""Sums of 27 single-precision products of size one."""


def scene(seed: int, offset_px: float) -> tuple[Array, Array, Array, Array]:
    """Input, offsets, weights and bias."""
    rng = np.random.default_rng(seed)
    shapes = (B, C, H, W), (B, 18, H, W), (D, C, 3, 3), (D,)
    x, offset, weight, bias = (rng.standard_normal(s).astype(np.float32) for s in shapes)
    return x, (offset_px * offset).astype(np.float32), weight, bias


def deformed(x: Array, offset: Array, weight: Array, bias: Array | None, **options: object) -> Floats:
    tensors = [None if a is None else torch.from_numpy(np.ascontiguousarray(a)) for a in (x, offset, weight, bias)]
    return np.asarray(deformable.deform_conv2d(*tensors, **options).numpy(), float)


def naive(x: Array, offset: Array, weight: Array, bias: Array, mask: Array) -> Floats:
    """The definition, pixel by pixel, padded by one."""
    out = np.zeros((B, D, H, W))

    def read(plane: Floats, y: float, z: float) -> Floats:
        y0, z0 = int(np.floor(y)), int(np.floor(z))
        total = np.zeros(len(plane))
        for yy, zz in ((y0, z0), (y0, z0 + 1), (y0 + 1, z0), (y0 + 1, z0 + 1)):
            if 0 <= yy < H and 0 <= zz < W:
                total += plane[:, yy, zz] * (1 - abs(y - yy)) * (1 - abs(z - zz))
        return total

    for b, i, j, tap in np.ndindex(B, H, W, 9):
        y = i - 1 + tap // 3 + offset[b, 2 * tap, i, j]
        z = j - 1 + tap % 3 + offset[b, 2 * tap + 1, i, j]
        out[b, :, i, j] += weight[:, :, tap // 3, tap % 3] @ (mask[b, tap, i, j] * read(x[b].astype(float), y, z))
    return out + bias[:, None, None]


@pytest.mark.parametrize(("stride", "padding", "dilation"), [(1, 1, 1), (2, 1, 1), (1, 2, 2), (1, 0, 1)])
def test_without_offsets_it_is_a_plain_convolution(stride: int, padding: int, dilation: int) -> None:
    x, _, weight, bias = scene(0, 0.0)
    plain = torch.nn.functional.conv2d(
        *(torch.from_numpy(a) for a in (x, weight, bias)), stride=stride, padding=padding, dilation=dilation
    ).numpy()
    offset = np.zeros((B, 18, *plain.shape[2:]), np.float32)
    found = deformed(x, offset, weight, bias, stride=stride, padding=padding, dilation=dilation)
    assert np.abs(found - plain).max() < ROUNDING


def test_whole_offsets_shift_the_input() -> None:
    x, offset, weight, bias = scene(1, 0.0)
    offset[:, 0::2], offset[:, 1::2] = 2, -1  # two down, one to the left
    found = deformed(x, offset, weight, bias, padding=(1, 1))
    moved = np.zeros_like(x)
    moved[:, :, : H - 2, 1:] = x[:, :, 2:, : W - 1]
    plain = torch.nn.functional.conv2d(*(torch.from_numpy(a) for a in (moved, weight, bias)), padding=1).numpy()
    # Pixels whose window lies within both pictures; at the border the shifted picture has lost what lies outside.
    assert np.abs(found - plain)[:, :, 1 : H - 3, 2 : W - 1].max() < ROUNDING


@pytest.mark.parametrize("offset_px", [0.4, 3.0])
def test_it_computes_the_definition(offset_px: float) -> None:
    x, offset, weight, bias = scene(2, offset_px)
    mask = np.random.default_rng(3).random((B, 9, H, W)).astype(np.float32)
    found = deformed(x, offset, weight, bias, padding=1, mask=torch.from_numpy(mask))
    assert np.abs(found - naive(x, offset, weight, bias, mask)).max() < ROUNDING


def test_several_groups_are_refused() -> None:
    x, offset, weight, _ = scene(4, 1.0)
    with pytest.raises(ValueError, match="one group"):
        deformed(x, np.concatenate([offset, offset], 1), weight, None, padding=1)


def test_the_stand_in_stays_for_its_block_only() -> None:
    before = {n for n in sys.modules if n.partition(".")[0] == "torchvision"}
    with deformable.in_torchvisions_place():
        assert importlib.import_module("torchvision").ops.deform_conv2d is deformable.deform_conv2d
        resnet = importlib.import_module("torchvision.models.resnet")
        assert tuple(resnet.conv3x3(2, 5).weight.shape) == (5, 2, 3, 3)
        assert tuple(resnet.conv1x1(2, 5).weight.shape) == (5, 2, 1, 1)
    assert {n for n in sys.modules if n.partition(".")[0] == "torchvision"} == before
