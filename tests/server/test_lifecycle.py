"""Workers, queues and clients that leave: nothing is waited for in vain, and nothing takes the server down."""

from __future__ import annotations

import json
import logging
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest
from fakes.grasp_server import Running, parts_of, running, told_recipe
from fakes.stages import table_frame

from thinkgrasp.server import serving
from thinkgrasp.server.app import ServerOptions
from thinkgrasp.server.client import Client
from thinkgrasp.server.limits import STAGE_TIMEOUTS_S, Limits

FRAME = table_frame()
LIMITS = Limits(queue=1, cancel_grace_s=0.3, stage_timeouts_s=STAGE_TIMEOUTS_S | {"plan": 1.0})


@pytest.fixture(scope="module", params=[1, 0], ids=["process", "in-process"])
def server(request: pytest.FixtureRequest):
    """In its own process no stage can be ended, so that its planner's sleep is short."""
    recipe = told_recipe(sleep_s=60.0 if request.param else 1.5)
    with running(recipe, ServerOptions(workers=request.param, limits=LIMITS)) as found:
        yield found


def grasp(server: Running, instruction: str) -> httpx.Response:
    return httpx.post(f"{server.url}/v1/grasp", files=parts_of(FRAME, instruction), timeout=60)


def count(server: Running, name: str, **labels: str) -> float:
    from prometheus_client.parser import text_string_to_metric_families

    families = text_string_to_metric_families(server.http.get("/metrics").text)
    return sum(s.value for f in families for s in f.samples if s.name == name and labels.items() <= s.labels.items())


def until(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def leave(server: Running, instruction: str) -> None:
    """Send a request, and close the connection once a worker has it."""
    request = httpx.Request("POST", f"{server.url}/v1/grasp", files=parts_of(FRAME, instruction))
    request.read()
    head = "".join(f"{k}: {v}\r\n" for k, v in request.headers.items())
    with socket.create_connection(("127.0.0.1", server.port)) as connection:
        connection.sendall(f"POST /v1/grasp HTTP/1.1\r\n{head}\r\n".encode() + request.content)
        until(lambda: count(server, "thinkgrasp_requests_running") >= 1)


def test_a_stage_that_takes_too_long_is_ended(server: Running):
    answer = grasp(server, "red sleep")
    assert answer.status_code == 504
    assert answer.json()["error"]["code"] == "stage_timeout"
    assert "'plan' took longer than 1 s" in answer.json()["error"]["message"]
    assert grasp(server, "red").status_code == 200


def test_a_client_that_leaves_frees_its_worker(server: Running):
    before = count(server, "thinkgrasp_cancelled_total")
    leave(server, "red sleep")
    until(lambda: count(server, "thinkgrasp_cancelled_total") == before + 1)
    assert grasp(server, "red").status_code == 200


def test_a_client_that_leaves_between_stages_costs_no_process(server: Running):
    restarts = count(server, "thinkgrasp_worker_restarts_total")
    before = count(server, "thinkgrasp_cancelled_total")
    leave(server, "red nap")
    until(lambda: count(server, "thinkgrasp_cancelled_total") == before + 1)
    assert grasp(server, "red").status_code == 200
    assert count(server, "thinkgrasp_worker_restarts_total") == restarts


def test_one_request_too_many_is_429_and_says_when_to_come_back(server: Running):
    with ThreadPoolExecutor(6) as threads:
        answers = list(threads.map(lambda _: grasp(server, "red nap"), range(6)))
    statuses = [a.status_code for a in answers]
    assert set(statuses) == {200, 429}
    for answer in answers:
        if answer.status_code == 429:
            assert answer.json()["error"]["code"] == "busy"
            assert 1 <= int(answer.headers["retry-after"]) <= 60
    assert grasp(server, "red").status_code == 200


def test_a_bug_is_told_by_its_place_alone(server: Running, caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.INFO, "thinkgrasp.server")
    answer = grasp(server, "red bug")
    assert answer.status_code == 500
    assert answer.json()["error"]["code"] == "internal_error"

    def logged() -> str:
        return " ".join(str(r.__dict__) for r in caplog.records if r.name == "thinkgrasp.server")

    until(lambda: answer.json()["error"]["request_id"] in logged())
    said = logged()
    assert "ZeroDivisionError at told_stages.py" in said
    for text in (answer.text, said):
        assert "secret" not in text
        assert "sk-1234" not in text


@pytest.fixture(scope="module")
def pair():
    """Two workers, started anew after four jobs each."""
    with running(told_recipe(sleep_s=0.8), ServerOptions(workers=2, recycle_after=4)) as found:
        until(lambda: found.http.get("/readyz").json()["ready_workers"] == 2)
        yield found


def test_several_workers_decide_side_by_side(pair: Running):
    seen: list[float] = []
    done = threading.Event()

    def look() -> None:
        while not done.is_set():
            seen.append(count(pair, "thinkgrasp_requests_waiting"))

    with ThreadPoolExecutor(3) as threads:
        threads.submit(look)
        answers = list(threads.map(lambda _: grasp(pair, "red sleep").status_code, range(2)))
        done.set()
    assert answers == [200, 200]
    assert max(seen) == 0


def test_each_workers_memory_is_reported(pair: Running):
    for worker in ("0", "1"):
        assert count(pair, "thinkgrasp_worker_resident_bytes", worker=worker) > 1e7


def test_an_episode_goes_from_worker_to_worker(pair: Running):
    with Client(pair.url) as client:
        episode = client.start_episode("red")
        for attempt in range(3):
            decision = episode.observe(FRAME).decision
            assert decision is not None
            assert [s.check for s in decision.funnel][1:-1] == ["not_failed_before"] * (attempt > 0)
            episode.report(False)
    assert episode.status.attempts == 3


def test_a_worker_that_dies_is_replaced(pair: Running, caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.INFO, "thinkgrasp.server")
    answer = grasp(pair, "red crash")
    assert answer.status_code == 500
    assert answer.json()["error"]["code"] == "internal_error"
    assert grasp(pair, "red").status_code == 200
    assert count(pair, "thinkgrasp_worker_restarts_total", reason="ended") == 1
    assert any("ended with code 11" in str(r.__dict__) for r in caplog.records)


def test_workers_are_started_anew_after_so_many_decisions(pair: Running):
    for _ in range(8):
        assert grasp(pair, "red").status_code == 200
        if count(pair, "thinkgrasp_worker_restarts_total", reason="recycled"):
            break
    assert count(pair, "thinkgrasp_worker_restarts_total", reason="recycled") >= 1
    assert grasp(pair, "red").status_code == 200


def test_what_libraries_print_in_a_worker_is_not_in_the_log(capfd: pytest.CaptureFixture[str]):
    with running(told_recipe(), ServerOptions()) as server:
        assert grasp(server, "red loud").status_code == 200
    out, err = capfd.readouterr()
    assert "secret" not in out + err
    (line,) = (json.loads(line) for line in err.splitlines() if "library" in line)
    assert line.items() >= {"level": "warning", "logger": "library", "event": "[path] is old"}.items()


def test_a_server_that_stops_answers_what_still_runs(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(serving, "GRACEFUL_S", 1)
    with ThreadPoolExecutor(1) as threads:
        with running(told_recipe(sleep_s=60.0), ServerOptions()) as server:
            asked = threads.submit(grasp, server, "red sleep")
            until(lambda: count(server, "thinkgrasp_requests_running") == 1)
        answer = asked.result()
    assert answer.status_code == 503
    assert answer.json()["error"]["code"] == "stopping"
    assert answer.headers["retry-after"]


def test_a_client_that_does_not_take_its_answers_is_cut_off():
    limits = Limits(send_timeout_s=0.5, keep_alive_s=60, connections=2)
    with running(told_recipe(), ServerOptions(workers=0, limits=limits)) as server, socket.socket() as connection:

        def is_room() -> bool:
            try:
                return httpx.get(f"{server.url}/healthz").status_code == 200
            except httpx.HTTPError:
                return False

        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.connect(("127.0.0.1", server.port))
        connection.setblocking(False)
        connection.send(b"GET /page/page.js HTTP/1.1\r\nHost: localhost\r\n\r\n" * 1500)
        assert not is_room()
        until(is_room)
