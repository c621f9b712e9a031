"""Who may ask: a bearer token, and on a server without one only this machine's own pages and programs."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
from dataclasses import dataclass
from pathlib import Path

from starlette.datastructures import Headers

from thinkgrasp.errors import ConfigError
from thinkgrasp.server.problems import RequestProblem

TOKEN_VARIABLE = "THINKGRASP_TOKEN"
MIN_TOKEN_CHARS = 16
OPEN_PATHS = ("/", "/healthz", "/readyz", "/docs", "/openapi.json")
OPEN_FOLDER = "/page/"
"""What needs no token: it holds nothing but what this package publishes, and whether the server is up."""


def is_loopback(host: str) -> bool:
    """Whether a host name or address is this machine's own."""
    name = host.strip("[]")
    if name.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(name).is_loopback
    except ValueError:
        return False


def read_token(file: Path | None) -> str | None:
    """Return the token from a file, else from the environment variable THINKGRASP_TOKEN; None where there is none.

    Raises:
        ConfigError: The file cannot be read, or the token is too short or no plain text.
    """
    if file is not None:
        try:
            token = file.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"token file {file} cannot be read: {error}") from error
    else:
        token = os.environ.get(TOKEN_VARIABLE, "").strip()
        if not token:
            return None
    if len(token) < MIN_TOKEN_CHARS or not token.isascii() or not token.isprintable() or " " in token:
        raise ConfigError(
            f"the token must be at least {MIN_TOKEN_CHARS} printable ASCII characters without spaces; make one with: "
            'python -c "import secrets; print(secrets.token_urlsafe(32))"'
        )
    return token


@dataclass(frozen=True)
class Access:
    """The rule for one server.

    Args:
        token: What clients have to present; None = nothing, which only a server on loopback may grant.
    """

    token: str | None

    def check(self, path: str, headers: Headers) -> None:
        """Let a request through.

        Raises:
            RequestProblem: 401 for a missing or wrong token; 403 where a page of another site asks, or by another
                name than this machine's own.
        """
        self._check_site(headers)
        if self.token is None or path in OPEN_PATHS or path.startswith(OPEN_FOLDER):
            return
        scheme, _, given = headers.get("authorization", "").partition(" ")
        same = hmac.compare_digest(_digest(given.strip()), _digest(self.token))
        if scheme.lower() != "bearer" or not same:
            said = "this server wants a token: send the header Authorization: Bearer TOKEN"
            raise RequestProblem(401, "unauthorized", said, {"WWW-Authenticate": "Bearer"})

    def _check_site(self, headers: Headers) -> None:
        """Refuse other sites' pages, which a browser would let post here, also by a name that points to loopback."""
        host = _name(headers.get("host", ""))
        if self.token is None and not is_loopback(host):
            said = "this server answers by the names of this machine only (localhost, 127.0.0.1, [::1])"
            raise RequestProblem(403, "wrong_host", said)
        origin = headers.get("origin")
        if origin is not None and origin.partition("://")[2] != headers.get("host", ""):
            raise RequestProblem(403, "foreign_page", "pages of other sites may not use this server")


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode("utf-8", "surrogateescape")).digest()


def _name(host: str) -> str:
    """Return a Host header without its port."""
    if host.startswith("["):
        return host.partition("]")[0] + "]"
    return host.partition(":")[0]
