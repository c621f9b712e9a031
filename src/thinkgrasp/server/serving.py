"""Run the server on a socket until it is told to stop."""

from __future__ import annotations

import socket
import sys
import warnings
from collections.abc import Callable

import uvicorn

from thinkgrasp.errors import ConfigError
from thinkgrasp.server import logs
from thinkgrasp.server.access import is_loopback
from thinkgrasp.server.app import ServerOptions, make_app
from thinkgrasp.server.protocol import bounded_protocol
from thinkgrasp.server.workers import Recipe

GRACEFUL_S = 10
"""How long running requests may take to end after the server is told to stop."""


def serve(
    recipe: Recipe,
    options: ServerOptions,
    *,
    host: str = "127.0.0.1",
    port: int = 8000,
    on_listening: Callable[[str], None] = lambda url: None,
) -> None:
    """Answer requests until SIGINT or SIGTERM.

    Args:
        recipe: What the workers make their pipeline from.
        options: Of the server.
        host: Address to listen at; one that is not this machine's own needs a token.
        port: 0 = any that is free.
        on_listening: Told the address once connections are accepted.

    Raises:
        ConfigError: The address cannot be used, needs a token, or the models cannot be loaded.
    """
    if options.token is None and not is_loopback(host):
        raise ConfigError(
            f"the server may be reached from other machines at {host!r}, so that it needs a token: set the "
            "environment variable THINKGRASP_TOKEN or give --token-file FILE; or listen at 127.0.0.1"
        )
    listener = _listen(host, port)
    problems: list[str] = []

    def give_up(message: str) -> None:
        problems.append(message)
        server.should_exit = True

    server = make_server(recipe, options, on_unloadable=give_up)
    name, bound = f"[{host}]" if ":" in host else host, listener.getsockname()[1]
    on_listening(f"http://{name}:{bound}")
    with listener, logs.to_stream(sys.stderr), warnings.catch_warnings():
        if not options.debug:
            warnings.simplefilter("ignore")  # they name files, and are none of the log's JSON
        logs.log("started", host=host, port=bound, workers=options.workers, token=options.token is not None)
        server.run(sockets=[listener])
    if problems:
        raise ConfigError(problems[0])


def make_server(
    recipe: Recipe, options: ServerOptions, *, on_unloadable: Callable[[str], None] = lambda message: None
) -> uvicorn.Server:
    """Return a server that is not running yet; `run(sockets=[...])` runs it, `should_exit` stops it."""
    limits = options.limits
    return uvicorn.Server(
        uvicorn.Config(
            make_app(recipe, options, on_unloadable=on_unloadable),  # type: ignore[arg-type]
            http=bounded_protocol(limits),
            ws="none",
            lifespan="on",
            log_config=None,
            access_log=False,
            proxy_headers=False,
            server_header=False,
            timeout_keep_alive=int(max(1, limits.keep_alive_s)),
            timeout_graceful_shutdown=GRACEFUL_S,
        )
    )


def _listen(host: str, port: int) -> socket.socket:
    """Return a bound socket.

    Raises:
        ConfigError: It cannot be bound.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
            listener.listen(128)
            listener.setblocking(False)
        except OSError:
            listener.close()
            raise
    except (OSError, UnicodeError, OverflowError) as error:
        raise ConfigError(f"cannot listen at {host}:{port}: {error}") from error
    return listener
