"""The first page of the site, as mkdocs makes it: the default arm, alive, in place of a picture."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import twodof

PAGE = "arm.html"
PICTURE = 'src="arm.png"'
FRAME = (
    f'<iframe src="{PAGE}" title="the default arm, alive" loading="lazy"'
    ' style="width: 100%; height: 34rem; border: 0"></iframe>'
)


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """The first page, with the arm in place of its picture."""
    if page.file.src_uri != "index.md":
        return html
    begin = html.rindex("<img", 0, html.index(PICTURE))
    end = html.index(">", begin) + 1
    return html[:begin] + FRAME + html[end:]


def on_post_build(config: Any, **_: Any) -> None:
    """The arm beside it."""
    with tempfile.TemporaryDirectory() as folder:
        fmu = twodof.build_fmu(Path(folder) / "TwoDof.fmu", twodof.FmuOptions(native=True))
        twodof.page(fmu, Path(config.site_dir) / PAGE)
