"""Ten thousand requests to one studio, connections that break off among them: memory and files stay as they were."""

import psutil
import pytest
from studio_client import Process
from test_studio_saving import cut_piece, photos

WARM_UP = 0.3  # of the requests
MOST_GROWTH, MOST_FILES = 0.05, 3
PAGES = ("/", "/app.js", "/api/state", "/api/capture?key=vase", "/nothing", "/api/capture?key=../..")


def soak(folder, requests: int, drops: int) -> tuple[list[int], list[int], int]:
    """Send requests as pages and phones do; resident bytes and open files after the warm-up and at the end; drops."""
    server = Process(folder, 0)
    try:
        client, dropped, marks = server.client, 0, []
        watched = psutil.Process(server.process.pid)
        capture = client.ok("new", title="vase")
        for number in range(requests):
            if number in (int(WARM_UP * requests), requests - 1):
                marks.append((watched.memory_info().rss, watched.num_fds()))
            if number % max(requests // drops, 1) == 0 and dropped < drops:
                ((name, content),) = photos(1, 200_000).items()
                address = client.create(capture, f"{number}_{name}", len(content)).headers["Location"]
                cut_piece(client, address, 0, content, len(content) // 2)
                dropped += 1
            elif number % 10 == 3:
                assert client.post("rename", key=capture, title=f"vase {number}")[0] in (200, 400)
            else:
                assert client.raw("GET", PAGES[number % len(PAGES)]).status in (200, 400, 404)
        return [mark[0] for mark in marks], [mark[1] for mark in marks], dropped
    finally:
        server.kill()


@pytest.mark.slow
def test_ten_thousand_requests_and_fifty_broken_connections_leave_memory_and_files_as_they_were(tmp_path):
    memory, files, dropped = soak(tmp_path, 10_000, 50)
    assert dropped == 50
    assert memory[1] < (1 + MOST_GROWTH) * memory[0]
    assert files[1] <= files[0] + MOST_FILES
