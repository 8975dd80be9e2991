"""Decoders that a file has led astray: what they try from within their process, as tasks of decode/sandbox.py."""

import os
import signal
import socket
from collections.abc import Iterator
from contextlib import suppress
from typing import BinaryIO

import numpy as np

from capture.decode.sandbox import Answer

GRANTED = 1 << 20  # bytes that the tests grant for an answer
_held: list[object] = []


def well_behaved(file: BinaryIO) -> Iterator[Answer]:
    yield Answer((len(file.read()), os.getpid()), ("a", "b"))
    yield Answer(pixels=np.arange(6, dtype=np.uint16).reshape(1, 2, 3))


def _elsewhere(file: BinaryIO) -> str:
    """The path that stands in the file."""
    return file.read().decode()


def makes_a_file(file: BinaryIO) -> Iterator[Answer]:
    os.close(os.open(_elsewhere(file), os.O_WRONLY | os.O_CREAT))
    yield Answer()


def removes_a_file(file: BinaryIO) -> Iterator[Answer]:
    os.remove(_elsewhere(file))
    yield Answer()


def reads_a_file(file: BinaryIO) -> Iterator[Answer]:
    with open(_elsewhere(file)) as other:
        yield Answer(names=(other.read(),))


def runs_a_program(file: BinaryIO) -> Iterator[Answer]:
    os.execv("/bin/true", ["true"])
    yield Answer()


def connects(file: BinaryIO) -> Iterator[Answer]:
    with socket.socket() as connection:
        connection.connect(("127.0.0.1", int(file.read())))
    yield Answer()


def signals_its_parent(file: BinaryIO) -> Iterator[Answer]:
    os.kill(os.getppid(), signal.SIGUSR1)
    yield Answer()


def writes_to_what_is_open(file: BinaryIO) -> Iterator[Answer]:
    yield Answer((os.write(os.memfd_create("any"), b"abc"),))


def opens_what_it_can(file: BinaryIO) -> Iterator[Answer]:
    before = len(_held)
    with suppress(OSError):
        while True:
            _held.append(os.memfd_create("any"))
    yield Answer((len(_held) - before,))


def takes_memory(file: BinaryIO) -> Iterator[Answer]:
    while True:
        _held.append(b"x" * (1 << 26))


def computes_without_end(file: BinaryIO) -> Iterator[Answer]:
    while True:
        pass


def waits_without_end(file: BinaryIO) -> Iterator[Answer]:
    signal.pause()
    yield Answer()


def breaks_off(file: BinaryIO) -> Iterator[Answer]:
    os.abort()
    yield Answer()


def says_it_is_damaged(file: BinaryIO) -> Iterator[Answer]:
    raise ValueError("line one\nline two")
    yield Answer()


def answers_too_much(file: BinaryIO) -> Iterator[Answer]:
    yield Answer(pixels=np.zeros(GRANTED + 1, np.uint8))


def answers_with_objects(file: BinaryIO) -> Iterator[Answer]:
    yield Answer(pixels=np.array([None, None]))


LIES = (
    b'{"numbers": [], "names": [], "shape": [100000, 100000, 3], "samples": "float32"}',
    b'{"numbers": [], "names": [], "shape": [1], "samples": "object"}',
    b'{"numbers": [NaN], "names": [], "shape": null, "samples": ""}',
    b"\xff\xfe{",
    b"[" * 60000,
)


def lies(file: BinaryIO, which: int) -> Iterator[Answer]:
    yield from _says(LIES[which])


def _says(words: bytes) -> Iterator[Answer]:
    """Answers past the module that would."""
    socket.socket(fileno=os.dup(0)).send(words)
    signal.pause()
    yield Answer()


def keeps_its_answer(file: BinaryIO) -> Iterator[Answer]:
    """Says that its array is there, and goes on writing to it."""
    import mmap

    newest = file.fileno() - 1  # the memory for the answer was handed over with the file
    _held.append(mmap.mmap(newest, GRANTED))
    yield from _says(b'{"numbers": [], "names": [], "shape": [8], "samples": "uint8"}')
