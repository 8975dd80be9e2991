"""MessageFilter: admits only messages that our page sends, with files of bounded size.

viser 1.1 decodes every message, stores the parts of an upload without a limit, and lets a message set any attribute of
a control. So every message passes a MessageFilter first.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec

MEGABYTE = 2**20
MOST_UPLOAD = 64 * MEGABYTE  # of all unfinished uploads of one page: an environment map of 4096 x 2048 as half floats
MOST_FILES = 8  # unfinished uploads
LEAST_PART = 64 * 1024  # bytes: viser's page cuts files into parts of 512 kB; smaller ones only cost memory
LARGEST_FRAME = 16 * MEGABYTE  # of one message: a picture of 4 million pixels that the page rendered
LARGEST_WORD = 64 * 1024  # of one message from a control: decoded, it may need a hundred times its size
LARGE = ("FileTransferPart", "GetRenderResponseMessage")
SMALL = (
    "CommandTriggerMessage",
    "FileTransferStartUpload",
    "GuiButtonHoldMessage",
    "GuiFormDirtyMessage",
    "GuiFormSubmitMessage",
    "GuiUpdateMessage",
    "LocalStorageGetItemResponseMessage",
    "SceneNodeClickMessage",
    "SceneNodeDragMessage",
    "ScenePointerMessage",
    "TransformControlsDragEndMessage",
    "TransformControlsDragStartMessage",
    "TransformControlsUpdateMessage",
    "ViewerCameraMessage",
)


class InvalidMessage(Exception):
    """A message that viser's page never sends; the connection is closed."""


class _Any(msgspec.Struct):
    type: str


class _Update(msgspec.Struct, forbid_unknown_fields=True):
    type: str
    uuid: str
    updates: dict[str, Any]


class _Start(msgspec.Struct, forbid_unknown_fields=True):
    type: str
    source_component_uuid: str
    transfer_uuid: str
    filename: str
    mime_type: str
    part_count: int
    size_bytes: int


class _Part(msgspec.Struct, forbid_unknown_fields=True):
    type: str
    source_component_uuid: str | None
    transfer_uuid: str
    part_index: int
    content: bytes


class _Render(msgspec.Struct, forbid_unknown_fields=True):
    type: str
    payload: bytes
    render_uuid: str


@dataclass
class Upload:
    """An unfinished upload of a file."""

    size: int
    parts: int
    received: int = 0  # bytes
    seen: set[int] = field(default_factory=set)  # parts


@dataclass
class MessageFilter:
    """Checks the messages of one connection. `admit` is called with every message, in order."""

    notify: Callable[[str], object] = lambda _: None  # called once, with a sentence, when a file is refused
    uploads: dict[str, Upload] = field(default_factory=dict)  # by the page's identifier
    has_notified: bool = False

    def admit(self, raw: bytes | str) -> bool:
        """Return whether to pass the message on; False: drop it silently, as a part of a refused file.

        Raises:
            InvalidMessage: the message is malformed, of another kind, or larger than its kind can be.
        """
        if isinstance(raw, str):
            raise InvalidMessage("text, where the page sends bytes")
        kind = _decoded(raw, _Any).type
        if kind not in LARGE and (kind not in SMALL or len(raw) > LARGEST_WORD):
            raise InvalidMessage(f"{len(raw)} bytes of a kind that the page does not send")
        if kind == "FileTransferStartUpload":
            return self._starts(_decoded(raw, _Start))
        if kind == "FileTransferPart":
            return self._goes_on(_decoded(raw, _Part))
        if kind == "GetRenderResponseMessage":
            _decoded(raw, _Render)
        if kind == "GuiUpdateMessage" and set(_decoded(raw, _Update).updates) != {"value"}:
            raise InvalidMessage("a control's value is all that the page changes")
        return True

    def _starts(self, start: _Start) -> bool:
        most_parts = 1 + start.size_bytes // LEAST_PART
        if start.size_bytes < 0 or not 0 <= start.part_count <= most_parts or start.transfer_uuid in self.uploads:
            raise InvalidMessage("a file whose parts do not add up")
        size = start.size_bytes + sum(upload.size for upload in self.uploads.values())
        if size > MOST_UPLOAD or len(self.uploads) == MOST_FILES:
            if not self.has_notified:
                self.notify(
                    f"{size / MEGABYTE:,.0f} MB; at most {MOST_UPLOAD / MEGABYTE:.0f} MB at a time can be taken."
                )
            self.has_notified = True
            return False
        if start.part_count:
            self.uploads[start.transfer_uuid] = Upload(start.size_bytes, start.part_count)
        return True

    def _goes_on(self, part: _Part) -> bool:
        upload = self.uploads.get(part.transfer_uuid)
        if upload is None:
            return False
        upload.received += len(part.content)
        is_new = 0 <= part.part_index < upload.parts and part.part_index not in upload.seen
        if not is_new or upload.received > upload.size:
            raise InvalidMessage("a file whose parts do not add up")
        upload.seen.add(part.part_index)
        if len(upload.seen) == upload.parts:
            del self.uploads[part.transfer_uuid]
        return True


def _decoded(raw: bytes, kind: type[Any]) -> Any:
    """Decode a message as `kind`. Fields that `kind` lacks are skipped without being decoded, or refused."""
    try:
        return msgspec.msgpack.decode(raw, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidMessage("not a message") from error
