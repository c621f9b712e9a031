"""Ask a ThinkGrasp server, in a program that waits or in one that does not.

    from thinkgrasp.server.client import Client
    with Client("http://localhost:8000") as client:
        decision = client.grasp(frame, "the red box")       # a DecisionModel, as `thinkgrasp grasp --json` prints

Requests are described in `calls`; what is sent when, and what an answer means, once in `_Asker`. The two clients only
send and wait.
"""

from __future__ import annotations

import asyncio
import math
import os
import time
from collections.abc import Generator
from types import TracebackType
from typing import Any, Self, TypeVar

from pydantic import BaseModel, ValidationError

from thinkgrasp.errors import ConfigError, InputError, MissingDependency, ServerError
from thinkgrasp.outputs import one_line
from thinkgrasp.schema import DecisionModel
from thinkgrasp.server.calls import (
    READY_CALL,
    Call,
    begin_call,
    explain_call,
    grasp_call,
    observe_call,
    outcome_call,
    stop_call,
)
from thinkgrasp.server.calls import frame_parts as frame_parts
from thinkgrasp.server.schema import EpisodeAnswer, ExplainedDecision
from thinkgrasp.types import Frame

try:
    import httpx
except ModuleNotFoundError as missing:
    if missing.name != "httpx":
        raise
    raise MissingDependency("httpx", "server", "the client of a server") from None

TOKEN_VARIABLE = "THINKGRASP_TOKEN"
DEFAULT_TIMEOUT_S = 300.0
DEFAULT_PATIENCE_S = 120.0
MAX_WAIT_S = 60.0
"""A server may ask for longer; it is asked again after this."""
READY_POLL_S = 0.1

BAD_INPUT_STATUSES = (400, 408, 409, 413, 415, 422)
ACCESS_STATUSES = (401, 403)
TRANSIENT_STATUSES = (429, 503)

_T = TypeVar("_T")
_M = TypeVar("_M", bound=BaseModel)
_Talk = Generator[tuple[float, Call[Any]], httpx.Response | httpx.HTTPError, _T]
"""Yields how long to wait [s] and what to send then, takes what came of it, and returns what came of it all."""


class _Asker:
    """What both clients share: the address, the token, and what is sent when."""

    def __init__(self, url: str, *, token: str | None, patience_s: float) -> None:
        self.url = _checked_url(url)
        self._headers = {"User-Agent": "thinkgrasp-client", "Accept": "application/json"}
        given = os.environ.get(TOKEN_VARIABLE) if token is None else token
        if given and given.strip():
            if not given.strip().isascii() or not given.strip().isprintable():
                raise ConfigError("the server's token must be printable ASCII")
            self._headers["Authorization"] = f"Bearer {given.strip()}"
        self._patience_s = patience_s

    def _sent(self, call: Call[Any]) -> dict[str, Any]:
        """Return a request as httpx takes it."""
        more: dict[str, Any] = {}
        if call.files is not None:
            more["files"] = dict(call.files)
        if call.body is not None:
            more["json"] = call.body
        return {"method": call.method, "url": f"{self.url}{call.path}", "headers": self._headers, **more}

    def _asked(self, call: Call[_M]) -> _Talk[_M]:
        """Send one request, again while the server is busy and there is time."""
        deadline = time.monotonic() + self._patience_s
        wait_s = 0.0
        while True:
            given = yield wait_s, call
            if isinstance(given, httpx.HTTPError):
                raise _unreachable(self.url, given) from given
            if given.status_code in TRANSIENT_STATUSES:
                wait_s = _retry_after_s(given)
                if time.monotonic() + wait_s <= deadline:
                    continue
            return _read(self.url, call, given)

    def _seen_ready(self) -> _Talk[bool]:
        """Look once."""
        return _is_ready((yield 0.0, READY_CALL))

    def _awaited(self, timeout_s: float) -> _Talk[None]:
        """Look until the models are loaded."""
        deadline = time.monotonic() + timeout_s
        wait_s = 0.0
        while not _is_ready((yield wait_s, READY_CALL)):
            if time.monotonic() > deadline:
                raise ServerError(f"{self.url} was not ready within {timeout_s:g} s")
            wait_s = READY_POLL_S


class Client(_Asker):
    """Asks a server and waits for its answers.

    Args:
        url: Where it listens, for example http://localhost:8000.
        token: What it wants to see; None = the environment variable THINKGRASP_TOKEN, if that is set.
        timeout_s: For each request.
        patience_s: How long one call goes on asking a server that says it is busy.
        transport: In place of the network; for tests.

    Raises:
        ConfigError: The address or the token cannot be used.
    """

    def __init__(
        self,
        url: str,
        *,
        token: str | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        patience_s: float = DEFAULT_PATIENCE_S,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        super().__init__(url, token=token, patience_s=patience_s)
        self._http = httpx.Client(timeout=timeout_s, transport=transport, follow_redirects=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def grasp(self, frame: Frame, instruction: str, **options: object) -> DecisionModel:
        """Decide on one frame.

        Args:
            frame: Aligned RGB-D view; it arrives as it is, without loss.
            instruction: What to take.
            **options: depth_scale, seed, n_nearest, standoff_m, alternatives, mask.

        Raises:
            InputError: The server cannot use the frame, the instruction or an option.
            ConfigError: It wants a token, or another one.
            ServerError: It cannot be reached, stays busy, or failed.
        """
        return self.ask(grasp_call(frame, instruction, options))

    def explain(self, frame: Frame, instruction: str, **options: object) -> ExplainedDecision:
        """Decide on one frame, with the annotated picture and the 3-D view; arguments and errors as `grasp`."""
        return self.ask(explain_call(frame, instruction, options))

    def start_episode(self, instruction: str, *, step_limit: int = 15) -> RemoteEpisode:
        """Open an episode; errors as `grasp`."""
        return RemoteEpisode(self, self.ask(begin_call(instruction, step_limit)))

    def is_ready(self) -> bool:
        """Whether the server is up and its models are loaded."""
        return self._carry_on(self._seen_ready())

    def wait_until_ready(self, timeout_s: float = 60) -> None:
        """Return once the server's models are loaded.

        Raises:
            ServerError: They are not within the time.
        """
        self._carry_on(self._awaited(timeout_s))

    def ask(self, call: Call[_M]) -> _M:
        """Send one request, again while the server is busy, and return its answer; errors as `grasp`."""
        return self._carry_on(self._asked(call))

    def _carry_on(self, talk: _Talk[_T]) -> _T:
        try:
            wait_s, call = next(talk)
            while True:
                time.sleep(wait_s)
                try:
                    given = self._http.request(**self._sent(call))
                except httpx.HTTPError as error:
                    given = error
                wait_s, call = talk.send(given)
        except StopIteration as done:
            return done.value


class AsyncClient(_Asker):
    """Asks a server from asyncio; arguments and methods as of Client."""

    def __init__(
        self,
        url: str,
        *,
        token: str | None = None,
        timeout_s: float = DEFAULT_TIMEOUT_S,
        patience_s: float = DEFAULT_PATIENCE_S,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        super().__init__(url, token=token, patience_s=patience_s)
        self._http = httpx.AsyncClient(timeout=timeout_s, transport=transport, follow_redirects=False)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def grasp(self, frame: Frame, instruction: str, **options: object) -> DecisionModel:
        """Decide on one frame, as `Client.grasp`."""
        return await self.ask(grasp_call(frame, instruction, options))

    async def explain(self, frame: Frame, instruction: str, **options: object) -> ExplainedDecision:
        """Decide on one frame with its pictures, as `Client.explain`."""
        return await self.ask(explain_call(frame, instruction, options))

    async def start_episode(self, instruction: str, *, step_limit: int = 15) -> AsyncRemoteEpisode:
        """Open an episode, as `Client.start_episode`."""
        return AsyncRemoteEpisode(self, await self.ask(begin_call(instruction, step_limit)))

    async def is_ready(self) -> bool:
        """Whether the server is up and its models are loaded."""
        return await self._carry_on(self._seen_ready())

    async def wait_until_ready(self, timeout_s: float = 60) -> None:
        """Return once the server's models are loaded, as `Client.wait_until_ready`."""
        await self._carry_on(self._awaited(timeout_s))

    async def ask(self, call: Call[_M]) -> _M:
        """Send one request, as `Client.ask`."""
        return await self._carry_on(self._asked(call))

    async def _carry_on(self, talk: _Talk[_T]) -> _T:
        try:
            wait_s, call = next(talk)
            while True:
                await asyncio.sleep(wait_s)
                try:
                    given = await self._http.request(**self._sent(call))
                except httpx.HTTPError as error:
                    given = error
                wait_s, call = talk.send(given)
        except StopIteration as done:
            return done.value


class RemoteEpisode:
    """An episode on a server: observe, carry the grasp out, report the outcome, until it has ended."""

    def __init__(self, client: Client, status: EpisodeAnswer) -> None:
        self._client = client
        self.status = status
        """As the server said last."""

    def observe(self, frame: Frame, *, more_views: bool = False, **options: object) -> EpisodeAnswer:
        """Decide what to do now; `status.decision` holds the grasp if `status.state` is "act"."""
        return self._ask(observe_call(self.status.episode, frame, more_views, options))

    def report(
        self, success: bool, reason: str | None = None, *, delivered: bool | None = None, after: Frame | None = None
    ) -> EpisodeAnswer:
        """Say what became of the grasp; a frame taken afterwards verifies a success."""
        return self._ask(outcome_call(self.status.episode, success, reason, delivered, after))

    def stop(self) -> EpisodeAnswer:
        """End it; the server forgets it."""
        return self._ask(stop_call(self.status.episode))

    def _ask(self, call: Call[EpisodeAnswer]) -> EpisodeAnswer:
        self.status = self._client.ask(call)
        return self.status


class AsyncRemoteEpisode:
    """As RemoteEpisode, for asyncio."""

    def __init__(self, client: AsyncClient, status: EpisodeAnswer) -> None:
        self._client = client
        self.status = status
        """As the server said last."""

    async def observe(self, frame: Frame, *, more_views: bool = False, **options: object) -> EpisodeAnswer:
        """Decide what to do now, as `RemoteEpisode.observe`."""
        return await self._ask(observe_call(self.status.episode, frame, more_views, options))

    async def report(
        self, success: bool, reason: str | None = None, *, delivered: bool | None = None, after: Frame | None = None
    ) -> EpisodeAnswer:
        """Say what became of the grasp, as `RemoteEpisode.report`."""
        return await self._ask(outcome_call(self.status.episode, success, reason, delivered, after))

    async def stop(self) -> EpisodeAnswer:
        """End it; the server forgets it."""
        return await self._ask(stop_call(self.status.episode))

    async def _ask(self, call: Call[EpisodeAnswer]) -> EpisodeAnswer:
        self.status = await self._client.ask(call)
        return self.status


def _checked_url(url: str) -> str:
    try:
        parsed = httpx.URL(url)
    except (httpx.InvalidURL, TypeError, ValueError) as error:
        raise ConfigError(f"{url!r} is no address of a server: {error}") from error
    if (
        parsed.scheme not in ("http", "https")
        or not parsed.host
        or "%" in parsed.host
        or parsed.query
        or parsed.userinfo
    ):
        raise ConfigError(f"{url!r} is no address of a server; give one like http://localhost:8000")
    return str(parsed).rstrip("/")


def _read(url: str, call: Call[_M], response: httpx.Response) -> _M:
    """Return what a server answered, or raise what its answer means."""
    if not response.is_success:
        raise _refusal(url, response)
    try:
        return call.answer.model_validate_json(response.content)
    except ValidationError as error:
        raise ServerError(
            f"{url} answered with something else than a ThinkGrasp server of this version does; is it one?"
        ) from error


def _is_ready(given: httpx.Response | httpx.HTTPError) -> bool:
    return isinstance(given, httpx.Response) and given.status_code == 200


def _retry_after_s(response: httpx.Response) -> float:
    try:
        asked = float(response.headers.get("Retry-After", "1"))
    except ValueError:
        return 1.0
    return 1.0 if math.isnan(asked) else min(max(asked, 0.1), MAX_WAIT_S)


def _refusal(url: str, response: httpx.Response) -> Exception:
    """Return the error that an answer other than a success means."""
    status, message = response.status_code, _said(response)
    if status in BAD_INPUT_STATUSES and message:
        return InputError(message)
    if status in ACCESS_STATUSES:
        advice = f"set {TOKEN_VARIABLE} to the server's token" if status == 401 else "ask by the server's own name"
        return ConfigError(f"{url} does not let us in ({message or status}); {advice}")
    if status == 404 and message:
        return InputError(message)
    return ServerError(f"{url} answered {status}: {message or 'it is no ThinkGrasp server, or it failed'}")


def _said(response: httpx.Response) -> str:
    try:
        message = response.json()["error"]["message"]
    except (ValueError, KeyError, TypeError):
        return ""
    return one_line(message) if isinstance(message, str) else ""


def _unreachable(url: str, error: httpx.HTTPError) -> ServerError:
    if isinstance(error, httpx.TimeoutException):
        return ServerError(f"{url} did not answer in time ({type(error).__name__})")
    return ServerError(f"{url} cannot be reached: {one_line(error) or type(error).__name__}")
