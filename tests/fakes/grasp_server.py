"""A ThinkGrasp server on a free port: with the offline preset, or with stages that do as they are told."""

from __future__ import annotations

import base64
import io
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import httpx
import numpy as np
from fakes.told_stages import told_pipeline
from PIL import Image

from thinkgrasp.config import StageConfig, load_config
from thinkgrasp.server.app import ServerOptions
from thinkgrasp.server.calls import frame_parts
from thinkgrasp.server.limits import Limits
from thinkgrasp.server.serving import make_server
from thinkgrasp.server.workers import Recipe
from thinkgrasp.types import Frame

TOKEN = "correct-horse-battery-staple"


@dataclass(frozen=True)
class Running:
    """A server that answers."""

    port: int
    http: httpx.Client
    """Sends to it."""

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"


@contextmanager
def running(recipe: Recipe | None = None, options: ServerOptions | None = None) -> Iterator[Running]:
    """Run a server in a thread until the end of the block; its models are loaded when the block begins."""
    server = make_server(recipe or offline_recipe(), options or ServerOptions())
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(128)
        port = listener.getsockname()[1]
        thread = threading.Thread(target=server.run, args=([listener],), daemon=True)
        thread.start()
        with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60) as http:
            try:
                deadline = time.monotonic() + 60
                while http.get("/readyz").status_code != 200:
                    assert time.monotonic() < deadline, "the server is not ready after a minute"
                    time.sleep(0.05)
                yield Running(port, http)
            finally:
                server.should_exit = True
                thread.join(30)
                assert not thread.is_alive()


def offline_recipe(limits: Limits | None = None) -> Recipe:
    return Recipe(load_config("offline"), (limits or Limits()).pixels)


def told_recipe(**orders: object) -> Recipe:
    """A recipe whose fake stages carry orders out: see `fakes.told_stages`."""
    config = replace(load_config("offline"), planner=StageConfig("told", orders))
    return Recipe(config, Limits().pixels, make=told_pipeline)


def png(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "PNG")
    return buffer.getvalue()


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def parts_of(frame: Frame, instruction: str = "the red box", **options: object) -> dict[str, tuple[str, bytes, str]]:
    """Multipart parts for httpx's `files`."""
    return {**frame_parts(frame, options), "instruction": ("i.txt", instruction.encode(), "text/plain")}


def json_of(frame: Frame, instruction: str = "the red box", **more: object) -> dict[str, object]:
    """The same as values for a JSON body."""
    parts = frame_parts(frame, {})
    files = {n: base64.b64encode(parts[n][1]).decode() for n in ("color", "depth")}
    return {**files, "camera": json.loads(parts["camera"][1]), "instruction": instruction, **more}
