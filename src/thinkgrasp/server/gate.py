"""What every request passes: an id, the access rule, one line in the log, the counters, and errors as JSON."""

from __future__ import annotations

import asyncio
import logging
import re
import sys
import time
import traceback
import uuid
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import Response

from thinkgrasp.server.access import Access
from thinkgrasp.server.logs import log, where_raised
from thinkgrasp.server.metrics import Metrics
from thinkgrasp.server.problems import ClientLeft, RequestProblem, as_problem, problem_response
from thinkgrasp.server.uploads import linger
from thinkgrasp.server.workers import Cancelled, WorkerFailed

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
ASGIApp = Callable[[MutableMapping[str, Any], Receive, Send], Awaitable[None]]

PAPER_ROUTE = "/grasp_pose"
CLIENT_LEFT = 499
_REQUEST_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")


class Gate:
    """Wraps the app.

    Args:
        app: What answers.
        access: Who may ask.
        metrics: What counts the answers.
        debug: Print the traceback of a bug on stderr.
    """

    def __init__(self, app: ASGIApp, *, access: Access, metrics: Metrics, debug: bool = False) -> None:
        self._app = app
        self._access = access
        self._metrics = metrics
        self._debug = debug

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        start, method = time.perf_counter(), scope["method"]
        if method == "HEAD":
            scope = {**scope, "method": "GET"}  # the server below sends the headers alone
        headers = Headers(scope=scope)
        asked = headers.get("x-request-id", "")
        request_id = asked if _REQUEST_ID.fullmatch(asked) else uuid.uuid4().hex
        notes: dict[str, object] = {}
        scope["thinkgrasp"] = {"request_id": request_id, "notes": notes}
        status = CLIENT_LEFT

        async def send_with_headers(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                more = MutableHeaders(scope=message)
                more["X-Request-ID"] = request_id
                more.setdefault("Cache-Control", "no-store")
                more["X-Content-Type-Options"] = "nosniff"
                more["Referrer-Policy"] = "no-referrer"
            await send(message)

        request = Request(scope, receive, send_with_headers)  # type: ignore[arg-type]
        try:
            self._access.check(scope["path"], headers)
            await self._app(scope, receive, send_with_headers)
        except Exception as error:
            if isinstance(error, RequestProblem):
                await linger(request)
            await self.answer_error(request, error)(scope, receive, send_with_headers)  # type: ignore[arg-type]
        except asyncio.CancelledError:  # the server is being stopped, and waits no longer
            if status != CLIENT_LEFT:
                raise
            stopping = RequestProblem(503, "stopping", "the server is being stopped", {"Retry-After": "5"})
            await self.answer_error(request, stopping)(scope, receive, send_with_headers)  # type: ignore[arg-type]
        seconds = time.perf_counter() - start
        route = getattr(scope.get("route"), "path", "unmatched")
        self._metrics.answered(route, method, status, seconds)
        log(
            "request",
            level=logging.ERROR if status >= 500 and status != 503 else logging.INFO,
            request_id=request_id,
            method=method if method.isalpha() and len(method) < 10 else "other",
            route=route,
            status=status,
            ms=round(seconds * 1e3, 1),
            **notes,
        )

    def answer_error(self, request: Request, error: Exception) -> Response:
        """Return the answer to an exception, and note in the log what the client is not told."""
        context = request.scope["thinkgrasp"]
        if isinstance(error, ClientLeft | Cancelled):
            self._metrics.cancelled()
            context["notes"]["left"] = True
            return Response(status_code=CLIENT_LEFT)
        problem = as_problem(error)
        context["notes"]["error"] = problem.code
        if problem.status == 500:
            context["notes"]["cause"] = error.what if isinstance(error, WorkerFailed) else where_raised(error)
            if self._debug:
                traceback.print_exception(error, file=sys.stderr)
        is_paper = request.scope["path"] == PAPER_ROUTE
        if is_paper and problem.status in (404, 422):
            problem = RequestProblem(400, problem.code, problem.message, problem.headers)
        return problem_response(problem, context["request_id"], flat=is_paper)
