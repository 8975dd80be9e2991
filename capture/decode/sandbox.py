"""Run decoders of untrusted files in a separate process that has no other rights.

`decoding` runs a task, a generator of Answers, in another process (capture/decode/sandbox_process.py). The process gets
the open file, and for each answer shared memory of a size chosen here. Its first answer is the file's header; if that
is acceptable, it gets memory for the pixels. It returns numbers, short names and one array, which are all checked;
nothing is unpickled. A task that takes more memory or time than its picture justifies is ended, and the error names the
file. Processes are kept for the next file. On systems other than Linux tasks run in this process, see `confinement`.
"""

import atexit
import json
import math
import mmap
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np
import rawpy
from jaxtyping import Shaped

from capture.decode.landlock import landlock_version
from capture.decode.limits import broken
from capture.errors import CaptureError
from capture.files.atomic import parse_json

NAME = "shadowgraph"  # as the system lists it
OWN_PLACE = str(Path(__file__).resolve().parents[2])  # where this package is imported from, also with `python -c`
BLOCK = 1 << 20  # bytes that are copied at a time


IS_CONFINED = sys.platform == "linux"  # limits, memory files and their seals are Linux's
FIXED_ROOM = 512 << 20  # bytes that a decoder may use for its tables, for any picture
ROOM_PER_CORE = 16 << 20  # decoders start a thread per core, each with its stack
ROOM_PER_PIXEL = 48  # bytes: a RAW file takes 22, an OpenEXR file of eight channels 45
SECONDS = 8.0  # of computing, for any picture
SECONDS_PER_MEGAPIXEL = 1.0  # the slowest, HEIC and RAW, take 0.1 to 0.2
COPY_IN_MEMORY = re.compile(r"/proc/self/fd/\d+")  # the name of a copy of the file in memory
PATIENCE = 10  # times the seconds of computing, wall-clock: other programs use the processor, too
LARGEST_MESSAGE = 1 << 16  # bytes
MOST_NUMBERS, MOST_NAMES, LONGEST_NAME = 16, 64, 255
SAMPLES = {"uint8", "uint16", "float32"}
# modules that tasks may come from
MODULES = tuple(f"capture.decode.{name}" for name in ("heif", "exr", "pictures", "video"))
DAMAGED = (OSError, SyntaxError, ValueError, EOFError, RuntimeError, TypeError, cv2.error, rawpy.LibRawError)


@dataclass(frozen=True)
class Answer:
    """One answer of a task: all data that its process returns at a time."""

    numbers: tuple[int | float, ...] = ()
    names: tuple[str, ...] = ()
    pixels: Shaped[np.ndarray, "..."] | None = None


def header_of(path: Path, answer: Answer | None, count: int) -> tuple[int, ...]:
    """Return the `count` whole numbers of a task's first answer.

    Raises:
        CaptureError: it has none.
    """
    if answer is None or len(answer.numbers) != count:
        raise broken(path, "no header")
    return tuple(map(int, answer.numbers))


Task = Callable[..., Iterator[Answer]]  # of a file that is open, and plain arguments
Next = Callable[..., Answer | None]  # see `decoding`


@contextmanager
def decoding(
    task: Task, path: Path, *arguments: int | float, in_memory: bool = False, opened: BinaryIO | None = None
) -> Iterator[Next]:
    """Run a task on a file; yield a function that returns its answers one by one, then None.

    The function's arguments are `most_bytes` of the answer's array, the number of `pixels` that are decoded for it
    (which sets the limits of memory and computing time), and additional `seconds` of computing. It raises CaptureError
    for a file that is damaged or exceeds a limit.

    Args:
        task: a function of one of MODULES.
        in_memory: pass a copy in memory, for libraries that need a name: it is opened as /proc/self/fd/N.
        opened: the file, where the caller has opened it, and closes it.

    Raises:
        CaptureError: the file cannot be opened.
    """
    try:
        file = nullcontext(opened) if opened is not None else path.open("rb")
    except OSError as error:
        raise CaptureError(f"{path} cannot be read ({error.strerror}). Check the file and its permissions.") from error
    with file as file:
        if not IS_CONFINED:
            yield _in_this_process(task(file, *arguments), path)
            return
        decoder = _acquire()
        try:
            decoder.begin(task, path, file, arguments, in_memory)
            yield decoder.next_answer
        finally:
            _release(decoder)


def confinement() -> str:
    """Describe the confinement of decoders on this system."""
    if not IS_CONFINED:
        return "in this process: limits for decoders need Linux. Do not open untrusted files here"
    version = landlock_version()
    lock = f"no access to files and network (Landlock {version})" if version else "files accessible (no Landlock)"
    return f"HEIC, AVIF, TIFF, EXR, RAW and clips in a separate process: limited memory and time, {lock}"


def stop_decoders() -> None:
    """End the processes that wait for the next file."""
    with _lock:
        waiting, _idle[:] = list(_idle), []
    for decoder in waiting:
        decoder.stop()


def _in_this_process(answers: Iterator[Answer], path: Path) -> Next:
    def next_answer(most_bytes: int = 0, pixels: int = 0, seconds: float = 0.0) -> Answer | None:
        del most_bytes, pixels, seconds
        try:
            return next(answers, None)
        except DAMAGED as error:
            raise broken(path, error) from error

    return next_answer


class _Decoder:
    """A process that decodes files, and the connection to it."""

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        paths = os.pathsep.join([*(os.path.abspath(entry) for entry in sys.path if entry), OWN_PLACE])
        single = {name: "1" for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")}
        words = [sys.executable, "-P", "-m", "capture.decode.sandbox_process", *MODULES]
        with theirs:
            self._process = subprocess.Popen(
                words,
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env={**os.environ, **single, "PYTHONPATH": paths},
                start_new_session=True,  # only the parent receives Ctrl-C
            )
        self._path = Path()
        self._fresh: dict[str, Any] = {}  # content of the first request about a file
        self._handed: list[int] = []  # file descriptors that go with it
        self._is_in_step = True  # its last answer was valid
        self.is_waiting = True  # for the next file
        if not self._socket.recv(LARGEST_MESSAGE):
            self.stop()
            raise RuntimeError(f"the process that decodes pictures did not start: {' '.join(words)}")

    def begin(
        self, task: Task, path: Path, file: BinaryIO, arguments: tuple[int | float, ...], in_memory: bool
    ) -> None:
        """Prepare the next request: it passes a file and names the task."""
        self._path, self.is_waiting = path, False
        self._fresh = {"task": f"{task.__module__}:{task.__name__}", "arguments": arguments}
        self._handed = [copied(file) if in_memory else os.dup(file.fileno())]

    def next_answer(self, most_bytes: int = 0, pixels: int = 0, seconds: float = 0.0) -> Answer | None:
        """Return the task's next answer, None after the last; see `decoding`.

        Raises:
            CaptureError: the file is damaged, or its task exceeded a limit.
        """
        cores = os.cpu_count() or 1
        room = FIXED_ROOM + ROOM_PER_CORE * cores + ROOM_PER_PIXEL * pixels
        seconds += SECONDS + SECONDS_PER_MEGAPIXEL * pixels / 1e6
        memory = sealed(most_bytes)
        try:
            request = {**self._fresh, "room": room, "seconds": math.ceil(seconds)}
            request["clock"] = math.ceil(PATIENCE * seconds) + 1
            reply = self._exchange(request, [memory, *self._handed], seconds, room)
            answer = _checked(reply, memory, most_bytes) if "numbers" in reply else None
            self.is_waiting = answer is None and reply.get("fault") != "memory"
            self._is_in_step = answer is not None
        except (ValueError, TypeError, AttributeError, KeyError, OverflowError) as error:
            raise broken(self._path, f"its decoder gave an invalid answer: {error}") from error
        finally:
            self._fresh = {}
            self._drop_handed()
            os.close(memory)
        if "fault" in reply:
            said = COPY_IN_MEMORY.sub(self._path.name, str(reply.get("text")))
            raise broken(self._path, said) if self.is_waiting else self._too_much(room)
        return answer

    def end(self) -> None:
        """Abandon the task and wait for the next file, if the last answer was valid."""
        self._drop_handed()
        if self._is_in_step and not self.is_waiting:
            self.is_waiting = self._exchange({"stop": True}, [], SECONDS, FIXED_ROOM) == {"end": True}

    def is_alive(self) -> bool:
        """Return whether the process is running."""
        return self._process.poll() is None

    def stop(self) -> None:
        """Kill the process."""
        self._drop_handed()
        self._socket.close()
        self._process.kill()
        self._process.wait()

    def _drop_handed(self) -> None:
        for number in self._handed:
            os.close(number)
        self._handed = []

    def _exchange(self, request: dict[str, Any], files: list[int], seconds: float, room: int) -> dict[str, Any]:
        self._socket.settimeout(PATIENCE * seconds)
        self._is_in_step = False
        try:
            socket.send_fds(self._socket, [json.dumps(request).encode()], files)
            reply = self._socket.recv(LARGEST_MESSAGE)
        except TimeoutError as error:
            raise self._too_long(PATIENCE * seconds) from error
        except OSError:
            reply = b""  # it is gone
        if reply:
            return parse_json(reply.decode())
        self._socket.close()
        code = self._process.wait()
        if code == -signal.SIGXCPU:
            raise self._too_long(seconds)
        if code == -signal.SIGKILL:
            raise self._too_much(room)
        how = signal.Signals(-code).name if code < 0 else f"code {code}"
        raise broken(self._path, f"its decoder broke off, {how}")

    def _too_long(self, seconds: float) -> CaptureError:
        return CaptureError(
            f"{self._path} could not be decoded within {seconds:.0f} s, more than a picture of its size takes. "
            "Copy it again from the phone, or remove it."
        )

    def _too_much(self, room: int) -> CaptureError:
        return CaptureError(
            f"{self._path} could not be decoded within {room / 1e9:.1f} GB of memory, more than a picture of its size "
            "takes. Copy it again from the phone, or remove it; where memory is short, close other programs."
        )


def _checked(reply: dict[str, Any], memory: int, most_bytes: int) -> Answer:
    """Check a reply and return it as an Answer.

    Raises:
        ValueError, TypeError, KeyError: the reply is invalid, or its process can still change its array.
    """
    numbers = tuple(float(value) for value in reply["numbers"][:MOST_NUMBERS])
    names = tuple(name[:LONGEST_NAME] for name in reply["names"][:MOST_NAMES] if isinstance(name, str))
    if not all(math.isfinite(value) for value in numbers):
        raise ValueError("numbers that are none")
    shape, kind = reply["shape"], reply["samples"]
    if shape is None:
        return Answer(numbers, names)
    if kind not in SAMPLES or not 1 <= len(shape) <= 3 or not all(type(n) is int and n >= 0 for n in shape):
        raise ValueError(f"an array of {kind} of shape {shape}"[:100])
    size = math.prod(shape) * np.dtype(kind).itemsize
    if size > most_bytes:
        raise ValueError(f"{size} bytes where {most_bytes} were granted")
    return Answer(numbers, names, mapped(memory, size, kind).reshape(shape))


_idle: list[_Decoder] = []
_lock = threading.Lock()


def _acquire() -> _Decoder:
    with _lock:
        decoder = _idle.pop() if _idle else None
    if decoder is not None and not decoder.is_alive():
        decoder.stop()
        decoder = None
    return decoder or _Decoder()


def _release(decoder: _Decoder) -> None:
    try:
        decoder.end()
    finally:
        if decoder.is_waiting:
            with _lock:
                _idle.append(decoder)
        else:
            decoder.stop()


atexit.register(stop_decoders)
if IS_CONFINED:
    os.register_at_fork(after_in_child=_idle.clear)  # the processes are the parent's


if sys.platform == "linux":
    import fcntl


def sealed(size: int) -> int:
    """Open a memory file of a fixed size: if it could be shortened, that would crash its reader.

    Raises:
        OSError: there is not enough memory, or the size is invalid.
    """
    number = os.memfd_create(NAME, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(number, size)
    fcntl.fcntl(number, fcntl.F_ADD_SEALS, fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK)
    return number


def copied(file: BinaryIO) -> int:
    """Open a copy of a file in memory."""
    number = os.memfd_create(NAME, os.MFD_CLOEXEC)
    with os.fdopen(os.dup(number), "wb") as copy:
        while block := file.read(BLOCK):
            copy.write(block)
    return number


def mapped(number: int, size: int, kind: str) -> Shaped[np.ndarray, " samples"]:
    """Map a sealed file as a read-only array, without a copy; the memory is freed with the array.

    Raises:
        ValueError: a process can still write to it.
    """
    if not size:
        return np.zeros(0, kind)
    try:
        fcntl.fcntl(number, fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE)
    except OSError as error:
        raise ValueError("its array is still being written to") from error
    return np.frombuffer(mmap.mmap(number, size, mmap.MAP_PRIVATE | mmap.MAP_POPULATE, mmap.PROT_READ), kind)
