"""A server in a process of its own: what keeps it from starting is said, and nothing of it is left."""

from __future__ import annotations

import gc
import threading

import pytest

from thinkgrasp.errors import ServerError
from thinkgrasp.server.background import server_process


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("--preset", "nothing"), "did not start: error: no preset 'nothing'"),
        (("--workers", "0", "--gripper", "nowhere"), "did not start: error: no gripper 'nowhere'"),
    ],
)
def test_what_keeps_it_from_starting_is_said(args: tuple[str, ...], said: str):
    threads = threading.active_count()
    with pytest.raises(ServerError, match=said), server_process(*args):
        pass
    gc.collect()  # a pipe that was left open would warn here
    assert threading.active_count() == threads
