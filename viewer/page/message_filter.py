"""Which messages of a browser viser may see: those that our page sends, none large, no file.

viser 1.1 decodes every message, keeps the parts of an upload without a limit, and lets a message set any attribute of a
control.
"""

from typing import Any

import msgspec

LARGEST = 1 << 16  # bytes of one message: decoded, it may need a hundred times its size
VALUE = "GuiUpdateMessage"  # a control was moved or pressed
KINDS = (
    VALUE,
    "TransformControlsDragEndMessage",
    "TransformControlsDragStartMessage",
    "TransformControlsUpdateMessage",
    "ViewerCameraMessage",
)


class InvalidMessage(Exception):
    """A message that our page never sends; the connection is closed."""


class _Message(msgspec.Struct):
    type: str
    updates: Any = None


def refuse_strange(raw: bytes | str) -> None:
    """Return if the page sends such messages.

    Raises:
        InvalidMessage: it is malformed, large, of another kind, or changes more of a control than its value.
    """
    if isinstance(raw, str) or len(raw) > LARGEST:
        raise InvalidMessage(f"{len(raw)} characters or bytes, where the page sends at most {LARGEST} bytes")
    try:
        message = msgspec.msgpack.decode(raw, type=_Message)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidMessage("not a message") from error
    if message.type not in KINDS:
        raise InvalidMessage("a kind that the page does not send")
    if message.type == VALUE and not (isinstance(message.updates, dict) and set(message.updates) == {"value"}):
        raise InvalidMessage("a control's value is all that the page changes")
