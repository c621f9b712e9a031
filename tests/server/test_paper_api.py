"""The paper's own interface: its requests, its answer, its errors."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fakes.grasp_server import Running, offline_recipe, png, running

from thinkgrasp.config import make_pipeline
from thinkgrasp.server.app import ServerOptions
from thinkgrasp.server.graspnet_pose import MAX_DEPTH_M, MIN_DEPTH_M, to_graspnet
from thinkgrasp.server.paper_api import PUBLISHED_CAMERA, PaperOptions
from thinkgrasp.sim.tabletop import demo_camera, demo_scene, render
from thinkgrasp.testing import sample_frame
from thinkgrasp.types import CameraIntrinsics

FRAME = sample_frame()
DEPTH_MM = np.rint(FRAME.depth * 1000).astype(np.uint16)
CAMERA = {n: getattr(FRAME.camera, n) for n in ("width", "height", "fx", "fy", "cx", "cy")}


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("paper")
    (folder / "image.png").write_bytes(png(FRAME.color))
    (folder / "depth.png").write_bytes(png(DEPTH_MM))
    (folder / "text.txt").write_text("the red box\n")
    return folder


@pytest.fixture(scope="module")
def server(root: Path):
    paper = PaperOptions(root, json.dumps(CAMERA).encode())
    with running(offline_recipe(), ServerOptions(workers=0, paper=paper)) as found:
        yield found


def files(**changes: bytes) -> dict[str, tuple[str, bytes, str]]:
    data = {"image": png(FRAME.color), "depth": png(DEPTH_MM), "text": b"the red box"} | changes
    return {name: (name, content, "application/octet-stream") for name, content in data.items()}


def assert_same_grasp(answer: dict) -> None:
    """The fingertips, the approach and the closing direction are those of the local decision, in the camera's frame."""
    assert set(answer) == {"xyz", "rot", "dep"}
    decision = make_pipeline("offline").decide(FRAME, "the red box")
    grasp = decision.grasp
    assert grasp is not None, (decision.status, decision.plan.rationale, decision.funnel, decision.degraded)
    xyz, rot, dep = np.array(answer["xyz"]), np.array(answer["rot"]), answer["dep"]
    np.testing.assert_allclose(rot @ rot.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rot) == pytest.approx(1)
    np.testing.assert_allclose(xyz + dep * rot[:, 0], grasp.position, atol=2e-3)
    assert rot[:, 0] @ grasp.rotation[:, 2] > 0.999
    assert abs(rot[:, 1] @ grasp.rotation[:, 0]) > 0.999
    assert MIN_DEPTH_M <= dep <= MAX_DEPTH_M


def test_uploads(server: Running):
    answer = server.http.post("/grasp_pose", files=files())
    assert answer.status_code == 200, answer.text
    assert_same_grasp(answer.json())
    assert "warning" not in answer.headers


@pytest.mark.parametrize("absolute", [False, True])
def test_paths(server: Running, root: Path, absolute: bool):
    names = {"image_path": "image.png", "depth_path": "depth.png", "text_path": "text.txt"}
    paths = {key: str(root / name) if absolute else name for key, name in names.items()}
    answer = server.http.post("/grasp_pose", json=paths)
    assert answer.status_code == 200, answer.text
    assert_same_grasp(answer.json())


def test_a_camera_with_the_request_goes_first(server: Running):
    wrong = json.dumps(CAMERA | {"width": 640, "height": 480}).encode()
    answer = server.http.post("/grasp_pose", files=files(camera=wrong))
    assert answer.status_code == 400
    assert "is for 640x480 images" in answer.json()["error"]


def test_an_empty_camera_is_not_taken_for_none(server: Running):
    answer = server.http.post("/grasp_pose", files=files(camera=b""))
    assert answer.status_code == 400
    assert "not readable JSON" in answer.json()["error"]


def test_no_grasp_is_an_error_of_the_papers_kind(server: Running):
    answer = server.http.post("/grasp_pose", files=files(text=b"a bicycle"))
    assert answer.status_code == 400
    assert set(answer.json()) == {"error"}
    assert answer.json()["error"].startswith(("no target: ", "no grasp: "))


class TestWithoutSettings:
    @pytest.fixture(scope="class")
    @classmethod
    def bare(cls):
        with running(offline_recipe(), ServerOptions(workers=0)) as found:
            yield found

    def test_paths_are_refused(self, bare: Running, root: Path):
        paths = {key: str(root / "text.txt") for key in ("image_path", "depth_path", "text_path")}
        answer = bare.http.post("/grasp_pose", json=paths)
        assert answer.status_code == 400
        assert "reads no files by path" in answer.json()["error"]

    def test_the_published_camera_is_assumed_for_its_size_and_said(self, bare: Running):
        camera = CameraIntrinsics(**PUBLISHED_CAMERA)  # type: ignore[arg-type]
        frame = render(demo_scene(0), camera, demo_camera()[1]).frame
        mm = np.rint(frame.depth * 1000).astype(np.uint16)
        answer = bare.http.post("/grasp_pose", files=files(image=png(frame.color), depth=png(mm)))
        assert answer.status_code == 200, answer.text
        assert "no camera was given" in answer.headers["warning"]
        answer = bare.http.post("/grasp_pose", files=files())
        assert answer.status_code == 400
        assert "640x480" in answer.json()["error"]


def test_the_seed_lies_on_the_surface():
    decision = make_pipeline("offline").decide(FRAME, "the red box")
    pose = to_graspnet(decision)
    assert pose is not None
    seen = decision.scene.points[np.isfinite(decision.scene.points[..., 2])]
    if MIN_DEPTH_M < pose.dep < MAX_DEPTH_M:
        local = (seen - pose.xyz) @ pose.rot
        near = local[(np.abs(local[:, 1]) < 0.04) & (np.abs(local[:, 2]) < 0.01) & (np.abs(local[:, 0]) < 0.05)]
        assert near[:, 0].min() == pytest.approx(0, abs=0.01)
