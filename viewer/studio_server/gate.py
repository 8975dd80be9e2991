"""What stands before every request of a studio: whose page it comes from, the secret, headers, and faults as sentences.

The owner's listener is bound to this machine and asks for the token of the printed address all the same, because other
users of the machine can reach it. The phones' listener has its own secrets, see viewer/studio_server/phones.py.

The studio's own files for browsers are read here, and listeners and servers made.
"""

import errno
import socket
from collections.abc import Callable
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import uvicorn
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from websockets.datastructures import Headers

from capture.errors import UserError
from capture.files.atomic import parse_json
from capture.files.names import in_one_line
from viewer.page.guard import COOKIE, SAFE_HEADERS, is_own_page, is_same
from viewer.studio.folder import without_folder
from viewer.studio.helper import in_page_words

WEB = Path(str(resources.files("viewer.studio_server") / "web"))
TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
FILES = tuple(sorted(file.name for file in WEB.iterdir()))
REVALIDATE = {"Cache-Control": "no-cache"}
SAFE = ("GET", "HEAD")
LONGEST_TEXT = 1000  # letters of a value of a request
LARGEST_BODY = 1 << 20  # bytes of a request that is no piece of a file
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "media-src 'self' blob:; frame-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
OWN_HEADERS = SAFE_HEADERS | {"Content-Security-Policy": POLICY, "X-Frame-Options": "DENY", "Cache-Control": "no-store"}
# Of a page made of a run's or capture's content: it gets no origin, so it reaches nothing of the studio.
FRAMED_POLICY = (
    "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data: blob:; "
    "frame-ancestors 'self'; base-uri 'none'; form-action 'none'"
)
MOST_PORTS = 50  # that are tried, one after the other
GRACE_S = 3  # for requests under way when a server ends
NEEDS_ADDRESS = "Open the address that shadowgraph printed, with the token at its end.\n"


def web_file(name: str) -> Response:
    """Return one of our own files."""
    return FileResponse(WEB / name, media_type=TYPES[Path(name).suffix], headers=REVALIDATE)


def file_routes(index: str) -> list[Route]:
    """Return a route for each of our files, and / for the page."""

    def route(name: str, path: str) -> Route:
        async def answer(_request: Request) -> Response:
            return web_file(name)

        return Route(path, answer, methods=["GET"])

    return [route(index, "/"), *(route(name, f"/{name}") for name in FILES)]


class Gate:
    """ASGI middleware: admits requests of the studio's own page, and adds the headers to every answer."""

    def __init__(self, app: ASGIApp, host: str, admits: Callable[[Request], Response | None]):
        """`admits` returns the answer for a request that may not pass, None for one that may."""
        self._app, self._host, self._admits = app, host, admits

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request; there is no WebSocket here, and nothing to begin or end."""
        if scope["type"] != "http":
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {name.lower() for name, _ in message["headers"]}
                pairs = [(name.lower().encode(), value.encode()) for name, value in OWN_HEADERS.items()]
                own = [(name, value) for name, value in pairs if name not in given]
                message["headers"] = [*message["headers"], *own]
            await send(message)

        request = Request(scope, receive)
        refusal = self._refusal(request)
        if refusal is not None:
            await refusal(scope, receive, send_with_headers)
            return
        await self._app(scope, receive, send_with_headers)

    def _refusal(self, request: Request) -> Response | None:
        headers = Headers([(k.decode("latin-1"), v.decode("latin-1")) for k, v in request.scope["headers"]])
        is_change = request.method not in SAFE
        if not is_own_page(headers, self._host) or (is_change and "Origin" not in headers):
            return PlainTextResponse("This page is only served to itself.\n", 403)
        return self._admits(request)


class OwnerSecret:
    """The owner's token: sent once in the address, a cookie from then on."""

    def __init__(self, token: str):
        """Keep the token."""
        self._token, self._name = token, f"{COOKIE}-{token[:6]}"

    def __call__(self, request: Request) -> Response | None:
        """Return None for a request with the cookie; set it for one with the token."""
        if is_same(request.cookies.get(self._name, ""), self._token):
            return None
        if request.method != "GET" or not is_same(request.query_params.get("token", ""), self._token):
            return PlainTextResponse(NEEDS_ADDRESS, 401)
        answer = RedirectResponse("/", 303)  # so that the token does not stay in the address
        answer.set_cookie(self._name, self._token, httponly=True, samesite="lax", path="/", max_age=30 * 86400)
        return answer


async def read_body(request: Request) -> bytes:
    """Return a request's body.

    Raises:
        UserError: it is too large.
    """
    body = b""
    async for piece in request.stream():
        body += piece
        if len(body) > LARGEST_BODY:
            raise UserError(f"The request has more than {LARGEST_BODY} bytes.")
    return body


async def read_object(request: Request) -> dict[str, Any]:
    """Return the JSON object in a request's body.

    Raises:
        UserError: it is none, or too large.
    """
    try:
        found = parse_json((await read_body(request) or b"{}").decode())
    except ValueError:
        found = None
    if not isinstance(found, dict):
        raise UserError("The request holds no JSON object.")
    return found


def text_of(values: dict[str, Any], name: str) -> str:
    """Return a text of a request.

    Raises:
        UserError: it is missing, no text, or too long.
    """
    value = values.get(name)
    if not isinstance(value, str) or len(value) > LONGEST_TEXT:
        raise UserError(f"{name} of the request is no text of at most {LONGEST_TEXT} letters.")
    return value


def sentences(root: Path) -> dict[Any, Any]:
    """Return the handlers of what the user can mend: a sentence each, which does not tell where `root` lies."""
    handler = partial(_as_sentence, root)
    return {UserError: handler, OSError: handler}


def _as_sentence(root: Path, _request: Request, error: Exception) -> Response:
    status, text = 400, without_folder(in_page_words(error), root)
    if isinstance(error, OSError):
        is_full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        status = 507 if is_full else 500
        hint = "Empty the trash, or make room." if is_full else "Try again; check that the folder can be written to."
        text = f"{error.strerror or error}. {hint}"
    return JSONResponse({"error": in_one_line(text)[:2000]}, status)


def free_socket(host: str, port: int) -> socket.socket:
    """Return a socket that listens on this host and port, or to one of the next ports; port 0: any.

    Raises:
        UserError: none is free.
    """
    kind = socket.AF_INET6 if ":" in host else socket.AF_INET
    for candidate in range(port, port + MOST_PORTS):
        listener = socket.socket(kind, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, candidate))
            listener.listen()  # until then another program may bind it, too
            return listener
        except OSError:
            listener.close()
    raise UserError(f"none of the ports {port} to {port + MOST_PORTS - 1} of {host} is free. Give another --port.")


def http_server(app: ASGIApp, certificate: Path | None = None, key: Path | None = None) -> uvicorn.Server:
    """Return a server of an application; with a certificate it speaks https."""
    config = uvicorn.Config(
        app,
        log_level="critical",
        access_log=False,
        lifespan="off",
        ws="none",
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
        ssl_certfile=certificate,
        ssl_keyfile=key,
    )
    return uvicorn.Server(config)
