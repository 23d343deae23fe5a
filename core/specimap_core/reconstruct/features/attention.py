"""LightGlue's attention between two photos as one fused operation, which its package keeps for GPUs.

On a CPU the package forms the whole table of weights twice, once for each direction; half of a match's time goes there.
Imports torch: nothing imports this module unless ALIKED is asked for.
"""

from __future__ import annotations

from typing import Any

import torch
from torch.nn.functional import scaled_dot_product_attention

Tensor = Any


class FusedCross(torch.nn.Module):  # type: ignore[misc, unused-ignore]
    """A ``CrossBlock`` of the package with the same weights and, up to rounding, the same result."""

    def __init__(self, block: Any) -> None:
        super().__init__()
        self.block = block

    def forward(self, x0: Tensor, x1: Tensor, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """States (B, N, D) and (B, M, D) of two photos' features after each has looked at the other.

        Raises ValueError for a ``mask``, which serves compiled networks alone.
        """
        if mask is not None:
            raise ValueError("fused attention takes no mask")
        keys, values = [[self._heads(f(x)) for x in (x0, x1)] for f in (self.block.to_qk, self.block.to_v)]
        seen = (
            scaled_dot_product_attention(keys[k], keys[1 - k], values[1 - k]).transpose(1, 2).flatten(start_dim=-2)
            for k in (0, 1)
        )
        after = [
            x + self.block.ffn(torch.cat([x, self.block.to_out(message)], -1))
            for x, message in zip((x0, x1), seen, strict=True)
        ]
        return after[0], after[1]

    def _heads(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (self.block.heads, -1)).transpose(1, 2).contiguous()


def fuse_attention(matcher: Any) -> Any:
    """The package's LightGlue with fused attention, in place."""
    for layer in matcher.transformers:
        layer.cross_attn = FusedCross(layer.cross_attn)
    return matcher
