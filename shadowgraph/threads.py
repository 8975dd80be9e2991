"""Threads of other libraries that wait for work: asleep, not in a loop that counts as CPU time and slows others down.

numpy's OpenBLAS and torch's OpenMP read the environment once, when they are loaded.
"""

import os

# OpenMP's threads (torch, numba) sleep between two parts of work. On a busy machine their loops took 5 to 10 times the
# CPU time of the work itself. OpenBLAS gets one thread: our matrices are small, and its second thread waits in a loop.
WAITING = {"OMP_WAIT_POLICY": "PASSIVE", "OPENBLAS_NUM_THREADS": "1"}


def wait_asleep() -> None:
    """Set the environment for libraries that are loaded from now on, and for processes; what the user set stays."""
    for name, value in WAITING.items():
        os.environ.setdefault(name, value)
