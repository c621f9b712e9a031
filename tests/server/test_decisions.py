"""What the server decides is what the command line decides, in every form a request can have."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from fakes.grasp_server import Running, json_of, npy, parts_of, png, running
from PIL import Image
from prometheus_client.parser import text_string_to_metric_families

from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.config import make_pipeline
from thinkgrasp.schema import DecisionModel, decision_to_schema
from thinkgrasp.server.app import ServerOptions
from thinkgrasp.server.client import Client
from thinkgrasp.server.schema import ExplainedDecision
from thinkgrasp.testing import sample_frame
from thinkgrasp.types import CameraIntrinsics, Frame


@pytest.fixture(scope="module")
def server():
    with running(options=ServerOptions(workers=0)) as found:
        yield found


@pytest.fixture(scope="module")
def local() -> DecisionModel:
    return decision_to_schema(make_pipeline("offline").decide(sample_frame(), "the red box"))


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[str, ...]:
    return tuple(map(str, save_frame(sample_frame(), tmp_path_factory.mktemp("frame"))))


def without_times(model: DecisionModel) -> dict:
    return json.loads(model.to_json()) | {"timings_ms": None}


def test_multipart_and_json_give_the_local_decision(server: Running, local: DecisionModel):
    frame = sample_frame()
    answers = (
        server.http.post("/v1/grasp", files=parts_of(frame)),
        server.http.post("/v1/grasp", json=json_of(frame)),
    )
    for answer in answers:
        assert answer.status_code == 200, answer.text
        assert without_times(DecisionModel.model_validate_json(answer.content)) == without_times(local)
        assert answer.headers["x-request-id"]


def test_files_may_come_as_fields_without_a_name(server: Running):
    """As some libraries send what is no file on their disk."""
    parts = parts_of(sample_frame()).items()
    body = b"".join(
        b'--b\r\nContent-Disposition: form-data; name="%s"\r\n\r\n%s\r\n' % (name.encode(), content)
        for name, (_, content, _) in parts
        if name != "depth"
    )
    mm = np.rint(sample_frame().depth * 1000).astype(np.uint16)
    body += b'--b\r\nContent-Disposition: form-data; name="depth"\r\n\r\n%s\r\n--b--\r\n' % png(mm)
    headers = {"Content-Type": "multipart/form-data; boundary=b"}
    answer = server.http.post("/v1/grasp", content=body, headers=headers)
    assert answer.status_code == 200, answer.text
    assert answer.json()["status"] == "grasp"


@pytest.mark.parametrize("depth", ["png", "tiff", "npy16", "npy32"])
def test_depth_comes_in_every_form(server: Running, depth: str):
    frame = sample_frame()
    mm = np.rint(frame.depth * 1000).astype(np.uint16)
    if depth == "tiff":
        buffer = io.BytesIO()
        Image.fromarray(frame.depth).save(buffer, "TIFF")
    data = {
        "png": lambda: png(mm),
        "tiff": lambda: buffer.getvalue(),
        "npy16": lambda: npy(mm),
        "npy32": lambda: npy(frame.depth),
    }[depth]()
    files = parts_of(frame) | {"depth": ("depth", data, "application/octet-stream")}
    answer = server.http.post("/v1/grasp", files=files)
    assert answer.status_code == 200, answer.text
    assert answer.json()["status"] == "grasp"


def test_options_are_obeyed(server: Running, local: DecisionModel):
    options = {"alternatives": 2, "mask": False, "standoff_m": 0.2, "seed": 3, "n_nearest": 1}
    answer = server.http.post("/v1/grasp", files=parts_of(sample_frame(), **options)).json()
    model = DecisionModel.model_validate(answer)
    assert len(model.alternatives) <= 2
    assert model.target is not None
    assert model.target.mask_png is None
    assert model.grasp is not None
    reach = np.subtract(model.grasp.position_m, model.grasp.pregrasp_position_m)
    assert np.linalg.norm(reach) == pytest.approx(0.2, abs=1e-5)
    again = server.http.post("/v1/grasp", files=parts_of(sample_frame()))
    assert without_times(DecisionModel.model_validate_json(again.content)) == without_times(local)


def test_the_workspace_is_obeyed(server: Running):
    frame = sample_frame()
    nowhere = np.zeros(frame.depth.shape, bool)
    nowhere[:12, :12] = True
    answer = server.http.post("/v1/grasp", files=parts_of(replace(frame, workspace=nowhere)))
    assert answer.status_code == 200, answer.text
    assert answer.json()["status"] != "grasp"


def sliver(width: int, height: int) -> Frame:
    depth = np.where(np.arange(width) < width // 2, 0.5, 0.8).astype(np.float32) * np.ones((height, 1), np.float32)
    camera = CameraIntrinsics(width, height, 300.0, 300.0, (width - 1) / 2, (height - 1) / 2)
    return Frame(np.full((height, width, 3), 90, np.uint8), depth, camera)


@pytest.mark.parametrize(("width", "height"), [(128, 8), (8, 128), (8, 8)])
def test_small_and_narrow_images_are_decided_upon(server: Running, width: int, height: int):
    answer = server.http.post("/v1/grasp", files=parts_of(sliver(width, height)))
    assert answer.status_code == 200, answer.text


def test_slivers_are_refused_here_but_are_no_bug_elsewhere(server: Running):
    answer = server.http.post("/v1/grasp", files=parts_of(sliver(8, 2000)))
    assert answer.status_code == 422
    assert "16 times the other" in answer.json()["error"]["message"]
    for size in ((8, 2000), (2000, 8)):
        assert make_pipeline("offline").decide(sliver(*size), "the red box").status == "no_target"


def test_explain_brings_the_pictures(server: Running, local: DecisionModel):
    with Client(server.url) as client:
        explained = client.explain(sample_frame(), "the red box")
    assert explained.overlay_bytes().startswith(b"\x89PNG")
    assert explained.view_html.startswith("<!doctype html>")
    assert without_times(explained.decision) == without_times(local)


@pytest.mark.parametrize("path", ["/healthz", "/readyz", "/", "/openapi.json"])
def test_probes_may_ask_for_the_headers_alone(server: Running, path: str):
    whole, head = server.http.get(path), server.http.head(path)
    assert (head.status_code, head.content) == (200, b"")
    assert head.headers["content-length"] == whole.headers["content-length"]
    assert server.http.head("/v1/grasp").status_code == 405


def test_health_readiness_metrics_and_interface(server: Running):
    get = server.http.get
    assert get("/healthz").json()["status"] == "ok"
    assert get("/readyz").json() == {"ready": True, "workers": 0, "ready_workers": 1}
    families = {f.name: f for f in text_string_to_metric_families(get("/metrics").text)}
    for name in ("thinkgrasp_http_requests", "thinkgrasp_stage_seconds", "thinkgrasp_decisions"):
        assert name in families
    (own,) = families["thinkgrasp_resident_bytes"].samples
    assert own.value > 1e7
    schema = get("/openapi.json").json()
    assert {"/v1/grasp", "/v1/explain", "/v1/episodes", "/grasp_pose"} <= set(schema["paths"])
    assert set(schema["paths"]["/v1/grasp"]["post"]["requestBody"]["content"]) == {
        "application/json",
        "multipart/form-data",
    }
    for path in ("/", "/docs"):
        page = get(path)
        assert page.headers["content-type"].startswith("text/html")
        assert "http://" not in page.text.replace("http://localhost", "")
        assert "https://" not in page.text


class TestCommand:
    """`thinkgrasp grasp --server URL` has the outputs and exit codes of a decision made here."""

    def args(self, files, instruction, *more):
        color, depth, camera = files
        return ["grasp", color, depth, instruction, "--camera", camera, *more]

    @pytest.mark.parametrize(("instruction", "code"), [("the red box", 0), ("a bicycle", 1)])
    def test_json(self, server, cli, files, instruction, code):
        here = cli(*self.args(files, instruction, "--json"))
        there = cli(*self.args(files, instruction, "--json", "--server", server.url))
        assert (there.code, there.err) == (here.code, here.err) == (code, "")
        assert json.loads(there.out) | {"timings_ms": 0} == json.loads(here.out) | {"timings_ms": 0}

    def test_summary_and_pictures(self, server, cli, files, tmp_path):
        here, there = tmp_path / "here", tmp_path / "there"
        outputs = {}
        for folder, more in ((here, ()), (there, ("--server", server.url))):
            folder.mkdir()
            pictures = ("--overlay", str(folder / "o.png"), "--view", str(folder / "v.html"))
            result = cli(*self.args(files, "the red box", *pictures, *more))
            assert result.code == 0, result.err
            outputs[folder] = result.out.partition("\ntime")[0]
        assert outputs[here] == outputs[there]
        assert (here / "o.png").read_bytes() == (there / "o.png").read_bytes()
        assert len((there / "v.html").read_text()) > 100_000

    def test_what_is_the_servers_is_refused(self, server, cli, files):
        result = cli(*self.args(files, "the red box", "--server", server.url, "--preset", "vlm"))
        assert result.code == 2
        assert "--preset is the server's to choose" in result.err

    @pytest.mark.parametrize("picture", ["", "AAAA", "=", "iVBORw0KGgo="])
    def test_a_picture_that_is_none_is_one_line(self, server, local, cli, files, tmp_path, monkeypatch, picture):
        explained = ExplainedDecision(decision=local, overlay_png=picture, view_html="")
        monkeypatch.setattr(Client, "explain", lambda *_, **__: explained)
        result = cli(*self.args(files, "the red box", "--server", server.url, "--overlay", str(tmp_path / "o.png")))
        assert result.code == 2
        assert result.err.splitlines() == [f"error: {server.url} sent an annotated picture that cannot be read"]

    def test_a_server_that_is_not_there_is_one_line(self, cli, files):
        result = cli(*self.args(files, "the red box", "--server", "http://127.0.0.1:9"))
        assert result.code == 2
        assert "cannot be reached" in result.err
        assert len(result.err.splitlines()) == 1
