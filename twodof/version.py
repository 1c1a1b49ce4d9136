"""The version of this package, and of others beside it."""

from __future__ import annotations

from functools import cache

__version__ = "0.1.0"


def versions(*packages: str) -> dict[str, str]:
    """Of this package, and of others as far as they are installed: Pinocchio is not everywhere."""
    known = {name: version for name in packages if (version := _version(name)) is not None}
    return {"twodof": __version__, **known}


@cache
def _version(package: str) -> str | None:
    import importlib.metadata  # takes longer than all else that a short command needs

    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
