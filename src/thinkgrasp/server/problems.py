"""What can go wrong with a request, as exceptions that become JSON; nothing in them names a path or a key."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import ValidationError
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse

from thinkgrasp.outputs import one_line
from thinkgrasp.server.pool import Busy, NotReady
from thinkgrasp.server.workers import Refused, StageTimeout

STATUS_CODES = {
    400: "bad_request",
    404: "not_found",
    405: "method_not_allowed",
    500: "internal_error",
}


class RequestProblem(Exception):
    """An answer other than a success."""

    def __init__(self, status: int, code: str, message: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.code = code
        self.message = message
        self.headers = dict(headers or {})


class ClientLeft(Exception):
    """The client closed the connection before there was an answer."""


def as_problem(error: Exception) -> RequestProblem:
    """Return what a client is told of an exception; one that is not expected is told by nothing but its status."""
    match error:
        case RequestProblem():
            return error
        case Busy():
            return RequestProblem(429, "busy", str(error), {"Retry-After": str(error.retry_after_s)})
        case NotReady():
            message = "no worker has its models loaded; ask /readyz"
            return RequestProblem(503, "not_ready", message, {"Retry-After": "2"})
        case Refused(too_large=True):
            return RequestProblem(413, "too_large", str(error))
        case Refused():
            return RequestProblem(422, "unusable_input", one_line(error))
        case StageTimeout():
            return RequestProblem(504, "stage_timeout", str(error))
        case ValidationError():
            return RequestProblem(422, "invalid_request", describe(error))
        case HTTPException():
            return _of_starlette(error)
        case _:
            return RequestProblem(500, "internal_error", "the server failed; its log names this request's id")


def describe(error: ValidationError) -> str:
    """Return pydantic's first complaints in one line, without what was sent."""
    said = [
        f"{'.'.join(map(str, e['loc'])) or 'body'}: {e['msg'].removeprefix('Value error, ')}"
        for e in error.errors(include_url=False, include_input=False, include_context=False)[:4]
    ]
    return one_line("; ".join(said))


def problem_response(problem: RequestProblem, request_id: str, *, flat: bool = False) -> JSONResponse:
    """Return the answer; `flat` is the form of the paper's server."""
    error = {"code": problem.code, "message": problem.message, "request_id": request_id}
    body = {"error": problem.message} if flat else {"error": error}
    return JSONResponse(body, problem.status, problem.headers)


def _of_starlette(error: HTTPException) -> RequestProblem:
    message = {
        404: "there is nothing at this address; /docs lists what there is",
        405: "this address does not take this method; /docs lists what it takes",
    }.get(error.status_code, "the request cannot be read")
    code = STATUS_CODES.get(error.status_code, "bad_request")
    return RequestProblem(error.status_code, code, message, error.headers or {})
