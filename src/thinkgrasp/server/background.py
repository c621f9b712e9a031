"""A server in a process of its own, for as long as a block runs: for notebooks, benchmarks and tests."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TextIO

from thinkgrasp.errors import ServerError
from thinkgrasp.outputs import one_line
from thinkgrasp.server.client import TOKEN_VARIABLE, Client

STOP_S = 30


@contextmanager
def server_process(*args: str, environment: Mapping[str, str] | None = None, ready_s: float = 120) -> Iterator[str]:
    """Run `thinkgrasp serve` on a free port, and yield its address once its models are loaded.

    Args:
        *args: Of the command, for example "--workers", "2".
        environment: Of the process; None = this one's without a token.
        ready_s: How long the models may take.

    Raises:
        ServerError: It did not start, or was not ready in time.
    """
    if environment is None:
        environment = {name: value for name, value in os.environ.items() if name != TOKEN_VARIABLE}
    process = subprocess.Popen(
        [sys.executable, "-m", "thinkgrasp.cli", "serve", "--port", "0", *args],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=dict(environment),
    )
    log = process.stderr
    try:
        first = log.readline() if log is not None else ""
        found = re.search(r" at (http://\S+)", first)
        if log is None or found is None:
            raise ServerError(f"the server did not start: {one_line(first)}")
        threading.Thread(target=_read_away, args=(log,), daemon=True).start()
        with Client(found[1], token=environment.get(TOKEN_VARIABLE, "")) as client:
            client.wait_until_ready(ready_s)
        yield found[1]
    finally:
        process.terminate()
        try:
            process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _read_away(log: TextIO) -> None:
    """Keep the pipe from filling up, which would stop the server."""
    with log:
        for _ in log:
            pass
