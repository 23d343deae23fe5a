"""A checkpoint of MASt3R, read without running anything that it says.

Used in the child's process. Upstream unpickles whatever the file holds and evaluates its text. Here the file is read
with ``weights_only``, and the text is parsed against a list of what a MASt3R network may be built from.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import math
import pickle
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from specimap_core.errors import BackendUnavailableError

NETWORK = "AsymmetricMASt3R"
MOST_LENGTH = 4000


def _text(pattern: str) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, str) and re.fullmatch(pattern, value) is not None


def _whole(low: int, high: int) -> Callable[[Any], bool]:
    return lambda value: type(value) is int and low <= value <= high


def _range(value: Any) -> bool:
    return (
        isinstance(value, tuple)
        and len(value) == 3
        and value[0] in ("exp", "linear", "square", "sigmoid")
        and all(type(v) in (int, float) and not math.isnan(v) for v in value[1:])
    )


def _size(value: Any) -> bool:
    return isinstance(value, tuple) and len(value) == 2 and all(_whole(16, 4096)(v) for v in value)


ALLOWED: dict[str, Callable[[Any], bool]] = {
    # Upstream evaluates some of these texts again, so each is held to its form.
    "pos_embed": _text(r"RoPE\d{1,4}"),
    "patch_embed_cls": _text("PatchEmbedDust3R|ManyAR_PatchEmbed"),
    "head_type": _text(r"catmlp\+dpt"),
    "output_mode": _text(r"pts3d\+desc\d{1,3}"),
    "desc_mode": _text("norm"),
    "freeze": _text("none|mask|encoder"),
    "img_size": _size,
    "depth_mode": _range,
    "conf_mode": _range,
    "desc_conf_mode": _range,
    "two_confs": lambda v: isinstance(v, bool),
    "landscape_only": lambda v: isinstance(v, bool),
    "norm_im2_in_dec": lambda v: isinstance(v, bool),
    "patch_size": _whole(8, 32),
    "mlp_ratio": _whole(1, 8),
    **{f"{part}_embed_dim": _whole(16, 4096) for part in ("enc", "dec")},
    **{f"{part}_depth": _whole(1, 64) for part in ("enc", "dec")},
    **{f"{part}_num_heads": _whole(1, 64) for part in ("enc", "dec")},
}
"""The network's keywords, each with what a value must be."""


def network_arguments(text: str) -> dict[str, Any]:
    """Keywords of the network from the checkpoint's text, such as ``AsymmetricMASt3R(enc_depth=24, ...)``.

    As upstream, photos of any shape go in: ``landscape_only`` is off and patches are embedded one shape at a time.

    Raises:
        BackendUnavailableError: the text is anything but a call of that network with known keywords.
    """
    if len(text) > MOST_LENGTH:
        _refuse(f"its description has {len(text)} characters")
    try:
        call = ast.parse(text, mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        _refuse("its description does not parse")
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name)) or call.func.id != NETWORK or call.args:
        _refuse(f"it does not describe a network {NETWORK}")
    found: dict[str, Any] = {}
    for keyword in call.keywords:
        name = keyword.arg or "**"
        if name not in ALLOWED or name in found:
            _refuse(f"its network has an argument {name}")
        value = _value(keyword.value)
        if not ALLOWED[name](value):
            _refuse(f"its network has {name} = {ast.unparse(keyword.value)[:100]}")
        found[name] = value
    return {**found, "landscape_only": False, "patch_embed_cls": "PatchEmbedDust3R"}


def _value(node: ast.expr) -> Any:
    match node:
        case ast.Constant(value=bool() | int() | float() | str() as value):
            return value
        case ast.Name(id="inf"):
            return math.inf
        case ast.UnaryOp(op=ast.USub(), operand=inner):
            value = _value(inner)
            return -value if type(value) in (int, float) else None
        case ast.Tuple(elts=parts):
            return tuple(_value(part) for part in parts)
    return None


def read_checkpoint(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The network's keywords and its state from a checkpoint; nothing in the file is run.

    Raises:
        BackendUnavailableError: the file does not read, holds more than tensors and plain values, or describes
            another network.
    """
    import torch

    try:
        with torch.serialization.safe_globals([argparse.Namespace]), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            stored = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        # Only the reason is taken from torch's text: the rest advises to load the file unsafely.
        code = re.search(r"GLOBAL ([\w.]+)", str(error))
        if code:
            raise BackendUnavailableError(
                f"The weights file {path.name} holds code, not only weights; it was not run.",
                advice="Get the checkpoint from its publisher.",
                reason="weights_unsafe",
                found=code[1][:300],
            ) from error
        reason = str(error).partition("WeightsUnpickler error:")[2].strip().partition("\n")[0]
        _refuse(f"it does not read ({(reason or type(error).__name__)[:200]})", error)
    except Exception as error:
        # Not a list of types: on a file that is no checkpoint the reader raises anything, IndexError included.
        _refuse(f"it does not read ({type(error).__name__}: {str(error)[:200]})", error)
    if not isinstance(stored, dict) or not isinstance(stored.get("model"), dict):
        _refuse("it holds no network's state")
    text = getattr(stored.get("args"), "model", None)
    if not isinstance(text, str):
        _refuse("it does not say how its network is built")
    return network_arguments(text), stored["model"]


def build_network(path: Path) -> Any:
    """The network of a checkpoint, on the CPU, ready to predict; upstream must be importable.

    Raises:
        BackendUnavailableError: see :func:`read_checkpoint`; or the weights do not fit the network.
    """
    arguments, state = read_checkpoint(path)
    network = importlib.import_module("mast3r.model").AsymmetricMASt3R(**arguments)
    try:
        network.load_state_dict(state, strict=True)
    except RuntimeError as error:
        _refuse(f"its weights do not fit its network ({' '.join(str(error).split())[:300]})", error)
    return network.eval()


def _refuse(why: str, cause: BaseException | None = None) -> NoReturn:
    raise BackendUnavailableError(
        f"The weights file is no checkpoint of MASt3R that Specimap reads: {why}.",
        advice="Give MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth, or one trained with the same network.",
        reason="weights_unknown",
    ) from cause
