"""VLPart against the original code, piece by piece and as a whole, and the rules that the golden data does not show."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs thinkgrasp[langsam]")

from fakes.gpu import needs_gpu  # noqa: E402
from fakes.vlpart import SHARED, TINY, golden, tiny_weights  # noqa: E402
from PIL import Image  # noqa: E402

from thinkgrasp.errors import ConfigError, InputError  # noqa: E402
from thinkgrasp.networks import boxes as bx  # noqa: E402
from thinkgrasp.networks import proposals as rpn  # noqa: E402
from thinkgrasp.networks import vlpart as vp  # noqa: E402
from thinkgrasp.networks.cascade_head import BOX_WEIGHTS, TextClassifier  # noqa: E402
from thinkgrasp.networks.swin import SwinConfig  # noqa: E402
from thinkgrasp.networks.vlpart_trace import trace  # noqa: E402

PAGE = Path(__file__).resolve().parents[2] / "docs" / "vlpart.md"
VARIANTS = ["tg", "up"]
LEVELS = range(2, 7)
RGB = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)


@lru_cache(maxsize=2)
def run(prefix: str):
    """The call that docs/vlpart.md gives for any golden set."""
    golden("golden_vlpart")
    return on_the_page("run_golden")(SHARED / "golden_vlpart.npz", prefix)


def on_the_page(function: str):
    """Return a function that docs/vlpart.md defines."""
    code = next(c for c in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if f"def {function}(" in c)
    names: dict[str, object] = {}
    exec(compile(code, str(PAGE), "exec"), names)
    return names[function]


def t(g, key: str) -> torch.Tensor:
    return torch.from_numpy(g[key])


def close(got, wanted, atol: float = 1e-4, rtol: float = 1e-4) -> None:
    np.testing.assert_allclose(np.asarray(got), wanted, atol=atol, rtol=rtol)


# The whole chain, with the tolerances of the specification's section 14.


def test_the_network_sees_what_the_original_sees():
    g, meta = golden("golden_vlpart"), json.loads(str(golden("golden_vlpart")["meta_json"]))
    model, steps = run("tg")
    height, width = vp.network_size(g["image_rgb"].shape[:2], model.config)
    assert [height, width] == meta["network_hw"]
    assert list(steps["input"].shape[1:]) == meta["padded_hw"]
    resized = Image.fromarray(g["image_rgb"]).resize((width, height), Image.Resampling.BILINEAR)
    np.testing.assert_array_equal(np.asarray(resized), g["resized_rgb"])
    close(steps["input"][:, ::4, ::4], g["input_sub4"], 1e-6, 0)
    close(steps["input"][:, height - 6 : height + 6, width - 6 : width + 6], g["input_corner"], 1e-6, 0)


def test_every_map_of_the_backbone_and_of_the_proposals():
    g, (_, steps) = golden("golden_vlpart"), run("tg")
    tall, wide = steps["input"].shape[1] // 4, steps["input"].shape[2] // 4
    embedded = steps["patch_embed"].view(tall, wide, -1).permute(2, 0, 1)
    close(embedded[:, ::4, ::4], g["patch_embed_sub4"], 5e-5, 0)
    blocks = [key for key in g.files if key.startswith("swin/block")]
    assert len(blocks) == 8
    for key in blocks:
        name, every = key.split("_tok")
        close(steps[name][:: int(every)], g[key], 5e-5, 0)
    for key in (k for k in g.files if k.startswith(("swin/out", "fpn/", "rpn/"))):
        close(steps[key], g[key], 5e-5, 0)


@pytest.mark.parametrize("prefix", VARIANTS)
def test_proposals_and_stages_as_a_whole(prefix):
    g, (_, steps) = golden("golden_vlpart"), run(prefix)
    close(steps["proposals"], g[f"{prefix}/proposals"], 2e-3, 0)
    close(steps["proposal_logits"], g[f"{prefix}/proposal_logits"], 5e-5, 0)
    for k in range(3):
        np.testing.assert_array_equal(steps[f"s{k}/levels"], g[f"{prefix}/s{k}/levels"])
        close(steps[f"s{k}/boxes_in"], g[f"{prefix}/s{k}/boxes_in"], 0.05, 0)
        pooled = steps[f"s{k}/pooled"].flatten(1)
        close(pooled.mean(1), g[f"{prefix}/s{k}/pooled_mean"], 1e-3)
        close((pooled**2).mean(1), g[f"{prefix}/s{k}/pooled_sqmean"], 1e-3, 1e-3)
        for name in ("head", "cls_logits", "deltas"):
            close(steps[f"s{k}/{name}"], g[f"{prefix}/s{k}/{name}"], 5e-3, 0)
    close(steps["final_boxes_unclipped"], g[f"{prefix}/final_boxes_unclipped"], 0.05, 0)
    close(steps["final_scores_with_bg"], g[f"{prefix}/final_scores_with_bg"], 1e-3, 0)


@pytest.mark.parametrize("prefix", VARIANTS)
@pytest.mark.parametrize("kind", ["nms_all", "det"])
def test_the_same_detections_as_a_whole(prefix, kind):
    g, (_, steps) = golden("golden_vlpart"), run(prefix)
    mine = {
        (int(r), int(c)): (i, float(s))
        for i, (r, c, s) in enumerate(
            zip(steps[f"{kind}_rows"], steps[f"{kind}_classes"], steps[f"{kind}_scores"], strict=True)
        )
    }
    theirs = zip(*(g[f"{prefix}/{kind}_{part}"].tolist() for part in ("rows", "classes", "scores")), strict=True)
    wanted = {(r, c): s for r, c, s in theirs}
    assert set(mine) == set(wanted)
    for key, score in wanted.items():
        assert mine[key][1] == pytest.approx(score, abs=1e-3)
    if kind == "det":
        rows = [mine[r, c][0] for r, c in zip(g[f"{prefix}/det_rows"], g[f"{prefix}/det_classes"], strict=True)]
        close(steps["det_boxes"][rows], g[f"{prefix}/det_boxes"], 0.05, 0)
        assert sorted(steps["out_classes"].tolist()) == sorted(g[f"{prefix}/out_classes"].tolist())
        assert len(steps["out_boxes"]) == len(g[f"{prefix}/out_boxes"]) == 99


@pytest.mark.parametrize("prefix", VARIANTS)
def test_looking_once_and_asking_is_the_traced_chain(prefix):
    g, (model, steps) = golden("golden_vlpart"), run(prefix)
    found = model.detect(model.regions(g["image_rgb"]), t(g, f"text_embed_{prefix}"))
    close(found.boxes, steps["out_boxes"], 1e-3)
    close(found.scores, steps["out_scores"], 1e-5)
    assert torch.equal(found.classes, steps["out_classes"])
    close(found.boxes, g[f"{prefix}/out_boxes"], 0.05, 0)
    close(found.scores, g[f"{prefix}/out_scores"], 1e-3, 0)


@needs_gpu
@pytest.mark.parametrize("prefix", VARIANTS)
def test_a_gpu_gives_the_same(prefix):
    g, (model, _) = golden("golden_vlpart"), run(prefix)
    on_gpu = vp.load_vlpart(model.state_dict(), model.config, device="cuda")[0]
    found = on_gpu.detect(on_gpu.regions(g["image_rgb"]), t(g, f"text_embed_{prefix}").to("cuda"))
    close(found.boxes.cpu(), g[f"{prefix}/out_boxes"], 0.05, 0)
    close(found.scores.cpu(), g[f"{prefix}/out_scores"], 1e-3, 0)
    assert found.classes.tolist() == g[f"{prefix}/out_classes"].tolist()


# Piece by piece: each golden input into one piece.


def test_backbone_stages_into_the_pyramid():
    g, (model, _) = golden("golden_vlpart"), run("tg")
    with torch.no_grad():
        maps = model.backbone.merge([t(g, f"swin/out{i}")[None] for i in range(4)])
    for i, level in zip(LEVELS, maps, strict=True):
        close(level[0], g[f"fpn/p{i}"])


def test_pyramid_into_logits_and_deltas():
    g, (model, _) = golden("golden_vlpart"), run("tg")
    for i in LEVELS:
        with torch.no_grad():
            logits, deltas = model.proposal_generator["rpn_head"](t(g, f"fpn/p{i}")[None])
        close(logits[0], g[f"rpn/logits_p{i}"])
        close(deltas[0], g[f"rpn/deltas_p{i}"])


@pytest.mark.parametrize("prefix", VARIANTS)
def test_logits_and_deltas_into_proposals(prefix):
    g, (model, _) = golden("golden_vlpart"), run(prefix)
    selection, levels = model.config.selection, []
    for i, stride, size in zip(LEVELS, vp.STRIDES, vp.ANCHOR_SIZES, strict=True):
        logits, deltas = t(g, f"rpn/logits_p{i}")[None], t(g, f"rpn/deltas_p{i}")[None]
        anchors = rpn.grid_anchors((logits.shape[2], logits.shape[3]), stride, size)
        levels.append(rpn.best_of_level(logits, deltas, anchors, selection.proposals_before_nms))
    found = rpn.select(levels, (180, 285), threshold=selection.proposal_nms, limit=selection.proposals)
    close(found.boxes, g[f"{prefix}/proposals"], 1e-3)
    close(found.logits, g[f"{prefix}/proposal_logits"], 0, 0)


@pytest.mark.parametrize("prefix", VARIANTS)
@pytest.mark.parametrize("k", range(3))
def test_maps_and_boxes_into_a_stage(prefix, k):
    g, (model, _) = golden("golden_vlpart"), run(prefix)
    key = f"{prefix}/s{k}"
    with torch.no_grad():
        stage = model.roi_heads.stage(k, [t(g, f"fpn/p{i}")[None] for i in range(2, 6)], t(g, f"{key}/boxes_in"))
    np.testing.assert_array_equal(stage.levels - 2, g[f"{key}/levels"])
    close(stage.pooled.flatten(1).mean(1), g[f"{key}/pooled_mean"])
    close((stage.pooled.flatten(1) ** 2).mean(1), g[f"{key}/pooled_sqmean"])
    if prefix == "tg":
        close(stage.pooled[t(g, f"{key}/pooled_rows")], g[f"{key}/pooled"])
    close(stage.described, g[f"{key}/head"])
    close(stage.deltas, g[f"{key}/deltas"])
    close(stage.queries @ t(g, f"text_embed_{prefix}"), g[f"{key}/cls_logits"], 2e-4)
    moved = bx.decode(t(g, f"{key}/deltas"), t(g, f"{key}/boxes_in"), BOX_WEIGHTS[k])
    if k < 2:
        close(bx.clip(moved, (180, 285)), g[f"{prefix}/s{k + 1}/boxes_in"], 1e-3)
    else:
        close(moved, g[f"{prefix}/final_boxes_unclipped"], 1e-3)


@pytest.mark.parametrize("prefix", VARIANTS)
def test_logits_into_scores(prefix):
    g, (model, _) = golden("golden_vlpart"), run(prefix)
    logits = torch.stack([t(g, f"{prefix}/s{k}/cls_logits") for k in range(3)])
    objectness = t(g, f"{prefix}/proposal_logits")
    regions = vp.Regions(torch.empty(0, 4), logits, objectness, (180, 285), (118, 187))
    scores = model.scores(regions, torch.eye(logits.shape[2]))
    close(scores, g[f"{prefix}/final_scores_with_bg"], 1e-6)


@pytest.mark.parametrize("prefix", VARIANTS)
def test_scores_into_detections(prefix):
    g, (model, _) = golden("golden_vlpart"), run(prefix)
    boxes, scores = t(g, f"{prefix}/final_boxes_unclipped"), t(g, f"{prefix}/final_scores_with_bg")
    selection = model.config.selection
    best = vp.select_detections(boxes, scores, (180, 285), selection)
    every = vp.select_detections(boxes, scores, (180, 285), replace(selection, detections=scores.numel()))
    for found, kind in ((best, "det"), (every, "nms_all")):
        for name in ("scores", "classes", "rows"):
            np.testing.assert_array_equal(getattr(found, name), g[f"{prefix}/{kind}_{name}"])
    close(best.boxes, g[f"{prefix}/det_boxes"])
    original = vp.to_original(best, (180, 285), (118, 187))
    close(original.boxes, g[f"{prefix}/out_boxes"])
    close(original.scores, g[f"{prefix}/out_scores"], 0, 0)
    np.testing.assert_array_equal(original.classes, g[f"{prefix}/out_classes"])


def test_text_into_the_matrix():
    g = golden("golden_vlpart")
    features, background = t(g, "text_raw").float(), t(g, "background_raw").float()
    close(vp.text_matrix(features, background, vp.VARIANTS["paper"]), g["text_embed_tg"], 1e-6)
    close(vp.text_matrix(features, background, vp.VARIANTS["upstream"]), g["text_embed_up"], 1e-6)
    close(vp.text_matrix(features, None, vp.VARIANTS["paper"]), g["text_embed_up"], 1e-6)


# Single operations on edge cases.


def test_resizing():
    g = golden("golden_ops")
    got = [vp.network_size(tuple(hw), vp.VLPartConfig()) for hw in g["resize/in_hw"].tolist()]
    assert [list(hw) for hw in got] == g["resize/out_hw"].tolist()
    for name, short, long in (("up", 40, 70), ("down", 37, 45)):
        config = replace(TINY, short_side_px=short, long_side_px=long)
        height, width = vp.network_size(g[f"resize/{name}_in"].shape[:2], config)
        resized = Image.fromarray(g[f"resize/{name}_in"]).resize((width, height), Image.Resampling.BILINEAR)
        np.testing.assert_array_equal(np.asarray(resized), g[f"resize/{name}_out"])


def test_padding():
    g = golden("golden_ops")
    chw = g["pad/in_chw_rgb"]
    config = replace(TINY, short_side_px=chw.shape[1], long_side_px=chw.shape[2])
    image = vp.prepare(chw.transpose(1, 2, 0), config)
    close(image.pixels[0], g["pad/out"], 1e-6)
    assert image.size_hw == chw.shape[1:]


@pytest.mark.parametrize(
    ("case", "least", "limit"), [("a", 0.0, 100), ("b", 0.5, 8), ("c", 0.05, 10**9)], ids=["a", "b", "c"]
)
def test_selecting(case, least, limit):
    g = golden("golden_ops")
    boxes, scores = t(g, "select/boxes"), t(g, "select/scores")
    selection = replace(vp.VARIANTS["paper"], min_score=least, detections=limit)
    found = vp.select_detections(boxes, scores, tuple(g["select/hw"].tolist()), selection)
    finite = np.flatnonzero((torch.isfinite(boxes).all(1) & torch.isfinite(scores).all(1)).numpy())
    close(found.boxes, g[f"select/{case}_boxes"])
    np.testing.assert_array_equal(found.scores, g[f"select/{case}_scores"])
    np.testing.assert_array_equal(found.classes, g[f"select/{case}_classes"])
    np.testing.assert_array_equal(found.rows, finite[g[f"select/{case}_rows"]])


def test_back_to_the_original_image():
    g = golden("golden_ops")
    scores = torch.tensor([0.9, 0.8, 0.7, 0.6, 0.5])
    found = vp.Detections(t(g, "post/in"), scores, torch.arange(5), torch.arange(5))
    original = vp.to_original(found, (100, 120), (333, 415))
    close(original.boxes, g["post/out"])
    np.testing.assert_array_equal(original.classes, g["post/out_classes"])
    np.testing.assert_allclose(original.scores, g["post/out_scores"])


def test_classifying():
    g = golden("golden_ops")
    classifier = TextClassifier(12, 16)
    classifier.linear.load_state_dict({"weight": t(g, "cls/weight"), "bias": t(g, "cls/bias")})
    with torch.no_grad():
        close(classifier(t(g, "cls/x")) @ t(g, "cls/text"), g["cls/logits"], 1e-5, 1e-5)


# The checkpoint's names.


@pytest.fixture(scope="module")
def entries():
    path = SHARED / "vlpart_state_dict.json"
    if not path.is_file():
        pytest.skip(f"no list of the checkpoint's entries at {path}")
    return json.loads(path.read_text())


def test_names_and_shapes_are_the_checkpoints(entries):
    with torch.device("meta"):
        own = vp.VLPart(vp.VLPartConfig()).state_dict()
    assert {n: list(v.shape) for n, v in own.items()} == {n: e["shape"] for n, e in entries["needed"].items()}
    assert sum(v.numel() for v in own.values()) == entries["about"]["needed_parameters"]


def test_settings_are_the_originals(entries):
    common = entries["config"]["common"]
    assert (list(vp.MEAN_RGB), list(vp.STD_RGB)) == (common["pixel_mean"], common["pixel_std"])
    paper, upstream = vp.VARIANTS["paper"], vp.VARIANTS["upstream"]
    assert paper.proposals_before_nms == 6000
    assert paper.min_score == entries["config"]["thinkgrasp"]["score_thresh_test"]
    assert upstream.proposals_before_nms == entries["config"]["upstream"]["rpn_pre_nms_topk_test_per_level"]
    assert upstream.min_score == entries["config"]["upstream"]["score_thresh_test"]
    for selection in (paper, upstream):
        assert selection.proposals == common["rpn"]["post_nms_topk_test"]
        assert (selection.proposal_nms, selection.nms) == (common["rpn"]["nms_thresh"], common["nms_thresh_test"])
        assert selection.detections == common["detections_per_image"]
    assert [list(w) for w in BOX_WEIGHTS] == common["roi"]["bbox_reg_weights"]


# Without golden data.


@lru_cache(maxsize=2)
def tiny(variant: vp.Variant = "paper") -> vp.VLPart:
    return vp.load_vlpart(tiny_weights(), TINY.variant(variant))[0]


def texts(count: int = 3) -> torch.Tensor:
    return vp.text_matrix(torch.randn(count, TINY.text_width, generator=torch.Generator().manual_seed(5)), None, PAPER)


PAPER = vp.VARIANTS["paper"]


def test_a_missing_weight_is_refused_and_what_is_not_used_is_told():
    weights = tiny_weights()
    gone = weights.pop("roi_heads.box_predictor.2.bbox_pred.2.weight")
    with pytest.raises(ConfigError, match=r"VLPart: .* 1 of \d+ tensors are missing \(roi_heads.box_predictor.2"):
        vp.load_vlpart(weights, TINY)
    weights["roi_heads.box_predictor.2.bbox_pred.2.weight"] = gone
    weights["roi_heads.mask_head.deconv.bias"] = torch.zeros(3)
    assert vp.load_vlpart(weights, TINY)[1] == ("roi_heads.mask_head.deconv.bias",)
    with pytest.raises(ConfigError, match="another shape"):
        vp.load_vlpart(weights, replace(TINY, head_width=32))


def test_size_is_rounded_after_each_of_two_steps():
    config = vp.VLPartConfig()
    both = int(min(800 / 105, 1333 / 310) * 105 + 0.5)
    assert vp.network_size((105, 310), config)[1] == 1333
    assert abs(vp.network_size((105, 310), config)[0] - both) == 1
    assert vp.network_size((480, 640), config) == (800, 1067)
    assert vp.network_size((300, 100), config) == (1333, 444)


def test_channels_are_red_green_blue_and_the_padding_is_zero_after_normalising():
    rgb = np.zeros((50, 70, 3), np.uint8)
    rgb[..., 0] = 255
    image = vp.prepare(rgb, replace(TINY, short_side_px=50, long_side_px=70))
    assert image.pixels.shape == (1, 3, 64, 96)
    assert image.pixels[0, :, 0, 0].tolist() == pytest.approx([2.2489, -2.0357, -1.8044], abs=1e-4)
    assert not image.pixels[0, :, 50:].any()
    assert not image.pixels[0, :, :, 70:].any()


@pytest.mark.parametrize("size", [(224, 224), (480, 640), (720, 1280), (400, 90)])
@pytest.mark.parametrize("variant", ["paper", "upstream"])
def test_any_image_gives_boxes_inside_it_and_the_same_ones_twice(size, variant):
    rgb = np.random.default_rng(1).integers(0, 256, (*size, 3), dtype=np.uint8)
    model = tiny(variant)
    found, again = (model.detect(model.regions(rgb), texts()) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(found, again, strict=True))
    assert 0 < len(found.boxes) <= 100
    assert found.boxes.shape == (len(found.scores), 4)
    assert (found.boxes >= 0).all()
    assert (found.boxes <= torch.tensor([size[1], size[0], size[1], size[0]])).all()
    assert bx.has_area(found.boxes).all()
    assert ((found.scores > 0) & (found.scores < 1)).all()
    assert (found.scores.diff() <= 0).all()
    assert set(found.classes.tolist()) <= {0, 1, 2}


def test_the_pages_short_call():
    features = torch.randn(2, TINY.text_width, generator=torch.Generator().manual_seed(5))
    found = on_the_page("detect")(tiny_weights(), features, RGB, TINY)
    assert len(found.boxes) == len(found.scores) == len(found.classes) > 0


def test_a_network_that_answers_nothing_finite_finds_nothing():
    weights = tiny_weights()
    weights["proposal_generator.rpn_head.conv.bias"][:] = float("nan")
    model = vp.load_vlpart(weights, TINY)[0]
    found = model.detect(model.regions(RGB), texts())
    assert found.boxes.shape == (0, 4)
    assert len(found.scores) == 0


def test_scores_of_a_name_do_not_depend_on_the_other_names_or_on_the_background():
    model, regions = tiny(), tiny().regions(RGB)
    three, one = model.scores(regions, texts()), model.scores(regions, texts()[:, [1, 3]])
    torch.testing.assert_close(three[:, 1], one[:, 0])


def test_objectness_counts_for_upstream_only():
    regions = tiny().regions(RGB)
    plain, mixed = tiny("paper").scores(regions, texts()), tiny("upstream").scores(regions, texts())
    torch.testing.assert_close(mixed, torch.sqrt(plain * torch.sigmoid(regions.objectness)[:, None]))


def test_a_box_may_answer_to_several_names_and_empty_ones_take_places():
    boxes = torch.tensor([[0.0, 0, 10, 10], [5, 5, 5, 9], [40, 40, 60, 60]])
    scores = torch.tensor([[0.9, 0.8, 0.99], [0.7, 0.1, 0.0], [0.6, 0.05, 0.5]])
    found = vp.select_detections(boxes, scores, (50, 50), replace(PAPER, detections=4))
    assert list(zip(found.rows.tolist(), found.classes.tolist(), strict=True)) == [(0, 0), (0, 1), (1, 0), (2, 0)]
    assert found.boxes[3].tolist() == [40, 40, 50, 50]
    assert vp.to_original(found, (50, 50), (100, 100)).boxes.tolist()[-1] == [80, 80, 100, 100]
    assert vp.to_original(found, (50, 50), (100, 100)).rows.tolist() == [0, 0, 2]


def test_half_precision_is_near():
    regions = tiny().regions(RGB)
    half = vp.load_vlpart(tiny_weights(), TINY, dtype=torch.bfloat16)[0]
    assert half.dtype == torch.bfloat16
    rough = half.regions(RGB)
    assert rough.boxes.dtype == rough.queries.dtype == torch.float32
    assert len(half.detect(rough, texts()).boxes) > 0
    assert len(rough.boxes) > 0.9 * len(regions.boxes)


@needs_gpu
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_on_a_gpu_is_near(dtype):
    regions = tiny().regions(RGB)
    half = vp.load_vlpart(tiny_weights(), TINY, device="cuda", dtype=dtype)[0]
    rough = half.regions(RGB)
    assert rough.boxes.dtype == rough.queries.dtype == torch.float32
    assert len(half.detect(rough, texts().to("cuda")).boxes) > 0
    assert len(rough.boxes) > 0.9 * len(regions.boxes)


def test_tracing_names_every_step():
    steps = trace(tiny(), RGB, texts())
    assert {"input", "patch_embed", "swin/block1_1", "swin/out3", "fpn/p6", "rpn/deltas_p2", "proposals"} <= set(steps)
    assert {"s2/pooled", "final_scores_with_bg", "nms_all_rows", "det_boxes", "out_boxes"} <= set(steps)
    assert not any(module._forward_hooks for module in tiny().modules())


@pytest.mark.parametrize(
    "image",
    [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4, 3), np.float32)],
)
def test_what_is_no_image_is_refused(image):
    with pytest.raises(InputError, match="must be"):
        tiny().regions(image)
    with pytest.raises(InputError, match="too thin"):
        tiny().regions(np.zeros((1, 5000, 3), np.uint8))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replace(TINY, short_side_px=0), "sides must be"),
        (lambda: replace(TINY, short_side_px=900, long_side_px=800), "sides must be"),
        (lambda: replace(TINY, swin=SwinConfig(8, (1, 1), (1, 1))), "4 stages"),
        (lambda: replace(TINY, swin=SwinConfig(8, (1, 1, 1, 1), (3, 1, 1, 1))), "multiples of the heads"),
        (lambda: TINY.variant("theirs"), "paper, upstream"),
    ],
)
def test_bad_settings(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
