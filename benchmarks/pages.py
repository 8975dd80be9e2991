"""Pages of measurements read back: their titles, text and tables."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

Row = dict[str, str]  # cells by the headings of their columns


@dataclass(frozen=True)
class Page:
    """One file of measurements."""

    name: str
    title: str
    lines: tuple[str, ...]  # below the title

    def tables(self) -> list[list[Row]]:
        """Every table, row by row."""
        return list(_tables(self.lines))


def read_page(path: Path) -> Page:
    """A page from its file, whose first line is its title.

    Raises:
        ValueError: it is not.
    """
    first, *rest = path.read_text(encoding="utf-8").splitlines()
    if not first.startswith("# "):
        raise ValueError(f"{path} begins with {first[:40]!r}; a title, '# ...', was needed.")
    return Page(path.stem, first[2:], tuple(rest))


def _tables(lines: tuple[str, ...]) -> Iterator[list[Row]]:
    block: list[list[str]] = []
    for line in (*lines, ""):
        if line.startswith("|"):
            block.append([cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]])
        elif block:
            head, rows = block[0], block[2:]
            yield [dict(zip(head, row, strict=False)) for row in rows]
            block = []


def with_columns(pages: list[Page], *columns: str) -> list[tuple[Page, list[Row]]]:
    """The tables that have all of these columns, and their pages."""
    found = ((page, table) for page in pages for table in page.tables())
    return [(page, table) for page, table in found if table and set(columns) <= set(table[0])]


def number(text: str | None) -> float | None:
    """The first number of a cell; None where there is none."""
    match = re.match(r"-?\d+(\.\d+)?(e[-+]?\d+)?", (text or "").strip())
    return float(match.group()) if match else None
