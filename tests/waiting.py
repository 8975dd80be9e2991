"""Waiting for another thread."""

import time
from collections.abc import Callable

PATIENCE_S = 300.0  # a very busy machine; what is waited for takes milliseconds


def wait_until(is_true: Callable[[], object]) -> None:
    """Until it is, or the patience is over."""
    end = time.monotonic() + PATIENCE_S
    while not is_true():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)
