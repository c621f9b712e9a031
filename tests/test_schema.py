"""The published JSON: its keys, its frames, and one example pinned in tests/golden."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fakes.stages import fake_pipeline, table_frame
from pydantic import ValidationError

from thinkgrasp import __version__
from thinkgrasp.errors import InputError
from thinkgrasp.geometry import rotation_from_quat_wxyz
from thinkgrasp.schema import DecisionModel, decision_json_schema, decision_to_schema, mask_from_png, mask_to_png
from thinkgrasp.types import Decision, Degradation, Grasp, Plan, PlannedObject, Usage

GOLDEN = Path(__file__).parent / "golden" / "decision.json"
T_WORLD_CAMERA = np.array([[0, -1, 0, 0.1], [-1, 0, 0, 0.2], [0, 0, -1, 0.9], [0, 0, 0, 1.0]])

KEYS = {
    "": "schema status instruction degraded plan target preferred_point_m grasp alternatives funnel timings_ms usage "
    "version",
    "plan": "target kind role mark grid cell crop_xyxy objects rationale",
    "target": "label score box_xyxy mask_png touches_border",
    "grasp": "frame position_m quat_wxyz rotation width_m score pregrasp_position_m convention",
    "timings_ms": "scene plan segment generate check select total",
    "usage": "model prompt_tokens completion_tokens usd requests",
}


def example(T_world_camera: np.ndarray | None = T_WORLD_CAMERA, instruction: str = "the red block") -> Decision:
    """A decision of the fake stages with every field filled and fixed times."""
    decision = fake_pipeline().decide(table_frame(T_world_camera=T_world_camera), instruction)
    plan = replace(
        decision.plan,
        crop_xyxy=(8, 16, 24, 32),
        objects=(PlannedObject("red block", 80.0, 5), PlannedObject("blue block", 20.0)),
        usage=Usage("gpt-4o", 1200, 80, 0.0041, 1),
    )
    timings = tuple((name, 1.5 * i) for i, (name, _) in enumerate(decision.timings_ms, 1))
    degraded = (Degradation("plan", "no answer within 30 s", "offline planner"),)
    return replace(decision, plan=plan, timings_ms=timings, degraded=degraded)


def published(decision: Decision) -> dict:
    return json.loads(decision_to_schema(decision).to_json())


def test_golden_example():
    text = decision_to_schema(example()).to_json(indent=2)
    got, expected = json.loads(text), json.loads(GOLDEN.read_text())
    assert got.pop("version") == __version__
    del expected["version"]
    got_mask, expected_mask = (mask_from_png(d["target"].pop("mask_png")) for d in (got, expected))
    assert np.array_equal(got_mask, expected_mask)
    assert got == expected


@pytest.mark.parametrize("part", KEYS)
def test_keys_are_the_designs(part):
    data = published(example())
    assert list(data[part] if part else data) == KEYS[part].split()


def test_keys_of_lists():
    data = published(example())
    assert list(data["funnel"][0]) == ["check", "in", "out"]
    assert list(data["degraded"][0]) == ["stage", "reason", "fallback"]
    assert list(data["plan"]["objects"][0]) == ["name", "grasp_score", "cell"]
    assert list(data["alternatives"][0]) == KEYS["grasp"].split()


def test_round_trip():
    model = decision_to_schema(example())
    assert DecisionModel.model_validate_json(model.to_json()) == model


def test_nothing_found_is_nulls_and_zeros():
    decision = fake_pipeline().decide(table_frame(), "the green block")
    data = published(decision)
    assert data["status"] == "no_target"
    assert (data["target"], data["grasp"], data["preferred_point_m"]) == (None, None, None)
    assert (data["alternatives"], data["funnel"]) == ([], [])
    assert list(data["timings_ms"]) == KEYS["timings_ms"].split()
    assert data["timings_ms"]["select"] == 0.0
    assert data["timings_ms"]["total"] > 0


class TestFrames:
    def test_camera_frame_without_pose(self):
        decision = example(None)
        data = published(decision)["grasp"]
        assert data["frame"] == "camera"
        assert np.allclose(data["position_m"], decision.grasp.position, atol=1e-6)
        assert np.allclose(data["rotation"], decision.grasp.rotation)

    def test_world_frame_with_pose(self):
        decision = example()
        data = published(decision)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = decision.grasp.rotation, decision.grasp.position
        T_world_grasp = T_WORLD_CAMERA @ T
        grasp = data["grasp"]
        assert grasp["frame"] == "world"
        assert np.allclose(grasp["position_m"], T_world_grasp[:3, 3], atol=1e-6)
        assert np.allclose(grasp["rotation"], T_world_grasp[:3, :3], atol=1e-8)
        assert np.allclose(rotation_from_quat_wxyz(grasp["quat_wxyz"]), T_world_grasp[:3, :3], atol=1e-7)
        p = np.array([*decision.preferred_point, 1])
        assert np.allclose(data["preferred_point_m"], (T_WORLD_CAMERA @ p)[:3], atol=1e-6)

    @pytest.mark.parametrize("T", [None, T_WORLD_CAMERA])
    @pytest.mark.parametrize("standoff", [0.0, 0.1, 0.25])
    def test_pregrasp_lies_back_along_the_approach(self, T, standoff):
        grasp = decision_to_schema(example(T), standoff_m=standoff).grasp
        approach = np.array(grasp.rotation)[:, 2]
        assert np.allclose(np.array(grasp.position_m) - standoff * approach, grasp.pregrasp_position_m, atol=2e-6)


def test_at_most_ten_alternatives():
    decision = example()
    many = replace(decision, alternatives=decision.alternatives * 3)
    assert len(published(many)["alternatives"]) == 10


def test_numpy_numbers_and_float_noise_are_published_plainly():
    decision = example()
    noisy = Grasp(decision.grasp.rotation, decision.grasp.position, np.float32(0.05), np.float32(1.0000001))
    target = replace(decision.target, score=np.float32(0.5), box_xyxy=tuple(np.array([8, 16, 24, 32])))
    data = published(replace(decision, grasp=noisy, target=target))
    assert data["grasp"]["score"] == 1.0
    assert data["grasp"]["width_m"] == 0.05
    assert data["target"]["box_xyxy"] == [8, 16, 24, 32]


def test_a_score_out_of_range_is_refused():
    decision = example()
    with pytest.raises(ValidationError, match="score"):
        decision_to_schema(replace(decision, grasp=replace(decision.grasp, score=1.2)))


def test_unknown_keys_are_refused():
    with pytest.raises(ValidationError, match="surprise"):
        DecisionModel.model_validate(published(example()) | {"surprise": 1})


class TestMask:
    def test_round_trip(self):
        mask = np.random.default_rng(0).random((37, 53)) < 0.4
        assert np.array_equal(mask_from_png(mask_to_png(mask)), mask)

    def test_left_out_on_request(self):
        model = decision_to_schema(example(), with_mask=False)
        assert model.target is not None
        assert model.target.mask_png is None

    @pytest.mark.parametrize("text", ["", "no base64!", "aGVsbG8="])
    def test_what_is_no_mask(self, text):
        with pytest.raises(InputError, match="not a PNG in base64"):
            mask_from_png(text)


def test_json_schema_has_the_published_names():
    schema = decision_json_schema()
    assert schema["properties"]["schema"]["const"] == "thinkgrasp/decision-1"
    assert set(schema["properties"]) == set(KEYS[""].split())
    assert set(schema["$defs"]["FunnelModel"]["properties"]) == {"check", "in", "out"}


def test_plan_without_mark():
    decision = replace(example(), plan=Plan("mug", "because"))
    assert published(decision)["plan"]["mark"] is None
