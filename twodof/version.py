"""The version of this package, and of others beside it."""

from __future__ import annotations

__version__ = "0.1.0"


def versions(*packages: str) -> dict[str, str]:
    """Of this package, and of others that are installed."""
    import importlib.metadata  # takes longer than all else that a short command needs

    installed = {name: importlib.metadata.version(name) for name in packages}
    return {"twodof": __version__, **installed}
