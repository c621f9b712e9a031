"""Requests made by schemathesis from the server's own schema, right and wrong ones: none may be answered with a 5xx."""

from __future__ import annotations

import json
import random
from collections import Counter

import pytest
from fakes.grasp_server import Running, json_of, npy, offline_recipe, parts_of, png, running
from hypothesis import HealthCheck, Phase, given, settings

from thinkgrasp.server.app import ServerOptions
from thinkgrasp.server.limits import Limits
from thinkgrasp.server.paper_api import PaperOptions
from thinkgrasp.testing import sample_frame

pytestmark = pytest.mark.fuzz

LIMITS = Limits(body_mb=3, megapixels=0.4, episodes=100_000)
EXAMPLES = 180
"""Requests per operation and mode."""
SPOILT = 400
"""Good requests with some bytes changed."""


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    root = tmp_path_factory.mktemp("paper")
    (root / "text.txt").write_text("the red box")
    options = ServerOptions(workers=2, limits=LIMITS, paper=PaperOptions(root))
    with running(offline_recipe(LIMITS), options) as found:
        yield found


def fuzz(server: Running, examples: int) -> Counter[int]:
    """Send so many right and wrong requests to every operation and return how often each status came back."""
    import schemathesis  # slow to import, so only where it is used
    from schemathesis import GenerationMode

    api = schemathesis.openapi.from_url(f"{server.url}/openapi.json")
    statuses: Counter[int] = Counter()
    for found in api.get_all_operations():
        operation = found.ok()
        for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):

            @settings(
                max_examples=examples,
                phases=[Phase.generate],
                suppress_health_check=list(HealthCheck),
                deadline=None,
                database=None,
                derandomize=True,
            )
            @given(case=operation.as_strategy(generation_mode=mode))
            def send(case: schemathesis.Case) -> None:
                answer = case.call(base_url=server.url, timeout=60)
                statuses[answer.status_code] += 1
                assert answer.status_code < 500, (case.as_curl_command()[:2000], answer.text[:500])
                if answer.status_code >= 400 and case.method.upper() != "HEAD":
                    assert json.loads(answer.content)["error"], case.as_curl_command()[:2000]

            try:
                send()
            except Exception as error:
                if "Unsatisfiable" not in type(error).__name__ and "cannot be negated" not in str(error).lower():
                    raise
    return statuses


def test_thousands_of_requests_from_the_schema(server: Running, capsys: pytest.CaptureFixture[str]):
    statuses = fuzz(server, EXAMPLES)
    with capsys.disabled():
        print(f"\n{sum(statuses.values())} requests from the schema, by status: {dict(sorted(statuses.items()))}")
    assert sum(statuses.values()) >= 2000
    assert server.http.get("/readyz").status_code == 200


def test_good_requests_with_bytes_changed(server: Running, capsys: pytest.CaptureFixture[str]):
    statuses: Counter[int] = Counter()
    rng = random.Random(0)
    frame = sample_frame()
    sources = {"color": png(frame.color), "depth": npy(frame.depth)}
    for i in range(SPOILT):
        if i % 4 == 3:
            text = bytearray(json.dumps(json_of(frame)).encode())
            body = {"content": bytes(_spoil(text, rng)), "headers": {"Content-Type": "application/json"}}
        else:
            files = parts_of(frame)
            name = ("color", "depth", "camera")[i % 4]
            data = bytearray(sources.get(name) or files[name][1])
            files[name] = (name, bytes(_spoil(data, rng, near_start=rng.random() < 0.7)), "application/octet-stream")
            body = {"files": files}
        answer = server.http.post("/v1/grasp", **body)
        statuses[answer.status_code] += 1
        assert answer.status_code < 500, (i, answer.text)
    with capsys.disabled():
        print(f"\n{SPOILT} good requests with bytes changed, by status: {dict(sorted(statuses.items()))}")
    assert server.http.get("/readyz").status_code == 200


def _spoil(data: bytearray, rng: random.Random, *, near_start: bool = True) -> bytearray:
    """Change, remove or repeat a few bytes, mostly where headers are."""
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(min(len(data), 300) if near_start else len(data))
        match rng.randrange(4):
            case 0:
                data[at] = rng.randrange(256)
            case 1:
                data[at] ^= 1 << rng.randrange(8)
            case 2:
                del data[at : at + rng.randint(1, 40)]
            case _:
                data[at:at] = data[at : at + rng.randint(1, 40)]
        if not data:
            return bytearray(b"\x00")
    return data
