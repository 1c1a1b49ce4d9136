"""The commands and programs of the documentation run, and its links exist.

A page runs as one shell script, from top to bottom, in a folder that contains only ``.venv``, this environment. Blocks
fenced as ``sh`` and ``python`` run. ``console`` marks commands that need ROS 2, a display, a network or minutes, and
``text`` marks output. The script has blank lines for all other lines, so that its line numbers are those of the page.
"""

import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from test_architecture import ROOMS
from tools import needs

import twodof
from twodof.cli.main import VERBS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
FENCES = {"math", "sh", "python", "console", "text"}
MAX_README = 10 * 1024  # bytes
SECONDS = 900  # by the clock: a guard against hanging


class Block(NamedTuple):
    """A fenced block: its language, the number of its first line, from 1, and its lines."""

    language: str
    line: int
    lines: list[str]


def blocks(text: str) -> Iterator[Block]:
    """The fenced blocks of a page."""
    block: Block | None = None
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.startswith("```"):
            if block is not None:
                block.lines.append(line)
        elif block is None:
            block = Block(line[3:].strip(), number + 1, [])
        else:
            yield block
            block = None
    assert block is None, "a fence is open at the end"


def script(text: str, name: str, folder: Path) -> str:
    """The page as a shell script; its programs become files in a folder."""
    lines = [""] * (len(text.splitlines()) + 1)
    # without the trap, a failure in the middle of a page would say no line
    lines[0] = f"set -eE; trap 'echo \"{name}:$LINENO: $BASH_COMMAND\" >&2' ERR"
    for block in blocks(text):
        if block.language == "sh":
            lines[block.line - 1 : block.line - 1 + len(block.lines)] = block.lines
        elif block.language == "python":
            program = folder / str(block.line) / name
            program.parent.mkdir()
            program.write_text("\n" * (block.line - 1) + "\n".join(block.lines))
            lines[block.line - 1] = f"python {shlex.quote(str(program))}"
    return "\n".join(lines)


def run_page(text: str, name: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a page in an environment that is not activated."""
    work, home, programs = (folder / part for part in ("work", "home", "programs"))
    for part in (work, home, programs):
        part.mkdir()
    here = Path(sys.executable).parent  # a link: what it leads to is no environment
    bin = work / ".venv" / "bin"
    bin.mkdir(parents=True)
    (bin / "twodof").symlink_to(here / "twodof")
    (bin / "activate").write_text(f'PATH={shlex.quote(str(here))}:"$PATH"\n')
    path = os.environ["PATH"].split(os.pathsep)
    others = [part for part in path if not (Path(part) / "twodof").exists()]
    environment = {
        **{k: v for k, v in os.environ.items() if k not in ("DISPLAY", "PYTHONPATH")},
        "HOME": str(home),
        "LC_ALL": "C.UTF-8",
        "PATH": os.pathsep.join(others),
        "ROS_LOCALHOST_ONLY": "1",
        # compiled libraries are kept between tests
        "XDG_CACHE_HOME": os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache")),
    }
    file = programs / name
    file.write_text(script(text, name, programs))
    return subprocess.run(
        ["bash", file],
        cwd=work,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=SECONDS,
    )


def with_commands(page: Path) -> bool:
    return any(block.language in ("sh", "python") for block in blocks(page.read_text("utf-8")))


@pytest.mark.parametrize("page", [*filter(with_commands, PAGES)], ids=lambda page: page.name)
def test_commands_and_programs_run_in_the_order_of_the_text(page, tmp_path):
    if page.name in ("loop.md", "network.md"):
        needs("cyclonedds")
    if page.name == "systems.md":  # it compiles a controller in C
        needs("gcc")
    done = run_page(page.read_text("utf-8"), page.name, tmp_path)
    assert done.returncode == 0, done.stderr
    warnings = [line for line in done.stderr.splitlines() if line.startswith("WARNING")]
    if page.name == "systems.md":  # the text says so
        assert "'mine.ssp': parameter bindings name no variable that can be set" in warnings.pop(0)
    assert not warnings
    if page.name == "README.md":  # which shows what its commands print; sizes depend on the compiler
        shown = [line for block in blocks(page.read_text("utf-8")) if block.language == "text" for line in block.lines]
        printed = {re.sub(r"\d+ KB", "N KB", line) for line in done.stdout.splitlines()}
        assert len(shown) > 5 and {re.sub(r"\d+ KB", "N KB", line) for line in shown} <= printed


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("# Title\n\n```sh\ntrue\nfalse\n```\n", "page.md:5: false"),
        ("\n```sh\ntwodof --version\n```\n", "page.md: line 3: twodof: command not found"),
        ("\n```sh\n. .venv/bin/activate\n```\n\n```python\n\n1 / 0\n```\n", 'page.md", line 8'),
        ("```sh\necho a | grep b\n```\n\n```sh\ntouch after\n```\n", "page.md:2: grep b"),
    ],
)
def test_a_page_that_fails_names_the_line(text, line, tmp_path):
    done = run_page(text, "page.md", tmp_path)
    assert done.returncode != 0
    assert line in done.stderr
    assert not (tmp_path / "work" / "after").exists()


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=lambda page: page.name)
def test_every_block_is_of_a_known_kind(page):
    for block in blocks(page.read_text("utf-8")):
        assert block.language in FENCES, f"{page.name}:{block.line}"
        if block.language == "sh":  # of 'a && b' the shell lets 'a' fail
            assert not re.search("&&|[|][|]", "\n".join(block.lines)), f"{page.name}:{block.line}"


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and mkdocs make them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text("utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading).lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", sorted(ROOT.glob("*.md")) + PAGES[1:], ids=lambda page: page.name)
def test_relative_links_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        if re.match("[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_that_programs_printed_name_their_commit(page):
    text = page.read_text("utf-8")
    cells = ([cell.strip() for cell in line.split("|")[1:]] for line in text.splitlines())
    number = re.compile(r"\d[\d.e-]*(?: [a-zµ]+)?")
    printed = [row for row in cells if sum(map(bool, map(number.fullmatch, row))) >= 2]
    assert not printed or re.search(r"printed at commit\n?\s?`[0-9a-f]{7,}`", text), printed[0]


def test_paths_of_the_map_are_there():
    readme = (ROOT / "README.md").read_text("utf-8").partition("## Map\n")[2]
    rows = re.findall(r"^[|] (`.+?) [|] (.+) [|]$", readme, re.MULTILINE)
    assert len(rows) > 10
    for paths, what in rows:
        first, *others = re.findall(r"`([\w./]+)`", paths)
        base = ROOT / first
        for place in (first, *others):
            assert (ROOT / place).exists() or (base.parent / place).exists(), place
        inside = re.findall(r"`([\w.]+(?:/|\.py))`", what) if base.is_dir() else []
        assert all((base / name).exists() for name in inside), what


def test_readme_is_short_and_has_the_command_of_the_tests():
    readme = (ROOT / "README.md").read_bytes()
    assert len(readme) <= MAX_README
    command = "python3 -m venv .venv && .venv/bin/pip install '.[test]' && .venv/bin/pytest"
    assert f"\n    {command}\n".encode() in readme  # .ci/run takes it from there


def test_change_log_changes_nothing_that_was_not_released():
    text = (ROOT / "CHANGELOG.md").read_text()
    released = re.findall(r"^## \[\d+\.\d+\.\d+\] - \d{4}-\d\d-\d\d$", text, re.M)
    assert text.count("\n## ") == 1 + len(released) and "\n## [Unreleased]\n" in text
    assert released or not re.search(r"^### (Changed|Fixed|Deprecated|Removed)$", text, re.M)


def test_every_public_name_is_on_the_page_of_functions():
    told = re.findall(r"^::: twodof\.(\w+)$", (DOCS / "api.md").read_text("utf-8"), re.MULTILINE)
    assert len(told) == len(set(told))
    assert {*told, "__version__"} == set(dir(twodof))


def test_every_module_is_in_the_architecture():
    text = (DOCS / "architecture.md").read_text("utf-8")
    verbs = {f"{verb.__name__.rpartition('.')[2]}.py" for verb in VERBS}  # as the text says
    for file in (ROOT / "twodof").rglob("*.py"):
        assert file.name in verbs or file.name[0] == "_" or f"`{file.name}`" in text, file
    rooms = re.findall(r"^[|] `(\w+)(?:/|[.]py)` [|]", text, re.MULTILINE)
    assert rooms == [*ROOMS][-len(rooms) :] and len(rooms) > 10


def test_site_is_built_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=SECONDS)
    assert done.returncode == 0, done.stderr
    api = (tmp_path / "api" / "index.html").read_text("utf-8")
    assert 'id="twodof.simulate"' in api
    assert '<iframe src="arm.html"' in (tmp_path / "index.html").read_text("utf-8")
    assert b'id="arm-engine"' in (tmp_path / "arm.html").read_bytes()
    plant, equations = (tmp_path / "plant" / "index.html").read_text("utf-8"), (DOCS / "plant.md").read_text("utf-8")
    assert plant.count("</math>") == equations.count("```math") > 5
    assert not re.search(r"\\\\|\\[a-z]|<mi>&amp;</mi>", "".join(re.findall(r"<math.*?</math>", plant, re.S)))


@pytest.mark.parametrize("page", sorted(ROOT.glob("*.md")) + PAGES[1:], ids=lambda page: page.name)
def test_lines_of_running_text_have_at_most_120_characters(page):
    """Rows of tables and lines of programs cannot be broken."""
    text = page.read_text("utf-8").splitlines()
    code = {block.line + i - 1 for block in blocks(page.read_text("utf-8")) for i in range(len(block.lines))}
    assert not [i + 1 for i, line in enumerate(text) if len(line) > 120 and i not in code and line[:1] != "|"]


def test_diagrams_of_the_architecture_are_current():
    """Otherwise run docs/make_diagrams.py."""
    page = (DOCS / "architecture.md").read_text("utf-8")
    for path, content in runpy.run_path(str(DOCS / "make_diagrams.py"))["diagrams"]().items():
        assert path.read_text("utf-8") == content
        assert f"]({path.name})" in page


def test_invariants_name_the_tests_that_hold_them():
    lines = re.findall(r"^Invariant: .*", (DOCS / "architecture.md").read_text("utf-8"), re.MULTILINE)
    tests = [re.search(r"\(`(test_\w+\.py)`\)\.$", line) for line in lines]
    assert len(lines) >= 8
    assert all(match and (ROOT / "tests" / match[1]).exists() for match in tests)
