"""Sentences of the program in the words of the page: its buttons in place of the options of the terminal's commands.

The same sentence serves the terminal, where options are what a person has. Every sentence that the page shows passes
here. A part that only a terminal can follow and that no rule rewrites is left out: it would be of no use.
"""

import os
import re
from pathlib import Path

_AGAIN = "Go on where it stood"  # the button of a run that failed or was stopped
_RULES = (
    # the board
    (r"Name it with --board, such as [^,]+, or paper:A4 if it is a blank sheet,", 'Choose it under "Board",'),
    (r"measure a square and give --board\b", 'measure a square and say it under "Board" ("Another board")'),
    (r"Measure a square and write it into --board\b", 'Measure a square and say it under "Board" ("Another board")'),
    (r" \(shadowgraph board\)", ' ("Board" prints one)'),
    (r"Put it into board/, or name it in session\.toml: roles = \{[^}]*\}", 'Choose "board" below its picture'),
    (r"and put (the|that) photo into board/", 'and choose "board" below its picture'),
    (r"Put (it|one) into (its folder )?board/", 'Choose "board" below its picture'),
    (r"Put them into its folder light/", 'Choose "flashlight\'s phone" below their pictures'),
    # photos
    (r"Remove it from the folder, or copy the photo again", "Copy the photo again"),
    (r" Remove it from the folder\.", ""),
    # lights
    (r"need a file of lights \(--lights FILE\)", "need a file of lights, dropped with them,"),
    (r"a file of lights \(--lights FILE\.lp\) gives them", "a file of lights, dropped with them, gives them"),
    (r"Give a file with a line for each: --lights FILE", "Drop a file of lights with the photos"),
    (r"give the directions with --lights FILE", "drop a file of lights with the photos"),
    (r"Name one with --lights, or remove the others", "Leave one"),
    (r", or use --lights shading", ', or choose "found from the picture" for those photos'),
    (r" needed for --lights phone", " needed"),
    (r"Add them, or leave --lights out", "Add them, or leave the file out"),
    (r", or give --light-error [\d.]+, which lets the lights move", ""),
    # the ground, the mask, the scale
    (r"Give the ground's height with --ground, or more photos", "More photos help"),
    (r"Leave --scale and session\.toml's scale out", "Leave session.toml's scale out"),
    (r", or leave it out with --mask none", ", or remove it"),
    # runs
    (r"choose --preset draft or --device cpu", 'choose "A first look"'),
    (
        r"Close other programs, or use --preset draft with --force; `shadowgraph doctor` says what runs need",
        'Close other programs, or start "A first look"',
    ),
    (r"Choose a coarser --preset", "Start a coarser run"),
    (r"; another --preset makes another grid", "; a coarser or finer run makes another grid"),
    (r", or start again with --force", ", or start another run"),
    (r"Give --force to start again( there)?, or another --out", "Start another run"),
    (
        r"[Rr]un the same command again, or with --seed 1",
        lambda found: f'{"Press" if found.group()[0] == "R" else "press"} "{_AGAIN}", or start another run',
    ),
    (r"Wait until it has finished, end it, or give another --out", "Wait until it has finished, or end it"),
    (r"Give another --out, or check permissions and free space", "Check permissions and free space"),
    (r"Give another --out, so that its frames are chosen again", "Start another run"),
    (r"or give another --out to choose its frames again", "or start another run"),
    (r"Give another --out", "Start another run"),
    (r"[.;] --debug shows more; `shadowgraph report RUN --bundle fault\.zip` packs what a bug report needs", ""),
    (r"The same command continues (it|from here)\.", f'"{_AGAIN}" continues it.'),
    (r"; the same command continues from here\.", f'; "{_AGAIN}" continues it.'),
    (r"; --memory GB overrides this", ""),
    (r"Export again with another number of --faces", "Save it in another format"),
    (r" \(--format\)", ""),
    (r"\. `shadowgraph run [^`]*` makes one", ""),
    # of two ways out, the one that the page has, too
    (r", or [^,.;]*--[a-z][^,.;]*", ""),
    (r"(?<=[.!?:] )[^.,;!?:]*--[a-z][^,.;!?]*, or (\w)", lambda found: found.group(1).upper()),
)
_OF_TERMINAL = re.compile(r"(?<![\w-])--[a-z][\w-]*|`shadowgraph\b[^`]*`")


def in_page_words(text: str) -> str:
    """Return a sentence, or several, in the words of the page: no option and no command of the terminal is left."""
    for pattern, words in _RULES:
        text = re.sub(pattern, words, text)
    if not _OF_TERMINAL.search(text):
        return text
    first, *rest = re.split(r"(?<=[.!?]) (?=\S)", text)
    kept = [sentence for sentence in rest if not _OF_TERMINAL.search(sentence)]
    return " ".join([_without_dashes(first), *kept])


def without_folder(text: str, folder: Path, called: str = "this folder") -> str:
    """Return a sentence with the names of files without this folder: where it lies is the studio's machine's alone."""
    return text.replace(f"{folder}{os.sep}", "").replace(str(folder), called)


def document_in_page_words(document: str) -> str:
    """Return an HTML document with the texts between its tags in the words of the page; style and script stay."""
    return re.sub(r"(?<=>)[^<>{}]+(?=<)", lambda found: in_page_words(found.group()), document)


def _without_dashes(sentence: str) -> str:
    """Return what happened, which no page leaves out, with the names of options as words."""
    return _OF_TERMINAL.sub(lambda found: found.group().strip("`").lstrip("-").replace("-", " "), sentence)
