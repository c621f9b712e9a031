"""The episode's page: what it says, and how it looks and behaves in a real browser."""

from __future__ import annotations

import base64
import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes.browser import Tab, chromium
from PIL import Image
from scipy.spatial import KDTree

from thinkgrasp.config import load_config, make_pipeline
from thinkgrasp.episode import EpisodeHeader
from thinkgrasp.errors import InputError
from thinkgrasp.gripper import GRIPPERS
from thinkgrasp.recorder import EpisodeRecorder
from thinkgrasp.sim.tabletop import demo_camera, demo_scene, render
from thinkgrasp.types import Decision, Degradation, Obstruction, Outcome, Usage
from thinkgrasp.viz import report
from thinkgrasp.viz.compact import compact_scene
from thinkgrasp.viz.graph import describe, draw_graph
from thinkgrasp.viz.report import write_report
from thinkgrasp.viz.view import render_view

GRIPPER = GRIPPERS["robotiq_2f85"]
NASTY = '</script><script>window.broken = 1</script> <b>"it\'s" & 你好 🍌 \x00 {{steps}}'
DARK = np.array([20, 23, 27])


@cache
def decisions() -> tuple[Decision, ...]:
    """What the offline pipeline decides on the demonstration frame: two grasps, and nothing found."""
    frame = render(demo_scene(0), *demo_camera()).frame
    pipeline = make_pipeline(load_config("offline"))
    said = ("I need a fruit", "something to drink from", "give me the scissors")
    return tuple(pipeline.decide(frame, words) for words in said)


NOTHING_SPENT = Usage()


def record(
    folder: Path,
    steps: list[tuple[Decision, Outcome | None]],
    *,
    preset: str = "offline",
    instruction: str = "I need a fruit",
    end: str | None = "goal_delivered",
    usage: Usage = NOTHING_SPENT,
) -> str:
    """Record an episode and return its page."""
    header = EpisodeHeader(instruction=instruction, goal="banana", preset=preset, seed=7)
    recorder = EpisodeRecorder(folder, header=header, gripper=GRIPPER)
    for step in steps:
        recorder.record(*step)
    if end is not None:
        recorder.finish(end=end, success=end == "goal_delivered", usage=usage)
    return (folder / "report.html").read_text("utf-8")


@pytest.fixture(scope="module")
def episode(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Missed, cleared, nothing found, held; with a video."""
    folder = tmp_path_factory.mktemp("episode")
    fruit, glass, nothing = decisions()
    cleared = replace(glass, plan=replace(glass.plan, role="obstruction"))
    Image.new("RGB", (64, 48), (90, 90, 90)).save(folder / "still.webp")
    steps = [(fruit, Outcome(False, "missed")), (cleared, Outcome(True, "held")), (nothing, None)]
    record(folder, [*steps, (fruit, Outcome(True, "held"))])
    shutil.copy(folder / "still.webp", folder / "episode.webp")
    write_report(folder)
    return folder


def words(page: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", re.sub(r"(?s)<(script|style).*?</\1>", "", page)))


# What it says


def test_page_tells_the_episode(episode: Path) -> None:
    page = (episode / "report.html").read_text("utf-8")
    said = words(page)
    assert page.count('<article class="step"') == 4
    for expected in (
        "“I need a fruit”",
        "Goal reached Ended because the goal is in the bin.",
        "Steps 4 Grasps held 2 of 3 Goal banana Preset offline Seed 7",
        "Take the goal: yellow banana The fingers closed on nothing. ✕ Missed",
        "Clear the way: grey glass",
        "✓ Held",
        "Nothing to take for scissors",
        "– No target",
        decisions()[0].plan.rationale.split(":")[0],
        "candidates 600",
        "Remembered failures before this step Step 1 : yellow banana, cell 2, missed",
        "Fallbacks taken segment :",
        "The whole step took",
    ):
        assert expected in said, expected
    assert "Oracle" not in said
    assert page.count('class="video"') == 1


def test_first_step_remembers_nothing(episode: Path) -> None:
    assert "Remembered" not in words((episode / "steps/001/panel.html").read_text("utf-8"))


def test_oracle_is_said_loudly(tmp_path: Path) -> None:
    said = words(record(tmp_path, [], preset="oracle", end="nothing_left"))
    assert "Oracle: reads the simulator’s truth" in said
    assert "✕ Goal not reached Ended because nothing in view answers to the instruction or can hide it." in said


def test_running_episode_is_shown_after_every_step(tmp_path: Path) -> None:
    page = record(tmp_path, [(decisions()[2], None)], end=None)
    assert page.count('<article class="step"') == 1
    assert "Not ended" in words(page)


def test_unknown_reasons_are_shown_as_they_are(tmp_path: Path) -> None:
    said = words(record(tmp_path, [(decisions()[0], Outcome(False, "bin_is_full"))]))
    assert "The robot reported this reason. ✕ Bin is full" in said


def test_page_refers_to_nothing_outside(episode: Path) -> None:
    page = (episode / "report.html").read_text("utf-8")
    assert not re.search(r"(?:src|href)=\"(?!data:|#)|https?://|@import|url\((?!\$)", page)


def test_fifteen_steps_stay_small(episode: Path) -> None:
    panels = [p.stat().st_size for p in episode.glob("steps/*/panel.html")]
    assert 15 * max(panels) < 6_000_000


def test_a_large_video_is_linked(episode: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "MAX_INLINE_VIDEO_BYTES", 10)
    page = report.render_report(report.read_episode(episode))
    assert '<a href="episode.webp">' in page


def test_a_missing_panel_is_named(tmp_path: Path) -> None:
    record(tmp_path, [(decisions()[2], None)])
    (tmp_path / "steps/001/panel.html").unlink()
    with pytest.raises(InputError, match=r"panel\.html cannot be read: No such file"):
        write_report(tmp_path)


# The compact 3-D scene and the graph


def test_compact_scene_is_the_view_with_fewer_points() -> None:
    decision = decisions()[0]
    found = re.search(r'id="scene">(.*?)</script>', render_view(decision, GRIPPER), re.S)
    assert found is not None
    full, small = json.loads(found[1]), json.loads(compact_scene(decision, GRIPPER))
    assert {x["name"] for x in small["layers"]} == {x["name"] for x in full["layers"]}
    sizes = dict.fromkeys(("points", "lines", "triangles"), 0)
    for layer in small["layers"]:
        sizes[layer["kind"]] += len(_vertices(layer))
    assert 8000 < sizes["points"] <= 15000
    chosen = [np.concatenate([_floats(x) for x in full["layers"] if x["name"] == "chosen"])]
    chosen.append(np.concatenate([_vertices(x) for x in small["layers"] if x["name"] == "chosen"]))
    np.testing.assert_allclose(chosen[1], chosen[0], atol=2e-5)
    cloud = np.concatenate([_vertices(x) for x in small["layers"] if x["kind"] == "points"])
    points = decision.scene.points[np.isfinite(decision.scene.points[..., 2])]
    assert np.max(KDTree(points).query(cloud[::10])[0]) < 2e-4


def _vertices(layer: dict[str, Any]) -> np.ndarray:
    packed = np.frombuffer(base64.b64decode(layer["positions"]), "<i2").reshape(-1, 3)
    return np.array(layer["origin"]) + layer["scale"] * packed


def _floats(layer: dict[str, Any]) -> np.ndarray:
    return np.frombuffer(base64.b64decode(layer["positions"]), "<f4").reshape(-1, 3)


def test_graph_draws_every_thing_apart_and_every_pair_once() -> None:
    scene = decisions()[0].scene
    drawing = draw_graph(scene, 9)
    centers = np.array(re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', drawing), float)
    assert len(centers) == len(scene.proposals)
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=2) + 1e3 * np.eye(len(centers))
    assert distance.min() > 26
    assert drawing.count('class="edge') == len({(e.a, e.b) for e in scene.obstructions})
    assert drawing.count("node target") == 1
    assert draw_graph(replace(scene, proposals=()), None) == ""


def test_things_on_one_spot_are_parted() -> None:
    scene = decisions()[0].scene
    same = tuple(replace(p, box_xyxy=(100, 100, 140, 140)) for p in scene.proposals)
    centers = re.findall(r'<circle cx="([\d.]+)" cy="([\d.]+)"', draw_graph(replace(scene, proposals=same), None))
    assert len(set(centers)) == len(same)


@pytest.mark.parametrize(
    ("edge", "said"),
    [
        (Obstruction("hides", 3, 2, 45.0, "px"), "3 hides 2 (45 px of its edge)"),
        (Obstruction("rests_on", 3, 2, 0.0143, "m"), "3 rests on 2 (gap 14 mm)"),
        (Obstruction("rests_on", 3, 2, -0.0024, "m"), "3 rests on 2 (sunk in 2 mm)"),
        (Obstruction("blocks", 3, 2, 0.006, "m"), "3 blocks 2 (6 mm of room)"),
    ],
)
def test_evidence_is_said_in_its_unit(edge: Obstruction, said: str) -> None:
    assert describe(edge) == said


# In the browser


@pytest.fixture(scope="module", params=["any", "no-webgl"])
def browser(request: pytest.FixtureRequest) -> Iterator[Any]:
    with chromium(webgl=request.param == "any") as started:
        yield started


WEBGL = pytest.mark.parametrize("browser", ["any"], indirect=True)


@pytest.fixture
def opened(browser: Any, episode: Path) -> Iterator[Tab]:
    tab = Tab(browser, (episode / "report.html").as_uri())
    yield tab
    tab.page.close()
    assert tab.complaints == []
    assert tab.foreign_requests(tab.url) == []


def drawn(tab: Tab, step: int) -> np.ndarray:
    """A step's canvas once it has been drawn, without what floats above it."""
    tab.page.locator(f"#step-{step}").scroll_into_view_if_needed()
    tab.page.locator(f"#step-{step} .space").scroll_into_view_if_needed()
    tab.page.wait_for_selector(f'#step-{step} canvas[data-drawn="true"]')
    tab.page.add_style_tag(content=".space .views, .space .wake { opacity: 0 }")
    tab.page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return tab.picture(f"#step-{step} canvas")


def test_each_step_draws_its_space(opened: Tab) -> None:
    for step in (1, 2, 3, 4):
        picture = drawn(opened, step)
        assert (np.abs(picture - DARK).max(axis=2) > 20).mean() > 0.3, step
    assert (np.abs(drawn(opened, 1) - [72, 190, 255]).max(axis=2) < 140).mean() > 0.01


def test_space_is_still_until_it_is_woken(opened: Tab) -> None:
    before = drawn(opened, 1)
    box = opened.page.locator("#step-1 canvas").bounding_box()

    def drag() -> np.ndarray:
        opened.page.mouse.move(box["x"] + 200, box["y"] + 150)
        opened.page.mouse.down()
        opened.page.mouse.move(box["x"] + 290, box["y"] + 130, steps=3)
        opened.page.mouse.up()
        return drawn(opened, 1)

    assert np.abs(drag() - before).max() == 0
    opened.page.click("#step-1 .wake")
    turned = drag()
    assert (np.abs(turned - before).max(axis=2) > 20).mean() > 0.1
    opened.page.click('#step-1 [data-toggle="candidates"]')
    assert (np.abs(drawn(opened, 1) - turned).max(axis=2) > 20).mean() > 0.0005
    opened.page.click('#step-1 [data-view="close"]')
    opened.page.click('#step-1 [data-toggle="candidates"]')
    assert np.abs(drawn(opened, 1) - before).max() == 0
    opened.page.keyboard.press("Escape")
    assert np.abs(drag() - before).max() == 0


def test_marks_and_decision_are_two_tabs(opened: Tab) -> None:
    decision, marks = (opened.page.locator(f"#step-1 img.{name}") for name in ("decision", "marks"))
    assert decision.is_visible()
    assert not marks.is_visible()
    opened.page.click('label[for="seen-1-marks"]')
    assert marks.is_visible()
    assert not decision.is_visible()
    assert marks.evaluate("image => image.naturalWidth") == 640


def test_steps_are_reached_from_the_list(opened: Tab) -> None:
    opened.page.click('.steps-nav a[href="#step-4"]')
    top = np.inf
    for _ in range(50):  # the page's security policy forbids wait_for_function
        top = opened.page.evaluate("document.querySelector('#step-4').getBoundingClientRect().top")
        if abs(top) < 50:
            break
        opened.page.wait_for_timeout(100)
    assert abs(top) < 50


@WEBGL
@pytest.mark.parametrize(("width", "dark"), [(360, True), (768, False), (1280, True)])
def test_nothing_runs_out_of_the_page(browser: Any, episode: Path, width: int, dark: bool) -> None:
    tab = Tab(browser, (episode / "report.html").as_uri(), width=width, dark=dark)
    for step in (1, 4):
        drawn(tab, step)
    assert tab.page.evaluate("document.documentElement.scrollWidth") == width
    background = tab.page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert background == ("rgb(20, 23, 27)" if dark else "rgb(246, 247, 248)")
    tab.page.close()
    assert tab.complaints == []


@WEBGL
def test_many_steps_keep_few_contexts(browser: Any, make_decision: Callable[..., Decision], tmp_path: Path) -> None:
    record(tmp_path, [(make_decision(), Outcome(False, "slipped"))] * 7)
    tab = Tab(browser, (tmp_path / "report.html").as_uri())
    for step in range(1, 8):
        drawn(tab, step)
    assert tab.page.locator("canvas[data-drawn]").count() <= 6
    assert (np.abs(drawn(tab, 1) - DARK).max(axis=2) > 20).mean() > 0.3  # it comes back
    tab.page.close()
    assert tab.complaints == []


@WEBGL
def test_words_are_shown_as_said_and_do_nothing(browser: Any, tmp_path: Path) -> None:
    fruit = decisions()[0]
    assert fruit.target is not None
    nasty = replace(
        fruit,
        instruction=NASTY,
        plan=replace(fruit.plan, target=NASTY, rationale=NASTY),
        target=replace(fruit.target, label=NASTY),
        degraded=(Degradation(NASTY, NASTY, NASTY),),
    )
    folder = tmp_path / "nasty"
    record(folder, [(nasty, Outcome(False, NASTY)), (nasty, None)], instruction=NASTY, preset=NASTY, end=NASTY)
    tab = Tab(browser, (folder / "report.html").as_uri())
    assert tab.page.locator("h1").inner_text().startswith("“</script><script>window.broken = 1</script> <b>")
    assert tab.page.evaluate("typeof window.broken") == "undefined"
    assert tab.page.locator("article.step").count() == 2
    assert tab.page.locator("main b b, main script script").count() == 0
    tab.page.close()
    assert tab.complaints == []
