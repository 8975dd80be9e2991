"""A studio that serves a folder in this process or in one of its own, and a client that talks as a browser does."""

import base64
import http.client
import json
import re
import subprocess
import sys
import threading
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from urllib.parse import quote

from test_queue import PROGRAM
from waiting import PATIENCE_S, wait_until

from viewer.studio.folder import StudioFolder
from viewer.studio.studio import Studio
from viewer.studio_server.gate import Gate, OwnerSecret, free_socket, http_server
from viewer.studio_server.phones import Phones
from viewer.studio_server.routes import owner_app
from viewer.studio_server.serve import phone_app

ROOT = Path(__file__).parent.parent


class Client:
    """Requests to one port, with the headers of a page of that port; None leaves one out."""

    def __init__(self, port: int, cookie: str = ""):
        self.port, self.cookie = port, cookie

    def raw(self, method: str, path: str, body: bytes | None = None, **headers: str | None) -> http.client.HTTPResponse:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        own = {"Origin": f"http://127.0.0.1:{self.port}" if method not in ("GET", "HEAD") else None}
        every = own | {"Cookie": self.cookie or None} | headers
        connection.request(method, path, body, {name: value for name, value in every.items() if value is not None})
        answer = connection.getresponse()
        try:
            answer.content = answer.read()
        except ConnectionResetError:  # a server may refuse a request, and close, before it has read all of it
            answer.content = b""
        connection.close()
        return answer

    def get(self, path: str):
        answer = self.raw("GET", path)
        return answer.status, json.loads(answer.content or b"null")

    def post(self, name: str, **values: str):
        answer = self.raw("POST", name if name.startswith("/") else f"/api/{name}", json.dumps(values).encode())
        return answer.status, json.loads(answer.content or b"null")

    def ok(self, name: str, **values: str):
        status, found = self.post(name, **values)
        assert status == 200, found
        return found["done"]

    def create(self, capture: str, name: str, size: int, role: str = "") -> http.client.HTTPResponse:
        values = {"capture": capture, "filename": name, "role": role}
        pairs = [f"{key} {base64.b64encode(value.encode()).decode()}" for key, value in values.items() if value]
        return self.raw("POST", "/upload", b"", **{"Upload-Length": str(size), "Upload-Metadata": ",".join(pairs)})

    def piece(self, address: str, offset: int, content: bytes) -> http.client.HTTPResponse:
        headers = {"Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream"}
        return self.raw("PATCH", address, content, **headers)

    def send(self, capture: str, name: str, content: bytes, role: str = "") -> http.client.HTTPResponse:
        address = self.create(capture, name, len(content), role).headers["Location"]
        return self.piece(address, 0, content)


@contextmanager
def served(folder: Path, program: tuple[str, ...] = (), port: int = 0, run_s: str = "0.3"):
    """Yield (studio, phones, the owner's client).

    Args:
        program: stands for `shadowgraph`; unless given, its runs take `run_s` seconds and its checks say nothing.
    """
    kept = StudioFolder(folder)
    (kept.kept / "program.py").write_text(PROGRAM.replace("sys.argv[7]", repr(run_s)))
    studio = Studio(kept, program or (sys.executable, str(kept.kept / "program.py")))
    phones = Phones(kept.kept / "phones.json", kept.kept / "phones", partial(phone_app, studio))
    token, listener = kept.token(), free_socket("127.0.0.1", port)
    port = listener.getsockname()[1]
    server = http_server(Gate(owner_app(studio, phones), "127.0.0.1", OwnerSecret(token)))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    studio.start()
    thread.start()
    wait_until(lambda: server.started)
    try:
        yield studio, phones, Client(port, cookie_of(port, token))
    finally:
        server.should_exit = True
        thread.join()
        phones.close()
        studio.close()
        listener.close()


def cookie_of(port: int, token: str) -> str:
    answer = Client(port).raw("GET", f"/?token={quote(token)}")
    assert answer.status == 303, answer.content
    return answer.headers["Set-Cookie"].partition(";")[0]


class Process:
    """The command `shadowgraph studio` in a process of its own, which may be killed."""

    def __init__(self, folder: Path, port: int):
        words = [sys.executable, "-m", "shadowgraph", "studio", str(folder), "--no-open", "--port", str(port)]
        self.process = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        line = self.process.stdout.readline()
        self.port, token = re.search(r"localhost:(\d+)/\?token=(\S+)", line).groups()
        self.port = int(self.port)
        self.client = Client(self.port, cookie_of(self.port, token))

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        self.process.stdout.close()
