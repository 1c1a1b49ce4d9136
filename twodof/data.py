"""Where the files are that the package ships beside its code."""

from pathlib import Path


def data_file(*parts: str) -> Path:
    """A file or folder: inside the package when installed, else in the checkout around it."""
    package = Path(__file__).parent
    installed = package.joinpath(*parts)
    return installed if installed.exists() else package.parent.joinpath(*parts)
