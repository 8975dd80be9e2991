"""Visitors: each browser window has a page of its own, so that nobody's lamp, layers or view show on another's.

Requests to the run itself (pause, stop) are files of the run folder: they are seen by all.
"""

import threading
from pathlib import Path

import viser

from viewer.page.page import Page


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
