"""A checkpoint's text and its file: what describes a network is read, anything else is refused and never run."""

from __future__ import annotations

import argparse
import math
import os
import pickle
from pathlib import Path
from typing import Any

import pytest

from specimap_core.errors import BackendUnavailableError
from specimap_core.reconstruct.backends.mast3r.checkpoint import network_arguments, read_checkpoint

PUBLISHED = (
    "AsymmetricMASt3R(pos_embed='RoPE100', patch_embed_cls='ManyAR_PatchEmbed', img_size=(512, 512), "
    "head_type='catmlp+dpt', output_mode='pts3d+desc24', depth_mode=('exp', -inf, inf), conf_mode=('exp', 1, inf), "
    "enc_embed_dim=1024, enc_depth=24, enc_num_heads=16, dec_embed_dim=768, dec_depth=12, dec_num_heads=12, "
    "two_confs=True, desc_conf_mode=('exp', 0, inf))"
)
"""How the published checkpoint describes its network."""


def test_the_published_text_is_read() -> None:
    found = network_arguments(PUBLISHED)
    assert found["depth_mode"] == ("exp", -math.inf, math.inf)
    assert found["img_size"] == (512, 512)
    assert found["two_confs"] is True
    assert found["enc_depth"] == 24
    # As upstream changes them when it loads.
    assert found["landscape_only"] is False
    assert found["patch_embed_cls"] == "PatchEmbedDust3R"
    assert len(found) == 16


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "AsymmetricMASt3R(enc_depth=__import__('os').getpid())",
        "AsymmetricMASt3R(enc_depth=24) or 1",
        "AsymmetricMASt3R('x')",
        "AsymmetricMASt3R(**{'enc_depth': 24})",
        "AsymmetricMASt3R(enc_depth=24).cuda()",
        "AsymmetricMASt3R(enc_depth=24, enc_depth=25)",
        "AsymmetricMASt3RWithDUNEBackbone(enc_depth=24)",
        # Upstream evaluates parts of these texts once more.
        "AsymmetricMASt3R(head_type='catconv:__import__(\"os\").getpid()')",
        "AsymmetricMASt3R(patch_embed_cls='print')",
        "AsymmetricMASt3R(output_mode='pts3d')",
        "AsymmetricMASt3R(enc_depth=1000000)",
        "AsymmetricMASt3R(enc_depth=True)",
        "AsymmetricMASt3R(enc_depth=-24)",
        "AsymmetricMASt3R(img_size=(512, 10**9))",
        "AsymmetricMASt3R(depth_mode=('exp', nan, inf))",
        "AsymmetricMASt3R(unknown=1)",
        "AsymmetricMASt3R(enc_depth=",
        "(" * 3000,
        "x" * 5000,
        "",
    ],
)
def test_any_other_text_is_refused(text: str) -> None:
    with pytest.raises(BackendUnavailableError) as caught:
        network_arguments(text)
    assert caught.value.details["reason"] == "weights_unknown"


# ---- the file -----------------------------------------------------------------------------------------


class Evil:
    """Runs a command when it is unpickled."""

    def __init__(self, witness: Path) -> None:
        self.witness = witness

    def __reduce__(self) -> tuple[Any, ...]:
        return os.system, (f"touch {self.witness}",)


def save(path: Path, content: object) -> Path:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    torch.save(content, path)
    return path


def test_a_checkpoint_is_read_with_weights_only(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed")
    args = argparse.Namespace(model=PUBLISHED, lr=1e-4)
    path = save(tmp_path / "good.pth", {"args": args, "model": {"a": torch.ones(2)}, "epoch": 3})
    arguments, state = read_checkpoint(path)
    assert arguments == network_arguments(PUBLISHED)
    assert state["a"].tolist() == [1, 1]


@pytest.mark.parametrize("place", ["args", "model", "more"])
def test_code_in_a_checkpoint_is_refused_and_not_run(tmp_path: Path, place: str) -> None:
    witness = tmp_path / "witness"
    content: dict[str, object] = {"args": argparse.Namespace(model=PUBLISHED), "model": {}, place: Evil(witness)}
    with pytest.raises(BackendUnavailableError, match="holds code") as caught:
        read_checkpoint(save(tmp_path / "evil.pth", content))
    assert caught.value.details["reason"] == "weights_unsafe"
    assert caught.value.details["found"] == f"{os.system.__module__}.system"
    assert not witness.exists()


def test_a_bare_pickle_is_refused_and_not_run(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="torch is not installed")
    path, witness = tmp_path / "evil.pkl", tmp_path / "witness"
    path.write_bytes(pickle.dumps(Evil(witness)))
    with pytest.raises(BackendUnavailableError):
        read_checkpoint(path)
    assert not witness.exists()


@pytest.mark.parametrize(
    "content",
    [{"model": {}}, {"args": argparse.Namespace(), "model": {}}, {"args": argparse.Namespace(model=PUBLISHED)}, [1]],
)
def test_other_files_are_refused(tmp_path: Path, content: object) -> None:
    with pytest.raises(BackendUnavailableError) as caught:
        read_checkpoint(save(tmp_path / "other.pth", content))
    assert caught.value.details["reason"] == "weights_unknown"


@pytest.mark.parametrize("data", [b"", b"text", b"<html>not found</html>", b"PK\x03\x04 cut off"])
def test_files_that_are_none_are_refused(tmp_path: Path, data: bytes) -> None:
    pytest.importorskip("torch", reason="torch is not installed")
    path = tmp_path / "broken.pth"
    path.write_bytes(data)
    with pytest.raises(BackendUnavailableError, match="does not read") as caught:
        read_checkpoint(path)
    assert caught.value.details["reason"] == "weights_unknown"
    assert "weights_only" not in caught.value.message
