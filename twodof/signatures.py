"""Shared keywords of functions, and default callbacks."""

from collections.abc import Callable, Iterable
from functools import wraps
from inspect import Parameter, signature
from typing import TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., object])


def never() -> bool:
    """Return False: nothing stops a run."""
    return False


def ignore(*_: object) -> None:
    """Do nothing with the arguments."""


def with_keywords_of(*delegates: Callable[..., object], name: str = "") -> Callable[[Function], Function]:
    """Return a decorator that shows and checks the delegates' keywords of a function with ``**options``.

    This decorator tells ``help`` and editors the keywords; type checkers know them by PEP 692. A call with another
    keyword raises a TypeError that names the function.

    Args:
        delegates: functions whose keywords the function accepts.
        name: name of the function if it is an alias.
    """

    def shown(function: Function) -> Function:
        @wraps(function)
        def checked(*arguments: object, **keywords: object) -> object:
            _check_keywords(keywords, checked)
            return function(*arguments, **keywords)

        own = signature(function)
        named = {key: p for key, p in own.parameters.items() if p.kind is not Parameter.VAR_KEYWORD}
        for delegate in delegates:
            for key, parameter in signature(delegate).parameters.items():
                if parameter.kind is Parameter.KEYWORD_ONLY:
                    named.setdefault(key, parameter)
        checked.__signature__ = own.replace(parameters=[*named.values()])  # type: ignore[attr-defined]
        checked.__name__ = checked.__qualname__ = name or function.__name__
        return cast(Function, checked)

    return shown


def _check_keywords(given: Iterable[str], called: Callable[..., object]) -> None:
    """Refuse keywords that a function with ``**options`` does not accept."""
    import difflib

    parameters = signature(called).parameters.values()
    known = sorted(p.name for p in parameters if p.kind is not Parameter.VAR_POSITIONAL)
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            remedy = f"did you mean '{near[0]}'? " if near else ""
            if not near and "settings" in known:
                remedy = f"inputs and parameters are settings={{'{name}': …}}. "
            raise TypeError(f"{called.__name__}() has no argument '{name}'; {remedy}It takes {', '.join(known)}")
