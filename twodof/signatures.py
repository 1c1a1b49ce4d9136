"""Keywords of public functions: shared ones, unknown ones and default callbacks."""

from collections.abc import Callable
from functools import wraps
from importlib import import_module
from inspect import Parameter, isfunction, signature
from typing import Generic, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., object])
Result = TypeVar("Result")


class _Constant(Generic[Result]):
    """A default callback, which ``help`` shows by its name."""

    def __init__(self, name: str, result: Result) -> None:
        self.name, self.result = name, result

    def __call__(self, *_: object) -> Result:
        return self.result

    def __repr__(self) -> str:
        return self.name


never, ignore = _Constant("never", False), _Constant("ignore", None)


def with_keywords_of(*delegates: Callable[..., object]) -> Callable[[Function], Function]:
    """Return a decorator that gives the signature of a function with ``**options`` the delegates' keywords.

    ``help``, editors and ``refusing_unknown`` know them by this signature, type checkers by PEP 692.
    """

    def shown(function: Function) -> Function:
        own = signature(function)
        named = {key: p for key, p in own.parameters.items() if p.kind is not Parameter.VAR_KEYWORD}
        for delegate in delegates:
            for key, parameter in signature(delegate).parameters.items():
                if parameter.kind is Parameter.KEYWORD_ONLY:
                    named.setdefault(key, parameter)
        function.__signature__ = own.replace(parameters=[*named.values()])  # type: ignore[attr-defined]
        return function

    return shown


def refusing_unknown(public: object, name: str) -> object:
    """Return a public function, or a class, whose call with an unknown keyword is a TypeError with the nearest one."""
    if isfunction(public):
        checked = _checked(public, name)
        checked.__module__, checked.__name__, checked.__qualname__ = "twodof", name, name
        return checked
    if isinstance(public, type) and isfunction(vars(public).get("__init__")):
        public.__init__ = _checked(public.__init__, name)  # type: ignore[misc]
    return public


def _checked(function: Function, name: str) -> Function:
    known = {p.name for p in signature(function).parameters.values() if p.kind is not Parameter.VAR_POSITIONAL}

    @wraps(function)
    def checked(*arguments: object, **keywords: object) -> object:
        for unknown in keywords.keys() - known:
            raise TypeError(_unknown(function, name, unknown, sorted(known - {"self"})))
        return function(*arguments, **keywords)

    return cast(Function, checked)


def _unknown(function: Callable[..., object], called: str, name: str, known: list[str]) -> str:
    """Return the message about an unknown keyword, which may be one of an optional argument's class."""
    from difflib import SequenceMatcher

    ways = {}
    for key, parameter in signature(function).parameters.items():
        kind, _, rest = str(parameter.annotation).partition(" | ")
        if rest == "None" and isinstance(of := vars(import_module(function.__module__)).get(kind), type):
            ways.update({each: f"{key}={kind}({each}=…)" for each in signature(of).parameters})
    ways.update({each: f"'{each}'" for each in known})
    likeness = {
        each: each.startswith(name) or (each[0] == name[0] and SequenceMatcher(None, name, each).ratio())
        for each in ways
    }
    near = [ways[each] for each, share in sorted(likeness.items()) if share == max(likeness.values()) > 0.7]
    remedy = f"; did you mean {' or '.join(near)}?" if near else "."
    if not near and "settings" in known:
        remedy = f"; inputs and parameters are settings={{'{name}': …}}."
    return f"{called}() has no argument '{name}'{remedy} It takes {', '.join(known)}"
