"""One server that speaks chat.completions: one request at a time, every failure in words, the key never in them."""

from __future__ import annotations

import ipaddress
import json
import os
import re
import time
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast
from urllib.parse import urlsplit

import httpx2
import openai

from thinkgrasp.errors import ConfigError
from thinkgrasp.planners.vlm.patience import retry_after_s

OPENAI_URL = "https://api.openai.com/v1"
OPENAI_KEY_ENV = "OPENAI_API_KEY"
MAX_REPLY_BYTES = 1_000_000
MAX_QUOTED = 300
TRANSIENT = frozenset({408, 409, 425, 429})
"""Statuses below 500 after which the same request may succeed."""
SHORTEST_HIDDEN_KEY = 6
"""Shorter keys are placeholders; hiding them would hide ordinary words."""


@dataclass(frozen=True)
class Reply:
    """The parts of a chat completion that matter here."""

    text: str
    model: str | None
    prompt_tokens: int | None
    completion_tokens: int | None
    refusal: str | None


class RequestFailed(Exception):
    """One request had no usable reply.

    Args:
        reason: In words, without the key.
        transient: Whether the same request may succeed later.
        status: HTTP status of an error reply.
        wait_s: How long the server asks to wait.
    """

    def __init__(self, reason: str, *, transient: bool, status: int | None = None, wait_s: float | None = None) -> None:
        super().__init__(reason)
        self.reason = reason
        self.transient = transient
        self.status = status
        self.wait_s = wait_s


class Endpoint:
    """A server by its address, asked through the openai client with that client's own retries off.

    Args:
        base_url: Address up to and with /v1; None = OpenAI.
        key: API key; None = the server wants none.
        max_reply_bytes: A longer reply is not read to its end.

    Raises:
        ConfigError: The address is no http(s) URL, or carries a password or a query.
    """

    def __init__(self, *, base_url: str | None, key: str | None, max_reply_bytes: int = MAX_REPLY_BYTES) -> None:
        self.url = checked_url(base_url)
        self._key = key
        http = openai.DefaultHttpxClient(
            event_hooks={"request": [_stamp], "response": [partial(_limit, max_reply_bytes)]},
            follow_redirects=False,
            trust_env=not _is_loopback(self.url),
        )
        self._client = openai.OpenAI(
            base_url=self.url,
            api_key=key or "none",
            max_retries=0,
            http_client=http,
            default_headers={"Accept-Encoding": "identity"},
        )
        if self.url != OPENAI_URL:
            # The client takes these from OPENAI_* of the environment; they are no other server's business.
            self._client.organization = self._client.project = None
        self.close = weakref.finalize(self, http.close)

    def post(self, body: Mapping[str, object], timeout_s: float) -> Reply:
        """Send one request.

        Args:
            body: Of a chat completion.
            timeout_s: For connecting, then for any silence, and from the start for the whole reply to be there.

        Raises:
            RequestFailed: There is no reply, it is an error, or it is not a chat completion.
        """
        try:
            raw = self._client.chat.completions.with_raw_response.create(**cast(Any, dict(body)), timeout=timeout_s)
        except openai.APITimeoutError:
            raise RequestFailed(f"no reply within {timeout_s:.3g} s", transient=True) from None
        except _UnusableBody as error:
            raise RequestFailed(str(error), transient=False) from None
        except openai.APIConnectionError as error:
            raise self._no_connection(error.__cause__ or error) from None
        except (httpx2.HTTPError, httpx2.InvalidURL, httpx2.StreamError, OSError) as error:
            raise self._no_connection(error) from None
        except openai.APIStatusError as error:
            raise self._error_reply(error) from None
        except openai.OpenAIError as error:
            raise RequestFailed(self._quote(str(error)), transient=False) from None
        response = raw.http_response
        return self._read(response.content, response.headers.get("content-type", "no content type"))

    def _no_connection(self, cause: BaseException) -> RequestFailed:
        reason = f"{self.url} cannot be reached ({type(cause).__name__}: {self._quote(str(cause))})"
        return RequestFailed(reason, transient=True)

    def _error_reply(self, error: openai.APIStatusError) -> RequestFailed:
        status = error.status_code
        said = _error_text(error.body) or error.response.text
        reason = f"HTTP {status} {error.response.reason_phrase}".rstrip()
        if said.strip():
            reason += f": {self._quote(said)}"
        out_of_money = error.code == "insufficient_quota"
        transient = (status in TRANSIENT or status >= 500) and not out_of_money
        return RequestFailed(reason, transient=transient, status=status, wait_s=retry_after_s(error.response.headers))

    def _read(self, content: bytes, content_type: str) -> Reply:
        try:
            data: object = json.loads(content)
        except (ValueError, RecursionError):
            start = self._quote(content[:200].decode(errors="replace"), 60)
            reason = f"the reply is not complete JSON ({content_type}, {len(content)} bytes, starts {start!r})"
            raise RequestFailed(reason, transient=True) from None
        said = _error_text(data)
        choices = _get(data, "choices")
        message = _get(cast(list[object], choices)[0], "message") if isinstance(choices, list) and choices else None
        if not isinstance(message, dict):
            reason = f"the reply is no chat completion: {self._quote(said or content[:2000].decode(errors='replace'))}"
            raise RequestFailed(reason, transient=True)
        usage, model, refusal = _get(data, "usage"), _get(data, "model"), _get(message, "refusal")
        return Reply(
            text=self._hide(_content_text(_get(message, "content"))),
            model=self._quote(model, 100) if isinstance(model, str) and model else None,
            prompt_tokens=_count(_get(usage, "prompt_tokens")),
            completion_tokens=_count(_get(usage, "completion_tokens")),
            refusal=self._quote(refusal) if isinstance(refusal, str) and refusal else None,
        )

    def _hide(self, text: str) -> str:
        if self._key is None or len(self._key) < SHORTEST_HIDDEN_KEY:
            return text
        return text.replace(self._key, "[key]")

    def _quote(self, text: str, most: int = MAX_QUOTED) -> str:
        line = " ".join(self._hide(text).split())
        line = "".join(c if c.isprintable() else "?" for c in line)
        return line if len(line) <= most else line[: most - 3] + "..."


def checked_url(base_url: str | None) -> str:
    """Return a server's address without a slash at its end; OpenAI's for None.

    Raises:
        ConfigError: It is no http(s) URL, or carries a password or a query; the message does not show it then.
    """
    if base_url is None:
        return OPENAI_URL
    try:
        parts = urlsplit(base_url)
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port or 1) > 0
    except ValueError:
        raise ConfigError("openai planner: base_url is no URL; write it like http://localhost:8000/v1") from None
    if "@" in parts.netloc or parts.query or parts.fragment:
        raise ConfigError(
            "openai planner: base_url must not hold a user, password or query (not shown here); "
            "name the environment variable with the key in key_env, or a file in key_file"
        )
    if not usable:
        raise ConfigError(f"openai planner: base_url must be like http://localhost:8000/v1, got {base_url!r}")
    return base_url.rstrip("/")


def read_key(*, key_env: str | None, key_file: str | Path | None, base_url: str | None) -> str | None:
    """Return the API key, or None for a server other than OpenAI for which none was named.

    Args:
        key_env: Name of an environment variable. None = OPENAI_API_KEY for OpenAI itself, so that OpenAI's key is
            never sent to another server unasked.
        key_file: File that holds the key alone; it goes before the environment.
        base_url: The server; None = OpenAI.

    Raises:
        ConfigError: The key that was named is not there or cannot be one; the message never shows it.
    """
    if key_file is not None:
        try:
            key = Path(key_file).read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError, ValueError) as error:
            kind = type(error).__name__
            raise ConfigError(f"openai planner: key_file {str(key_file)!r} cannot be read ({kind})") from None
        return _checked_key(key, f"key_file {str(key_file)!r}")
    if key_env is None:
        if base_url is not None and checked_url(base_url) != OPENAI_URL:
            return None
        key_env = OPENAI_KEY_ENV
    if re.fullmatch(r"[A-Z_][A-Z0-9_]{0,79}", key_env) is None:
        raise ConfigError(
            "openai planner: key_env must be the NAME of an environment variable, in capitals, for example "
            f"{OPENAI_KEY_ENV}, not the key itself (what arrived is not shown)"
        )
    if key_env not in os.environ:
        raise ConfigError(
            f"openai planner: the environment variable {key_env} is not set; put the API key there, name a file in "
            "key_file, or set base_url to a server that needs no key"
        )
    return _checked_key(os.environ[key_env].strip(), f"the environment variable {key_env}")


def _checked_key(key: str, where: str) -> str:
    if not key or len(key) > 4096 or re.fullmatch(r"[\x21-\x7e]+", key) is None:
        raise ConfigError(f"openai planner: {where} must hold one API key: printable characters without spaces")
    return key


class _UnusableBody(Exception):
    """A reply's body is not worth reading on."""


class _LimitedStream(httpx2.SyncByteStream):
    """A body that may neither grow nor take longer than allowed."""

    def __init__(self, stream: httpx2.SyncByteStream, most_bytes: int, deadline: float) -> None:
        self._stream = stream
        self._most_bytes = most_bytes
        self._deadline = deadline

    def __iter__(self) -> Iterator[bytes]:
        received = 0
        for chunk in self._stream:
            received += len(chunk)
            if received > self._most_bytes:
                raise _UnusableBody(f"the reply is longer than {self._most_bytes} bytes; it was not read to its end")
            if time.monotonic() > self._deadline:
                raise httpx2.ReadTimeout("the reply's body arrives too slowly")
            yield chunk

    def close(self) -> None:
        self._stream.close()


def _stamp(request: httpx2.Request) -> None:
    request.extensions = {**request.extensions, "thinkgrasp_start": time.monotonic()}


def _limit(most_bytes: int, response: httpx2.Response) -> None:
    encoding = response.headers.get("content-encoding", "identity")
    if encoding != "identity":
        raise _UnusableBody(f"the reply is compressed ({encoding[:40]!r}), which was not asked for")
    extensions = cast(dict[str, Any], response.request.extensions)
    deadline = extensions["thinkgrasp_start"] + extensions["timeout"]["read"]
    response.stream = _LimitedStream(cast(httpx2.SyncByteStream, response.stream), most_bytes, deadline)


def _is_loopback(url: str) -> bool:
    host = urlsplit(url).hostname or ""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _get(data: object, key: str) -> object:
    return cast(dict[str, object], data).get(key) if isinstance(data, dict) else None


def _error_text(data: object) -> str:
    """The message of an error reply, whichever of the usual forms it has."""
    error = _get(data, "error")
    for said in (_get(error, "message"), error, _get(data, "message"), _get(data, "detail")):
        if isinstance(said, str):
            return said
    return ""


def _content_text(content: object) -> str:
    if isinstance(content, list):
        parts = [_get(part, "text") for part in cast(list[object], content)]
        return "".join(part for part in parts if isinstance(part, str))
    return content if isinstance(content, str) else ""


def _count(value: object) -> int | None:
    return value if isinstance(value, int) and not isinstance(value, bool) and value >= 0 else None
