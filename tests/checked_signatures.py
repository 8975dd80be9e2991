"""Shapes and types in signatures are checked when a function is called: most of those that a test imports never are.

In every test the first calls of a function are checked. A call that is the thousandth of its kind tells nothing new;
checking all of them took a third of the time of tests that call small functions often. So with functions inside others:
each call of the outer one makes a new one, and to wrap it takes 3 ms, more than most of them do.
"""

import inspect
import sys
from collections import Counter
from collections.abc import Callable
from functools import cached_property, partial
from types import CodeType, FunctionType

import jaxtyping
from beartype import beartype

FIRST_CALLS = 20  # of a function in a test; parameters and result are two checks of each
FIRST_MADE = 3  # of the functions that one inside another gives in a test
_wrapped = jaxtyping.jaxtyped
_made: Counter[CodeType] = Counter()
_now = 0  # number of the test
_left_alone: list[FunctionType] = []  # functions whose further calls in this test are not checked


def next_test() -> None:
    """Begin to check again."""
    global _now
    _now += 1
    for function in _left_alone:
        function.__no_type_check__ = False
    _left_alone.clear()
    _made.clear()


def wrap(function: Callable | None = None, *, typechecker: Callable | None) -> Callable:
    """As jaxtyping.jaxtyped, which the import hook puts on every function; those inside others are soon left alone."""
    if function is None:
        return partial(wrap, typechecker=typechecker)
    if isinstance(function, FunctionType) and "<locals>" in function.__qualname__:
        _made[function.__code__] += 1
        if _made[function.__code__] > FIRST_MADE:
            return function
    return _wrapped(function, typechecker=typechecker)


def when_called(function: Callable) -> Callable:
    """As beartype, whose check of a function is only made for its first call, and used for the first ones of a test."""
    checked, test, count = None, _now, 0

    def check(*args: object, **named: object) -> object:
        nonlocal checked, test, count
        if test != _now:
            test, count = _now, 0
        count += 1
        if count > FIRST_CALLS:
            _leave_alone(function)
            return None  # jaxtyping asks for an error alone
        if checked is None:
            checked = beartype(function)
        return checked(*args, **named)

    return check


def _leave_alone(function: Callable) -> None:
    """Let jaxtyping call a function without a look at its arguments, if it can be found by its name."""
    found: object = sys.modules[function.__module__]
    for name in function.__qualname__.split("."):
        found = inspect.getattr_static(found, name, None)
    while not isinstance(found, FunctionType):
        if isinstance(found, property):
            found = found.fget
        elif isinstance(found, cached_property):
            found = found.func
        elif found is not None and hasattr(found, "__wrapped__"):  # a class method, a cached function
            found = found.__wrapped__
        else:
            return
    while hasattr(found, "__wrapped__") and hasattr(found.__wrapped__, "__wrapped__"):
        found = found.__wrapped__
    found.__no_type_check__ = True
    _left_alone.append(found)
