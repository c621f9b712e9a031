"""The page in a real browser: files dropped, a sentence typed, the result seen."""

from __future__ import annotations

import base64
import os
from pathlib import Path

import numpy as np
import pytest
from fakes.browser import Tab, chromium
from fakes.grasp_server import TOKEN, Running, offline_recipe, running

from thinkgrasp.cameras.saving import save_frame
from thinkgrasp.server.app import ServerOptions
from thinkgrasp.testing import sample_frame

DROP = """
([target, files]) => {
  const dropped = new DataTransfer();
  for (const [name, type, content] of files) {
    const bytes = Uint8Array.from(atob(content), (c) => c.charCodeAt(0));
    dropped.items.add(new File([bytes], name, { type }));
  }
  document.querySelector(target).dispatchEvent(
    new DragEvent("drop", { dataTransfer: dropped, bubbles: true, cancelable: true }));
}
"""


@pytest.fixture(scope="module")
def server():
    with running(offline_recipe(), ServerOptions(workers=0)) as found:
        yield found


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> tuple[Path, ...]:
    return save_frame(sample_frame(), tmp_path_factory.mktemp("frame"))


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


def drop(tab: Tab, target: str, *files: Path) -> None:
    kinds = {".png": "image/png", ".json": "application/json"}
    sent = [[f.name, kinds[f.suffix], base64.b64encode(f.read_bytes()).decode()] for f in files]
    tab.page.evaluate(DROP, [target, sent])


def wait_for_result(tab: Tab, instruction: str) -> None:
    tab.page.wait_for_function(
        "text => !document.getElementById('result').hidden && document.getElementById('headline').textContent === text",
        arg=instruction,
        timeout=60_000,
    )


def test_files_are_dropped_a_sentence_typed_and_the_grasp_seen(browser, server: Running, files, tmp_path):
    tab = Tab(browser, server.url, width=1280, height=1400)
    page = tab.page
    page.wait_for_selector("#ready.yes")
    drop(tab, ".drop[data-role=color]", *files)  # all three at once: each goes where its name says
    for role, name in (("color", "color.png"), ("depth", "depth.png"), ("camera", "camera.json")):
        assert page.inner_text(f".drop[data-role={role}] .file") == name
    page.fill("#instruction", "the red box")
    page.click("#go")
    wait_for_result(tab, "the red box")
    assert page.inner_text("#status") == "GRASP"
    assert "red" in page.inner_text("#plan").lower()
    assert "collision" in page.inner_text("#funnel")
    assert "total" in page.inner_text("#times")
    assert '"schema": "thinkgrasp/decision-1"' in page.text_content("#json")
    assert page.evaluate("document.getElementById('overlay').naturalWidth") > 300
    view = page.frame_locator("#view").locator("canvas")
    view.wait_for()
    page.wait_for_timeout(300)
    shades = tab.picture("#view").reshape(-1, 3)
    assert (shades.std(axis=0) > 10).all(), "the 3-D view shows something"
    assert (shades[:, 2] - shades[:, 0] > 80).sum() > 300, "the gripper is drawn"
    keep = os.environ.get("THINKGRASP_SCREENSHOTS")
    page.screenshot(path=str(Path(keep or tmp_path) / "server-page.png"))

    page.fill("#instruction", "a bicycle")
    page.press("#instruction", "Enter")
    wait_for_result(tab, "a bicycle")
    assert page.inner_text("#status") == "NO TARGET"
    page.click("#numbers summary")
    page.fill("input[name=fx]", "wide")
    page.press("#instruction", "Enter")
    assert page.inner_text("#problem") == 'fx must be a number, got "wide"'
    assert page.is_hidden("#result"), "no old answer beside a new problem"
    page.fill("input[name=fx]", "")
    page.press("#instruction", "Enter")
    wait_for_result(tab, "a bicycle")
    if keep:
        page.wait_for_timeout(500)
        page.screenshot(path=str(Path(keep) / "server-page-nothing.png"))
    assert tab.foreign_requests(server.url) == []
    assert tab.complaints == []
    page.close()


def test_what_is_missing_is_said_and_numbers_can_be_typed(browser, server: Running, files):
    tab = Tab(browser, server.url, width=420, height=900)
    page = tab.page
    color, depth, camera = files
    page.click("#go")
    assert page.inner_text("#problem") == "Add the colour image."
    page.set_input_files("input[name=color]", str(color))
    page.click("#go")
    assert page.inner_text("#problem") == "Add the depth image."
    page.set_input_files("input[name=depth]", str(depth))
    page.click("#go")
    assert "type fx, fy, cx, cy" in page.inner_text("#problem")
    for name, value in (("fx", "590"), ("fy", "590"), ("cx", "319.5"), ("cy", "a")):
        page.fill(f"input[name={name}]", value)
    page.click("#go")
    assert page.inner_text("#problem") == 'cy must be a number, got "a"'
    page.fill("input[name=cy]", "119,5")
    page.fill("input[name=fx]", "295")
    page.fill("input[name=fy]", "295")
    page.fill("input[name=cx]", "159.5")
    page.click("#go")
    wait_for_result(tab, "the red box")
    assert page.evaluate("document.documentElement.scrollWidth") <= 420
    drop(tab, "body", camera)
    assert page.inner_text(".drop[data-role=camera] .file") == "camera.json"
    assert tab.complaints == []
    page.close()


def test_a_refusal_is_shown_as_the_server_says_it(browser, files):
    with running(offline_recipe(), ServerOptions(workers=0, token=TOKEN)) as guarded:
        tab = Tab(browser, guarded.url)
        page = tab.page
        color, depth, camera = files
        for name, file in (("color", color), ("depth", color), ("camera", camera)):
            page.set_input_files(f"input[name={name}]", str(file))
        page.click("#go")
        page.wait_for_selector("#token", state="visible")
        assert "wants a token" in page.inner_text("#problem")
        page.fill("#token", TOKEN)
        page.click("#go")
        page.wait_for_function("() => document.getElementById('problem').textContent.includes('picture of the depth')")
        page.set_input_files("input[name=depth]", str(depth))
        page.click("#go")
        wait_for_result(tab, "the red box")
        page.close()


def test_the_interfaces_page_shows_every_address(browser, server: Running):
    tab = Tab(browser, f"{server.url}/docs")
    tab.page.wait_for_selector("article")
    text = tab.page.inner_text("main")
    for path in ("/v1/grasp", "/v1/episodes/{episode_id}/observe", "/grasp_pose", "/metrics"):
        assert path in text
    assert "multipart/form-data" in text.lower()
    keep = os.environ.get("THINKGRASP_SCREENSHOTS")
    if keep:
        tab.page.screenshot(path=str(Path(keep) / "server-docs.png"))
    assert tab.foreign_requests(server.url) == []
    assert tab.complaints == []
    assert isinstance(tab.picture("main"), np.ndarray)
    tab.page.close()
