"""Headless Chromium, and what a page complained of or asked for."""

from __future__ import annotations

import io
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from PIL import Image


@contextmanager
def chromium(*, webgl: bool = True) -> Iterator[Any]:
    """Chromium with or without WebGL; skips where there is none, fails on CI."""
    executable = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if executable is None:
        message = "no Chromium on the PATH; on Debian: apt-get install chromium"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    from playwright.sync_api import sync_playwright

    switch = "--enable-unsafe-swiftshader" if webgl else "--disable-3d-apis"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=["--no-sandbox", switch])
        yield browser
        browser.close()


class Tab:
    """One open page."""

    def __init__(self, browser: Any, url: str, *, width: int = 1280, height: int = 800, dark: bool = False) -> None:
        self.url = url
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.page = browser.new_page(
            viewport={"width": width, "height": height}, color_scheme="dark" if dark else "light"
        )
        self.page.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda e: self.complaints.append(str(e)))
        self.page.on("request", lambda r: self.requests.append(r.url))
        self.page.goto(url)

    def picture(self, selector: str) -> np.ndarray:
        """What an element looks like, (H, W, 3)."""
        png = self.page.locator(selector).screenshot()
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)

    def foreign_requests(self, own: str) -> list[str]:
        """Requests that went neither to a URL with this beginning nor to data of the page."""
        return [r for r in self.requests if not r.startswith(("data:", "blob:", own))]
