"""The tab "Save": exports the result and sends it as a download."""

import html
import tempfile
import threading
from pathlib import Path

import viser

from capture.errors import UserError
from reconstruct.export.export import ExportOptions, as_one_file, default_file, export
from reconstruct.run_folder.folder import Progress as Step
from reconstruct.run_folder.forecast import duration_text
from reconstruct.run_folder.progress import progress
from viewer.display.result import Result
from viewer.report.formats import FORMATS
from viewer.widgets.panel import PanelContext
from viewer.widgets.picture_panel import MUTED

DETAILS = {"As suits it": None, "Light (5,000 triangles)": 5_000, "Fine (100,000 triangles)": 100_000}
WIDTHS = {"As suits it": None, "Small (640 px)": 640, "Full HD (1920 px)": 1920}


class Stopped(Exception):
    """The page closes, or somebody pressed Stop."""


class SavePanel:
    """Choices, a button, and one export at a time in a thread of its own. No path comes from a client."""

    def __init__(self, context: PanelContext, tab: viser.GuiTabHandle):
        """Lay the controls out."""
        self._result: Result | None = None
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._names = {row.title: name for name, row in FORMATS.items()}
        gui = context.server.gui
        with tab:
            self._what = gui.add_dropdown("Save", tuple(self._names), hint="What to make of the result")
            self._about = gui.add_html("")
            self._detail = gui.add_dropdown("Detail", tuple(DETAILS), hint="How many triangles the mesh has")
            self._width = gui.add_dropdown("Width", tuple(WIDTHS), hint="Of the picture or video")
            self._button = gui.add_button("Make and download", icon=viser.Icon.DOWNLOAD)
            self._cancel = gui.add_button("Stop", icon=viser.Icon.PLAYER_STOP, visible=False)
            self._bar = gui.add_progress_bar(0.0, visible=False)
            self._said = gui.add_html("")
        self._what.on_update(lambda _: self._choose())
        self._button.on_click(self._begin)
        self._cancel.on_click(lambda _: self._stop.set())
        self._choose()

    def show(self, result: Result) -> None:
        """Save this result from now on."""
        self._result = result

    def close(self) -> None:
        """End an export that goes on."""
        self._stop.set()
        thread = self._thread
        if thread is not None:
            thread.join()

    def said(self) -> str:
        """Return the line about what was written, as it was sent."""
        return self._said.content

    def _name(self) -> str:
        """Return the chosen key of FORMATS; the first one if a client sends an unknown name."""
        return self._names.get(str(self._what.value), next(iter(FORMATS)))

    def _choose(self) -> None:
        """Show the description of the format, and the options that change it."""
        row = FORMATS[self._name()]
        self._about.content = _line(row.about)
        self._detail.visible = "faces" in row.takes
        self._width.visible = "width" in row.takes

    def _begin(self, event: viser.GuiEvent) -> None:
        """Start one export for the client that pressed the button."""
        client = event.client
        with self._lock:
            if client is None or self._result is None or (self._thread is not None and self._thread.is_alive()):
                return
            self._stop.clear()
            options = ExportOptions(
                faces=DETAILS.get(str(self._detail.value)), width=WIDTHS.get(str(self._width.value))
            )
            arguments = (client, self._name(), self._result.run_dir, options)
            self._thread = threading.Thread(target=self._make, args=arguments, daemon=True)
            self._thread.start()

    def _make(self, client: viser.ClientHandle, name: str, run_dir: Path, options: ExportOptions) -> None:
        self._busy(True)
        try:
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / default_file(run_dir, name).name
                written = export(run_dir, name, file, options, progress(name, self._show_progress))
                self._said.content = _line(f"{file.name}: {written.about()}")
                download = as_one_file(written)
                client.send_file_download(download.name, download.read_bytes(), save_immediately=True)
        except Stopped:
            self._said.content = _line("Stopped; nothing was saved.")
        except (UserError, OSError) as error:
            self._said.content = _line(str(error))
        finally:
            self._busy(False)

    def _busy(self, is_busy: bool) -> None:
        self._button.visible = not is_busy
        self._cancel.visible = self._bar.visible = is_busy
        self._bar.value = 0.0

    def _show_progress(self, step: Step) -> None:
        """Show the progress of the export, or stop it if the visitor asked for that."""
        if self._stop.is_set():
            raise Stopped
        if step.total:
            self._bar.value = 100 * step.done / step.total
        left = "" if step.eta_s is None else f", about {duration_text(step.eta_s)} left"
        counts = f"{step.done:g} of {step.total:g}" if step.total else ""
        self._said.content = _line(f"{counts}: {step.message}{left}")


def _line(text: str) -> str:
    return f'<div style="padding:.2rem .75rem .4rem;{MUTED}">{html.escape(text)}</div>'
