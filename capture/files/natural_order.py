"""The order in which people number files: IMG_9 before IMG_10."""

import re
from pathlib import Path


def natural_order(path: Path) -> list[tuple[int, str]]:
    """A key to sort by: digits in a name count as a number."""
    parts = re.split(r"([0-9]+)", path.name)  # every second part is digits
    return [(int(part) if k % 2 else 0, part) for k, part in enumerate(parts)]
