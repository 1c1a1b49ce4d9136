"""Versions of this package and of its dependencies."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache

__version__ = "0.1.0"


def versions(*packages: str) -> dict[str, str]:
    """Return the versions of this package and of its installed dependencies."""
    known = {name: version for name in packages if (version := _version(name)) is not None}
    return {"twodof": __version__, **known}


def install(extra: str) -> str:
    """Return the remedy for a missing extra: a pip command with this package's source or the extra's requirements.

    The package may be on no index. If its source was removed, the command names the requirements one by one.
    """
    import importlib.metadata as metadata
    import json
    import re
    import shlex
    import sys
    from pathlib import Path
    from urllib.parse import unquote

    wanted: list[str] = []
    with suppress(metadata.PackageNotFoundError):
        own = metadata.distribution("twodof")
        source = unquote(json.loads(own.read_text("direct_url.json") or "{}").get("url", "")).removeprefix("file://")
        if source and Path(source).exists():
            wanted = [f"{source}[{extra}]"]
        else:
            of_extra = re.compile(rf"(.+?)\s*;.*extra == ['\"]{extra}['\"]")
            wanted = [match[1] for line in own.requires or () if (match := of_extra.fullmatch(line))]
    words = shlex.join([sys.executable, "-m", "pip", "install", *(wanted or [f".[{extra}]"])])
    return f"install the extra '{extra}': {words}{'' if wanted else ' in the checkout'}"


@contextmanager
def needing(kind: type[Exception], task: str, extra: str) -> Iterator[None]:
    """Raise ``kind`` with the remedy if an extra's package is missing that a task needs."""
    try:
        yield
    except ImportError as missing:
        raise kind(f"cannot {task}: {missing}; {install(extra)}") from missing


@cache
def _version(package: str) -> str | None:
    import importlib.metadata  # takes longer to import than everything else in a short command

    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
