"""What phones that were let in can ask for: the page, sending files to one capture, and how that capture is doing."""

from anyio import to_thread
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from capture.errors import CaptureError
from viewer.page.guard import COOKIE
from viewer.studio.studio import Studio
from viewer.studio_server.gate import Gate, read_object, sentences, text_of
from viewer.studio_server.phones import EVERYWHERE, Door, Phone, Phones
from viewer.studio_server.uploads import Uploads
from viewer.studio_server.web_files import file_routes, web_file

COOKIE_NAME = f"{COOKIE}-phone"
FILES = ("studio.css", "dom.js", "phone.js", "album.js", "live.js", "upload.js", "hemisphere.js", "voice.js")
FILES += ("icon.svg",)
FREE = {"/", "/live", "/join", *(f"/{name}" for name in FILES)}  # what a phone gets that is not in yet


class PhoneRoutes:
    """Answers the requests of phones."""

    def __init__(self, studio: Studio):
        """Answer for this studio."""
        self._studio = studio
        self._phones: Phones

    def app(self, phones: Phones) -> ASGIApp:
        """Return the application of the phones' listeners."""
        self._phones = phones
        routes = [
            *file_routes(FILES, "phone.html"),
            Route("/live", self.live, methods=["GET"]),
            Route("/join", self.join, methods=["POST"]),
            Route("/api/state", self.state, methods=["GET"]),
            Route("/api/role", self.role, methods=["POST"]),
            Route("/api/leave", self.leave, methods=["POST"]),
            *Uploads(self._studio.parts, self._target, lambda request: self._mine(request).id).routes(),
        ]
        return Gate(
            Starlette(routes=routes, exception_handlers=sentences(self._studio.folder.root)), EVERYWHERE, self._admits
        )

    async def live(self, _request: Request) -> Response:
        """The same page; its address tells it to show the live camera."""
        return web_file("phone.html")

    async def join(self, request: Request) -> Response:
        """Let a phone in that shows the code."""
        values = await read_object(request)
        phone = self._phones.join(text_of(values, "token"), text_of(values, "name"))
        answer = JSONResponse({"done": phone.name})
        answer.set_cookie(COOKIE_NAME, phone.secret, httponly=True, samesite="strict", path="/", max_age=86400)
        return answer

    async def state(self, request: Request) -> Response:
        """Say how the capture is doing that the phone sends to."""
        phone, door = self._mine(request), self._door()
        found = await to_thread.run_sync(self._studio.for_phone, door.capture)
        return JSONResponse(found | {"name": phone.name, "role": phone.role, "shots": door.shots})

    async def role(self, request: Request) -> Response:
        """Note what a phone does in live mode."""
        values = await read_object(request)
        self._phones.set_role(self._mine(request), text_of(values, "role"))
        return JSONResponse({"done": None})

    async def leave(self, request: Request) -> Response:
        """Forget a phone."""
        self._phones.leave(self._mine(request).secret)
        return JSONResponse({"done": None})

    def _admits(self, request: Request) -> Response | None:
        if self._phones.door is None:
            return PlainTextResponse("Phones are not let in at the moment.\n", 403)
        if request.url.path in FREE or self._phones.find(request.cookies.get(COOKIE_NAME, "")) is not None:
            return None
        return JSONResponse({"error": "This phone is not in. Scan the new code that the studio shows."}, 401)

    def _mine(self, request: Request) -> Phone:
        phone = self._phones.find(request.cookies.get(COOKIE_NAME, ""))
        if phone is None:
            raise CaptureError("This phone is not in any more. Scan the new code that the studio shows.")
        return phone

    def _door(self) -> Door:
        door = self._phones.door
        if door is None:
            raise CaptureError("Phones are not let in any more.")
        return door

    def _target(self, request: Request, _key: str) -> str:
        """Return the capture that phones send to, whichever they name."""
        self._mine(request)
        return self._door().capture
