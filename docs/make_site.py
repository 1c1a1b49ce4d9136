"""For mkdocs: replace the picture on the first page by the running default arm, and typeset equations as MathML."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

import twodof

PAGE = "arm.html"
PICTURE = 'src="arm.png"'
FRAME = (
    f'<iframe src="{PAGE}" title="the default arm, alive" loading="lazy"'
    ' style="width: 100%; height: 34rem; border: 0"></iframe>'
)


def on_page_markdown(text: str, **_: Any) -> str:
    """Put MathML, which browsers draw without a script, in place of equations in LaTeX."""
    return re.sub(r"^```math\n(.*?)^```$", lambda found: convert(found[1], display="block"), text, flags=re.M | re.S)


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Put the arm in place of its picture on the first page."""
    if page.file.src_uri != "index.md":
        return html
    begin = html.rindex("<img", 0, html.index(PICTURE))
    end = html.index(">", begin) + 1
    return html[:begin] + FRAME + html[end:]


def on_post_build(config: Any, **_: Any) -> None:
    """Write the arm's page into the site."""
    with tempfile.TemporaryDirectory() as folder:
        fmu = twodof.build_fmu(Path(folder) / "TwoDof.fmu", twodof.FmuOptions(native=True))
        twodof.page(fmu, Path(config.site_dir) / PAGE)
