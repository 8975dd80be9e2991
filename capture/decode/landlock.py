"""Landlock: on Linux a process can give up its access to files, network and signals, without privileges.

https://docs.kernel.org/userspace-api/landlock.html; the numbers are those of <linux/landlock.h>.
"""

import ctypes
import os
import struct
import sys

CREATE_RULESET, RESTRICT_SELF = 444, 446  # system calls, the same on every processor but Alpha
ASK_VERSION = 1
NO_NEW_PRIVILEGES = 38  # option of prctl
FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15}  # number of file rights by version; 16 from the fifth on
ALL_FILE_RIGHTS = 16
NETWORK_FROM, SCOPES_FROM = 4, 6  # versions
BIND_AND_CONNECT = 0b11  # TCP
SOCKETS_AND_SIGNALS = 0b11  # of processes that are no children of this one


def landlock_version() -> int:
    """Return the kernel's version of Landlock, 0 where it has none or does not allow it."""
    if sys.platform != "linux":
        return 0
    return max(0, ctypes.CDLL(None).syscall(CREATE_RULESET, None, ctypes.c_size_t(0), ASK_VERSION))


def restrict_self() -> None:
    """Keep this thread, and those it starts, from opening, changing, making, removing and running files and connecting.

    Open files stay open, and memory files can be opened. Without Landlock in the kernel this does nothing.

    Raises:
        OSError: the kernel has Landlock, but refused.
    """
    version = landlock_version()
    if not version:
        return
    libc = ctypes.CDLL(None, use_errno=True)
    files = (1 << FILE_RIGHTS.get(version, ALL_FILE_RIGHTS)) - 1
    network = BIND_AND_CONNECT if version >= NETWORK_FROM else 0
    scopes = SOCKETS_AND_SIGNALS if version >= SCOPES_FROM else 0
    handled = struct.pack("QQQ", files, network, scopes)
    size = len(handled) if scopes else 16 if network else 8  # older kernels expect a shorter struct
    rules = libc.syscall(CREATE_RULESET, handled, ctypes.c_size_t(size), 0)
    if rules < 0 or libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0) or libc.syscall(RESTRICT_SELF, rules, 0):
        raise OSError(ctypes.get_errno(), "Landlock refused")
    os.close(rules)
