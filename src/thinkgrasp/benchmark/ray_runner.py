"""Where a benchmark runs: on a Ray cluster, one core per group of episodes. Results are those of local processes."""

from __future__ import annotations

import queue
import socket
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, cast

from thinkgrasp.benchmark.methods import check_methods
from thinkgrasp.benchmark.plan import BenchmarkPlan
from thinkgrasp.benchmark.records import EpisodeRecord, Record, SceneRecord
from thinkgrasp.benchmark.runner import THREAD_VARIABLES, Died, Group, Source, methods_of, run_group, take_group
from thinkgrasp.errors import ConfigError, MissingDependency

CONNECT_S = 5.0
"""Ray itself tries for minutes."""


def ray_workers(address: str) -> Source:
    """Return a source of the workers of a cluster, on whose nodes thinkgrasp is installed.

    Args:
        address: "HOST:PORT" of the cluster's head, "auto" for the one that this machine belongs to, or "local" for
            one that is started for this run.

    Raises:
        MissingDependency: Ray is not installed.
        ConfigError: The cluster cannot be reached.
    """
    try:
        import ray
        from ray.exceptions import RayError
    except ModuleNotFoundError as error:
        raise MissingDependency("ray", "ray", "running a benchmark on a cluster") from error
    host, colon, port = address.rpartition(":")
    if colon and port.isdecimal() and "/" not in address:
        try:
            socket.create_connection((host, int(port)), CONNECT_S).close()
        except (OSError, OverflowError) as error:
            raise ConfigError(f"the Ray cluster {address!r} cannot be reached: {error}") from error
    environment = {"env_vars": dict.fromkeys(THREAD_VARIABLES, "1")}
    try:
        ray.init(
            address=address, runtime_env=environment, log_to_driver=False, configure_logging=False,
        )  # fmt: skip
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise ConfigError(f"the Ray cluster {address!r} cannot be reached: {error}") from error
    remote: Any = ray.remote(num_cpus=1, max_retries=0)(_records)

    def run(plan: BenchmarkPlan, groups: deque[Group]) -> Iterator[Record | Died]:
        try:
            ray.get(ray.remote(check_methods).remote(methods_of(plan, groups)))
        except RayError as error:
            ray.shutdown()
            raise ConfigError(str(getattr(error, "cause", error))) from error
        return records(plan, groups)

    def records(plan: BenchmarkPlan, groups: deque[Group]) -> Iterator[Record | Died]:
        running: dict[Any, Group] = {}
        shared = ray.put(plan)
        slots = max(1, int(ray.cluster_resources().get("CPU", 1)))
        try:
            while groups or running:
                while groups and len(running) < slots:
                    group = take_group(groups, slots)
                    running[remote.remote(shared, group)] = group
                found, _ = ray.wait(list(running), num_returns=1)
                ready: Any = found[0]
                group = running.pop(ready)
                try:
                    record = cast(Record, ray.get(next(ready)))
                except StopIteration:
                    continue
                except RayError as error:
                    yield Died(group, f"its worker was lost: {str(error).strip().splitlines()[-1]}")
                    continue
                if isinstance(record, SceneRecord):
                    group = replace(group, needs_scene=False)
                elif isinstance(record, EpisodeRecord):
                    group = replace(group, methods=group.methods[1:])
                running[ready] = group
                yield record
        finally:
            for left in running:
                ray.cancel(left, force=True)
            ray.shutdown()

    return run


def _records(plan: BenchmarkPlan, group: Group) -> Iterator[Record]:
    """Yield the records of a group as they come."""
    said: queue.SimpleQueue[Record | None] = queue.SimpleQueue()

    def work() -> None:
        try:
            run_group(plan, group, said.put)
        finally:
            said.put(None)

    threading.Thread(target=work, daemon=True).start()
    while (record := said.get()) is not None:
        yield record
