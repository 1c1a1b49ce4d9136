"""The version of this package, and of others beside it."""

from __future__ import annotations

from contextlib import suppress

__version__ = "0.1.0"


def versions(*packages: str) -> dict[str, str]:
    """Of this package, and of others as far as they are installed: Pinocchio is not everywhere."""
    import importlib.metadata  # takes longer than all else that a short command needs

    known = {"twodof": __version__}
    for name in packages:
        with suppress(importlib.metadata.PackageNotFoundError):
            known[name] = importlib.metadata.version(name)
    return known
