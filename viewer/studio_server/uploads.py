"""Files under way over HTTP: tus 1.0.0 with creation (https://tus.io/protocols/resumable-upload).

The owner's page and the phones' use the same routes; who may send to which capture is the caller's.
"""

import base64
import binascii
from collections.abc import Callable
from typing import Any

from anyio import to_thread
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route

from capture.errors import CaptureError
from capture.intake.parts import OffsetError, Part, Parts

VERSION = "1.0.0"
TUS = {"Tus-Resumable": VERSION, "Cache-Control": "no-store"}
PIECE = "application/offset+octet-stream"

Target = Callable[[Request, str], str]  # the request and the key that it names: the key of the capture to send to


class Uploads:
    """Answers the requests about files under way."""

    def __init__(self, parts: Parts, target: Target, sender: Callable[[Request], str]):
        """`target` and `sender` (who sends: another text for each) raise a CaptureError for who may not send."""
        self._parts, self._target, self._sender = parts, target, sender

    def routes(self) -> list[Route]:
        """Return the routes below /upload."""
        return [
            Route("/upload", self.create, methods=["POST"]),
            Route("/upload/{id}", self.answer, methods=["HEAD", "PATCH"]),
        ]

    async def create(self, request: Request) -> Response:
        """Note a file that will come; its address is in the answer."""
        values = _metadata(request.headers.get("Upload-Metadata", ""))
        capture = self._target(request, values.get("capture", ""))
        size, role = _number(request.headers.get("Upload-Length")), values.get("role", "")
        part = self._parts.begin(capture, values.get("filename", ""), size, role, self._sender(request))
        return Response(status_code=201, headers=TUS | {"Location": f"/upload/{part.id}"})

    async def answer(self, request: Request) -> Response:
        """Say how much of a file is here, or take its next piece."""
        part = self._part(request)
        if part is None:
            return Response(status_code=404, headers=TUS)
        if request.method == "PATCH":
            return await self._append(request, part)
        part = await self._finished(part)  # a sender that was told of a full disk asks here before it goes on
        return Response(headers=TUS | {"Upload-Length": str(part.size)} | self._where(part))

    async def _append(self, request: Request, part: Part) -> Response:
        if request.headers.get("Content-Type") != PIECE:
            return Response(status_code=415, headers=TUS)
        try:
            await self._parts.append(part, _number(request.headers.get("Upload-Offset")), request.stream())
        except OffsetError as error:
            return Response(status_code=409, headers=TUS | {"Upload-Offset": str(error.offset)})
        except ClientDisconnect:
            return Response(status_code=400, headers=TUS)
        part = await self._finished(part)
        return Response(status_code=204, headers=TUS | self._where(part))

    async def _finished(self, part: Part) -> Part:
        """The file, in its capture if it is whole."""
        is_whole = not part.is_over and self._parts.offset(part) == part.size
        return await to_thread.run_sync(self._parts.finish, part) if is_whole else part

    def _part(self, request: Request) -> Part | None:
        """The file that an address names; None: there is none, or somebody else sends it."""
        sender = self._sender(request)
        try:
            part = self._parts.find(request.path_params["id"])
        except KeyError:
            return None
        return part if part.sender == sender else None

    def _where(self, part: Part) -> dict[str, str]:
        found = {"Upload-Offset": str(self._parts.offset(part))}
        if part.refused:
            found["Shadowgraph-Refused"] = base64.b64encode(part.refused.encode()).decode()
        return found


def _metadata(header: str) -> dict[str, str]:
    """Return tus metadata: pairs of a name and a value in base64, separated by commas."""
    found: dict[str, Any] = {}
    for pair in header.split(",")[:16]:
        name, _, value = pair.strip().partition(" ")
        try:
            found[name] = base64.b64decode(value, validate=True).decode("utf-8")
        except (binascii.Error, ValueError) as error:
            raise CaptureError("Upload-Metadata is not as tus 1.0.0 wants it.") from error
    return found


def _number(text: str | None) -> int:
    if text is None or not text.isdecimal() or len(text) > 15:
        raise CaptureError("Upload-Length or Upload-Offset is no number of bytes.")
    return int(text)
