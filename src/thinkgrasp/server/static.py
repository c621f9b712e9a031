"""The pages of the server, from the package itself: nothing is fetched from elsewhere, nor may it be."""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from importlib import resources

from starlette.responses import Response

from thinkgrasp.server.problems import RequestProblem

TYPES = {
    "index.html": "text/html",
    "docs.html": "text/html",
    "page.css": "text/css",
    "page.js": "text/javascript",
    "docs.js": "text/javascript",
}


def page_response(name: str) -> Response:
    """Return a part of a page.

    Raises:
        RequestProblem: 404; there is none of this name.
    """
    kind = TYPES.get(name)
    if kind is None:
        raise RequestProblem(404, "not_found", "there is no such part of a page")
    content = resources.files("thinkgrasp.server").joinpath("page").joinpath(name).read_bytes()
    headers = {"Content-Security-Policy": content_policy(), "X-Frame-Options": "DENY", "Cache-Control": "no-cache"}
    return Response(content, media_type=kind, headers=headers)


@cache
def content_policy() -> str:
    """Return what the pages may load: their own parts, pictures that they made, and the 3-D view's own script."""
    script = resources.files("thinkgrasp.viz").joinpath("view.js").read_text("utf-8")
    digest = base64.b64encode(hashlib.sha256(f"\n{script}\n".encode()).digest()).decode("ascii")
    return "; ".join(
        (
            "default-src 'none'",
            f"script-src 'self' 'sha256-{digest}'",
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "connect-src 'self'",
            "frame-src 'self' blob:",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        )
    )
