"""Who may ask, what is logged, and that the defaults are safe."""

from __future__ import annotations

import io
import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest
from fakes.grasp_server import TOKEN, Running, parts_of, running, told_recipe
from fakes.stages import table_frame
from starlette.datastructures import Headers

from thinkgrasp.errors import ConfigError
from thinkgrasp.server import logs
from thinkgrasp.server.access import Access, is_loopback, read_token
from thinkgrasp.server.app import ServerOptions
from thinkgrasp.server.client import Client
from thinkgrasp.server.decoding import without_paths
from thinkgrasp.server.limits import Limits
from thinkgrasp.server.problems import RequestProblem

GUARDED = ("/v1/grasp", "/v1/explain", "/v1/episodes", "/grasp_pose")
OPEN = ("/", "/docs", "/openapi.json", "/healthz", "/readyz", "/page/page.js")


@pytest.fixture(scope="module")
def server():
    with running(told_recipe(), ServerOptions(workers=0, token=TOKEN)) as found:
        yield found


@pytest.mark.parametrize("path", GUARDED)
@pytest.mark.parametrize(
    "given",
    [None, "", "Bearer", f"Bearer {TOKEN}x", f"Bearer {TOKEN[:-1]}", TOKEN, f"Basic {TOKEN}", "Bearer \xff"],
)
def test_without_the_token_nothing_is_answered(server: Running, path: str, given: str | None):
    headers = {} if given is None else {"Authorization": given.encode("latin-1")}
    answer = server.http.post(path, headers=headers, files=parts_of(table_frame(), "red"))
    assert answer.status_code == 401
    assert answer.headers["www-authenticate"] == "Bearer"
    error = answer.json()["error"]
    assert "wants a token" in (error if path == "/grasp_pose" else error["message"])
    assert TOKEN not in answer.text


def test_other_addresses_want_it_too(server: Running):
    for path in ("/metrics", "/v1/episodes/abc", "/nothing"):
        assert server.http.get(path).status_code == 401
    for path in OPEN:
        assert server.http.get(path).status_code == 200


def test_with_the_token_it_answers_by_any_name(server: Running):
    headers = {"Authorization": f"bearer {TOKEN}", "Host": "robot.lab:8000"}
    assert server.http.post("/v1/grasp", headers=headers, files=parts_of(table_frame(), "red")).status_code == 200
    answer = server.http.get("/metrics", headers={"Authorization": f"Bearer {TOKEN}"})
    assert answer.status_code == 200


def test_pages_of_other_sites_are_refused_even_with_the_token(server: Running):
    headers = {"Authorization": f"Bearer {TOKEN}", "Origin": "https://evil.example"}
    assert server.http.get("/metrics", headers=headers).status_code == 403
    own = {"Authorization": f"Bearer {TOKEN}", "Origin": server.url}
    assert server.http.get("/metrics", headers=own).status_code == 200


@pytest.mark.parametrize("host", ["127.0.0.1:8000", "localhost", "[::1]:8000", "127.8.8.8"])
def test_without_a_token_this_machines_names_are_taken(host: str):
    Access(None).check("/v1/grasp", Headers({"Host": host}))


@pytest.mark.parametrize(
    "host", ["evil.example", "0.0.0.0:8000", "127.0.0.1.evil.example", "localhost.evil", "", "[::2]"]
)
def test_without_a_token_other_names_are_not(host: str):
    with pytest.raises(RequestProblem) as refused:
        Access(None).check("/", Headers({"Host": host}))
    assert refused.value.status == 403


def test_loopback():
    assert all(map(is_loopback, ("127.0.0.1", "localhost", "::1", "[::1]", "127.1.2.3")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "", "192.168.0.5", "example.com", "localhost.evil.com")))


class TestCommand:
    @pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", ""])
    def test_other_addresses_need_a_token(self, cli, monkeypatch, host):
        monkeypatch.delenv("THINKGRASP_TOKEN", raising=False)
        result = cli("serve", "--host", host)
        assert result.code == 2
        assert "needs a token" in result.err
        assert len(result.err.splitlines()) == 1

    @pytest.mark.parametrize(
        ("args", "said"),
        [
            (("--port", "70000"), "--port must lie in 0 to 65535"),
            (("--workers", "-1"), "--workers must lie in 0 to 64"),
            (("--queue", "-1"), "queue must be a whole number of at least 0"),
            (("--max-megapixels", "0"), "megapixels must be positive"),
            (("--stage-timeout", "plan"), "--stage-timeout takes STAGE=SECONDS"),
            (("--stage-timeout", "nap=3"), "no stage 'nap'"),
            (("--stage-timeout", "plan=0"), "must be positive"),
            (("--recycle-after", "-1"), "--recycle-after must be at least 0"),
            (("--preset", "nothing"), "no preset 'nothing'"),
            (("--paper-root", "nowhere"), "is not a folder"),
            (("--paper-camera", "nowhere.json"), "does not exist"),
            (("--token-file", "nowhere"), "cannot be read"),
            (("--host", "no.such.host.invalid"), "needs a token"),
        ],
    )
    def test_bad_settings_are_one_line(self, cli, monkeypatch, args, said):
        monkeypatch.delenv("THINKGRASP_TOKEN", raising=False)
        result = cli("serve", *args)
        assert (result.code, result.out) == (2, "")
        assert said in result.err
        assert len(result.err.splitlines()) == 1

    def test_a_recording_has_one_writer(self, cli, tmp_path):
        result = cli("serve", "--preset", "vlm", "--workers", "2", "--record", str(tmp_path / "c.jsonl"))
        assert result.code == 2
        assert "--record needs --workers 1" in result.err

    @pytest.mark.parametrize("token", ["short", "has a space in it, so it is none", "ключ-ключ-ключ-ключ"])
    def test_weak_tokens_are_refused(self, cli, monkeypatch, token):
        monkeypatch.setenv("THINKGRASP_TOKEN", token)
        result = cli("serve", "--host", "0.0.0.0")
        assert result.code == 2
        assert "at least 16 printable ASCII characters" in result.err
        assert token not in result.err

    def test_a_port_in_use_is_one_line(self, server, cli):
        result = cli("serve", "--port", str(server.port))
        assert result.code == 2
        assert f"cannot listen at 127.0.0.1:{server.port}" in result.err

    def test_models_that_cannot_be_loaded_end_it(self, cli):
        result = cli("serve", "--port", "0", "--workers", "0", "--gripper", "nowhere")
        assert result.code == 2
        assert "no gripper 'nowhere'" in result.err.splitlines()[-1]

    def test_it_serves_until_it_is_told_to_stop(self, tmp_path):
        token = tmp_path / "token"
        token.write_text(f"{TOKEN}\n")
        args = ["serve", "--port", "0", "--workers", "0", "--token-file", str(token)]
        process = subprocess.Popen(
            [sys.executable, "-m", "thinkgrasp.cli", *args],
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={k: v for k, v in os.environ.items() if k != "THINKGRASP_TOKEN"},
        )
        assert process.stderr is not None
        timer = threading.Timer(60, process.kill)
        timer.start()
        try:
            line = process.stderr.readline()
            found = re.search(r"serves preset offline at (http://127\.0\.0\.1:\d+)", line)
            assert found is not None, line
            process.stderr.readline()
            with Client(found[1]) as client:
                client.wait_until_ready()
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=60)
        finally:
            timer.cancel()
            process.kill()
        assert process.returncode in (0, 130)
        assert '"event": "stopped"' in err
        assert out == ""
        assert TOKEN not in err + line


def test_a_token_from_a_file(tmp_path, monkeypatch):
    monkeypatch.setenv("THINKGRASP_TOKEN", "another-token-of-some-length")
    file = tmp_path / "token"
    file.write_text(f" {TOKEN}\n")
    assert read_token(file) == TOKEN
    assert read_token(None) == "another-token-of-some-length"
    file.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_token(file)


def test_connections_are_bounded():
    limits = Limits(connections=3, keep_alive_s=60)
    with running(told_recipe(), ServerOptions(workers=0, limits=limits)) as server:
        idle = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(2)]
        try:
            with socket.create_connection(("127.0.0.1", server.port)) as one_too_many:
                one_too_many.settimeout(20)
                answer = one_too_many.recv(4096)
        finally:
            for connection in idle:
                connection.close()
        assert answer.startswith(b"HTTP/1.1 429 ")
        assert json.loads(answer.partition(b"\r\n\r\n")[2])["error"]["code"] == "too_many_connections"
        assert server.http.get("/healthz").status_code == 200


class TestLogs:
    def test_a_request_is_one_line_of_json_without_what_was_said(self, server: Running):
        out = io.StringIO()
        with logs.to_stream(out):
            headers = {"Authorization": f"Bearer {TOKEN}", "X-Request-ID": "mine-1"}
            server.http.post("/v1/grasp", headers=headers, files=parts_of(table_frame(), "my secret red thing"))
            server.http.get("/etc/passwd", headers={"X-Request-ID": "bad id \u00ff".encode()})
            deadline = time.monotonic() + 30
            while out.getvalue().count("\n") < 2 and time.monotonic() < deadline:
                time.sleep(0.01)  # a line follows its answer
        first, second = map(json.loads, out.getvalue().splitlines())
        assert (
            first.items() >= {"event": "request", "request_id": "mine-1", "status": 200, "route": "/v1/grasp"}.items()
        )
        assert first["decision"] == "grasp"
        assert first["ms"] > 0
        assert (second["status"], second["route"]) == (401, "unmatched")
        assert re.fullmatch(r"[0-9a-f]{32}", second["request_id"])
        assert not re.search("secret|passwd|battery", out.getvalue())

    def test_other_loggers_say_no_paths(self):
        try:
            raise ValueError("/home/someone/weights.pth")
        except ValueError as error:
            info = (type(error), error, error.__traceback__)
        record = logging.LogRecord("uvicorn.error", logging.ERROR, "/x.py", 1, "Exception in ASGI %s", ("/a/b",), info)
        line = json.loads(logs.JsonLines().format(record))
        assert line["event"] == "Exception in ASGI %s"
        assert re.fullmatch(r"ValueError at test_access\.py:\d+", line["error"])
        assert "/" not in line["error"]


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("weights file /home/me/w.pth is missing", "weights file [path] is missing"),
        (r"cannot read C:\models\sam\w.pth", "cannot read [path]"),
        ("~/cache/thinkgrasp/x", "[path]"),
        ("[Errno 2] No such file or directory: '/home/some one/w.pth'", "[Errno 2] No such file or directory: [path]"),
        ('cannot open "/weights.pth"', "cannot open [path]"),
        ("see file:///home/me/w.pth", "see [path]"),
        ("http://127.0.0.1:8000/v1 cannot be reached", "http://127.0.0.1:8000/v1 cannot be reached"),
        ("3/4 of the pixels, 640x480 px/m", "3/4 of the pixels, 640x480 px/m"),
    ],
)
def test_paths_are_taken_out_of_messages(text: str, left: str):
    assert without_paths(text) == left
