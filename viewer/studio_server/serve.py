"""studio: serve the pages of a folder, and open the browser."""

import contextlib
import threading
import webbrowser
from collections.abc import Callable
from pathlib import Path

from capture.errors import UserError
from viewer.studio.folder import CAPTURES, RUNS, StudioFolder, is_capture, is_run
from viewer.studio.sockets import free_socket, http_server
from viewer.studio.studio import Studio
from viewer.studio_server.gate import Gate, OwnerSecret
from viewer.studio_server.phone_routes import PhoneRoutes
from viewer.studio_server.phones import Phones
from viewer.studio_server.routes import owner_app

HOST = "127.0.0.1"


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
        folder.take()
    except UserError:
        address = folder.holder_address()
        if address is None:
            raise
        say(f"The studio of {folder.root} is open already. Open {address}")
        if opens is not None:
            opens(f"{address}&again=1{at}")
        return
    try:
        _serve(folder, port, opens, say, at)
    finally:
        folder.release()


def _serve(
    folder: StudioFolder,
    port: int,
    opens: Callable[[str], object] | None,
    say: Callable[[str], object],
    at: str,
) -> None:
    studio = Studio(folder)
    phones = Phones(folder.kept / "phones.json", folder.kept / "phones", PhoneRoutes(studio).app)
    token = folder.token()
    listener = free_socket(HOST, port)
    address = f"http://localhost:{listener.getsockname()[1]}/?token={token}"
    folder.note_address(address)
    server = http_server(Gate(owner_app(studio, phones), HOST, OwnerSecret(token)))
    studio.start()
    phones.resume()
    say(f"Open {address}")
    say(f"Captures and runs of {folder.root}. Ctrl-C closes the studio; runs go on.")
    if opens is not None:
        threading.Timer(0.5, opens, (address + at,)).start()
    try:
        with contextlib.suppress(KeyboardInterrupt):
            server.run(sockets=[listener])
    finally:
        phones.close()
        studio.close()
        listener.close()


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
