"""The closed loop over HTTP: the same memory, verification and ends as in `thinkgrasp.loop`."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from fakes.chat_server import dead_url
from fakes.grasp_server import Running, parts_of, running, told_recipe
from fakes.stages import table_frame

from thinkgrasp.config import StageConfig, load_config
from thinkgrasp.errors import ConfigError, InputError
from thinkgrasp.schema import DecisionModel
from thinkgrasp.server.app import ServerOptions
from thinkgrasp.server.client import Client
from thinkgrasp.server.decoding import FrameUpload
from thinkgrasp.server.episodes import Episodes
from thinkgrasp.server.jobs import MAX_SIGHTING_PIXELS, Settings, Sighting
from thinkgrasp.server.limits import Limits
from thinkgrasp.server.problems import RequestProblem
from thinkgrasp.server.workers import Recipe
from thinkgrasp.testing import sample_frame
from thinkgrasp.types import CameraIntrinsics, Decision, Frame, Plan, Scene, Segment, Usage

FULL, EMPTY = table_frame(), table_frame(things=False)
LIMITS = Limits(episodes=20)
NO_FILES = FrameUpload(b"", b"", b"")
PRICES = {"m": {"input": 1.0, "output": 1.0}}


@pytest.fixture(scope="module")
def server():
    with running(told_recipe(), ServerOptions(workers=0, limits=LIMITS)) as found:
        yield found


@pytest.fixture
def client(server: Running):
    with Client(server.url) as found:
        yield found


def without_red() -> Frame:
    depth = FULL.depth.copy()
    depth[:, :32] = EMPTY.depth[:, :32]
    return replace(FULL, depth=depth)


def test_a_goal_is_delivered(client: Client):
    episode = client.start_episode("red")
    assert episode.status.state == "observe"
    status = episode.observe(FULL)
    assert (status.state, status.attempts) == ("act", 0)
    assert status.decision is not None
    assert status.decision.grasp is not None
    status = episode.report(True)
    assert (status.state, status.end, status.success, status.attempts) == ("ended", "goal_delivered", True, 1)
    with pytest.raises(InputError, match="it has ended: goal_delivered"):
        episode.observe(FULL)


def test_what_failed_is_not_tried_again(client: Client):
    episode = client.start_episode("red")
    first = episode.observe(FULL).decision
    assert episode.report(False, "slipped").state == "observe"
    second = episode.observe(FULL).decision
    assert first is not None
    assert second is not None
    assert [s.check for s in first.funnel] == ["candidates", "score"]
    assert [s.check for s in second.funnel] == ["candidates", "not_failed_before", "score"]
    assert second.funnel[1].n_out < second.funnel[1].n_in


def test_a_success_that_the_next_frame_belies_counts_as_failed(client: Client):
    episode = client.start_episode("red")
    episode.observe(FULL)
    episode.report(True, delivered=False)
    status = episode.observe(FULL)
    assert status.undone
    assert status.decision is not None
    assert status.decision.funnel[1].check == "not_failed_before"

    episode = client.start_episode("red")
    episode.observe(FULL)
    episode.report(True, delivered=False)
    status = episode.observe(without_red())
    assert not status.undone


def test_a_frame_with_the_outcome_verifies_it(client: Client):
    episode = client.start_episode("red")
    episode.observe(FULL)
    status = episode.report(True, after=FULL)
    assert (status.verified, status.undone, status.state) == (False, True, "observe")
    episode.observe(FULL)
    status = episode.report(True, after=without_red())
    assert (status.verified, status.end) == (True, "goal_delivered")


@pytest.mark.parametrize("blind", ["another camera", "another pose", "no depth there"])
def test_a_frame_that_cannot_tell_verifies_nothing(client: Client, blind: str):
    pose = np.eye(4)
    first = replace(FULL, T_world_camera=pose) if blind == "another pose" else FULL
    after = {
        "another camera": lambda: replace(FULL, camera=replace(FULL.camera, fx=FULL.camera.fx + 1)),
        "another pose": lambda: replace(FULL, T_world_camera=pose + 0.1 * np.eye(4, k=3)),
        "no depth there": lambda: replace(FULL, depth=np.where(np.arange(FULL.depth.shape[1]) < 32, 0, FULL.depth)),
    }[blind]()
    episode = client.start_episode("red")
    episode.observe(first)
    status = episode.report(True, delivered=False, after=after)
    assert (status.verified, status.undone, status.state) == (None, False, "observe")
    assert episode.observe(first).undone, "the next frame can tell"


def test_one_that_is_stopped_while_it_is_decided_asks_for_nothing(client: Client, server: Running):
    episode = client.start_episode("red nap")
    with ThreadPoolExecutor(1) as threads:
        observed = threads.submit(episode.observe, FULL)
        deadline = time.monotonic() + 30
        while "thinkgrasp_requests_running 1.0" not in server.http.get("/metrics").text:
            assert time.monotonic() < deadline
        assert server.http.delete(f"/v1/episodes/{episode.status.episode}").json()["end"] == "stopped"
        status = observed.result()
    assert (status.state, status.end) == ("ended", "stopped")


def test_of_a_large_target_little_is_kept():
    size = (300, 400)
    depth = np.full(size, 0.5, np.float32)
    frame = Frame(np.zeros((*size, 3), np.uint8), depth, CameraIntrinsics(400, 300, 400.0, 400.0, 199.5, 149.5))
    target = Segment("", 1.0, np.ones(size, bool), (0, 0, 400, 300), True)
    scene = Scene(frame, np.zeros((*size, 3), np.float32))
    sighting = Sighting.of(Decision("grasp", "", scene, Plan("", ""), target))
    assert sighting is not None
    assert len(sighting.pixels) <= MAX_SIGHTING_PIXELS
    assert sighting.is_in(frame) is True
    assert sighting.is_in(replace(frame, depth=depth + 0.1)) is False


@pytest.mark.parametrize(("instruction", "end"), [("green", "nothing_left"), ("red", "no_grasp")])
def test_the_loops_other_ends(client: Client, instruction: str, end: str):
    episode = client.start_episode(instruction, step_limit=1000)
    while episode.observe(FULL).state == "act":  # until every grasp is near one that failed
        episode.report(False)
    assert (episode.status.state, episode.status.end) == ("ended", end)
    assert (episode.status.attempts > 0) == (end == "no_grasp")


def test_the_limit_of_steps(client: Client):
    episode = client.start_episode("red", step_limit=2)
    for _ in range(2):
        episode.observe(FULL)
        status = episode.report(False)
    assert (status.state, status.end) == ("ended", "step_limit")


def test_another_view_may_follow(client: Client):
    episode = client.start_episode("red")
    status = episode.observe(EMPTY, more_views=True)
    assert (status.state, status.end) == ("observe", None)
    assert status.decision is not None
    assert status.decision.status == "no_target"
    assert episode.observe(FULL).state == "act"


def test_turns_are_kept(client: Client, server: Running):
    episode = client.start_episode("red")
    with pytest.raises(InputError, match="it waits for a frame"):
        episode.report(True)
    assert server.http.get(f"/v1/episodes/{episode.status.episode}").json()["decision"] is None
    decision = episode.observe(FULL).decision
    with pytest.raises(InputError, match="it waits for the outcome"):
        episode.observe(FULL)
    looked = server.http.get(f"/v1/episodes/{episode.status.episode}").json()
    assert looked["state"] == "act"
    assert DecisionModel.model_validate(looked["decision"]) == decision, "a client whose answer was lost asks again"
    assert episode.stop().end == "stopped"
    with pytest.raises(InputError, match="no episode has this id"):
        episode.report(True)


def test_two_requests_at_once_are_told_apart(client: Client, server: Running):
    episode = client.start_episode("red nap")
    parts = {k: v for k, v in parts_of(FULL).items() if k != "instruction"}
    path = f"/v1/episodes/{episode.status.episode}/observe"
    with ThreadPoolExecutor(2) as threads:
        answers = list(threads.map(lambda _: server.http.post(path, files=parts), range(2)))
    assert sorted(a.status_code for a in answers) == [200, 409]


def test_a_bad_frame_leaves_the_episode_as_it_was(client: Client, server: Running):
    episode = client.start_episode("red")
    parts = {k: v for k, v in parts_of(FULL).items() if k != "instruction"}
    parts["depth"] = ("depth.npy", b"nonsense", "application/octet-stream")
    answer = server.http.post(f"/v1/episodes/{episode.status.episode}/observe", files=parts)
    assert answer.status_code == 422
    assert episode.observe(FULL).state == "act"


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_episodes_expire_and_are_bounded():
    clock = Clock()
    episodes = Episodes(Limits(episodes=2, episode_ttl_s=10), clock)
    first, second = episodes.create("a", 1), episodes.create("b", 1)
    assert first.id != second.id
    assert len(first.id) >= 20
    with pytest.raises(RequestProblem, match="2 episodes are open") as full:
        episodes.create("c", 1)
    assert full.value.status == 429
    assert int(full.value.headers["Retry-After"]) == 10
    clock.now = 9
    episodes.get(second.id)
    clock.now = 11
    assert len(episodes) == 1
    with pytest.raises(RequestProblem, match="after 10 s without a request") as gone:
        episodes.get(first.id)
    assert gone.value.status == 404
    assert episodes.get(second.id) is second


def test_one_that_is_being_answered_does_not_expire():
    clock = Clock()
    episodes = Episodes(Limits(episode_ttl_s=10), clock)
    episode = episodes.create("a", 1)
    with episodes.turn(episode.id, "observe"):
        clock.now = 100
        assert len(episodes) == 1
    clock.now = 109
    assert len(episodes) == 1, "its time begins with the answer"
    clock.now = 111
    assert len(episodes) == 0


@pytest.mark.parametrize(("usd", "left"), [(0.4, [1.0, 0.6, 0.2]), (None, [1.0, 0.0, 0.0])])
def test_the_budget_is_for_one_episode(usd: float | None, left: list[float]):
    told = told_recipe()
    recipe = replace(told, config=replace(told.config, planner=told.config.planner.with_setting("budget_usd", 1.0)))
    episode = Episodes(Limits()).create("red", 5)
    found = []
    for _ in range(3):
        job = episode.observe(NO_FILES, Settings(), more_views=False, budget_usd=recipe.budget_usd)
        found.append(job.budget_usd)
        episode.usage += Usage("told", 1, 1, usd, 1)
    assert found == pytest.approx(left)


def test_a_spent_budget_ends_the_episode(tmp_path):
    pytest.importorskip("openai", reason="needs thinkgrasp[vlm]")
    planner = StageConfig("openai", {"base_url": dead_url(), "prices": PRICES, "model": "m", "budget_usd": 0.0})
    recipe = Recipe(replace(load_config("offline"), planner=planner), Limits().pixels)
    with running(recipe, ServerOptions(workers=0)) as server, Client(server.url) as client:
        status = client.start_episode("the red box").observe(sample_frame())
    assert (status.state, status.end) == ("ended", "budget_spent")


def test_limits_are_checked():
    for bad in ({"queue": -1}, {"body_mb": 0}, {"episode_ttl_s": float("nan")}, {"stage_timeouts_s": {"nap": 1}}):
        with pytest.raises(ConfigError):
            Limits(**bad)  # type: ignore[arg-type]
