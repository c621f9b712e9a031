"""The live page: really served, opened in a real browser; and what it refuses."""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from fakes.browser import Tab, chromium

from thinkgrasp.errors import ConfigError, ContractError, MissingDependency
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.testing import check_recorder
from thinkgrasp.types import Decision, Degradation, Outcome
from thinkgrasp.viz.live import LiveView

GRIPPER = GRIPPERS["robotiq_2f85"]
NASTY = "<b>bold</b> </div><script>window.broken = 1</script> & 你好"
TETRAHEDRON = (
    0.2 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)
Make = Callable[..., Decision]


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@pytest.fixture
def live(capfd: pytest.CaptureFixture[str]) -> Iterator[LiveView]:
    pytest.importorskip("viser", reason="viser is not installed (extra 'viz')")
    with LiveView(GRIPPER, port=free_port()) as view:
        yield view
    assert capfd.readouterr().out == ""


def test_page_follows_the_episode(live: LiveView, make_decision: Make) -> None:
    live.update_decision(make_decision(instruction=NASTY, degraded=(Degradation("segment", "two fit", "the nearer"),)))
    live.set_meshes(["base", "tool"], [TETRAHEDRON[0]] * 2, [TETRAHEDRON[1]] * 2, [(80, 80, 90), (200, 60, 40)])
    live.set_poses(["tool"], np.array([[1.0, 0, 0, 0]]), np.array([[0.4, 0, 0.2]]))
    with chromium() as browser:
        tab = Tab(browser, live.url, width=900, height=500)
        panel = tab.page.locator(".thinkgrasp")
        panel.wait_for()
        tab.page.wait_for_selector("canvas[data-engine]")
        tab.page.wait_for_function("document.querySelector('.thinkgrasp').innerText.includes('Executing')")
        said = panel.inner_text()
        for words in ("<b>bold</b> </div><script>", "banana (goal)", "6 of 812", "segment: two fit; instead"):
            assert words in said, words
        assert tab.page.evaluate("typeof window.broken") == "undefined"
        tab.page.wait_for_timeout(500)
        seen = tab.picture("canvas[data-engine]")[:, :500]
        assert len(np.unique(seen.reshape(-1, 3), axis=0)) > 100

        live.record(make_decision("no_grasp"), None)
        tab.page.wait_for_function("document.querySelector('.thinkgrasp').innerText.includes('Not executed')")
        live.update_decision(make_decision())
        live.update_outcome(Outcome(False, "missed"))
        tab.page.wait_for_function("document.querySelector('.thinkgrasp').innerText.includes('✕ Missed')")
        assert tab.complaints == []
        assert tab.foreign_requests(live.url) == []


def test_it_is_a_recorder_and_shows_a_decision_once(live: LiveView, make_decision: Make) -> None:
    check_recorder(live)
    assert live._step == 3
    decision = make_decision()
    live.update_decision(decision)
    live.record(decision, Outcome(True, "held"))
    assert live._step == 4
    live.record(make_decision("no_target", marks=False), None)
    assert live._step == 5


def test_wrong_calls_are_named(live: LiveView) -> None:
    with pytest.raises(ContractError, match="call update_decision first"):
        live.update_outcome(None)
    vertices, faces = TETRAHEDRON
    with pytest.raises(ContractError, match=r"got 2 names \(1 different\), 2 vertices"):
        live.set_meshes(["a", "a"], [vertices] * 2, [faces] * 2, [(0, 0, 0)] * 2)
    live.set_meshes(["a"], [vertices], [faces], [(0, 0, 0)])
    with pytest.raises(ContractError, match=r"unknown: \['b'\]"):
        live.set_poses(["b"], np.zeros((1, 4)), np.zeros((1, 3)))
    with pytest.raises(ContractError, match="1 names, 2 quaternions"):
        live.set_poses(["a"], np.zeros((2, 4)), np.zeros((1, 3)))


def test_missing_package_is_named_with_its_install_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(
        MissingDependency, match=r"needs the package 'viser'.*pip install 'thinkgrasp\[viz\]'"
    ) as raised:
        LiveView(GRIPPER)
    assert isinstance(raised.value, ConfigError)
