"""A viser server that answers only its own page: no tunnel, no foreign origin, no foreign host name.

viser 1.1 accepts a WebSocket from any origin, so any web page open in the user's browser could read the scene and move
its controls, also on 127.0.0.1. It passes none of the options on that `websockets` has against that, and a proxy before
it would leave its own port open; so while viser opens its socket, the function that opens it gets these options too.
A visitor over a network sends the token of the printed address once, and a cookie from then on.

Which messages of a browser viser may see: those that our page sends, none large, no file.

viser 1.1 decodes every message, keeps the parts of an upload without a limit, and lets a message set any attribute of a
control.
"""

import asyncio
import contextlib
import gzip
import hmac
import html
import http
import io
import ipaddress
import secrets
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.frames import CloseCode
from websockets.http11 import Request, Response

from capture.errors import UserError
from reconstruct.stored_run.stage_document import save_stage_document
from viewer.stage.page import page_of, stage_pack

LARGEST = 1 << 16  # bytes of one message: decoded, it may need a hundred times its size
VALUE = "GuiUpdateMessage"  # a control was moved or pressed
KINDS = (
    VALUE,
    "TransformControlsDragEndMessage",
    "TransformControlsDragStartMessage",
    "TransformControlsUpdateMessage",
    "ViewerCameraMessage",
)
LOOPBACK_NAMES = ("localhost", "127.0.0.1", "::1")
PAGE = ("/", "/index.html")  # viser's page is one file
STAGE, STAGE_DOCUMENT = "/stage/", "/stage/stage.json"  # the run as a picture, beside viser's page
TOKEN_BYTES = 24
VISER_TITLE = b"<title>Viser</title>"
# viser draws a white page until it hears of its theme: until then, for at most eight seconds, there is a dark ground
DARK = """<style>html,body{background:#141517}html:not(.themed) body{background:#141517!important}
html:not(.themed) #root{visibility:hidden}</style><script>
{const page = document.documentElement;
const observer = new MutationObserver(() => { if (page.dataset.mantineColorScheme === "dark") show(); });
const show = () => { observer.disconnect(); page.classList.add("themed"); };
observer.observe(page, {attributeFilter: ["data-mantine-color-scheme"]});
setTimeout(show, 8000);}
</script>"""
COOKIE = "shadowgraph"
LARGEST_FRAME = 1 << 21  # bytes of a message: twice a stage document, so that one too large gets a sentence
FRAMES_WAITING = 4  # of one connection: received messages that are held before they are read
HTML = "text/html; charset=utf-8"
SAFE_HEADERS = {  # of every answer of a server of ours
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
STAGE_HEADERS = SAFE_HEADERS | {  # a page of the same server may show the stage in a frame
    "X-Frame-Options": "SAMEORIGIN",
    "Cache-Control": "no-cache",
}
OWN_HEADERS = SAFE_HEADERS | {
    # nothing is loaded from elsewhere, and no other page may show this one in a frame (clickjacking)
    "Content-Security-Policy": (
        "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'; connect-src 'self' data: blob:; "
        "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    ),
    "X-Frame-Options": "DENY",
}


class _Message(msgspec.Struct):
    type: str
    updates: Any = None


def fault_of(raw: bytes | str) -> str:
    """Return why a message is none that our page sends, "" for one that it does."""
    if isinstance(raw, str) or len(raw) > LARGEST:
        return f"{len(raw)} characters or bytes, where the page sends at most {LARGEST} bytes"
    try:
        message = msgspec.msgpack.decode(raw, type=_Message)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return "not a message"
    if message.type not in KINDS:
        return "a kind that the page does not send"
    if message.type == VALUE and not (isinstance(message.updates, dict) and set(message.updates) == {"value"}):
        return "a control's value is all that the page changes"
    return ""


class GuardedServer(viser.ViserServer):
    """A ViserServer behind `is_own_page` and `fault_of`, without its banner and its public share tunnel."""

    def __init__(self, host: str, port: int, run_dir: Path | None = None, title: str = "Shadowgraph"):
        """Serve on this host and port, or on the next free port, see `get_port`.

        Args:
            run_dir: a run whose stage is served below STAGE, beside viser's page.
            title: of the page.

        Raises:
            RuntimeError: the guard does not fit this version of viser.
        """
        self.token = "" if is_loopback(host) else secrets.token_urlsafe(TOKEN_BYTES)  # of the address; "": none needed
        with _guarded_handshakes(host, self.token, run_dir, title) as guards, contextlib.redirect_stdout(io.StringIO()):
            super().__init__(host=host, port=port, verbose=False)
        if not guards:  # another viser, which opens its socket in another way
            self.stop()
            raise RuntimeError(f"the handshake guard does not fit viser {viser.__version__}; the page was not opened")


def is_loopback(host: str) -> bool:
    """Return whether nothing outside this machine can reach a server bound to `host`."""
    return host == "localhost" or (_address(host) is not None and ipaddress.ip_address(host).is_loopback)


def is_own_page(headers: Headers, bound_host: str) -> bool:
    """Return whether a request comes from this server's own page, under a name that nobody else can redirect to it.

    The Host must be this machine (a foreign name that resolves here is DNS rebinding), and the Origin, which browsers
    always send with a WebSocket, must be the same host and port. Any port is accepted: `ssh -L` may have changed it.

    Args:
        headers: of the HTTP request.
        bound_host: the host name or address that the server listens on.
    """
    hosts, origins, upgrades = (headers.get_all(name) for name in ("Host", "Origin", "Upgrade"))
    if len(hosts) != 1 or len(origins) > 1 or len(upgrades) > 1:
        return False
    try:
        name, origin = urlsplit(f"//{hosts[0]}").hostname or "", urlsplit(origins[0] if origins else "")
    except ValueError:  # "[" without "]"
        return False
    if name not in (*LOOPBACK_NAMES, bound_host) and (is_loopback(bound_host) or not _is_this_machine(name)):
        return False
    if not origins:
        return not _is_websocket(headers)
    return origin.scheme in ("http", "https") and origin.netloc.lower() == hosts[0].lower()


def shows_token(request: Request, token: str) -> bool:
    """Return whether the address of a request contains the token."""
    given = parse_qs(request.path.partition("?")[2]).get("token", [])
    return len(given) == 1 and is_same(given[0], token)


def has_cookie(request: Request, token: str) -> bool:
    """Return whether a request has the cookie that is set after the token was sent; one for each server."""
    pairs = (pair.strip().partition("=") for line in request.headers.get_all("Cookie") for pair in line.split(";"))
    return any(name == _cookie_name(token) and is_same(value, token) for name, _, value in pairs)


def _cookie_name(token: str) -> str:
    """Return the cookie's name. Cookies are shared by all ports, so each page of a machine needs its own name."""
    return f"{COOKIE}-{token[:6]}"


def is_same(given: str, token: str) -> bool:
    """Compare a text that was given with a secret, in a time that does not depend on how much of it is correct."""
    return hmac.compare_digest(given.encode("utf-8", "surrogateescape"), token.encode())


def _is_websocket(headers: Headers) -> bool:
    return headers.get("Upgrade", "").lower() == "websocket"


def _is_this_machine(name: str) -> bool:
    """Return whether a name is an address, which cannot be rebound, or one of this machine's own names."""
    return _address(name) is not None or name.lower() in (socket.gethostname().lower(), socket.getfqdn().lower())


def _address(name: str) -> str | None:
    try:
        return str(ipaddress.ip_address(name))
    except ValueError:
        return None


def _refusal(connection: ServerConnection, request: Request, bound_host: str, token: str) -> Response | None:
    """Answer a request before viser sees it; None: viser may see it."""
    if not is_own_page(request.headers, bound_host):
        return connection.respond(http.HTTPStatus.FORBIDDEN, "This page is only served to itself.\n")
    path = request.path.partition("?")[0]
    if path not in PAGE and not path.startswith(STAGE):  # no path that a client chose is ever opened on the disk
        return connection.respond(http.HTTPStatus.NOT_FOUND, "There is one page here: /\n")
    if not token or has_cookie(request, token):
        return None
    if not shows_token(request, token) or _is_websocket(request.headers):
        text = "Open the address that shadowgraph printed, with the token at its end.\n"
        return connection.respond(http.HTTPStatus.UNAUTHORIZED, text)
    answer = connection.respond(http.HTTPStatus.SEE_OTHER, "")  # so that the token does not stay in the address
    answer.headers["Location"] = STAGE if path.startswith(STAGE) else "/"
    answer.headers["Set-Cookie"] = f"{_cookie_name(token)}={token}; HttpOnly; SameSite=Lax; Path=/"
    answer.headers["Cache-Control"] = "no-store"
    return answer


def _name_page(answer: Response, title: str) -> None:
    """Give viser's page its own title, and the dark ground that it has later from the beginning, without a flash."""
    is_packed = answer.headers.get("Content-Encoding") == "gzip"
    body = gzip.decompress(answer.body) if is_packed and answer.body else answer.body or b""
    if VISER_TITLE not in body:
        return
    body = body.replace(VISER_TITLE, f"<title>{html.escape(title)}</title>{DARK}".encode(), 1)
    answer.body = gzip.compress(body, 1) if is_packed else body
    del answer.headers["Content-Length"]
    answer.headers["Content-Length"] = str(len(answer.body))


def _is_stage_document(request: Request | None) -> bool:
    return request is not None and request.path.partition("?")[0] == STAGE_DOCUMENT


async def _stage_answer(connection: ServerConnection, request: Request, run_dir: Path | None) -> Response | None:
    """Answer a request below STAGE; None where it opens the socket that takes the document."""
    if run_dir is not None and _is_websocket(request.headers) and _is_stage_document(request):
        return None
    status, text = http.HTTPStatus.NOT_FOUND, "There is no such file here.\n"
    try:
        if run_dir is not None and request.path.partition("?")[0] == STAGE:
            text = page_of(run_dir, await asyncio.to_thread(stage_pack, run_dir), "socket", "/")
            status = http.HTTPStatus.OK
    except UserError as error:
        text = f"{error}\n"
    answer = connection.respond(status, text)
    if status is http.HTTPStatus.OK:
        del answer.headers["Content-Type"]
        answer.headers["Content-Type"] = HTML
    answer.headers.update(STAGE_HEADERS)
    return answer


async def _keep_document(connection: ServerConnection, run_dir: Path) -> None:
    """Keep each document that comes, and answer with nothing, or with the sentence why it was not kept."""
    async for message in connection:
        content = message.encode() if isinstance(message, str) else bytes(message)
        try:
            await asyncio.to_thread(save_stage_document, run_dir, content)
            await connection.send("")
        except UserError as error:
            await connection.send(str(error))


class _GuardedConnection(ServerConnection):
    """Closes at a message that our page does not send."""

    async def recv(self, decode: bool | None = None) -> Any:
        message = await super().recv(decode)
        if not _is_stage_document(self.request) and (fault := fault_of(message)):
            closing = asyncio.create_task(self.close(CloseCode.POLICY_VIOLATION, fault))
            while not closing.done():  # messages under way must be read, or the connection never closes
                await super().recv(decode)
            await super().recv(decode)  # raises ConnectionClosed
        return message


@contextlib.contextmanager
def _guarded_handshakes(
    bound_host: str, token: str, run_dir: Path | None, title: str
) -> Iterator[list[Callable[..., Any]]]:
    """Open each websockets server with `_refusal` before its request handler while the block runs.

    Yields the list of guards that were installed; it is empty if no server opened.
    """
    serve, guards = websockets.asyncio.server.serve, []

    def guarded_serve(handler: Callable[..., Any], *args: Any, process_request: Callable[..., Any], **options: Any):
        async def guard(connection: ServerConnection, request: Request) -> Response | None:
            answer = _refusal(connection, request, bound_host, token)
            if answer is None and request.path.startswith(STAGE):
                return await _stage_answer(connection, request, run_dir)
            answer = answer or process_request(connection, request)
            if answer is not None:
                _name_page(answer, title)
                answer.headers.update(OWN_HEADERS)
            return answer

        async def handle(connection: ServerConnection) -> None:
            if run_dir is not None and _is_stage_document(connection.request):
                await _keep_document(connection, run_dir)
            else:
                await handler(connection)

        guards.append(guard)
        options |= {"max_size": LARGEST_FRAME, "max_queue": FRAMES_WAITING, "create_connection": _GuardedConnection}
        return serve(handle, *args, process_request=guard, **options)

    websockets.asyncio.server.serve = guarded_serve  # viser opens its socket inside its constructor, with this name
    try:
        yield guards
    finally:
        websockets.asyncio.server.serve = serve
