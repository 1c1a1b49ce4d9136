"""Shared keywords of functions, and default callbacks."""

from collections.abc import Callable, Iterable
from inspect import Parameter, signature
from typing import TypeVar

Function = TypeVar("Function", bound=Callable[..., object])


def never() -> bool:
    """Return False: nothing stops a run."""
    return False


def ignore(*_: object) -> None:
    """Do nothing with the arguments."""


def with_keywords_of(*delegates: Callable[..., object]) -> Callable[[Function], Function]:
    """Return a decorator that adds the delegates' keywords to the signature of a function with ``**options``.

    Type checkers know these keywords from PEP 692; ``help``, editors and ``check_keywords`` read the signature.
    """

    def shown(function: Function) -> Function:
        own = signature(function)
        named = {name: p for name, p in own.parameters.items() if p.kind is not Parameter.VAR_KEYWORD}
        for delegate in delegates:
            for name, parameter in signature(delegate).parameters.items():
                if parameter.kind is Parameter.KEYWORD_ONLY:
                    named.setdefault(name, parameter)
        function.__signature__ = own.replace(parameters=[*named.values()])  # type: ignore[attr-defined]
        return function

    return shown


def check_keywords(given: Iterable[str], called: Callable[..., object]) -> None:
    """Refuse keywords that a function with ``**options`` does not accept.

    Raises:
        TypeError: a keyword is unknown; the message names the function and its nearest keyword.
    """
    import difflib

    parameters = signature(called).parameters.values()
    known = sorted(p.name for p in parameters if p.kind is not Parameter.VAR_POSITIONAL)
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            remedy = f"did you mean '{near[0]}'? " if near else ""
            raise TypeError(f"{called.__name__}() has no argument '{name}'; {remedy}It takes {', '.join(known)}")
