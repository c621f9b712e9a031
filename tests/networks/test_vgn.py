"""The Volumetric Grasping Network gives what the published code gives, from the same weights and views."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[graspnet]")

from fakes.gpu import needs_gpu  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from thinkgrasp.errors import ConfigError, InputError  # noqa: E402
from thinkgrasp.networks import vgn  # noqa: E402
from thinkgrasp.types import CameraIntrinsics  # noqa: E402

SHARED = Path(__file__).parents[3] / "shared" / "vgn"
WEIGHTS, GOLDEN = SHARED / "vgn_conv.pth", SHARED / "golden_vgn.npz"
needs_golden = pytest.mark.skipif(not GOLDEN.is_file(), reason=f"no golden data at {GOLDEN}")
VARIANTS = ("corl2020", "devel")


@lru_cache(maxsize=1)
def golden() -> dict[str, np.ndarray]:
    with np.load(GOLDEN) as data:
        return dict(data)


@lru_cache(maxsize=1)
def network() -> vgn.Vgn:
    return vgn.load_vgn(WEIGHTS)


@lru_cache(maxsize=4)
def detection(views: str, variant: vgn.Variant) -> vgn.Detection:
    data = golden()
    fx, fy, cx, cy = (float(v) for v in data["K_fx_fy_cx_cy"])
    height, width = (int(v) for v in data["image_hw"])
    camera = CameraIntrinsics(width, height, fx, fy, cx, cy)
    return vgn.detect(network(), data[f"{views}_depth_m"], camera, data[f"{views}_T_cam_task"], variant=variant)


@needs_golden
@pytest.mark.parametrize("views", ["single", "multi"])
def test_the_field_is_the_golden_one_bit_for_bit(views):
    found = detection(views, "corl2020")
    np.testing.assert_array_equal(found.grid, golden()[f"{views}_tsdf_grid"])
    np.testing.assert_array_equal(found.weight, golden()[f"{views}_tsdf_weight"])


@needs_golden
@pytest.mark.parametrize("views", ["single", "multi"])
def test_the_network_answers_as_the_published_one(views):
    found = detection(views, "corl2020")
    np.testing.assert_allclose(found.raw.quality, golden()[f"{views}_qual_raw"], atol=1e-4)
    np.testing.assert_allclose(found.raw.rotation_xyzw, golden()[f"{views}_rot_raw"], atol=1e-4)
    np.testing.assert_allclose(found.raw.width_voxels, golden()[f"{views}_width_raw"], atol=1e-4)


@needs_golden
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("views", ["single", "multi"])
def test_the_same_voxels_are_chosen(views, variant):
    found, data, key = detection(views, variant), golden(), f"{views}_{variant}_"
    np.testing.assert_array_equal(found.valid, data[f"{views}_valid_mask"])
    np.testing.assert_allclose(found.quality, data[f"{key}qual_processed"], atol=1e-4)
    np.testing.assert_array_equal(found.voxels.index, data[f"{key}index"])
    np.testing.assert_allclose(found.voxels.score, data[f"{key}score"], atol=1e-4)
    np.testing.assert_allclose(found.voxels.width_m(), data[f"{key}width_m"], atol=1e-5)
    np.testing.assert_allclose(
        Rotation.from_quat(found.voxels.quat_xyzw).as_matrix(), data[f"{key}R_task_grasp"], atol=1e-4
    )


@needs_gpu
@needs_golden
@pytest.mark.parametrize("views", ["single", "multi"])
def test_a_gpu_gives_the_same(views):
    (found,) = vgn.predict(vgn.load_vgn(WEIGHTS, "cuda"), golden()[f"{views}_tsdf_grid"].reshape(1, 40, 40, 40))
    np.testing.assert_allclose(found.quality, golden()[f"{views}_qual_raw"], atol=1e-4)
    np.testing.assert_allclose(found.rotation_xyzw, golden()[f"{views}_rot_raw"], atol=1e-4)
    np.testing.assert_allclose(found.width_voxels, golden()[f"{views}_width_raw"], atol=1e-4)


@needs_golden
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("views", ["single", "multi"])
def test_positions_are_the_published_ones_and_centred_on_request(views, variant):
    voxels, data, key = detection(views, variant).voxels, golden(), f"{views}_{variant}_"
    np.testing.assert_allclose(voxels.position_m(centring=False), data[f"{key}position_task_m"], atol=1e-9)
    np.testing.assert_allclose(voxels.position_m(), data[f"{key}position_task_xyhalf_m"], atol=1e-9)


@needs_golden
def test_processing_the_golden_answer_alone_gives_the_golden_quality():
    data = golden()
    for views in ("single", "multi"):
        raw = vgn.Prediction(data[f"{views}_qual_raw"], data[f"{views}_rot_raw"], data[f"{views}_width_raw"])
        for variant in VARIANTS:
            quality = vgn.process_quality(data[f"{views}_tsdf_grid"], raw, variant=variant)
            np.testing.assert_allclose(quality, data[f"{views}_{variant}_qual_processed"], rtol=0, atol=1e-7)


@needs_golden
def test_the_call_that_the_page_shows_runs_as_it_stands(monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "vgn.md").read_text()
    code, _ = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(SHARED)
    names: dict[str, object] = {}
    exec(compile(code, "vgn.md", "exec"), names)
    assert len(names["voxels"].index) == 8


@needs_golden
def test_an_empty_cube_holds_no_grasp():
    grid = np.zeros((1, 40, 40, 40), np.float32)
    (raw,) = vgn.predict(network(), grid)
    assert len(vgn.select_voxels(vgn.process_quality(grid[0], raw), raw).index) == 0


def untrained(seed: int = 0) -> vgn.Vgn:
    torch.manual_seed(seed)
    return vgn.Vgn().eval()


def test_names_and_shapes_are_those_of_the_published_weights():
    shapes = {name: tuple(t.shape) for name, t in vgn.Vgn().state_dict().items()}
    assert len(shapes) == 18
    assert sum(int(np.prod(s)) for s in shapes.values()) == 313_238
    assert shapes["encoder.conv1.weight"] == (16, 1, 5, 5, 5)
    assert shapes["decoder.conv3.weight"] == (16, 32, 5, 5, 5)
    assert shapes["conv_rot.bias"] == (4,)


def test_cubes_are_answered_independently():
    rng = np.random.default_rng(0)
    grids = rng.random((3, 40, 40, 40), np.float32)
    network = untrained()
    together = vgn.predict(network, grids)
    for grid, answer in zip(grids, together, strict=True):
        (alone,) = vgn.predict(network, grid[None])
        np.testing.assert_allclose(answer.quality, alone.quality, atol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(answer.rotation_xyzw, axis=0), 1, atol=1e-5)


def test_another_shape_is_refused():
    with pytest.raises(InputError, match="cubes"):
        vgn.predict(untrained(), np.zeros((40, 40, 40), np.float32))


def test_weights_of_another_network_are_told_apart(tmp_path):
    torch.save({"conv.weight": torch.zeros(3)}, tmp_path / "other.pth")
    with pytest.raises(ConfigError, match="another model: 18 of 18 tensors are missing"):
        vgn.load_vgn(tmp_path / "other.pth")


def test_voxels_before_a_surface_are_valid_and_those_inside_are_not():
    grid = np.zeros((12, 12, 12), np.float32)
    grid[..., 3:5], grid[..., 5:8] = 0.3, 0.7
    valid = vgn.valid_voxels(grid)
    assert valid[..., 5:8].all()
    assert not valid[..., 3:5].any()
    assert valid[..., 8:10].all()
    assert not valid[..., 10:].any()


def one_peak(at: tuple[int, int, int], value: float, width: float = 5.0) -> tuple[np.ndarray, vgn.Prediction]:
    quality = np.zeros((40, 40, 40), np.float32)
    quality[at] = value
    rotation = np.zeros((4, 40, 40, 40), np.float32)
    rotation[3] = 1
    return quality, vgn.Prediction(quality, rotation, np.full((40, 40, 40), width, np.float32))


def test_the_variants_differ_at_the_threshold_and_in_the_window():
    quality, raw = one_peak((10, 10, 10), 0.90)
    assert len(vgn.select_voxels(quality, raw, variant="corl2020", threshold=float(np.float32(0.90))).index) == 1
    assert len(vgn.select_voxels(quality, raw, variant="devel", threshold=float(np.float32(0.90))).index) == 0
    quality[10, 10, 10], quality[12, 10, 10] = 0.95, 0.96
    corl, devel = (vgn.select_voxels(quality, raw, variant=v).index.tolist() for v in VARIANTS)
    assert corl == [[10, 10, 10], [12, 10, 10]]  # two voxels ahead is outside of the window, two behind is inside
    assert devel == [[10, 10, 10], [12, 10, 10]]
    quality[10, 10, 10], quality[12, 10, 10] = 0.96, 0.95
    assert vgn.select_voxels(quality, raw, variant="corl2020").index.tolist() == [[10, 10, 10]]
    assert len(vgn.select_voxels(quality, raw, variant="devel").index) == 2
    assert len(vgn.select_voxels(quality, raw, only_maxima=False).index) == 2


def test_widths_beyond_belief_count_in_the_published_code_alone():
    grid = np.full((40, 40, 40), 0.7, np.float32)
    for width, believed in ((0.5, False), (5.0, True), (9.5, False)):
        _, raw = one_peak((10, 10, 10), 1.0, width)
        assert bool(vgn.process_quality(grid, raw).max() > 0) is believed
        assert vgn.process_quality(grid, raw, variant="devel").max() > 0
