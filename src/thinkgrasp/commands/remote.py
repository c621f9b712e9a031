"""`thinkgrasp grasp --server URL`: the outputs of a decision made here, made by a server."""

from __future__ import annotations

import io
from dataclasses import fields
from pathlib import Path

from PIL import Image

from thinkgrasp.commands.stages import DEFAULT_STAGES, StageOptions
from thinkgrasp.errors import ConfigError, ServerError
from thinkgrasp.outputs import OVERLAY_SUFFIXES, write_atomic
from thinkgrasp.schema import DecisionModel
from thinkgrasp.server.client import Client
from thinkgrasp.server.schema import ExplainedDecision
from thinkgrasp.types import Frame

CLIENTS_OWN = ("seed", "debug")
"""What may be set of the stages although a server runs them."""


def ask_server(
    url: str,
    frame: Frame,
    instruction: str,
    stages: StageOptions,
    *,
    overlay: Path | None = None,
    view: Path | None = None,
) -> tuple[DecisionModel, dict[str, float]]:
    """Let a server decide, write its pictures, and return its decision and the time of each stage reached [ms].

    Raises:
        ConfigError: An option sets what is the server's; or the server wants a token.
        InputError: The server cannot use what it is sent, or a picture cannot be written.
        ServerError: The server cannot be reached, stays busy, or failed.
    """
    for field in fields(stages):
        value = getattr(stages, field.name)
        if field.name not in CLIENTS_OWN and value != getattr(DEFAULT_STAGES, field.name):
            raise ConfigError(f"--{field.name} is the server's to choose; leave it out, or leave out --server")
    options = {} if stages.seed is None else {"seed": stages.seed}
    with Client(url) as client:
        if overlay is None and view is None:
            model = client.grasp(frame, instruction, **options)
        else:
            explained = client.explain(frame, instruction, **options)
            model = explained.decision
            if overlay is not None:
                buffer = io.BytesIO()
                _picture(url, explained).save(buffer, OVERLAY_SUFFIXES[overlay.suffix.lower()])
                write_atomic(overlay, buffer.getvalue())
            if view is not None:
                write_atomic(view, explained.view_html.encode("utf-8"))
    return model, {name: ms for name, ms in model.timings_ms.model_dump().items() if ms > 0}


def _picture(url: str, explained: ExplainedDecision) -> Image.Image:
    try:
        return Image.open(io.BytesIO(explained.overlay_bytes())).convert("RGB")
    except Exception as error:  # decoders raise many types on broken data
        raise ServerError(f"{url} sent an annotated picture that cannot be read") from error
