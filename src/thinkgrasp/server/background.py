"""A server in a process of its own, for as long as a block runs: for notebooks, benchmarks and tests."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TextIO, cast

from thinkgrasp.errors import ServerError
from thinkgrasp.outputs import one_line
from thinkgrasp.server.client import TOKEN_VARIABLE, Client

STOP_S = 30
POLL_S = 0.1


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
    command = [sys.executable, "-m", "thinkgrasp.cli", "serve", "--port", "0", *args]
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=dict(environment)
    ) as process:
        log = cast(TextIO, process.stderr)
        last: deque[str] = deque(maxlen=1)
        reader = threading.Thread(target=last.extend, args=(log,), daemon=True)  # else the pipe fills up and stops it
        try:
            first = log.readline()
            found = re.search(r" at (http://\S+)", first)
            reader.start()
            if found is None:
                raise ServerError(f"the server did not start: {one_line(first)}")
            with Client(found[1], token=environment.get(TOKEN_VARIABLE, "")) as client:
                deadline = time.monotonic() + ready_s
                while not client.is_ready():
                    if process.poll() is not None:
                        reader.join()
                        raise ServerError(f"the server did not start: {one_line(''.join(last))}")
                    if time.monotonic() > deadline:
                        raise ServerError(f"{found[1]} was not ready within {ready_s:g} s")
                    time.sleep(POLL_S)
            yield found[1]
        finally:
            process.terminate()
            try:
                process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                process.kill()
            reader.join()
