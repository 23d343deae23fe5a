"""ALIKED and LightGlue with the package's own weights, on photos of weakly textured tissue."""

from __future__ import annotations

import importlib
import pickle
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from specimap_core.errors import BackendUnavailableError
from specimap_core.geometry.cameras import Pose
from specimap_core.reconstruct.features.base import FeatureKind, Features
from specimap_core.reconstruct.features.choice import aliked_missing, feature_kind
from specimap_core.reconstruct.resection import Locator
from tests.support.feature_scene import Ring, angle_deg, epipolar_px, photo_of, ring

pytestmark = pytest.mark.slow

needs_aliked = pytest.mark.skipif(bool(aliked_missing()), reason="the packages of make learned are not installed")
TARGET = np.array([0.0, 0.0, 3.0])
PHOTO = 5
NEIGHBOURS = (3, 4, 6, 7)


@pytest.fixture(scope="module")
def low() -> Ring:
    return ring(texture_contrast=0.25)


@pytest.fixture(scope="module")
def aliked() -> FeatureKind:
    return feature_kind("aliked", 2)


@pytest.fixture(scope="module")
def found(low: Ring, aliked: FeatureKind) -> dict[int, Features]:
    use = (PHOTO, *NEIGHBOURS)
    return dict(zip(use, aliked.extract([low.photos[p] for p in use]), strict=True))


@needs_aliked
def test_matches_lie_on_the_true_epipolar_lines(low: Ring, aliked: FeatureKind, found: dict[int, Features]) -> None:
    beside = (4, 6)
    for other, pairs in zip(beside, aliked.match([(found[PHOTO], found[p]) for p in beside]), strict=True):
        assert len(pairs) > 100
        assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
        off = epipolar_px(
            (low.views[PHOTO], low.views[other]), (found[PHOTO].xy[pairs[:, 0]], found[other].xy[pairs[:, 1]])
        )
        # By chance one in a hundred would lie so close; noise keeps all from being exact.
        assert (off < 2).mean() > 0.8
        assert 0.02 < np.median(off) < 1


@needs_aliked
def test_features_repeat(low: Ring, aliked: FeatureKind, found: dict[int, Features]) -> None:
    (again,) = aliked.extract([low.photos[PHOTO]])
    assert np.array_equal(again.xy, found[PHOTO].xy)
    assert np.allclose(np.linalg.norm(again.descriptors, axis=1), 1, atol=1e-4)


def located(low: Ring, kind: FeatureKind, *, quarter_turns: int) -> tuple[Pose, Pose]:
    """Pose found and true pose of the photo turned clockwise in its plane."""
    photos = list(low.photos)
    photos[PHOTO] = photo_of("turned", np.ascontiguousarray(np.rot90(photos[PHOTO].image, -quarter_turns)))
    poses = {p: low.views[p].cam_from_world for p in NEIGHBOURS}
    locator = Locator(photos, low.views[0].intrinsics, poses, TARGET, 0, kind)
    answer = locator.locate(PHOTO) or locator.locate(PHOTO, turned=True)
    assert answer is not None
    roll = Pose(np.linalg.matrix_power(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), quarter_turns), np.zeros(3))
    return answer.pose, roll @ low.views[PHOTO].cam_from_world


@needs_aliked
@pytest.mark.parametrize("quarter_turns", [0, 1, 2])
def test_a_photo_is_located_however_it_was_held(low: Ring, aliked: FeatureKind, quarter_turns: int) -> None:
    pose, true = located(low, aliked, quarter_turns=quarter_turns)
    # Half a pixel at 384 pixels and a focal length of 750 is 0.04 degrees; the neighbours' places err by more.
    assert 1e-3 < angle_deg(pose, true) < 1
    assert np.linalg.norm(pose.centre - true.centre) < 3  # of 150 mm


@needs_aliked
def test_fused_attention_computes_what_the_package_does() -> None:
    torch = importlib.import_module("torch")
    fused = importlib.import_module("specimap_core.reconstruct.features.attention").FusedCross
    package = importlib.import_module("specimap_core.reconstruct.features.aliked")._package()
    block = sys.modules[package.LightGlue.__module__].CrossBlock(32, 4, True)
    rng = np.random.default_rng(0)
    x0, x1 = (torch.from_numpy(rng.standard_normal((1, n, 32)).astype(np.float32)) for n in (50, 70))
    with torch.inference_mode():
        for own, theirs, given in zip(fused(block)(x0, x1), block(x0, x1), (x0, x1), strict=True):
            assert (own - given).abs().max() > 0.01
            assert (own - theirs).abs().max() < 1e-4
        with pytest.raises(ValueError, match="mask"):
            fused(block)(x0, x1, torch.ones(1, 50, 70))


@needs_aliked
@pytest.mark.parametrize("shape", [(192, 192), (150, 203), (97, 64)])
def test_sparse_maps_give_the_keypoints_and_descriptors_of_the_package(shape: tuple[int, int]) -> None:
    """Sizes that are and are not multiples of the network's coarsest step, with the image's border in play."""
    torch = importlib.import_module("torch")
    module = importlib.import_module("specimap_core.reconstruct.features.aliked")
    whole = module._package().ALIKED(model_name=module.MODEL, max_num_keypoints=300, detection_threshold=-1).eval()
    image = cv2.GaussianBlur(np.random.default_rng(1).uniform(0, 1, (*shape, 3)).astype(np.float32), (0, 0), 1.5)
    tensor = torch.from_numpy((image - image.min()) / np.ptp(image)).permute(2, 0, 1)[None]
    with torch.inference_mode():
        theirs = whole({"image": tensor})
        xy, descriptors = module.SparseAliked(whole)(tensor)
    # Scores that are equal up to rounding may come in another order.
    gaps = (theirs["keypoints"][0][:, None] - xy[None]).abs().amax(-1)
    nearest = gaps.argmin(1)
    assert len(set(nearest.tolist())) == len(xy) == 300
    assert gaps.amin(1).max() < 1e-3
    assert 0 < (theirs["descriptors"][0] - descriptors[nearest]).abs().max() < 1e-3


@needs_aliked
def test_turning_there_and_back() -> None:
    module = importlib.import_module("specimap_core.reconstruct.features.aliked")
    xy = np.random.default_rng(0).uniform(0, 50, (20, 2))
    for turns in range(4):
        size = (80, 60) if turns % 2 else (60, 80)
        assert np.allclose(module.unturned(module.turned(xy, (60, 80), turns), size, turns), xy)
    mark = np.zeros((80, 60, 3), np.uint8)
    mark[10, 20] = 255
    row, col = np.argwhere(np.rot90(mark, -1)[..., 0])[0]
    assert module.turned(np.array([[20.0, 10.0]]), (60, 80), 1).tolist() == [[col, row]]


@needs_aliked
def test_weights_are_read_as_tensors_never_as_objects(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("specimap_core.reconstruct.features.aliked")
    package = module._package()
    trace = tmp_path / "ran"

    class Trap:
        def __reduce__(self) -> tuple[object, tuple[object, ...]]:
            return Path.touch, (trace,)

    importlib.import_module("torch").save({"weight": Trap()}, tmp_path / f"{module.MODEL}.pth")
    monkeypatch.setattr(sys.modules[package.ALIKED.__module__], "PRETRAINED_MODEL_WEIGHTS_PATH", tmp_path)
    with pytest.raises(pickle.UnpicklingError):
        package.ALIKED(model_name=module.MODEL)
    assert not trace.exists()


@needs_aliked
def test_missing_weights_are_refused_not_fetched(monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("specimap_core.reconstruct.features.aliked")
    monkeypatch.setattr(module, "WEIGHTS", ("absent.pth",))
    with pytest.raises(BackendUnavailableError, match=r"absent\.pth") as refused:
        module._networks.__wrapped__()
    assert "make learned" in refused.value.advice


def test_torch_stays_out_unless_aliked_is_asked_for() -> None:
    code = (
        "import sys; from specimap_core.reconstruct import poses; "
        "from specimap_core.reconstruct.features import choice; "
        "choice.feature_kind('sift', 1); choice.check_features('auto'); print('torch' in sys.modules)"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    assert output.stdout.strip() == "False"
