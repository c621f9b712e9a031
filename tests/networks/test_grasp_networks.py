"""GraspNet-1Billion and FGC-GraspNet against the official modules' results, and the traps of porting them."""

from __future__ import annotations

import json
import re
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[graspnet]")

from fakes.gpu import needs_gpu  # noqa: E402
from fakes.grasp_networks import GOLDEN, NETWORKS, golden, random_weights, save, table_cloud, weights_of  # noqa: E402

from thinkgrasp.errors import ConfigError, InputError  # noqa: E402
from thinkgrasp.networks import fgc_graspnet, graspnet  # noqa: E402
from thinkgrasp.networks.checkpoint import read_checkpoint  # noqa: E402
from thinkgrasp.networks.grasp_views import approach_rotations, decoded_rows, view_directions  # noqa: E402
from thinkgrasp.networks.pointnet2 import FeaturePropagation  # noqa: E402

DOCS = Path(__file__).resolve().parents[2] / "docs" / "grasp_networks.md"
needs_golden = pytest.mark.skipif(not GOLDEN.is_dir(), reason=f"no golden data at {GOLDEN}")
HEADS = ("grasp_score_pred", "grasp_angle_cls_pred", "grasp_width_pred", "grasp_tolerance_pred", "grasp_depth_cls_pred")
SUBSETS = {
    "view_score_sub": lambda found, data: found["view_score"][data["sub_seeds"]],
    "grouped_sub": lambda found, data: found["grouped"][:, data["crop_sub_seeds"]],
    "vp_features_sub": lambda found, data: found["vp_features"][:, data["crop_sub_seeds"]],
    "att_in_sub": lambda found, data: found["att_in"][data["crop_sub_seeds"][:8]],
    "att_out_sub": lambda found, data: found["att_out"][data["crop_sub_seeds"][:8]],
    "grouped_shape": lambda found, data: np.array([1, *found["grouped"].shape]),
    "cylinder_idx": lambda found, data: found["cylinder_idx"],
}
ELSEWHERE = re.compile(
    r"w/|margin_|collision|empty_mask|nms_|voxel_|cloud|meta|sub_seeds|crop_sub_seeds|\w+_features_cols"
)
"""Inputs, and what tests/checks/ compares."""


@lru_cache(maxsize=2)
def traced(name: str) -> dict[str, np.ndarray]:
    """Run the page's snippet on the golden data; it is the call for any other set of such data as well."""
    (snippet,) = re.findall(r"```python\n(# Every named intermediate.*?)```", DOCS.read_text(), re.DOTALL)
    if name == "fgc":
        snippet = snippet.replace("graspnet import GraspNet", "fgc_graspnet import FGCGraspNet").replace(
            "GraspNet.f", "FGCGraspNet.f"
        )
    names: dict[str, object] = {"GOLDEN": str(GOLDEN / f"golden_{name}.npz")}
    exec(compile(snippet, DOCS.name, "exec"), names)
    return names["found"]  # type: ignore[return-value]


def value_of(key: str, name: str) -> np.ndarray:
    found, data = traced(name), golden(name)
    if key in SUBSETS:
        return SUBSETS[key](found, data)
    if key.endswith("_features_sub"):
        return found[key[:-4]][:, data[key[:-4] + "_cols"]]
    if key.endswith("_features_mean"):
        return found[key[:-5]].mean(axis=1)
    return found[key]


def golden_keys() -> list[tuple[str, str]]:
    return [(n, k) for n in NETWORKS for k in golden(n) if not ELSEWHERE.match(k)] if GOLDEN.is_dir() else []


@needs_golden
@pytest.mark.parametrize(("name", "key"), golden_keys())
def test_golden(name, key):
    expected, found = golden(name)[key], value_of(key, name)
    assert found.shape == expected.shape
    if expected.dtype.kind in "ib":
        assert np.array_equal(found, expected)
    else:
        tolerance = 1e-3 if key in HEADS or key == "grasps" else 2e-4
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)


@needs_golden
@pytest.mark.parametrize("name", NETWORKS)
def test_decoded_rows_are_equal(name):
    """Every row, those with an exact tie of depths included: angle, depth and so rotation are the same."""
    found, expected = traced(name)["grasps"], golden(name)["grasps"]
    assert np.array_equal(found[:, 2:], expected[:, 2:])
    np.testing.assert_allclose(found[:, :2], expected[:, :2], rtol=0, atol=1e-4)


@needs_golden
@pytest.mark.parametrize("name", NETWORKS)
def test_names_and_shapes_of_the_official_state_dict(name):
    listed = json.loads((GOLDEN / f"{name}_state_dict.json").read_text())["state_dict"]
    own = NETWORKS[name]().state_dict()
    assert list(own) == list(listed)
    assert {k: [list(v.shape), str(v.dtype)] for k, v in own.items()} == {
        k: [v["shape"], f"torch.{v['dtype']}"] for k, v in listed.items()
    }


@needs_golden
@pytest.mark.parametrize("name", NETWORKS)
def test_without_a_trace_the_graspable_seeds_come_out_the_same(name):
    data, whole = golden(name), traced(name)
    network = NETWORKS[name].from_weights(weights_of(data))
    rows = np.flatnonzero(data["graspable_mask"])
    brief = network.run(data["cloud"]).arrays()
    assert not {"grouped", "att_in", "att_out"} & set(brief)
    assert np.array_equal(brief["rows"], rows)
    assert np.array_equal(brief["grasps"][:, 2:], whole["grasps"][:, 2:])
    np.testing.assert_allclose(brief["grasps"], whole["grasps"], rtol=0, atol=1e-4)
    wanted = np.arange(len(data["cloud"])) % 3 == 0
    some = network.run(data["cloud"], wanted=wanted).arrays()
    assert np.array_equal(some["rows"], rows[wanted[data["fp2_inds"][rows]]])
    assert len(some["grasps"]) == len(some["rows"])


@needs_golden
def test_golden_views_and_rotations():
    data = golden("ops")
    for count in (300, 60):
        np.testing.assert_allclose(view_directions(count), data[f"views/{count}"], rtol=0, atol=1e-7)
    found = approach_rotations(torch.from_numpy(data["rotation/approach"]), torch.from_numpy(data["rotation/angle"]))
    np.testing.assert_allclose(found.numpy(), data["rotation/matrix"], rtol=0, atol=1e-6)


def test_the_first_view_looks_along_the_optical_axis():
    x, y, z = view_directions()[0]
    assert z < -0.99
    R = approach_rotations(-torch.tensor([[x, y, z]]), torch.zeros(1))[0].numpy()
    np.testing.assert_allclose(R[:, 0], [-x, -y, -z], atol=1e-6)
    straight = approach_rotations(torch.tensor([[0.0, 0, 1]]), torch.zeros(1))[0].numpy()
    assert straight[:, 1].tolist() == [0, 1, 0]


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_rotations_are_proper_for_any_number_of_grasps(n):
    """Three are the trap: a cross product that guesses its axis takes the wrong one."""
    rng = np.random.default_rng(n)
    approach = torch.from_numpy(rng.normal(size=(n, 3)).astype(np.float32))
    angle = torch.from_numpy(rng.uniform(0, 3, n).astype(np.float32))
    found = approach_rotations(approach, angle)
    one_by_one = torch.cat([approach_rotations(approach[i : i + 1], angle[i : i + 1]) for i in range(n)])
    torch.testing.assert_close(found, one_by_one)
    torch.testing.assert_close(found @ found.transpose(1, 2), torch.eye(3).expand(n, 3, 3))
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(n))


@pytest.mark.parametrize("name", NETWORKS)
def test_three_graspable_seeds(name):
    cloud = table_cloud(2500)
    network = NETWORKS[name].from_weights(random_weights(name))
    seeds = network.run(cloud).arrays()
    three = np.zeros(len(cloud), bool)
    three[seeds["fp2_inds"][[5, 400, 900]]] = True
    rows = network.run(cloud, wanted=three).grasps.numpy()
    assert len(rows) == 3
    np.testing.assert_allclose(rows, seeds["grasps"][[5, 400, 900]], atol=1e-4)


def test_of_equal_depths_the_smaller_wins():
    """A thing 5 mm thick: every deeper cylinder holds the same points, so all depths are equal to the last bit."""
    rng = np.random.default_rng(0)
    cloud = np.column_stack([rng.uniform(-0.1, 0.1, (3000, 2)), 0.5 + rng.uniform(0, 0.005, 3000)]).astype(np.float32)
    found = graspnet.GraspNet.from_weights(random_weights("graspnet")).run(cloud)
    same = (found.cylinder_idx[1:] == found.cylinder_idx[:1]).all(dim=2).all(dim=0)
    assert same.sum() > 20
    assert (found.grasp_score_pred[:, same] == found.grasp_score_pred[:, same][..., :1]).all()
    assert (found.depth_class[same] == 0).all()


def test_graspnet_picks_the_angle_per_depth_and_the_depth_by_raw_score():
    score, angle, width, tolerance = (torch.zeros(12, 1, 4) for _ in range(4))
    angle[3, 0, 1] = angle[7, 0, 2] = 1.0
    score[3, 0, 1], score[7, 0, 2] = 0.8, 0.9
    score[5] = 9.0  # at an angle that is not chosen
    tolerance[3, 0, 1], tolerance[7, 0, 2] = 0.05, 0.01
    width[7, 0, 2] = 0.04
    angles, depths, best = graspnet.decode(score, angle, width, tolerance)
    assert (angles.tolist(), depths.tolist()) == ([7], [2])
    torch.testing.assert_close(best, torch.tensor([[0.9 * 0.01 / 0.05, 0.04]]))


def test_fgc_picks_the_depth_by_its_classifier():
    score, angle = torch.zeros(48, 1), torch.zeros(12, 1)
    width, depth = torch.zeros(4, 1), torch.zeros(4, 1)
    angle[2], depth[1], width[1] = 1.0, 1.0, 0.05
    score[4 * 2 + 1], score[4 * 2 + 3] = 0.3, 0.9
    angles, depths, best = fgc_graspnet.decode(score, angle, width, depth)
    assert (angles.tolist(), depths.tolist()) == ([2], [1])
    torch.testing.assert_close(best, torch.tensor([[0.3, 0.05]]))


def test_a_row_opens_a_fifth_wider_within_limits_and_counts_depth_from_one():
    width = torch.tensor([-0.01, 0.05, 0.5])
    rows = decoded_rows(
        torch.tensor([-2.0, 0.5, 7.0]), width, torch.tensor([0, 2, 3]), torch.tensor([0, 6, 11]),
        torch.tensor([[0, 0, -1.0]] * 3), torch.ones(3, 3),
    )  # fmt: skip
    torch.testing.assert_close(rows[:, 0], torch.tensor([-2.0, 0.5, 7.0]))
    torch.testing.assert_close(rows[:, 1], torch.tensor([0, 0.06, 0.1]))
    torch.testing.assert_close(rows[:, 3], torch.tensor([0.01, 0.03, 0.04]))
    torch.testing.assert_close(rows[:, 4:13].view(3, 3, 3)[:, :, 0], torch.tensor([[0, 0, 1.0]] * 3))


def test_propagation_weighs_by_distance_not_its_square():
    layer = FeaturePropagation((2, 1)).eval()
    layer.mlp.layer0.conv.weight.data[:] = torch.tensor([1.0, 0.0])[None, :, None, None]
    known = torch.tensor([[1.0, 0, 0], [-2.0, 0, 0], [4.0, 0, 0]])
    with torch.inference_mode():
        out = layer(torch.zeros(1, 3), torch.zeros(1, 1), known, torch.tensor([[1.0], [2.0], [3.0]]))
    expected = (1 + 2 / 2 + 3 / 4) / (1 + 1 / 2 + 1 / 4)
    assert float(out) == pytest.approx(expected / np.sqrt(1 + 1e-5), abs=1e-5)


def test_attention_mixes_by_columns_and_padding_takes_part():
    attention = fgc_graspnet.FGCGraspNet.from_weights(random_weights("fgc")).local_att.local_att
    torch.manual_seed(0)
    group = torch.randn(32, 256) * 0.2
    group[20:] = group[0]
    with torch.inference_mode():
        query = attention.q_conv(group.T[None])[0]
        weights = torch.softmax(query.T @ query, dim=1)
        value = attention.v_conv(group.T[None])[0]
        columns = torch.stack([sum(value[:, j] * weights[j, i] for j in range(32)) for i in range(32)], dim=1)
        rows = torch.stack([sum(value[:, j] * weights[i, j] for j in range(32)) for i in range(32)], dim=1)
        expected, usual = (
            group.T + torch.relu(attention.after_norm(attention.trans_conv((group.T - y)[None])))[0]
            for y in (columns, rows)
        )
        found = attention(group[None])[0].T
        alone = attention(group[None, :20])[0].T
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)
    assert (found - usual).abs().max() > 1e-2
    assert (found[:, :20] - alone).abs().max() > 1e-2


def test_queries_and_keys_are_one_tensor(tmp_path):
    weights = random_weights("fgc")
    key, query = (f"local_att.local_att.{n}_conv.weight" for n in "kq")
    lacks = {name: value for name, value in weights.items() if name != key}
    network = fgc_graspnet.FGCGraspNet.from_weights(lacks)
    assert torch.equal(network.state_dict()[key], weights[query])
    with pytest.raises(ConfigError, match="q_conv and k_conv differ"):
        fgc_graspnet.FGCGraspNet.from_weights({**weights, key: weights[key] + 1})


@pytest.mark.parametrize(("name", "other"), [("graspnet", "fgc"), ("fgc", "graspnet")])
def test_another_networks_weights_are_refused(name, other, tmp_path):
    path = save(tmp_path / "w.tar", random_weights(other))
    with pytest.raises(ConfigError, match=r"weights of another model: \d+ of \d+ tensors are missing"):
        NETWORKS[name].from_weights(read_checkpoint(path, what=name))
    with pytest.raises(ConfigError, match="1 tensors have no place in it, among them extra"):
        NETWORKS[name].from_weights({**random_weights(name), "extra": torch.zeros(1)})
    broken = random_weights(name)
    key = next(iter(broken))
    broken[key][0] = float("nan")
    with pytest.raises(ConfigError, match=f"1 tensors hold values that are not finite, such as {key}"):
        NETWORKS[name].from_weights(broken)


ODD_CLOUDS = {
    "one point": np.array([[0.1, 0.1, 0.5]]),
    "ten points": table_cloud(10),
    "one spot": np.full((3000, 3), 0.4),
    "a plane": np.column_stack([np.random.default_rng(0).uniform(-0.2, 0.2, (3000, 2)), np.full(3000, 0.5)]),
    "a few, many times": np.repeat(table_cloud(40), 60, axis=0),
}


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("cloud", ODD_CLOUDS)
def test_odd_clouds_give_finite_rows(name, cloud):
    found = NETWORKS[name].from_weights(random_weights(name)).run(ODD_CLOUDS[cloud])
    assert found.grasps.shape == (1024, 17)
    assert torch.isfinite(found.grasps).all()


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (np.zeros((0, 3)), "at least one point"),
        (np.zeros((5, 4)), "must be"),
        (np.array([[0.1, np.nan, 0.5]]), "not finite"),
        (table_cloud(100) * 1000, "are these millimetres"),
        (table_cloud(100) / 1000, "within 3.16 cm of the origin"),
    ],
)
def test_unusable_clouds_are_named(cloud, message):
    network = graspnet.GraspNet.from_weights(random_weights("graspnet"))
    with pytest.raises(InputError, match=message):
        network.run(cloud)


def test_a_wrong_mask_is_named():
    network = fgc_graspnet.FGCGraspNet.from_weights(random_weights("fgc"))
    with pytest.raises(InputError, match=r"wanted must be \(30,\) bool"):
        network.run(table_cloud(30), wanted=np.ones(29, bool))


def test_the_same_cloud_gives_the_same_rows_and_stays_as_it_is():
    cloud = table_cloud(2500)
    cloud.flags.writeable = False
    before = cloud.copy()
    network = fgc_graspnet.FGCGraspNet.from_weights(random_weights("fgc"))
    assert torch.equal(network.run(cloud).grasps, network.run(cloud).grasps)
    assert np.array_equal(cloud, before)


@needs_gpu
@needs_golden
@pytest.mark.parametrize("name", NETWORKS)
def test_a_gpu_gives_the_same(name):
    data = golden(name)
    found = NETWORKS[name].from_weights(weights_of(data), "cuda").run(data["cloud"], trace=True).arrays()
    for key in ("sa1_inds", "sa1_ball_idx", "cylinder_idx", "grasp_top_view_inds"):
        assert np.array_equal(found[key], data[key]), key
    np.testing.assert_allclose(found["fp2_features"], data["fp2_features"], rtol=0, atol=2e-4)
    sure = data["margin_min"][data["graspable_mask"]] > 1e-4
    np.testing.assert_allclose(found["grasps"][sure], data["grasps"][sure], rtol=0, atol=1e-3)
