"""Who gets a worker when, with workers that do as they are told and cost no process."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable

import pytest
from fakes.told_stages import broken_pipeline

from thinkgrasp.config import load_config
from thinkgrasp.errors import ConfigError
from thinkgrasp.server import pool as pool_module
from thinkgrasp.server.decoding import FrameUpload
from thinkgrasp.server.jobs import Answer, Job, Sighting, Verified, Verify
from thinkgrasp.server.limits import Limits
from thinkgrasp.server.pool import Busy, NotReady, Pool
from thinkgrasp.server.workers import ProcessWorker, Recipe, Watch

NOTHING = Sighting.__new__(Sighting)
JOB = Verify(FrameUpload(b"", b"", b""), NOTHING)
LIMITS = Limits(wait_s=0.05)


class ToldWorker:
    """Is busy until it is told to go on, and usable while it is told so."""

    def __init__(self) -> None:
        self.go_on = threading.Event()
        self.usable = False
        self.starts = self.jobs = 0

    def start(self) -> None:
        self.starts += 1
        self.usable = True

    def carry_out(self, job: Job, watch: Watch) -> Answer:
        self.jobs += 1
        self.go_on.wait(10)
        return Verified(False)

    def is_usable(self) -> bool:
        return self.usable

    def memory_bytes(self) -> int:
        return 0

    def close(self) -> None:
        self.go_on.set()


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(10):
        while not holds():
            await asyncio.sleep(0.005)


async def started(worker: ToldWorker) -> Pool:
    pool = Pool([worker], LIMITS)
    pool.start()
    await until(lambda: pool.ready == 1 and worker.starts == 1)
    return pool


def never() -> asyncio.Future[None]:
    return asyncio.get_running_loop().create_future()


def test_a_request_waits_only_so_long_for_a_worker():
    async def run() -> None:
        worker = ToldWorker()
        pool = await started(worker)
        first = asyncio.ensure_future(pool.carry_out(JOB, never()))
        await until(lambda: worker.jobs == 1)
        with pytest.raises(Busy, match="try again"):
            await pool.carry_out(JOB, never())
        worker.go_on.set()
        assert (await first) == Verified(False)
        assert (await pool.carry_out(JOB, never())) == Verified(False)
        await pool.close()

    asyncio.run(run())


def test_a_request_does_not_wait_for_workers_that_cannot_be_started(monkeypatch: pytest.MonkeyPatch):
    async def run() -> None:
        worker = ToldWorker()
        pool = await started(worker)
        worker.usable = False
        monkeypatch.setattr(pool_module, "RESTART_WAITS_S", (60.0,))
        with pytest.raises(NotReady):
            await pool.carry_out(JOB, never())
        await pool.close()

    asyncio.run(run())


def test_a_worker_that_dies_while_it_waits_is_replaced_without_a_request(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pool_module, "WATCH_S", 0.01)

    async def run() -> None:
        worker = ToldWorker()
        pool = await started(worker)
        worker.usable = False
        await until(lambda: worker.starts == 2)
        worker.go_on.set()
        assert (await pool.carry_out(JOB, never())) == Verified(False)
        await pool.close()

    asyncio.run(run())


class ClosedMeanwhile(ProcessWorker):
    """Another thread closes it right after it was found to have a process."""

    @property
    def _process(self):
        found, self._found = self._found, None
        return found

    @_process.setter
    def _process(self, value) -> None:
        self._found = value


class Process:
    pid = 1

    def is_alive(self) -> bool:
        return True


@pytest.mark.parametrize("ask", [ProcessWorker.is_usable, ProcessWorker.memory_bytes])
def test_a_worker_may_be_closed_while_it_is_looked_at(ask: Callable[[ProcessWorker], object]):
    worker = ClosedMeanwhile(None, LIMITS)  # type: ignore[arg-type]
    worker._usable, worker._process = True, Process()
    ask(worker)


def test_why_the_models_cannot_be_loaded_is_said():
    worker = ProcessWorker(Recipe(load_config("offline"), LIMITS.pixels, make=broken_pipeline), LIMITS)
    with pytest.raises(ConfigError, match=r"^RuntimeError at told_stages\.py:\d+$"):
        worker.start()
    worker.close()
