"""Our own files for browsers."""

from importlib import resources
from pathlib import Path

from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

WEB = Path(str(resources.files("viewer.studio_server") / "web"))
TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
REVALIDATE = {"Cache-Control": "no-cache"}


def web_file(name: str) -> Response:
    """Return one of our own files."""
    return FileResponse(WEB / name, media_type=TYPES[Path(name).suffix], headers=REVALIDATE)


def file_routes(names: tuple[str, ...], index: str) -> list[Route]:
    """Return a route for each of our files, and / for the page."""

    def route(name: str, path: str) -> Route:
        async def answer(_request: Request) -> Response:
            return web_file(name)

        return Route(path, answer, methods=["GET"])

    return [route(index, "/"), *(route(name, f"/{name}") for name in names)]
