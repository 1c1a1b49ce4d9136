"""Versions of this package and of its dependencies."""

from __future__ import annotations

from contextlib import suppress
from functools import cache

__version__ = "0.1.0"


def versions(*packages: str) -> dict[str, str]:
    """Return the versions of this package and of its installed dependencies."""
    known = {name: version for name in packages if (version := _version(name)) is not None}
    return {"twodof": __version__, **known}


def install(extra: str) -> str:
    """Return the remedy for a missing extra: pip with the folder that this package comes from."""
    import importlib.metadata as metadata
    import json
    import shlex
    import sys
    from urllib.parse import unquote

    source = "."
    with suppress(metadata.PackageNotFoundError):
        said = metadata.distribution("twodof").read_text("direct_url.json") or "{}"
        source = unquote(json.loads(said).get("url", "")).removeprefix("file://") or source
    words = shlex.join([sys.executable, "-m", "pip", "install", f"{source}[{extra}]"])
    return f"install the extra '{extra}': {words}{' in the checkout' * (source == '.')}"


@cache
def _version(package: str) -> str | None:
    import importlib.metadata  # takes longer than all else that a short command needs

    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
