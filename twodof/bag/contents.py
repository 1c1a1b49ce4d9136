"""Storage files of a bag, and the messages in them."""

import re
from collections.abc import Iterator
from pathlib import Path

from ..bounds import MAX_CHUNK, MAX_HOLLOW, MAX_METADATA
from ..errors import BagError
from ..files import read_file
from .mcap import mcap_messages
from .records import Batch, ReadBudget, refusing_damage
from .sqlite import sqlite3_messages


def storage_files(folder: Path) -> list[Path]:
    """Return the files that hold a bag's messages, in the order of writing.

    A single MCAP file, as pages and other tools write it, is a bag too.

    Raises:
        BagError: a file is sparse, a pipe, a device, or a link, which could name any file of this machine.
    """
    if folder.suffix == ".mcap" and folder.is_file():
        _check_content(folder)
        return [folder]
    for path in folder.iterdir():
        if path.suffix.startswith((".mcap", ".db3")):  # also .db3-wal, which is copied
            _check_content(path)
    named = [p for p in folder.iterdir() if p.suffix in (".mcap", ".db3")]
    if link := next((p for p in named if p.is_symlink()), None):
        raise BagError(f"'{link}' is a link, and links in a bag are not followed; copy the file")
    if odd := next((p for p in named if not (p.is_file() or p.is_dir())), None):
        raise BagError(f"'{odd}' is not a regular file; remove it from the bag")
    return sorted(filter(Path.is_file, named), key=lambda p: [int(n) for n in re.findall(r"\d{1,9}", p.stem)][-1:])


def _check_content(path: Path) -> None:
    """Refuse a sparse file: a terabyte of its zeros needs no room on the disk."""
    state = path.lstat()
    used = 512 * state.st_blocks  # 0 on file systems without blocks
    if state.st_size > MAX_CHUNK + MAX_HOLLOW * used and (used or "-" in path.suffix):
        raise BagError(f"'{path}' is damaged: of its {state.st_size} bytes only {used} are on the disk")


def stated_count(folder: Path) -> int | None:
    """Return the number of messages that metadata.yaml states; None if it states none."""
    text = read_file(folder / "metadata.yaml", MAX_METADATA, follow=False).decode("utf-8", "replace")
    stated = re.search(r"^  message_count: (\d{1,18})$", text, re.MULTILINE)
    return int(stated[1]) if stated else None


def read_messages(file: Path, budget: ReadBudget) -> Iterator[Batch]:
    """Read all messages of a file; the order is kept among messages of one channel and length.

    Raises:
        DamageError: the file is truncated or damaged.
        OSError: the file cannot be read.
    """
    mcap = file.suffix == ".mcap"
    with refusing_damage(file):
        yield from mcap_messages(file, budget) if mcap else sqlite3_messages(file)
