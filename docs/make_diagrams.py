"""Draw the diagrams of docs/architecture.md from the code.

    python docs/make_diagrams.py

``rooms.svg`` shows which room imports which. ``sample.svg`` shows the way of one sample, from the FMU to the disk:
files, functions and the first lines of their docstrings.
"""

from __future__ import annotations

import ast
import re
import textwrap
from html import escape
from pathlib import Path

DOCS = Path(__file__).parent
PACKAGE = DOCS.parent / "twodof"
INK, GREY, BLUE, PALE = "#1f2933", "#5b6570", "#0072B2", "#f4f7fa"
ROW, STEP, WIDTH = 30, 64, 760  # px

WAY = (
    ("fmu/instance.py", "Instance.step"),
    ("simulation/stepping.py", "samples"),
    ("simulation/sample.py", "Sample"),
    ("simulation/master.py", "simulate_together"),
    ("bag/writer.py", "Bag.write"),
    ("ros/messages.py", "Messages.numbers"),
    ("bag/writer.py", "Bag.hand_over"),
    ("ros/messages.py", "Messages.of_all"),
    ("bag/storage.py", "BagWriter"),
)
"""Files and names that a sample passes, in order."""


def rooms() -> dict[str, str]:
    """Return the rooms in the order of the table in architecture.md, and what each does."""
    table = re.findall(r"^\| `(\w+)(?:/|\.py)` \| ([^|]+?) \|", (DOCS / "architecture.md").read_text("utf-8"), re.M)
    return dict(table)


def imports(room: str) -> set[str]:
    """Return the names at the top of the package that the files of a room import."""
    folder = PACKAGE / room
    found = set()
    for path in sorted(folder.rglob("*.py")) if folder.is_dir() else [folder.with_suffix(".py")]:
        depth = len(path.relative_to(PACKAGE).parts)
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.level == depth:
                names = [node.module] if node.module else [alias.name for alias in node.names]
                found |= {name.partition(".")[0] for name in names}
    return found - {room}


def first_line(file: str, name: str) -> str:
    """Return the first line of the docstring of a function, class or method."""
    scope: ast.AST = ast.parse((PACKAGE / file).read_text("utf-8"))
    for part in name.split("."):
        kinds = (ast.FunctionDef, ast.ClassDef)
        scope = next(n for n in ast.iter_child_nodes(scope) if isinstance(n, kinds) and n.name == part)
    return (ast.get_docstring(scope) or "").partition("\n")[0]  # type: ignore[arg-type]


def text(x: float, y: float, content: str, *, colour: str = INK, size: int = 13, more: str = "") -> str:
    """Return a line of text."""
    return f'<text x="{x}" y="{y}" fill="{colour}" font-size="{size}" {more}>{escape(content)}</text>'


def svg(width: int, height: int, parts: list[str]) -> str:
    """Return a picture on white."""
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    body = "\n".join([f'<rect width="{width}" height="{height}" fill="white"/>', *parts])
    return f'{head} font-family="sans-serif">\n{body}\n</svg>\n'


def diagram_of_rooms() -> str:
    """Return a table with a dot where the room of a row imports the room of a column."""
    names, left, top = rooms(), 400, 90
    parts = [text(12, 24, "Rooms from the bottom to the top: a row imports the columns with a dot", size=14)]
    for i, (name, purpose) in enumerate(names.items()):
        y, x, used = top + ROW * i, left + ROW * i, imports(name)
        parts.append(f'<rect x="8" y="{y}" width="{left - 16}" height="{ROW - 4}" rx="4" fill="{PALE}"/>')
        parts += [text(16, y + 18, name, more='font-weight="bold"'), text(96, y + 18, purpose, colour=GREY, size=10)]
        parts.append(text(x + 12, top - 8, name, size=11, more=f'transform="rotate(-50 {x + 12} {top - 8})"'))
        for k, other in enumerate(names):
            mark = "white" if other not in used else BLUE
            if k < i:
                edge = "#c3cad1" if other not in used else BLUE
                parts.append(
                    f'<circle cx="{left + ROW * k + 13}" cy="{y + 13}" r="6" fill="{mark}" stroke="{edge}">'
                    f"<title>{name} {'imports' if other in used else 'does not import'} {other}</title></circle>"
                )
    return svg(left + ROW * len(names) + 50, top + ROW * len(names) + 10, parts)


def diagram_of_a_sample() -> str:
    """Return boxes from top to bottom, one for each station of a sample."""
    parts = []
    for i, (file, name) in enumerate(WAY):
        y = 8 + STEP * i
        parts.append(f'<rect x="8" y="{y}" width="{WIDTH - 16}" height="{STEP - 18}" rx="5" fill="{PALE}"/>')
        parts.append(text(20, y + 19, name, more='font-weight="bold"'))
        parts.append(text(WIDTH - 20, y + 19, f"twodof/{file}", colour=GREY, size=11, more='text-anchor="end"'))
        parts.append(text(20, y + 37, textwrap.shorten(first_line(file, name), 120), colour=GREY, size=12))
        if i + 1 < len(WAY):
            parts.append(f'<path d="M30 {y + STEP - 17} v12 m-4 -5 l4 5 l4 -5" stroke="{BLUE}" fill="none"/>')
    return svg(WIDTH, 8 + STEP * len(WAY), parts)


def diagrams() -> dict[Path, str]:
    """Return the content of each file."""
    return {DOCS / "rooms.svg": diagram_of_rooms(), DOCS / "sample.svg": diagram_of_a_sample()}


if __name__ == "__main__":
    for path, content in diagrams().items():
        path.write_text(content, "utf-8")
