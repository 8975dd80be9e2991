"""studio: serve the pages of a folder, and open the browser.

What phones that were let in can ask for: the page, sending files to one capture, and how that capture is doing.
"""

import contextlib
import threading
import webbrowser
from collections.abc import Callable
from functools import partial
from pathlib import Path

from anyio import to_thread
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from capture.errors import CaptureError, UserError
from capture.files.atomic import write_json
from capture.files.schema import read_kept
from reconstruct.run_folder.lock import release_lock, take_lock
from viewer.page.guard import COOKIE
from viewer.studio.folder import ADDRESS, CAPTURES, RUNS, StudioFolder, is_capture, is_run
from viewer.studio.studio import Studio
from viewer.studio_server.gate import (
    FILES,
    Gate,
    OwnerSecret,
    file_routes,
    free_socket,
    http_server,
    read_object,
    sentences,
    text_of,
    web_file,
)
from viewer.studio_server.phones import EVERYWHERE, Door, Phones
from viewer.studio_server.routes import owner_app
from viewer.studio_server.uploads import Uploads

COOKIE_NAME = f"{COOKIE}-phone"
FREE = {"/", "/live", "/join", *(f"/{name}" for name in FILES)}  # what a phone gets that is not in yet
HOST = "127.0.0.1"


def phone_app(studio: Studio, phones: Phones) -> ASGIApp:
    """Return the application of the phones' listeners."""

    def door() -> Door:
        found = phones.door
        if found is None:
            raise CaptureError("Phones are not let in any more.")
        return found

    def admits(request: Request) -> Response | None:
        if phones.door is None:
            return PlainTextResponse("Phones are not let in at the moment.\n", 403)
        request.state.phone = phones.find(request.cookies.get(COOKIE_NAME, ""))
        if request.url.path in FREE or request.state.phone is not None:
            return None
        return JSONResponse({"error": "This phone is not in. Scan the new code that the studio shows."}, 401)

    async def live(_request: Request) -> Response:  # the same page; its address tells it to show the live camera
        return web_file("phone.html")

    async def join(request: Request) -> Response:
        values = await read_object(request)
        phone = phones.join(text_of(values, "token"), text_of(values, "name"))
        answer = JSONResponse({"done": phone.name})
        answer.set_cookie(COOKIE_NAME, phone.secret, httponly=True, samesite="strict", path="/", max_age=86400)
        return answer

    async def state(request: Request) -> Response:
        phone, now = request.state.phone, door()
        found = await to_thread.run_sync(studio.for_phone, now.capture)
        return JSONResponse(found | {"name": phone.name, "role": phone.role, "shots": now.shots})

    async def role(request: Request) -> Response:
        phones.set_role(request.state.phone, text_of(await read_object(request), "role"))
        return JSONResponse({"done": None})

    routes = [
        *file_routes("phone.html"),
        Route("/live", live, methods=["GET"]),
        Route("/join", join, methods=["POST"]),
        Route("/api/state", state, methods=["GET"]),
        Route("/api/role", role, methods=["POST"]),
        *Uploads(studio.parts, lambda *_: door().capture, lambda request: request.state.phone.id).routes(),
    ]
    return Gate(Starlette(routes=routes, exception_handlers=sentences(studio.folder.root)), EVERYWHERE, admits)


def serve(
    root: Path,
    port: int = 8090,
    opens: Callable[[str], object] | None = webbrowser.open,
    say: Callable[[str], object] = print,
) -> None:
    """Serve the studio of a folder until Ctrl-C. Runs that it started go on after that.

    Args:
        root: the folder; one that is itself a capture or a run means the folder that it lies in.
        port: if it is busy, one of the next ones is taken.
        opens: called with the address, to show it in a browser; None: nothing is opened.
        say: called with each line for the terminal.

    Raises:
        UserError: the folder cannot be used, or no port is free.
    """
    place, at = _studio_of(root)
    folder = StudioFolder(place)
    try:
        take_lock(folder.kept)
    except UserError:
        address = (read_kept(folder.kept / ADDRESS, dict) or {}).get("address")
        if address is None:
            raise
        say(f"The studio of {folder.root} is open already. Open {address}")
        if opens is not None:
            opens(f"{address}&again=1{at}")
        return
    with contextlib.ExitStack() as ending:
        ending.callback(release_lock, folder.kept)
        studio = Studio(folder)
        phones = Phones(folder.kept / "phones.json", folder.kept / "phones", partial(phone_app, studio))
        token, listener = folder.token(), ending.enter_context(free_socket(HOST, port))
        address = f"http://localhost:{listener.getsockname()[1]}/?token={token}"
        write_json(folder.kept / ADDRESS, {"address": address})  # for a second studio that is started by mistake
        server = http_server(Gate(owner_app(studio, phones), HOST, OwnerSecret(token)))
        studio.start()
        ending.callback(studio.close)
        phones.resume()
        ending.callback(phones.close)
        say(f"Open {address}")
        say(f"Captures and runs of {folder.root}. Ctrl-C closes the studio; runs go on.")
        if opens is not None:
            threading.Timer(0.5, opens, (address + at,)).start()
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[listener])


def _studio_of(root: Path) -> tuple[Path, str]:
    """Return the folder of a studio for what a person named, and the part of its page that shows it."""
    if root.exists() and not root.is_dir():
        raise UserError(f"{root} is a file; a folder with captures and runs was needed.")
    if not root.is_dir() or not (is_run(root) or is_capture(root)):
        return root, ""
    path = root.resolve()
    parent = path.parent.parent if path.parent.name in (CAPTURES, RUNS) else path.parent
    kind = "run" if is_run(path) else "capture"
    return parent, f"#/{kind}/{path.relative_to(parent).as_posix()}"
