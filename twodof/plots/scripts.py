"""Scripts and data of pages: ES modules of the package as one script, and packed content."""

import base64
import re
import zlib
from pathlib import Path

from ..files import data_file

IMPORT = re.compile(r'^import \{ (.*) \} from "(.*)";$', re.MULTILINE)
EXPORT = re.compile(r"^export (?=(?:async )?(?:function\*?|class|const) (\w+))", re.MULTILINE)


def script(*parts: str) -> str:
    """Return a module and all modules that it imports as one script, in which each module has its own scope.

    A page is a single file and cannot import modules. In the sources, each import or export must be on one line that
    lists all its names.
    """
    scopes: dict[Path, str] = {}
    _add(data_file(*parts), scopes)
    return '"use strict";\n' + "".join(scopes.values())


def _add(file: Path, scopes: dict[Path, str]) -> None:
    """Add a module after the modules that it imports."""
    text = file.read_text("utf-8")
    for _, path in IMPORT.findall(text):
        if (imported := data_file("fmu_src", "page", Path(path).name)) not in scopes:
            _add(imported, scopes)
    names = ", ".join(EXPORT.findall(text))
    text = EXPORT.sub("", IMPORT.sub(lambda line: f"const {{ {line[1]} }} = _{Path(line[2]).stem};", text))
    scopes[file] = f"const _{file.stem} = (() => {{\n{text}\nreturn {{ {names} }};\n}})();\n"


def packed(content: bytes) -> str:
    """Return data compressed (zlib, which browsers call deflate) as base64, for a page."""
    return base64.b64encode(zlib.compress(content, 9)).decode()
