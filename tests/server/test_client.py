"""The clients: what they send arrives as it was, and what can go wrong has a name."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import replace

import httpx
import numpy as np
import pytest
from fakes.grasp_server import TOKEN, Running, running, told_recipe
from fakes.stages import table_frame

from thinkgrasp.errors import ConfigError, InputError, ServerError
from thinkgrasp.server import client as client_module
from thinkgrasp.server.app import ServerOptions
from thinkgrasp.server.calls import frame_parts
from thinkgrasp.server.client import AsyncClient, AsyncRemoteEpisode, Client, RemoteEpisode
from thinkgrasp.server.decoding import FrameUpload, decode_frame
from thinkgrasp.testing import sample_frame

FRAME = table_frame()


@pytest.fixture(scope="module")
def server():
    with running(told_recipe(), ServerOptions(workers=0, token=TOKEN)) as found:
        yield found


def test_a_frame_arrives_as_it_was():
    frame = sample_frame(dropout=0.1)
    workspace = np.zeros(frame.depth.shape, bool)
    workspace[50:200, 30:300] = True
    depth = frame.depth.copy()
    depth[0, :9] = np.nan
    sent = replace(frame, workspace=workspace, depth=depth)
    parts = {name: content for name, (_, content, _) in frame_parts(sent, {}).items()}
    upload = FrameUpload(parts["color"], parts["depth"], parts["camera"], parts["workspace"])
    got = decode_frame(upload, 10**6)
    np.testing.assert_array_equal(got.color, frame.color)
    np.testing.assert_array_equal(got.depth, np.nan_to_num(depth))
    np.testing.assert_array_equal(got.workspace, workspace)
    np.testing.assert_allclose(got.T_world_camera, frame.T_world_camera, atol=0)
    assert got.camera == frame.camera


def test_both_clients_give_the_same(server: Running):
    with Client(server.url, token=TOKEN) as client:
        assert client.is_ready()
        client.wait_until_ready(1)
        here = client.grasp(FRAME, "red", seed=3)
        episode = client.start_episode("red")
        assert episode.observe(FRAME, seed=3).decision is not None
        assert episode.report(True, "held", delivered=False).attempts == 1

    async def ask() -> tuple:
        async with AsyncClient(server.url, token=TOKEN) as client:
            assert await client.is_ready()
            await client.wait_until_ready(1)
            decision, explained = await asyncio.gather(
                client.grasp(FRAME, "red", seed=3), client.explain(FRAME, "red", seed=3)
            )
            episode = await client.start_episode("red", step_limit=2)
            await episode.observe(FRAME)
            await episode.report(True, after=FRAME)
            return decision, explained, await episode.stop()

    there, explained, episode = asyncio.run(ask())
    assert there.grasp == here.grasp == explained.decision.grasp
    assert (episode.end, episode.attempts) == ("stopped", 1)


def test_the_token_comes_from_the_environment(server: Running, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("THINKGRASP_TOKEN", TOKEN)
    with Client(server.url) as client:
        assert client.grasp(FRAME, "red").status == "grasp"
    monkeypatch.delenv("THINKGRASP_TOKEN")
    with Client(server.url) as client, pytest.raises(ConfigError, match="set THINKGRASP_TOKEN"):
        client.grasp(FRAME, "red")


def test_what_the_server_cannot_use_is_an_input_error(server: Running):
    with Client(server.url, token=TOKEN) as client:
        with pytest.raises(InputError, match="instruction"):
            client.grasp(FRAME, "")
        with pytest.raises(InputError, match="planner"):
            client.grasp(FRAME, "red", planner="openai")
        with pytest.raises(InputError, match="no valid text"):
            client.grasp(FRAME, "\ud800")
        with pytest.raises(InputError, match="cannot be sent"):
            client.grasp(FRAME, "red", standoff_m=float("nan"))


@pytest.mark.parametrize(
    "url", ["", "localhost:8000", "ftp://x", "http://", "http://a?b=c", "http://me:pw@host", "http://[", 5]
)
def test_bad_addresses(url):
    with pytest.raises(ConfigError, match="is no address of a server"):
        Client(url)


def test_a_bad_token():
    with pytest.raises(ConfigError, match="printable ASCII"):
        Client("http://localhost", token="a\nb")


Reply = httpx.Response | Exception


def answering(*replies: Reply) -> tuple[httpx.MockTransport, list[httpx.Request]]:
    """A transport that gives these in turn, the last one for ever."""
    seen: list[httpx.Request] = []

    def handle(request: httpx.Request) -> httpx.Response:
        seen.append(request)
        reply = replies[min(len(seen), len(replies)) - 1]
        if isinstance(reply, Exception):
            raise reply
        return httpx.Response(reply.status_code, headers=reply.headers, content=reply.content)

    return httpx.MockTransport(handle), seen


def error(status: int, message: str = "m", **headers: str) -> httpx.Response:
    body = {"error": {"code": "c", "message": message, "request_id": "r"}}
    return httpx.Response(status, json=body, headers=headers)


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    found: list[float] = []
    monkeypatch.setattr(client_module.time, "sleep", found.append)
    return found


@pytest.fixture(scope="module")
def good(server: Running) -> httpx.Response:
    from fakes.grasp_server import parts_of

    headers = {"Authorization": f"Bearer {TOKEN}"}
    return server.http.post("/v1/grasp", headers=headers, files=parts_of(FRAME, "red"))


def test_a_busy_server_is_asked_again_when_it_says(good, waits):
    says = ("3", "soon", "nan", "inf", "-5")
    transport, seen = answering(*(error(429, **{"Retry-After": when}) for when in says), good)
    with Client("http://robot/api/", token="", transport=transport) as client:
        assert client.grasp(FRAME, "red").status == "grasp"
    assert waits == [0, 3, 1, 1, 60, 0.1]
    assert {str(r.url) for r in seen} == {"http://robot/api/v1/grasp"}
    assert "authorization" not in seen[0].headers


@pytest.mark.parametrize(
    ("replies", "kind", "said"),
    [
        ((error(429, "busy", **{"Retry-After": "600"}),), ServerError, "answered 429: busy"),
        ((error(400, "bad"),), InputError, "^bad$"),
        ((error(413, "too large"),), InputError, "^too large$"),
        ((error(422, "no"),), InputError, "^no$"),
        ((error(404, "no episode"),), InputError, "no episode"),
        ((error(401, "wants a token"),), ConfigError, "wants a token"),
        ((error(403, "by name"),), ConfigError, "by name"),
        ((error(500, "failed"),), ServerError, "answered 500: failed"),
        ((error(504, "slow"),), ServerError, "answered 504: slow"),
        ((httpx.Response(404, text="<html>nginx</html>"),), ServerError, "no ThinkGrasp server"),
        ((httpx.Response(302, headers={"Location": "http://evil"}),), ServerError, "answered 302"),
        ((httpx.Response(200, text="hello"),), ServerError, "something else"),
        ((httpx.Response(200, json={"status": "grasp"}),), ServerError, "something else"),
        ((httpx.Response(200, json=[]),), ServerError, "something else"),
        ((httpx.ConnectError("refused"),), ServerError, "cannot be reached: refused"),
        ((httpx.ReadTimeout("slow"),), ServerError, "did not answer in time"),
        ((httpx.RemoteProtocolError("cut"),), ServerError, "cannot be reached: cut"),
    ],
)
def test_answers_that_are_none(replies: Sequence[Reply], kind: type[Exception], said: str, waits: list[float]):
    transport, _ = answering(*replies)
    with Client("http://robot", transport=transport, patience_s=50) as client, pytest.raises(kind, match=said):
        client.grasp(FRAME, "red")


def test_a_server_that_is_not_ready_in_time(waits: list[float], monkeypatch: pytest.MonkeyPatch):
    clock: Callable[[], float] = iter(range(0, 1000, 30)).__next__
    monkeypatch.setattr(client_module.time, "monotonic", clock)
    transport, _ = answering(httpx.ConnectError("refused"))
    with Client("http://robot", transport=transport) as client, pytest.raises(ServerError, match="not ready within 60"):
        client.wait_until_ready(60)


def test_both_clients_have_the_same_methods():
    def public(kind: type) -> set[str]:
        return {name for name in vars(kind) if not name.startswith("_")}

    assert public(Client) == public(AsyncClient)
    assert public(RemoteEpisode) == public(AsyncRemoteEpisode)
