"""Shapes and types in signatures are checked when a function is called: most of those that a test imports never are."""

from collections.abc import Callable

from beartype import beartype


def when_called(function: Callable) -> Callable:
    """As beartype, whose check of a function is only made for its first call."""
    checked = None

    def check(*args: object, **named: object) -> object:
        nonlocal checked
        if checked is None:
            checked = beartype(function)
        return checked(*args, **named)

    return check
