"""Who gets a worker when: a bound on how many wait, and jobs that end when their client leaves."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from thinkgrasp.errors import ThinkGraspError
from thinkgrasp.server.jobs import Answer, Job
from thinkgrasp.server.limits import Limits
from thinkgrasp.server.logs import where_raised
from thinkgrasp.server.workers import Cancelled, Watch, Worker

RESTART_WAITS_S = (0.0, 1.0, 5.0, 30.0)
"""Before a worker that could not be started anew is tried again; the last one from then on."""
WATCH_S = 1.0
"""How often workers that wait for a job are looked at."""


class Busy(Exception):
    """Every worker is busy and enough requests wait already."""

    def __init__(self, retry_after_s: int) -> None:
        super().__init__(f"the server is busy; try again in {retry_after_s} s")
        self.retry_after_s = retry_after_s


class NotReady(Exception):
    """No worker has its models loaded."""


class Pool:
    """Workers, and the requests that want one.

    Args:
        workers: Not started yet.
        limits: How many may wait, and for how long a stage may run.
        recycle_after: A worker's process is started anew after so many jobs; 0 = never.
        on_stage: Told each stage that ended and its seconds.
        on_restart: Told why a worker is started anew.
        on_unloadable: Told why the models cannot be loaded at the start.
    """

    def __init__(
        self,
        workers: Sequence[Worker],
        limits: Limits,
        *,
        recycle_after: int = 0,
        on_stage: Callable[[str, float], None] = lambda stage, seconds: None,
        on_restart: Callable[[str], None] = lambda reason: None,
        on_unloadable: Callable[[str], None] = lambda message: None,
    ) -> None:
        self.workers = tuple(workers)
        self._limits = limits
        self._recycle_after = recycle_after
        self._on_stage, self._on_restart, self._on_unloadable = on_stage, on_restart, on_unloadable
        self._idle: asyncio.Queue[Worker] = asyncio.Queue()
        self._done: dict[int, int] = {}
        self._threads = ThreadPoolExecutor(len(self.workers), "thinkgrasp-worker")
        self._tasks: set[asyncio.Task[None]] = set()
        self._admitted = 0
        self._typical_s = 1.0
        self._closed = False
        self._was_ready = False

    @property
    def ready(self) -> int:
        """How many workers have their models loaded."""
        return sum(worker.is_usable() for worker in self.workers)

    @property
    def admitted(self) -> int:
        """How many requests have a worker or wait for one."""
        return self._admitted

    @property
    def waiting(self) -> int:
        """How many requests wait for a worker."""
        return max(0, self._admitted - len(self.workers))

    def start(self) -> None:
        """Begin to start the workers; to be called in the event loop."""
        for worker in self.workers:
            self._spawn(self._bring_up(worker, first=True))
        self._spawn(self._replace_dead())

    async def close(self) -> None:
        """End the workers; what they do is lost."""
        self._closed = True
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*(asyncio.to_thread(worker.close) for worker in self.workers))
        self._threads.shutdown(wait=False, cancel_futures=True)

    @contextmanager
    def admit(self) -> Iterator[None]:
        """Hold a place among those that have a worker or wait for one.

        Raises:
            Busy: There is none.
            NotReady: No worker has ever been ready.
        """
        if not self._was_ready:
            raise NotReady
        if self._admitted >= len(self.workers) + self._limits.queue:
            raise self._busy()
        self._admitted += 1
        try:
            yield
        finally:
            self._admitted -= 1

    async def carry_out(self, job: Job, left: Awaitable[None]) -> Answer:
        """Carry a job out on the next worker that is free.

        Args:
            job: What to do.
            left: Ends when the client has left.

        Raises:
            Cancelled: The client left.
            Busy: No worker became free in time.
            NotReady: None is usable.
            Refused: The job's input cannot be used.
            StageTimeout: A stage took too long.
            WorkerFailed: A bug, or the end of the worker's process.
        """
        leaving = asyncio.ensure_future(left)
        try:
            worker = await self._next(leaving)
            watch = Watch(self._limits, self._on_stage)
            loop = asyncio.get_running_loop()
            begun = loop.time()
            running = loop.run_in_executor(self._threads, worker.carry_out, job, watch)
            running.add_done_callback(lambda _: self._after(worker))
            try:
                await asyncio.wait({running, leaving}, return_when=asyncio.FIRST_COMPLETED)
                if not running.done():
                    raise Cancelled
                answer = running.result()
            finally:
                if not running.done():
                    watch.left.set()
                    running.add_done_callback(_forget)
            self._typical_s += 0.2 * (loop.time() - begun - self._typical_s)
            return answer
        finally:
            leaving.cancel()

    async def _next(self, leaving: asyncio.Future[None]) -> Worker:
        """Return a free worker, or raise Cancelled, Busy or NotReady where there is none before it is too late."""
        loop = asyncio.get_running_loop()
        deadline = loop.time() + self._limits.wait_s
        while True:
            getting = asyncio.ensure_future(self._idle.get())
            try:
                left_s = deadline - loop.time()
                await asyncio.wait({getting, leaving}, timeout=left_s, return_when=asyncio.FIRST_COMPLETED)
                if not getting.done():
                    raise Cancelled if leaving.done() else self._busy() if self.ready else NotReady
            finally:
                getting.cancel()
            worker = getting.result()
            if worker.is_usable():
                return worker
            self._restart(worker, "ended")  # its process was ended from outside while it waited for a job

    def _busy(self) -> Busy:
        ahead = self._admitted / len(self.workers)
        return Busy(min(60, max(1, math.ceil(self._typical_s * ahead / 2))))

    def _after(self, worker: Worker) -> None:
        """Give a worker back, started anew where it has to be."""
        if self._closed:
            return
        done = self._done[id(worker)] = self._done.get(id(worker), 0) + 1
        if not worker.is_usable():
            self._restart(worker, "ended")
        elif self._recycle_after and done >= self._recycle_after:
            self._restart(worker, "recycled")
        else:
            self._idle.put_nowait(worker)

    async def _replace_dead(self) -> None:
        """Start workers anew whose process ended while they waited for a job: no job comes to a server not ready."""
        while not self._closed:
            await asyncio.sleep(WATCH_S)
            for _ in range(self._idle.qsize()):
                worker = self._idle.get_nowait()
                if worker.is_usable():
                    self._idle.put_nowait(worker)
                else:
                    self._restart(worker, "ended")

    def _restart(self, worker: Worker, reason: str) -> None:
        self._on_restart(reason)
        self._spawn(self._bring_up(worker))

    async def _bring_up(self, worker: Worker, *, first: bool = False) -> None:
        """Start a worker until that succeeds; at the server's start a failure is reported instead."""
        self._done[id(worker)] = 0
        attempt = 0
        while not self._closed:
            await asyncio.sleep(RESTART_WAITS_S[min(attempt, len(RESTART_WAITS_S) - 1)])
            try:
                await asyncio.get_running_loop().run_in_executor(self._threads, worker.start)
            except Exception as error:  # a plug-in may fail in any way while it is made
                if self._closed:
                    return
                if first:
                    self._on_unloadable(str(error) if isinstance(error, ThinkGraspError) else where_raised(error))
                    return
                self._on_restart("failed")
                attempt += 1
            else:
                self._was_ready = True
                self._idle.put_nowait(worker)
                return

    def _spawn(self, work: Awaitable[None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)  # type: ignore[arg-type]
        task.add_done_callback(self._tasks.discard)  # type: ignore[arg-type]


def _forget(running: asyncio.Future[Answer]) -> None:
    """Take note of what became of a job that nobody waits for, so that asyncio does not complain."""
    if not running.cancelled():
        running.exception()
