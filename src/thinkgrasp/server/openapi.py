"""The interface as OpenAPI: bodies that come in two forms, errors that look alike, and the token."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema
from starlette.requests import Request
from starlette.responses import Response

from thinkgrasp.server.schema import EpisodeBody, ErrorBody, GraspBody, ObserveBody, OutcomeBody, PaperError

REF = "#/components/schemas/{model}"
BODIES: tuple[type[BaseModel], ...] = (GraspBody, ObserveBody, EpisodeBody, OutcomeBody, ErrorBody, PaperError)
FILE_PARTS = ("color", "depth", "workspace")
Endpoint = Callable[[Request], Awaitable[Response]]


def add_route(
    app: FastAPI,
    method: str,
    path: str,
    answered: Endpoint,
    documented: Endpoint,
    *,
    status: int,
    answer: type | None,
    body: dict[str, Any] | None,
) -> None:
    """Register an endpoint; `documented` gives its name and its words."""
    is_paper = path == "/grasp_pose"
    error = {"model": PaperError if is_paper else ErrorBody, "description": "What was wrong with the request"}
    extra: dict[str, Any] = {}
    if body is not None:
        extra["requestBody"] = body
    if "{" in path:
        name = path.partition("{")[2].partition("}")[0]
        extra["parameters"] = [{"name": name, "in": "path", "required": True, "schema": {"type": "string"}}]
    responses: dict[int | str, dict[str, Any]] = {status: {"description": "Done"}, "4XX": error}
    if path == "/readyz":
        responses[503] = {"model": answer, "description": "Not yet"}
    if answer is not None:
        responses[status] = {"model": answer, "description": "Done"}
    app.add_api_route(
        path,
        answered,
        methods=[method],
        name=documented.__name__,
        operation_id=documented.__name__,
        description=documented.__doc__,
        status_code=status,
        responses=responses,
        response_model=None,
        openapi_extra=extra,
        include_in_schema=not path.startswith("/page/"),
    )


def json_body(model: type[BaseModel]) -> dict[str, Any]:
    """Describe a body that is JSON."""
    return {"required": True, "content": {"application/json": {"schema": _reference(model)}}}


def frame_body(model: type[BaseModel]) -> dict[str, Any]:
    """Describe a body that is JSON with base64, or multipart with files."""
    described = json_body(model)
    described["content"]["multipart/form-data"] = _multipart(model)
    return described


def paper_body() -> dict[str, Any]:
    """Describe the two forms of the paper's request."""
    text, file = {"type": "string"}, {"type": "string", "format": "binary"}
    camera = {"type": "object"}
    paths = {"image_path": text, "depth_path": text, "text_path": text}
    files = {"image": file, "depth": file, "text": file}
    by_path = {"type": "object", "required": [*paths], "properties": {**paths, "camera": camera}}
    by_file = {"type": "object", "required": [*files], "properties": {**files, "camera": camera}}
    return {
        "required": True,
        "content": {"application/json": {"schema": by_path}, "multipart/form-data": {"schema": by_file}},
    }


def document(app: FastAPI, *, needs_token: bool) -> None:
    """Complete the app's description by the bodies' schemas and the token."""

    def describe() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
            _, definitions = models_json_schema([(model, "validation") for model in BODIES], ref_template=REF)
            components = schema.setdefault("components", {})
            components["schemas"] = {**definitions["$defs"], **components.get("schemas", {})}
            if needs_token:
                components["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
                schema["security"] = [{"token": []}]
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = describe  # type: ignore[method-assign]


def _reference(model: type[BaseModel]) -> dict[str, str]:
    return {"$ref": REF.format(model=model.__name__)}


def _multipart(model: type[BaseModel]) -> dict[str, Any]:
    schema = model.model_json_schema(ref_template=REF)
    properties: dict[str, Any] = {}
    encoding: dict[str, Any] = {}
    for name, value in schema["properties"].items():
        if name in FILE_PARTS:
            properties[name] = {"type": "string", "format": "binary", "description": value.get("description", "")}
        else:
            properties[name] = value
            if name != "instruction" and name != "reason":
                encoding[name] = {"contentType": "application/json"}
    described = {"type": "object", "required": schema.get("required", []), "properties": properties}
    return {"schema": described, "encoding": encoding}
