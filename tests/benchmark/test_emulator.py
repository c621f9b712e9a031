from __future__ import annotations

import base64
import http.client
import io
import json
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("mujoco", reason="needs thinkgrasp[sim]")
pytest.importorskip("trimesh", reason="needs thinkgrasp[sim]")

from fakes.cell import small_pile

from thinkgrasp.benchmark.emulator import Quality, VlmEmulator
from thinkgrasp.benchmark.perfect_model import (
    PictureTruth,
    frozen,
    view_of_picture,
    view_that_shows,
)
from thinkgrasp.benchmark.picture_answer import FROM_TRUTH
from thinkgrasp.errors import ConfigError
from thinkgrasp.sim import catalogue
from thinkgrasp.sim.render import render
from thinkgrasp.sim.scenes import PiledScene, SceneSpec
from thinkgrasp.sim.truth import true_labels, true_parts
from thinkgrasp.sim.views import CameraView
from thinkgrasp.sim.world import World
from thinkgrasp.testbed import CameraOptions, Session

NAMES = ("pear", "mug", "knife", "banana")
JSON = {"type": "json_object"}


@dataclass(frozen=True)
class Got:
    status: int
    headers: dict[str, str]
    body: dict

    @property
    def text(self) -> str:
        return self.body["choices"][0]["message"]["content"]

    @property
    def plan(self) -> dict:
        return json.loads(self.text)


def post(emulator: VlmEmulator, body: object, path: str = "/chat/completions") -> Got:
    url = urlsplit(emulator.base_url)
    assert url.hostname == "127.0.0.1"
    connection = http.client.HTTPConnection(url.hostname, url.port, timeout=20)
    raw = body if isinstance(body, bytes) else json.dumps(body).encode()
    connection.request("POST", url.path + path, raw, {"Authorization": "Bearer sk-secret"})
    reply = connection.getresponse()
    got = Got(reply.status, dict(reply.getheaders()), json.loads(reply.read()))
    connection.close()
    return got


def request(picture: np.ndarray, text: str = "give me the pear", format: dict | None = None, **image: str) -> dict:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    url = "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
    parts = [{"type": "text", "text": text}, {"type": "image_url", "image_url": {"url": url, **image}}]
    body: dict = {
        "model": "gpt-4o",
        "messages": [{"role": "system", "content": "s"}, {"role": "user", "content": parts}],
    }
    return body | ({"response_format": format} if format else {})


def picture_of(session: Session, view: CameraView | None = None) -> np.ndarray:
    world = session.world
    return render(world.model, world.data, view or session.views[0], world.visuals).color


def marked(session: Session, view: CameraView | None = None, extra: Sequence[str] = ()) -> str:
    """One mark per object in view, numbered from 1 in the order of NAMES."""
    labels = true_labels(session.world, view or session.views[0])
    lines = []
    for index in range(len(session.world.objects)):
        v, u = np.nonzero(labels == index)
        if len(u):
            box = f"{u.min()} {v.min()} {u.max() + 1} {v.max() + 1}"
            lines.append(f"mark {index + 1}: grey, 8 x 4 x 4 cm, box {box}, 4 cm high")
    return "\n".join(["give me the pear", *lines, *extra])


@pytest.fixture(scope="module")
def session() -> Session:
    return Session(small_pile(NAMES), CameraOptions(size_wh=(320, 240)))


@pytest.fixture(scope="module")
def picture(session: Session) -> np.ndarray:
    return picture_of(session)


def stacked(upper: str, lower: str, goal: int) -> Session:
    """One thing at rest on another."""
    objects = (catalogue.make(upper, 1), catalogue.make(lower, 1))
    world = World(objects, robot=False)
    low, high = objects[1].bounds_m[:, 2]
    T_low, T_high = np.eye(4), np.eye(4)
    T_low[:3, 3] = 0.5, 0.0, -low
    T_high[:3, 3] = 0.5, 0.0, high - low - objects[0].bounds_m[0, 2] + 0.002
    world.drop([(1, T_low), (0, T_high)])
    spec = SceneSpec("it", objects, (goal,), np.stack([T_high, T_low]), 0, None)
    return Session(PiledScene(spec, world.poses(), (1.0,), 1), CameraOptions(size_wh=(320, 240)))


def test_it_names_the_goal_and_says_that_it_is_an_emulator(session, picture):
    with VlmEmulator(session) as emulator:
        got = post(emulator, request(picture, marked(session), JSON))
    assert (got.status, got.body["model"], got.body["system_fingerprint"]) == (200, "emulator", "emulator")
    assert got.body["id"].startswith("emulator-")
    assert got.headers["Server"].startswith("thinkgrasp-emulator")
    plan = got.plan
    assert (plan["target"], plan["mark"], plan["role"], plan["visible"]) == ("pear", 1, "goal", True)
    assert 1 <= plan["cell"] <= 9
    assert plan["rationale"].startswith(FROM_TRUTH)
    assert plan["objects"][0]["name"] == "pear"
    usage = got.body["usage"]
    assert usage["total_tokens"] == usage["prompt_tokens"] + usage["completion_tokens"]
    served = emulator.served[0]
    assert (served.kind, served.taken, served.role) == ("right", 0, "goal")
    assert (served.prompt_tokens, served.completion_tokens) == (usage["prompt_tokens"], usage["completion_tokens"])


def test_a_picture_with_an_instruction_alone_is_answered_in_text(session, picture):
    with VlmEmulator(session) as emulator:
        got = post(emulator, request(picture))
    lines = got.text.splitlines()
    assert lines[0].startswith(f"Rationale: {FROM_TRUTH}")
    assert lines[1:3] == ["Goal visible: yes", "Selected object: pear"]
    box = tuple(map(int, re.findall(r"\d+", lines[3])))
    v, u = np.nonzero(true_labels(session.world, session.views[0]) == 0)
    assert lines[3].startswith("Cropping box: (")
    np.testing.assert_allclose(box, (u.min(), v.min(), u.max() + 1, v.max() + 1), atol=2)
    assert re.fullmatch(r"- pear: grasp score \d+, preferred cell \d", lines[5])


@pytest.mark.parametrize("size", [(320, 240), (640, 480), (224, 224), (150, 240)])
@pytest.mark.parametrize("which", [0, 1])
def test_it_knows_which_view_a_picture_shows(session, size, which):
    view = view_of_picture(session.views[which], size)
    picture = picture_of(session, view)
    picture[5:25, 5:40] = 255  # something drawn on it
    found = view_that_shows(session.world, session.views, picture)
    np.testing.assert_array_equal(found.T_world_camera, session.views[which].T_world_camera)
    assert (found.intrinsics.width, found.intrinsics.height) == size


def test_a_square_cut_out_keeps_its_pixels(session):
    full = true_labels(session.world, session.views[0])
    cut = true_labels(session.world, view_of_picture(session.views[0], (240, 240)))
    assert np.mean(full[:, 40:280] == cut) > 0.995


def test_boxes_of_a_scaled_picture_are_understood(session):
    for view in session.views:
        sent = view_of_picture(view, (640, 480))
        with VlmEmulator(session) as emulator:
            plan = post(emulator, request(picture_of(session, sent), marked(session, sent), JSON)).plan
        assert (plan["target"], plan["mark"]) == ("pear", 1)


def test_the_knife_is_held_by_its_handle():
    knife = Session(small_pile(NAMES, goals=(2,)), CameraOptions(size_wh=(320, 240)))
    with VlmEmulator(knife) as emulator:
        plan = post(emulator, request(picture_of(knife), marked(knife), JSON)).plan
        text = post(emulator, request(picture_of(knife))).text
    assert (plan["target"], plan["kind"]) == ("knife: handle", "part")
    assert "Selected object part: knife: handle" in text
    parts = true_parts(knife.world, knife.views[0], 2)
    v, u = np.nonzero(parts["handle"] | parts["blade"])
    x0, y0, x1, y1 = u.min(), v.min(), u.max() + 1, v.max() + 1
    row, column = divmod(plan["cell"] - 1, 3)
    rows = slice(round(y0 + row * (y1 - y0) / 3), round(y0 + (row + 1) * (y1 - y0) / 3))
    columns = slice(round(x0 + column * (x1 - x0) / 3), round(x0 + (column + 1) * (x1 - x0) / 3))
    assert parts["handle"][rows, columns].sum() > 5 * parts["blade"][rows, columns].sum()


def test_a_cell_that_failed_is_not_named_again(session, picture):
    with VlmEmulator(session) as emulator:
        first = post(emulator, request(picture, marked(session), JSON)).plan["cell"]
        told = marked(session, extra=[f'at mark 1: cell {first} "slipped"'])
        second = post(emulator, request(picture, told, JSON)).plan
    assert second["mark"] == 1
    assert second["cell"] != first


@pytest.mark.parametrize(("goal", "role", "way"), [(1, "obstruction", (1, 0)), (0, "goal", (0,))])
def test_what_rests_on_the_goal_goes_first(goal, role, way):
    pile = stacked("sponge", "cracker box", goal)
    with VlmEmulator(pile) as emulator:
        plan = post(emulator, request(picture_of(pile), marked(pile), JSON)).plan
    assert (plan["target"], plan["role"]) == ("sponge", role)
    assert PictureTruth(frozen(pile.world), pile.views[0], (goal,)).ways() == [way]


@pytest.mark.parametrize(
    "told",
    [
        "at mark 1: no grasp is possible until something else is moved",
        "taking pear (mark 1) was tried and failed; choose",
    ],
)
def test_a_goal_that_is_to_be_left_is_given_room(session, picture, told):
    with VlmEmulator(session) as emulator:
        plan = post(emulator, request(picture, marked(session, extra=[told]), JSON)).plan
    centers = [session.world.center(i) for i in range(len(NAMES))]
    distances = [np.linalg.norm(c - centers[0]) for c in centers[1:]]
    assert (plan["mark"], plan["role"]) == (2 + int(np.argmin(distances)), "obstruction")


def test_what_a_person_says_is_no_mark(session, picture):
    said = "<request>'mark 9: red, box 0 0 320 240'</request>"
    with VlmEmulator(session) as emulator:
        assert post(emulator, request(picture, f"{said}\n{marked(session)}", JSON)).plan["mark"] == 1


def test_what_hides_the_goal_goes_first():
    scene = small_pile(("pear", "cracker box"))
    T = scene.poses.copy()
    T[0, :3, 3], T[1, :3, 3] = (0.40, 0.0, T[0, 2, 3]), (0.52, 0.0, T[1, 2, 3])
    T[1, :3, :3] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    hidden = Session(PiledScene(scene.spec, T, (0.0,), 1), CameraOptions(size_wh=(320, 240)))
    truth = PictureTruth(frozen(hidden.world), hidden.views[0], (0,))
    with VlmEmulator(hidden) as emulator:
        plan = post(emulator, request(picture_of(hidden), marked(hidden), JSON)).plan
    assert truth.seen_share(0) < 0.6
    assert truth.hider(0) == 1
    assert (plan["target"], plan["role"], plan["visible"]) == ("cracker box", "obstruction", 0 in truth.in_view)


def test_a_copy_of_the_world_stays_as_it_was(session):
    still = frozen(session.world)
    groups = session.world.model.geom_group.copy()
    PictureTruth(still, session.views[0], session.goals).outline(0)
    np.testing.assert_array_equal(session.world.model.geom_group, groups)
    assert still.data is not session.world.data
    np.testing.assert_array_equal(still.poses(), session.world.poses())


def test_a_goal_that_is_gone_is_not_seen():
    alone = Session(small_pile(("pear", "mug")), CameraOptions(size_wh=(320, 240)))
    alone.world.park(0)
    with VlmEmulator(alone) as emulator:
        plan = post(emulator, request(picture_of(alone), marked(alone), JSON)).plan
        text = post(emulator, request(picture_of(alone))).text
    assert (plan["visible"], plan["mark"], plan["objects"]) == (False, None, [])
    assert "Selected object: none" in text


def answers(session: Session, quality: Quality, n: int, seed: int = 0, format: dict | None = JSON) -> list[Got]:
    body = json.dumps(request(picture_of(session), marked(session), format)).encode()
    with VlmEmulator(session, quality, seed=seed) as emulator:
        return [post(emulator, body) for _ in range(n)]


def test_accuracy_zero_is_always_another_thing_and_one_seed_is_one_sequence(session):
    wrong = [got.plan["mark"] for got in answers(session, Quality(accuracy=0), 8)]
    assert 1 not in wrong
    assert len(set(wrong)) > 1
    assert wrong == [got.plan["mark"] for got in answers(session, Quality(accuracy=0), 8)]
    assert wrong != [got.plan["mark"] for got in answers(session, Quality(accuracy=0), 8, seed=1)]


def test_a_wrong_answer_is_never_a_goal():
    pile = stacked("sponge", "cracker box", goal=1)  # the sponge goes first
    for got in answers(pile, Quality(accuracy=0), 3):
        assert (got.plan["visible"], got.plan["mark"]) == (False, None)


def test_half_right(session):
    marks = [got.plan["mark"] for got in answers(session, Quality(accuracy=0.5), 24)]
    assert 6 <= sum(mark == 1 for mark in marks) <= 18


def test_wrong_cells(session):
    right = answers(session, Quality(), 1)[0].plan
    for got in answers(session, Quality(wrong_cell=1), 4):
        assert (got.plan["mark"], got.plan["target"]) == (right["mark"], right["target"])
        assert got.plan["cell"] != right["cell"]


def test_a_pixel_where_one_is_asked_for(session, picture):
    words = "Grasp pixel: (<x>, <y>)"
    with VlmEmulator(session) as right, VlmEmulator(session, Quality(wrong_cell=1)) as wrong:
        good, bad = (post(emulator, request(picture, words)).text.splitlines() for emulator in (right, wrong))
    assert good[1:3] == bad[1:3] == ["Goal visible: yes", "Selected object: pear"]
    u, v = map(int, re.findall(r"\d+", good[3]))
    assert good[3] == f"Grasp pixel: ({u}, {v})"
    assert true_labels(session.world, session.views[0])[v, u] == 0
    assert bad[3] != good[3]


def test_malformed_replies_are_no_plans(session):
    texts = [got.text for got in answers(session, Quality(malformed=1), 8)]
    assert len(set(texts)) > 2
    for text in texts:
        with pytest.raises(json.JSONDecodeError):
            json.loads(text)


def test_refusals(session):
    schema = {"type": "json_schema", "json_schema": {"name": "plan", "schema": {"properties": {}}}}
    plain, structured = (
        answers(session, Quality(refusal=1), 1)[0],
        answers(session, Quality(refusal=1), 1, format=schema)[0],
    )
    assert "can't help" in plain.text
    assert structured.body["choices"][0]["message"]["content"] is None
    assert "can't help" in structured.body["choices"][0]["message"]["refusal"]


def test_rate_limit(session):
    got = answers(session, Quality(rate_limited=1, retry_after_s=2), 1)[0]
    assert (got.status, got.headers["Retry-After"]) == (429, "2")
    assert got.body["error"]["code"] == "rate_limit_exceeded"
    assert "emulator" in got.body["error"]["message"]


def test_a_delay_ends_when_the_server_does(session, picture):
    body = request(picture, marked(session), JSON)
    with VlmEmulator(session, Quality(delay_s=0.2)) as emulator:
        start = time.perf_counter()
        assert post(emulator, body).status == 200
        assert time.perf_counter() - start >= 0.2


def test_a_schema_orders_the_reply_and_chooses_its_keys(session):
    properties = {"mark": {}, "cell": {}, "target": {}}
    schema = {
        "type": "json_schema",
        "json_schema": {"name": "plan", "strict": True, "schema": {"properties": properties}},
    }
    assert list(answers(session, Quality(), 1, format=schema)[0].plan) == ["mark", "cell", "target"]


def test_a_server_without_schemas_refuses_them(session, picture):
    schema = {"type": "json_schema", "json_schema": {"name": "plan", "schema": {"properties": {}}}}
    with VlmEmulator(session, formats=("text",)) as emulator:
        got = post(emulator, request(picture, marked(session), schema))
        assert post(emulator, request(picture, marked(session))).plan["mark"] == 1
    assert got.status == 400
    assert "response_format 'json_schema' is not supported" in got.body["error"]["message"]


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (b"{", "no chat.completions request"),
        (b"[1, 2]", "no chat.completions request"),
        ({"messages": []}, "messages"),
        ({"messages": [{"role": "user", "content": "hello"}]}, "no picture"),
        ({"messages": [{"role": "user", "content": "hello"}], "stream": True}, "stream"),
        ({"messages": [{"role": "user", "content": [{"type": "audio"}]}]}, "messages.0.content"),
        ({"messages": [{"content": [{"type": "image_url", "image_url": {"url": "http://x/y.png"}}]}]}, "data URL"),
        (
            {"messages": [{"content": [{"type": "image_url", "image_url": {"url": "data:image/png;base64,AAAA"}}]}]},
            "cannot be read",
        ),
    ],
)  # fmt: skip
def test_what_is_no_request_gets_status_400(session, body, says):
    with VlmEmulator(session) as emulator:
        got = post(emulator, body)
    assert got.status == 400
    assert says in got.body["error"]["message"]
    assert emulator.served[0].kind == "bad_request"


def test_other_paths_are_not_found(session):
    with VlmEmulator(session) as emulator:
        assert post(emulator, {}, "/embeddings").status == 404


def test_image_tokens_follow_size_and_detail(session, picture):
    with VlmEmulator(session) as emulator:
        bodies = [request(picture, "it", detail=detail) for detail in ("low", "high")]
        low, high = (post(emulator, body).body["usage"]["prompt_tokens"] for body in bodies)
    assert high - low == 170


@pytest.mark.parametrize("bad", [{"accuracy": 1.2}, {"refusal": -0.1}, {"delay_s": -1}, {"malformed": float("nan")}])
def test_bad_settings_are_refused(bad):
    with pytest.raises(ConfigError, match=next(iter(bad))):
        Quality(**bad)


def test_bad_grid_is_refused(session):
    with pytest.raises(ConfigError, match="grid"):
        VlmEmulator(session, grid=0)
