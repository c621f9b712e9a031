"""The HTML page: what it holds, and how it behaves in a real browser with and without WebGL."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from thinkgrasp.errors import InputError
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.types import Decision, Degradation
from thinkgrasp.viz import view
from thinkgrasp.viz.view import render_view, score_color, write_view

GRIPPER = GRIPPERS["robotiq_2f85"]
BACKGROUND = np.array([20, 23, 27])
NASTY = '</script><script>window.broken = 1</script> <b>"it\'s" & 你好 🍌 \ud83c \x00 {{scene}}'
Make = Callable[..., Decision]


def scene_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="scene">(.*?)</script>', page, re.S)
    assert found is not None
    return json.loads(found[1])


def vertices(layer: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(layer["positions"]), "<f4").reshape(-1, 3)


def names(page: str) -> set[str]:
    return {layer["name"] for layer in scene_of(page)["layers"]}


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        ("grasp", {"target", "cloud", "plane", "candidates", "chosen", "point"}),
        ("no_grasp", {"target", "cloud", "plane", "point"}),
        ("no_target", {"cloud", "plane"}),
    ],
)
def test_page_holds_what_the_decision_has(make_decision: Make, status: str, expected: set[str]) -> None:
    page = render_view(make_decision(status), GRIPPER)
    assert names(page) == expected
    assert set(re.findall(r'data-layer="(\w+)"', page)) == expected - {"cloud"}


def test_cloud_is_the_frames(make_decision: Make) -> None:
    decision = make_decision(width=160, height=120)
    layers = scene_of(render_view(decision, GRIPPER))["layers"]
    cloud = np.concatenate([vertices(layer) for layer in layers if layer["kind"] == "points"])
    valid = np.isfinite(decision.scene.points[..., 2])
    assert len(cloud) == valid.sum()
    np.testing.assert_allclose(np.sort(cloud[:, 2]), np.sort(decision.scene.points[valid][:, 2]))


def test_cloud_is_thinned_and_objects_keep_their_points(make_decision: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    decision = make_decision(width=160, height=120)
    monkeypatch.setattr(view, "MAX_POINTS", 6000)
    target, objects, rest = (
        layer for layer in scene_of(render_view(decision, GRIPPER))["layers"] if layer["kind"] == "points"
    )
    assert decision.target is not None
    assert len(vertices(target)) == (decision.target.mask & (decision.scene.frame.depth > 0)).sum()
    assert 4000 < len(vertices(target)) + len(vertices(objects)) + len(vertices(rest)) <= 6000
    assert rest["spacing"] > 1.2 * objects["spacing"]


def test_chosen_gripper_is_where_the_grasp_is(make_decision: Make) -> None:
    decision = make_decision()
    assert decision.grasp is not None
    chosen = [x for x in scene_of(render_view(decision, GRIPPER))["layers"] if x["name"] == "chosen"]
    corners = np.concatenate([vertices(layer) for layer in chosen]) - decision.grasp.position
    local = corners @ decision.grasp.rotation
    assert local[:, 2].max() == pytest.approx(0.0, abs=1e-5)
    assert local[:, 2].min() == pytest.approx(-GRIPPER.finger_length_m - GRIPPER.palm_size_m[2], abs=1e-5)
    tips = local[np.abs(local[:, 2]) < 1e-5]
    assert np.abs(tips[:, 0]).min() == pytest.approx(decision.grasp.width_m / 2, abs=1e-5)


def test_plane_layer_lies_on_the_support(make_decision: Make) -> None:
    decision = make_decision()
    plane = next(x for x in scene_of(render_view(decision, GRIPPER))["layers"] if x["name"] == "plane")
    assert decision.scene.support is not None
    np.testing.assert_allclose(decision.scene.support.height(vertices(plane)), view.PLANE_LIFT_M, atol=1e-5)


def test_strict_mode_without_support_and_marks(make_decision: Make) -> None:
    decision = make_decision("no_target")
    bare = replace(decision, scene=replace(decision.scene, support=None, proposals=()))
    page = render_view(bare, GRIPPER)
    assert names(page) == {"cloud"}
    np.testing.assert_allclose(scene_of(page)["up"], bare.scene.frame.T_world_camera[2, :3])
    nameless = replace(bare, scene=replace(bare.scene, frame=replace(bare.scene.frame, T_world_camera=None)))
    assert scene_of(render_view(nameless, GRIPPER))["up"] == [0, -1, 0]


def test_text_is_escaped_everywhere(make_decision: Make) -> None:
    decision = make_decision(
        "no_grasp", instruction=NASTY, rationale=NASTY, degraded=(Degradation(NASTY, NASTY, NASTY),)
    )
    assert decision.target is not None
    decision = replace(
        decision, target=replace(decision.target, label=NASTY), plan=replace(decision.plan, target=NASTY)
    )
    page = render_view(decision, GRIPPER)
    assert page.lower().count("</script>") == 2
    assert '<b>"it' not in page
    assert "你好" in page
    page.encode("utf-8")


def test_page_refers_to_nothing_outside(make_decision: Make) -> None:
    page = render_view(make_decision(), GRIPPER)
    assert not re.search(r"(?:src|href)=\"(?!data:)|https?://|@import|url\(", page)


def test_funnel_and_timings_are_listed(make_decision: Make) -> None:
    page = render_view(make_decision("no_grasp", degraded=(Degradation("segment", "two fit", "the nearer"),)), GRIPPER)
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))
    for words in (
        "candidates 812",
        "width 640",
        "collision 0",
        "scene 101.2 ms",
        "total 103.3 ms",
        "segment : two fit",
    ):
        assert words in text


def test_same_decision_same_page(make_decision: Make, tmp_path: Path) -> None:
    decision = make_decision()
    write_view(decision, GRIPPER, tmp_path / "a.html")
    assert (tmp_path / "a.html").read_text("utf-8") == render_view(decision, GRIPPER)


def test_unwritable_path_is_named(make_decision: Make, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot write the 3-D view to .*nowhere.*No such file"):
        write_view(make_decision("no_target"), GRIPPER, tmp_path / "nowhere" / "a.html")


def test_score_colours_run_along_the_ramp() -> None:
    assert [score_color(s) for s in (-1.0, 0.0, 0.5, 1.0, 2.0)] == [view.SCORE_RAMP[i] for i in (0, 0, 1, 2, 2)]
    assert score_color(float("nan")) == view.SCORE_RAMP[0]
    assert score_color(0.75) not in view.SCORE_RAMP


# In the browser


@pytest.fixture(scope="module", params=["any", "no-webgl"])
def browser(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Chromium, once as it is and once without WebGL."""
    executable = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if executable is None:
        message = "no Chromium on the PATH; on Debian: apt-get install chromium"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    from playwright.sync_api import sync_playwright

    switch = "--enable-unsafe-swiftshader" if request.param == "any" else "--disable-3d-apis"
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox", switch])
        yield chromium
        chromium.close()


class Page:
    """A decision's page in the browser, with everything it complained of or asked for."""

    def __init__(self, browser: Any, decision: Decision, folder: Path) -> None:
        write_view(decision, GRIPPER, folder / "view.html")
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.tab = browser.new_page(viewport={"width": 820, "height": 440})
        self.tab.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        self.tab.on("pageerror", lambda e: self.complaints.append(str(e)))
        self.tab.on("request", lambda r: self.requests.append(r.url))
        self.tab.goto((folder / "view.html").as_uri())

    def picture(self) -> np.ndarray:
        """The canvas (H, W, 3) once what is pending has been drawn."""
        self.tab.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        self.tab.add_style_tag(content=".views, .hint { opacity: 0 }")
        png = self.tab.locator("#canvas").screenshot()
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)

    def drag(self, dx: int, dy: int, button: str = "left") -> None:
        self.tab.mouse.move(300, 300)
        self.tab.mouse.down(button=button)
        self.tab.mouse.move(300 + dx, 300 + dy, steps=3)
        self.tab.mouse.up(button=button)


@pytest.fixture
def opened(browser: Any, make_decision: Make, tmp_path: Path) -> Iterator[Page]:
    page = Page(browser, make_decision(width=320, height=240, instruction=NASTY), tmp_path)
    yield page
    page.tab.close()
    assert page.complaints == []
    assert [r for r in page.requests if not r.startswith("data:")] == [(tmp_path / "view.html").as_uri()]


def differs(a: np.ndarray, b: np.ndarray) -> float:
    return float((np.abs(a - b).max(axis=2) > 20).mean())


def test_first_view_is_the_cameras(opened: Page, make_decision: Make) -> None:
    for name in ("candidates", "chosen", "target", "point", "plane"):
        opened.tab.uncheck(f'input[data-layer="{name}"]')
    picture = opened.picture()
    decision = make_decision(width=320, height=240)
    height, width = picture.shape[:2]
    s = min(width / 320, height / 240)
    compared = 0
    for proposal in decision.scene.proposals:
        v, u = np.nonzero(ndimage.binary_erosion(proposal.mask, iterations=3))
        if len(u) == 0:
            continue
        x, y = (u + 0.5 - 160) * s + width / 2, (v + 0.5 - 120) * s + height / 2
        seen = picture[y.astype(int), x.astype(int)]
        compared += len(u)
        assert np.median(np.abs(seen - decision.scene.frame.color[v, u]).max(axis=1)) < 12, proposal.mark
    assert compared > 1000


def test_turning_zooming_and_panning(opened: Page) -> None:
    start = opened.picture()
    assert (np.abs(start - BACKGROUND).max(axis=2) > 20).mean() > 0.3
    opened.drag(120, -30)
    turned = opened.picture()
    assert differs(start, turned) > 0.2
    opened.drag(40, 25, button="right")
    panned = opened.picture()
    back = np.roll(panned, (-25, -40), axis=(0, 1))
    inner = slice(60, -60)
    assert differs(turned[inner, inner], back[inner, inner]) < 0.8 * differs(turned[inner, inner], panned[inner, inner])
    assert differs(turned, panned) > 0.15
    opened.tab.click("#camera-view")
    assert differs(start, opened.picture()) < 0.001
    opened.tab.mouse.move(300, 300)
    opened.tab.mouse.wheel(0, 400)
    assert (np.abs(opened.picture() - BACKGROUND).max(axis=2) > 20).mean() < 0.75 * (
        np.abs(start - BACKGROUND).max(axis=2) > 20
    ).mean()
    opened.tab.click("#close-up")
    close = opened.picture()
    blue = np.abs(close - [72, 190, 255]).max(axis=2) < 140
    assert blue.mean() > 0.01
    opened.tab.focus("#canvas")
    opened.tab.keyboard.press("ArrowLeft")
    assert differs(close, opened.picture()) > 0.05


def test_each_toggle_changes_the_picture_and_back(opened: Page) -> None:
    opened.tab.click("#close-up")
    before = opened.picture()
    for name in ("candidates", "chosen", "target", "point", "plane"):
        opened.tab.uncheck(f'input[data-layer="{name}"]')
        assert differs(before, opened.picture()) > 0.00003, name
        opened.tab.check(f'input[data-layer="{name}"]')
        assert differs(before, opened.picture()) == 0, name


def test_words_are_shown_as_said_and_do_nothing(opened: Page, request: pytest.FixtureRequest) -> None:
    said = opened.tab.inner_text("h1")
    assert said.startswith('</script><script>window.broken = 1</script> <b>"it\'s" & 你好 🍌 ?')
    assert said.endswith("{{scene}}")
    assert opened.tab.evaluate("typeof window.broken") == "undefined"
    painter = opened.tab.get_attribute("#canvas", "data-painter")
    without = "no-webgl" in request.node.name
    assert painter == "CanvasPainter" if without else painter in ("WebGLPainter", "CanvasPainter")
