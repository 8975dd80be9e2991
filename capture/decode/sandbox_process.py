"""The process that decodes untrusted files: it gives up all rights that it does not need, then answers the sandbox.

It is started as `python -m capture.decode.sandbox_process MODULE...` with a socket as standard input. A request is JSON
with a memory file for the answer's array and, for the first answer, the file to decode.
"""

import json
import math
import mmap
import multiprocessing
import os
import resource
import signal
import socket
import sys
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import numpy as np
from PIL import TiffImagePlugin

from capture.decode.landlock import restrict_self
from capture.decode.sandbox import DAMAGED, LARGEST_MESSAGE, Answer, Task

FILES_AT_WORK = 4  # file, memory for the answer, and two to open a file in memory by its name
HANDED = 2  # files that come with a request
LONGEST_TEXT = 500  # letters of an error
AT_FIRST_USE = (multiprocessing, TiffImagePlugin)  # imported late by rawpy and Pillow, when no file can be opened


def restrict_process() -> None:
    """Set the limits that hold for every file; each request sets those of memory and time.

    The number of processes is not limited, because the system counts the threads of all the user's programs with them.
    """
    open_now = max(int(name) for name in os.listdir("/proc/self/fd")[:-1])
    for limit, value in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, 0),  # nothing is written to any file
        (resource.RLIMIT_NOFILE, open_now + 1 + FILES_AT_WORK),
    ):
        resource.setrlimit(limit, (value, value))
    restrict_self()


def serve(connection: socket.socket) -> None:
    """Answer requests until the other side closes the connection."""
    statm = os.open("/proc/self/statm", os.O_RDONLY)
    answers: Iterator[Answer] = iter(())
    restrict_process()
    connection.send(json.dumps({"end": True}).encode())  # ready
    while True:
        request, files, _, _ = socket.recv_fds(connection, LARGEST_MESSAGE, HANDED)
        if not request:
            return
        words = json.loads(request)
        reply: dict[str, Any] = {"end": True}
        if "stop" in words:
            answers = iter(())
        else:
            _limit(words["room"], words["seconds"], statm)
            if "task" in words:
                answers = _begun(words["task"], files[1], words["arguments"])
            signal.alarm(words["clock"])  # ends this process if the other side is gone and cannot do so
            reply = _reply(answers, files[0])
            signal.alarm(0)
            os.close(files[0])
        if "shape" not in reply:
            answers = iter(())  # and its file is closed
        connection.send(json.dumps(reply).encode())


def _begun(name: str, number: int, arguments: list[float]) -> Iterator[Answer]:
    module, _, function = name.partition(":")
    task: Task = getattr(sys.modules[module], function)
    with os.fdopen(number, "rb") as file:
        yield from task(file, *arguments)


def _limit(room: int, seconds: int, statm: int) -> None:
    """Limit memory (bytes) and computing time (s) to this much above what is used now."""
    data = int(os.pread(statm, 200, 0).split()[5]) * resource.getpagesize()
    used = resource.getrusage(resource.RUSAGE_SELF)
    for limit, most in (
        (resource.RLIMIT_DATA, data + room),
        (resource.RLIMIT_CPU, math.ceil(used.ru_utime + used.ru_stime) + seconds),
    ):
        hard = resource.getrlimit(limit)[1]
        resource.setrlimit(limit, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _reply(answers: Iterator[Answer], memory: int) -> dict[str, Any]:
    try:
        answer = next(answers, None)
        if answer is None:
            return {"end": True}
        _put(answer.pixels, memory)
    except MemoryError:
        return {"fault": "memory"}
    except DAMAGED as error:
        return {"fault": "damaged", "text": str(error)[:LONGEST_TEXT]}
    shape, samples = (None, "") if answer.pixels is None else (answer.pixels.shape, answer.pixels.dtype.name)
    return {"numbers": answer.numbers, "names": answer.names, "shape": shape, "samples": samples}


def _put(pixels: np.ndarray | None, memory: int) -> None:
    """Copy pixels to the memory file and unmap it: the other side accepts it only when nobody can change it."""
    if pixels is None or not pixels.nbytes:
        return
    size = os.fstat(memory).st_size
    if pixels.nbytes > size:
        raise ValueError(f"{pixels.nbytes} bytes of pixels, {size} were expected by the header")
    with mmap.mmap(memory, size) as mapped:
        there = np.frombuffer(mapped, pixels.dtype, pixels.size).reshape(pixels.shape)
        np.copyto(there, pixels)
        del there


if __name__ == "__main__":
    for module in sys.argv[1:]:
        import_module(module)
    with socket.socket(fileno=os.dup(0)) as connection:
        serve(connection)
