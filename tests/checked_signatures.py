"""Shapes and types in signatures are checked when a function is called: most of those that a test imports never are.

In every test the first calls of a function are checked. A call that is the thousandth of its kind tells nothing new;
checking all of them took a third of the time of tests that call small functions often. So with functions inside others:
each call of the outer one makes a new one, and to wrap it takes 3 ms, more than most of them do.
"""

import dataclasses
import functools
from collections import Counter
from collections.abc import Callable
from types import CodeType, FunctionType

import jaxtyping
from beartype import beartype

FIRST_CALLS = 20  # of a function in a test, with their results
FIRST_MADE = 3  # of the functions that one inside another gives in a test
_wrapped = jaxtyping.jaxtyped
_made: Counter[CodeType] = Counter()
_now = 0  # number of the test


def next_test() -> None:
    """Begin to check again."""
    global _now
    _now += 1
    _made.clear()


def wrap(function: Callable | None = None, *, typechecker: object) -> Callable:
    """In place of jaxtyping.jaxtyped, which the import hook puts on every function and class; beartype does the checks.

    What checks a function is made for its first call alone: 1 ms each, of three thousand functions.
    """
    if function is None:
        return functools.partial(wrap, typechecker=typechecker)
    if isinstance(function, type):
        own = vars(function).get("__init__")
        if dataclasses.is_dataclass(function) and isinstance(own, FunctionType) and not hasattr(own, "__wrapped__"):
            function.__init__ = _checked_at_first(own)
        return function
    if not isinstance(function, FunctionType):
        return _wrapped(function, typechecker=beartype)
    if "<locals>" in function.__qualname__:
        _made[function.__code__] += 1
        if _made[function.__code__] > FIRST_MADE:
            return function
    return _checked_at_first(function)


def _checked_at_first(function: FunctionType) -> Callable:
    checked, test, count = None, _now, 0

    @functools.wraps(function)
    def call(*args: object, **named: object) -> object:
        nonlocal checked, test, count
        if test != _now:
            test, count = _now, 0
        if count >= FIRST_CALLS:
            return function(*args, **named)
        count += 1
        if checked is None:
            checked = _wrapped(function, typechecker=beartype)
        return checked(*args, **named)

    return call
