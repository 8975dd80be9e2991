"""Parts of a page in one file: pictures and other files as data addresses, and what its policy knows a script by."""

import base64
import hashlib
import io

import numpy as np
from jaxtyping import UInt8
from PIL import Image


def jpeg(picture: UInt8[np.ndarray, "height width 3"], quality: int, is_exact: bool = False) -> bytes:
    """Return a picture as JPEG; with `is_exact` its colours are kept at full resolution, as those of normals."""
    file = io.BytesIO()
    subsampling = 0 if is_exact else 2
    Image.fromarray(picture).save(file, format="JPEG", quality=quality, subsampling=subsampling)
    return file.getvalue()


def as_address(content: bytes, kind: str) -> str:
    """Return a file as a data address."""
    return f"data:{kind};base64," + base64.b64encode(content).decode()


def hash_of(text: str) -> str:
    """Return the source of a script or style by its hash, for a content security policy."""
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"
