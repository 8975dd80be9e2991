"""Two windows that look at one run: what one does with light and layers is not seen in the other."""

import gc
import weakref

import fake_run
import pytest
from chromium import open_page
from waiting import wait_until

from viewer.page.guard import GuardedServer
from viewer.page.serve import Visitors

pytestmark = pytest.mark.browser


@pytest.mark.slow
def test_what_one_visitor_switches_the_other_does_not_see_and_who_leaves_is_forgotten(browser, truth, tmp_path):
    run = tmp_path / "heap"
    fake_run.start_run(run, truth)
    fake_run.finish_run(run, truth)
    server = GuardedServer("127.0.0.1", 0)
    visitors = Visitors(run, server)

    def polled(is_true) -> None:
        wait_until(lambda: visitors.poll() or is_true())

    try:
        address = f"http://localhost:{server.get_port()}"
        tabs = []
        for number in range(2):
            tabs.append(open_page(browser, address, is_drawn=False)[0])
            polled(lambda number=number: len(visitors.pages) == number + 1)
        pages = list(visitors.pages.values())
        polled(lambda: all(page._mesh_name == "mesh.ply" for page in pages))
        tabs[0].get_by_text("Show", exact=True).click()
        tabs[0].get_by_label("Surface").uncheck()
        polled(lambda: not pages[0].controls.shows("Surface"))
        assert pages[1].controls.shows("Surface")
        gone = weakref.ref(pages.pop(0))
        tabs[0].close()
        polled(lambda: list(visitors.pages.values()) == pages)
        polled(lambda: gc.collect() and gone() is None)  # nothing keeps what was shown to one who has left
        tabs[1].close()
        polled(lambda: not visitors.pages)
    finally:
        server.stop()
