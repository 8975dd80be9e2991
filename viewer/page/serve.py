"""view: serve the page of a run folder, and print the address to open.

Each browser window has a page of its own, so that nobody's lamp, layers or view show on another's. Requests to the run
itself (pause, stop) are files of the run folder: they are seen by all.
"""

import contextlib
import gc
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import viser

from capture.errors import UserError
from capture.files.title import title_of
from reconstruct.run.bundle import user_name
from reconstruct.run_folder.forecast import give_memory_back, share_memory_among_threads
from reconstruct.stored_run.documents import refuse_no_run
from viewer.page.guard import GuardedServer, is_loopback
from viewer.page.page import Page
from viewer.stage.page import is_finished, stage_pack

POLL_S = 0.5  # between two looks at the folder: the growing mesh is written every two seconds
GIVE_BACK_S = 60.0  # takes a twentieth of a second


class Visitors:
    """The pages of all windows that look at one run. One thread calls `poll`."""

    def __init__(self, run_dir: Path, server: viser.ViserServer):
        """Make a page for whoever comes, and for whoever is here already."""
        self.pages: dict[int, Page] = {}  # by the number of the window's connection
        self._run_dir, self._server = run_dir, server
        self._came = threading.Event()
        server.on_client_connect(lambda _: self._came.set())

    def wait(self, seconds: float) -> None:
        """Wait, but not while a new visitor does."""
        self._came.wait(seconds)

    def poll(self) -> None:
        """Look for new and for gone visitors, and let every page look for changes of the run."""
        self._came.clear()
        clients = self._server.get_clients()
        for number in self.pages.keys() - clients.keys():
            self.pages.pop(number)
        for number, client in clients.items():
            if number not in self.pages:
                self.pages[number] = Page(self._run_dir, client, client.camera)
            self.pages[number].poll()


def view(
    run_dir: Path,
    host: str = "127.0.0.1",
    port: int = 8080,
    say: Callable[[str], object] = print,
    opens: Callable[[str], object] | None = None,
) -> None:
    """Serve the page of a run folder until Ctrl-C.

    Args:
        run_dir: a run's folder; the run may have just begun.
        host: 127.0.0.1 unless others shall see and use the page; they need the token of the printed address.
        port: if it is busy, the next free one is taken.
        say: called with each line about the address, once it is known.
        opens: called with the address, to show it in a browser.

    Raises:
        UserError: it is not the folder of a run.
    """
    refuse_no_run(run_dir)
    share_memory_among_threads()
    if is_finished(run_dir):
        with contextlib.suppress(UserError):  # the visitor gets the sentence
            stage_pack(run_dir)  # before somebody waits for it
    server = GuardedServer(host, port, run_dir, f"{title_of(run_dir)} - Shadowgraph")
    visitors = Visitors(run_dir, server)
    gc.freeze()  # objects made by imports stay; without this each collection would scan them for 0.15 s
    start = "stage/" if is_finished(run_dir) else ""
    for line in address_lines(host, server.get_port(), server.token, start):
        say(line)
    if opens is not None:
        opens(f"http://localhost:{server.get_port()}/{start}" + (f"?token={server.token}" if server.token else ""))
    given_back = time.monotonic()
    try:
        while True:
            visitors.poll()
            if time.monotonic() - given_back > GIVE_BACK_S:
                give_memory_back()  # of data for visitors who have left
                given_back = time.monotonic()
            visitors.wait(POLL_S)
    except KeyboardInterrupt:
        say("Page closed.")
    finally:
        server.stop()
        gc.unfreeze()


def address_lines(host: str, port: int, token: str = "", path: str = "") -> list[str]:
    """Return lines with the address to open here and from another machine, with the token if one is needed.

    Args:
        path: of the page to open first: that of a finished run is its picture, which links to the solver's view.
    """
    here = f"http://localhost:{port}" + (f"/{path}" if path else "")
    if is_loopback(host):
        account = "@".join(filter(None, (user_name(), socket.gethostname())))
        return [
            f"Open {here}",
            f"From another machine: ssh -L {port}:localhost:{port} {account}, then open {here} there",
        ]
    name = socket.gethostname() if host in ("0.0.0.0", "::") else host
    return [
        f"Open http://{name}:{port}/{path}?token={token}",
        f"Warning: --host {host} lets everybody who can reach this machine and has this address see and move this "
        "page; it is sent unencrypted, so others on the network may read along.",
    ]
