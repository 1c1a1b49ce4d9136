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
DOTS = '</mrow><mo style="font-size: 1.5em">'  # of time derivatives, which are too small to be read as accents
FRAME = (
    f'<iframe src="{PAGE}" title="the default arm, alive" loading="lazy"'
    ' style="width: 100%; height: 34rem; border: 0"></iframe>'
)


def on_page_markdown(text: str, **_: Any) -> str:
    """Put MathML, which browsers draw without a script, in place of equations in LaTeX."""

    def typeset(found: re.Match[str]) -> str:
        equation = re.sub(r"</mrow><mo>(?=&#x000A8;|&#x002D9;)", DOTS, convert(found[1], display="block"))
        return f'<div style="overflow-x: auto; padding: .3em 0">{equation}</div>'

    return re.sub(r"^```math\n(.*?)^```$", typeset, text, flags=re.M | re.S)


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
