"""Visitors: each browser window has a page of its own, so that nobody's lamp, layers or lengths show on another's.

Requests to the run itself (pause, stop) are files of the run folder: they are seen by all.
"""

import contextlib
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import viser

from capture.errors import UserError
from reconstruct.stored_run.stored_run import FIELDS, MESH, StoredRun
from viewer.display.run_follower import RunFollower, status
from viewer.page.page import KeptReadings, Page
from viewer.page.tabs import TABS

if TYPE_CHECKING:
    from collections.abc import Callable

    from reconstruct.evaluate.deviation import ReferenceMesh


class VisitorServer(viser.ViserServer):
    """Scene, controls and camera of one visitor, with the part of a server's interface that a Page uses."""

    def __init__(self, client: viser.ClientHandle):
        """Open nothing: the visitor is connected to a server already."""
        self.scene, self.gui = client.scene, client.gui
        self._client = client

    @property
    def initial_camera(self) -> Any:
        """The visitor's camera: nobody comes later."""
        return self._client.camera

    def get_clients(self) -> dict[int, viser.ClientHandle]:
        """Return the one visitor."""
        return {self._client.client_id: self._client}

    def on_client_connect(self, cb: "Callable[[viser.ClientHandle], Any]") -> "Callable[[viser.ClientHandle], Any]":
        """Call at once: the visitor is here."""
        cb(self._client)
        return cb

    def atomic(self) -> Any:
        """Return a context whose messages reach the visitor together."""
        return self._client.atomic()


class Visitors:
    """The pages of all windows that look at one run. One thread calls `poll`."""

    def __init__(self, run_dir: Path, server: viser.ViserServer, reference: "ReferenceMesh | None" = None):
        """Make a page for whoever comes, and for whoever is here already."""
        self.pages: dict[int, Page] = {}  # by the number of the window's connection
        self._run_dir, self._server, self._reference = run_dir, server, reference
        self._kept = KeptReadings()
        self._follower = RunFollower(run_dir)
        self._came = threading.Event()
        server.on_client_connect(lambda _: self._came.set())

    def warm(self) -> None:
        """Import the panels of a finished run and read its result: its first visitor then waits for neither."""
        if not self.is_over:
            return
        run = StoredRun(self._run_dir)
        with contextlib.suppress(UserError):  # what is damaged is said on the page
            self._kept.glb(run.run_dir / MESH)
            self._kept.get(run.run_dir / FIELDS, lambda: run.fields)
        for tab in TABS:
            if tab.is_result:
                tab.load()

    def wait(self, seconds: float) -> None:
        """Wait, but not while a new visitor does."""
        self._came.wait(seconds)

    def poll(self) -> None:
        """Look for new and for gone visitors, and let every page look for changes of the run."""
        self._came.clear()
        clients = self._server.get_clients()
        for number in self.pages.keys() - clients.keys():
            self.pages.pop(number).close()
        for number, client in clients.items():
            if number not in self.pages:
                self.pages[number] = Page(self._run_dir, VisitorServer(client), self._reference, self._kept)
            self.pages[number].poll(is_watched=True)

    @property
    def is_over(self) -> bool:
        """Whether the run has ended, as far as its folder says."""
        return status(self._follower.log(), self._follower.is_running()).is_over

    def close(self) -> None:
        """End the threads of all pages."""
        for page in self.pages.values():
            page.close()
        self.pages.clear()
