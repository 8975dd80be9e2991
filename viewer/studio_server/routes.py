"""The owner's requests: addresses, and what of the Studio answers them; the boards that its page offers."""

from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from anyio import to_thread
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from calibration.board.board import parse_print
from calibration.board.printing import DEFAULT_BOARDS, PAPERS, BoardPage, draw_pdf, lay_out
from capture.errors import CaptureError
from capture.files.regular import is_regular
from reconstruct.stored_run.stage_document import save_stage_document
from viewer.page.guard import HTML, STAGE_HEADERS
from viewer.stage.page import page_of, page_policy
from viewer.studio.library import example_page
from viewer.studio.studio import Studio
from viewer.studio_server.gate import FRAMED_POLICY, file_routes, read_body, read_object, sentences, text_of
from viewer.studio_server.phones import Phones
from viewer.studio_server.uploads import Uploads

BOARDS = (  # text of session.toml ("": none), title, about
    ("", "Find out from the photos", "Common printed boards are tried."),
    (DEFAULT_BOARDS["charuco"], "Our printed board", "Recognised from all sides and with parts of it hidden."),
    (DEFAULT_BOARDS["checkerboard"], "Our printed checkerboard", "Fewer fine details; for printers that smear."),
    ("paper:A4", "A blank sheet of A4", "No printer needed: a clean, flat sheet on a darker table."),
    ("paper:letter", "A blank sheet of US letter", "No printer needed: a clean, flat sheet on a darker table."),
    ("card", "A bank card", "No printer needed: for objects not much larger than a hand."),
)
SAVED = ("format", "size")  # what a request for another kind of file names beside the run
STAGED = STAGE_HEADERS | {  # of a page that runs the stage's script, and saves pictures and notes
    "Content-Security-Policy": f"sandbox allow-scripts allow-downloads allow-forms; {page_policy()}; "
    "frame-ancestors 'self'"
}
FRAMED = {"Content-Security-Policy": FRAMED_POLICY, "X-Frame-Options": "SAMEORIGIN"}
KEPT = {"Cache-Control": "private, max-age=86400"}


def owner_app(studio: Studio, phones: Phones) -> Starlette:
    """Return the application of the owner's page, without its gate."""
    routes = [
        *file_routes("index.html"),
        *_questions(studio, phones),
        *_changes(studio, phones),
        *Uploads(studio.parts, lambda _, key: _existing(studio, key), lambda _: "owner").routes(),
    ]
    return Starlette(routes=routes, exception_handlers=sentences(studio.folder.root))


def _questions(studio: Studio, phones: Phones) -> list[Route]:
    def ask(path: str, answer: Callable[[Request], Any]) -> Route:
        async def endpoint(request: Request) -> Response:
            found = await to_thread.run_sync(answer, request)
            return found if isinstance(found, Response) else JSONResponse(found)

        return Route(path, endpoint, methods=["GET"])

    return [
        ask("/api/state", lambda _: studio.state()),
        ask("/api/capture", lambda r: studio.capture(_key(r))),
        ask("/api/presets", lambda r: studio.presets(_key(r))),
        ask("/api/folders", lambda r: [{"key": k, "is_capture": c} for k, c in studio.folder.browse(_key(r))]),
        ask("/api/boards", lambda _: [dict(zip(("spec", "title", "about"), board, strict=True)) for board in BOARDS]),
        ask("/api/board_shapes", lambda r: _board_shapes(_board_page(r))),
        ask("/board.pdf", lambda r: Response(draw_pdf(_board_page(r)), media_type="application/pdf")),
        ask("/api/phones", lambda _: phones.row()),
        ask("/api/code", lambda r: Response(phones.code("live" in r.query_params), media_type="image/svg+xml")),
        ask("/api/picture", lambda r: _made(studio.picture(_key(r), r.query_params.get("photo", "")), "image/jpeg")),
        ask("/api/run_picture", lambda r: _made(studio.run_picture(_key(r)), "image/jpeg")),
        ask("/api/formats", lambda _: studio.saving.formats()),
        ask("/api/saved", lambda r: studio.saving.asked(_key(r))),
        ask("/download", lambda r: _download(studio.saving.file(_key(r), *(r.query_params.get(n, "") for n in SAVED)))),
        ask("/stage/{key:path}/", lambda r: _stage(studio, r)),
        ask("/example/", lambda _: Response(example_page(), media_type=HTML, headers=STAGED)),
        ask("/report", lambda r: _framed(studio.folder.run(_key(r)) / "report.html")),
        ask("/check_page", lambda r: _framed(studio.checks.page(studio.folder.capture(_key(r))))),
    ]


def _changes(studio: Studio, phones: Phones) -> list[Route]:
    def change(name: str, do: Callable[..., Any], *names: str) -> Route:
        async def endpoint(request: Request) -> Response:
            values = await read_object(request)
            arguments = [text_of(values, each) for each in names]
            found = await to_thread.run_sync(lambda: do(*arguments))
            return JSONResponse({"done": found})

        return Route(f"/api/{name}", endpoint, methods=["POST"])

    return [
        Route("/stage/{key:path}/stage.json", partial(_keep_document, studio), methods=["PUT"]),
        change("new", studio.new_capture, "title"),
        change("try_example", studio.try_example),
        change("add", studio.folder.add, "key"),
        change("rename", studio.rename, "key", "title"),
        change("delete", studio.delete, "key"),
        change("go_on_without", studio.go_on_without, "key"),
        change("dismiss", studio.dismiss, "key", "part"),
        change("delete_photo", studio.delete_photo, "key", "photo"),
        change("restore", studio.trash.restore, "id"),
        change("empty_trash", studio.empty_trash),
        change("board", studio.set_board, "key", "board"),
        change("role", studio.set_role, "key", "photo", "role"),
        change("check", lambda key: studio.checks.ask(studio.folder.capture(key)), "key"),
        change("start", studio.start_run, "key", "preset"),
        change("let_in", lambda key: phones.turn_on(_existing(studio, key)), "key"),
        change("send_away", phones.turn_off),
        change("shoot", phones.shoot),
        change("save", studio.saving.ask, "key", *SAVED),
        change("forget_save", studio.saving.forget, "key", *SAVED),
        change("view", studio.pages.open, "key"),
        change("queue", studio.change_queue, "job", "action"),
    ]


def _stage(studio: Studio, request: Request) -> Response:
    """Return the stage of a run, which may be a stranger's: without an origin, and it runs its own script alone."""
    pack = studio.stage(request.path_params["key"])
    if isinstance(pack, Future):
        return _made(pack, "")
    if request.method == "HEAD":
        return Response()
    run = studio.folder.run(request.path_params["key"])
    return Response(page_of(run, pack, "frame"), media_type=HTML, headers=STAGED)


async def _keep_document(studio: Studio, request: Request) -> Response:
    """Keep what a visitor noted on a run's stage with the run."""
    content = await read_body(request)
    await to_thread.run_sync(lambda: save_stage_document(studio.folder.run(request.path_params["key"]), content))
    return JSONResponse({"done": None})


def _existing(studio: Studio, key: str) -> str:
    return studio.folder.key(studio.folder.capture(key))


def _key(request: Request) -> str:
    return request.query_params.get("key", "")


def _board_page(request: Request) -> BoardPage:
    """Lay the board that a request names out on its sheet."""
    spec, paper = request.query_params.get("board", ""), request.query_params.get("paper", "a4")
    if paper not in PAPERS:
        raise CaptureError(f"{paper!r:.40} is no paper; {' or '.join(PAPERS)} was needed.")
    return lay_out(parse_print(spec or DEFAULT_BOARDS["charuco"]), paper)


def _board_shapes(page: BoardPage) -> dict[str, Any]:
    """Return the board's rectangles in mm from the upper left corner of its sheet, with the sheet's size, to draw."""
    upright = [replace(shape, y=page.height_mm - shape.y - shape.height) for shape in page.rectangles]
    rows = [[shape.x, shape.y, shape.width, shape.height, int(shape.is_black)] for shape in upright]
    return {"width": page.width_mm, "height": page.height_mm, "shapes": rows, "spec": page.board.spec()}


def _made(found: "Path | bytes | Future[Any]", kind: str) -> Response:
    """Return a file once it is made; the address of a picture changes with its content, so browsers may keep it."""
    if isinstance(found, bytes):
        return Response(found, media_type=kind, headers=KEPT)
    if isinstance(found, Path):
        return FileResponse(found, media_type=kind, headers=KEPT)
    if found.done():
        found.result()  # or its error
    return JSONResponse({"wait": True}, 202)


def _download(file: Path) -> Response:
    """Return a file to keep; it is never shown as a page of ours."""
    return FileResponse(file, media_type="application/octet-stream", filename=file.name)


def _framed(found: Path) -> Response:
    """Return a page made of content that may be a stranger's: without an origin, and nothing to load."""
    if not is_regular(found):
        raise CaptureError(f"There is no {found.name} yet.")
    return FileResponse(found, media_type="text/html", headers=FRAMED)
