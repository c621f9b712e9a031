"""Many independent trials on a few processes, kept as they come, and what may be said of k successes in n."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Generic, TypeVar

from pydantic import TypeAdapter

from thinkgrasp.benchmark.statistics import wilson

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_all(work: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Yield the results of an importable function in the order in which they are finished.

    The jobs run in fresh processes with one thread for linear algebra, so that sums are the same for any number of
    workers; the processes end when this one does, however it ends.
    """
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[variable] = "1"
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(max(1, min(workers, len(jobs))), mp_context=spawn, initializer=_end_with_parent)
    try:
        for future in as_completed([pool.submit(work, job) for job in jobs]):
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


class TrialLog(Generic[Result]):
    """A file of records that survives the end of the process at any moment; a torn last line is cut off.

    Args:
        path: Appended to when it exists; None = nothing is written.
        kind: The records' class.
    """

    def __init__(self, path: Path | None, kind: type[Result]) -> None:
        self._path = path
        self._adapter = TypeAdapter(kind)
        self.records: list[Result] = []
        if path is None or not path.exists():
            return
        content = path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            os.truncate(path, len(whole))
        self.records = [self._adapter.validate_json(line) for line in whole.splitlines()]

    def add(self, record: Result) -> None:
        """Append a record and wait until it is on the disk."""
        self.records.append(record)
        if self._path is None:
            return
        with self._path.open("ab") as file:
            file.write(self._adapter.dump_json(record) + b"\n")
            file.flush()
            os.fsync(file.fileno())


def rate(k: int, n: int) -> str:
    """Return "87/100 = 87.0 % (95 %: 79.0 to 92.2)"."""
    if n == 0:
        return "0/0"
    low, high = wilson(k, n)
    return f"{k}/{n} = {100 * k / n:.1f} % (95 %: {100 * low:.1f} to {100 * high:.1f})"
