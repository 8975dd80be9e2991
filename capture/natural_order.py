"""The order in which people number files: IMG_9 before IMG_10."""

import re
from pathlib import Path


def natural_order(path: Path) -> list[tuple[bool, int, str]]:
    """A key to sort by: digits in a name count as a number."""
    return [(part.isdigit(), int(part) if part.isdigit() else 0, part) for part in re.split(r"([0-9]+)", path.name)]
