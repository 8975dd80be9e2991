"""A viser server that only this machine's own page can talk to: no tunnel, no foreign origin, no foreign host name.

viser 1.1 accepts a WebSocket from any origin, so any web page open in the user's browser could read the scene and move
its controls, also on 127.0.0.1. It offers no hook for the handshake; here a check is put before its request handler.
"""

import contextlib
import http
import io
import ipaddress
import socket
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")


class GuardedServer(viser.ViserServer):
    """A ViserServer behind `is_own_page`, without its banner and without the public share tunnel."""

    def __init__(self, host: str, port: int):
        """Serve on host and port (or the next free one: ask `get_port`)."""
        with _guarded_handshakes(host) as guards, contextlib.redirect_stdout(io.StringIO()):
            super().__init__(host=host, port=port, verbose=False)
        if not guards:  # another viser, which opens its socket in another way
            self.stop()
            raise RuntimeError(f"the handshake guard does not fit viser {viser.__version__}; the page was not opened")

    def request_share_url(self, verbose: bool = True) -> str | None:
        """None, always: any client may ask for the tunnel, button or not, and viser answers with this method."""
        return None


def is_loopback(host: str) -> bool:
    """Whether nothing outside this machine can reach a server bound to `host`."""
    return host == "localhost" or (_address(host) is not None and ipaddress.ip_address(host).is_loopback)


def is_own_page(headers: Headers, bound_host: str) -> bool:
    """Whether a request comes from this server's own page, reached by a name that nobody else can point at it.

    The Host must be this machine (a foreign name that resolves here is DNS rebinding), and the Origin, which browsers
    always send with a WebSocket, must be that same host and port. Any port is right: `ssh -L` may have changed it.

    Args:
        headers: of the HTTP request.
        bound_host: what the server listens on.
    """
    hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(hosts) != 1 or len(origins) > 1:
        return False
    name = urlsplit(f"//{hosts[0]}").hostname or ""
    if name not in (*LOOPBACK_NAMES, bound_host) and (is_loopback(bound_host) or not _is_this_machine(name)):
        return False
    if not origins:
        return headers.get("Upgrade", "").lower() != "websocket"
    origin = urlsplit(origins[0])
    return origin.scheme in ("http", "https") and origin.netloc.lower() == hosts[0].lower()


def _is_this_machine(name: str) -> bool:
    """An address needs no name service, so it cannot be rebound; else only our own names."""
    return _address(name) is not None or name.lower() in (socket.gethostname().lower(), socket.getfqdn().lower())


def _address(name: str) -> str | None:
    try:
        return str(ipaddress.ip_address(name))
    except ValueError:
        return None


@contextlib.contextmanager
def _guarded_handshakes(bound_host: str) -> Iterator[list[Callable[..., Any]]]:
    """While this lasts, a websockets server that opens asks `is_own_page` before its own request handler.

    Yields the handlers that were put behind the guard: empty if no server opened.
    """
    serve, guards = websockets.asyncio.server.serve, []

    def guarded_serve(*args: Any, process_request: Callable[..., Any], **options: Any) -> Any:
        def guard(connection: ServerConnection, request: Request) -> Response | None:
            if not is_own_page(request.headers, bound_host):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "This page is only served to itself.\n")
            return process_request(connection, request)

        guards.append(guard)
        return serve(*args, process_request=guard, **options)

    websockets.asyncio.server.serve = guarded_serve  # viser opens its socket inside its constructor, with this name
    try:
        yield guards
    finally:
        websockets.asyncio.server.serve = serve
