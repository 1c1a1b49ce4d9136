"""Replace the picture on the site's first page by the running default arm, for mkdocs."""

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
