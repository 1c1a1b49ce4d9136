"""pytest plugin: fixtures that run and check FMUs, and the folder of the assertions' plots.

pytest loads it in every run; therefore it imports the package only when a fixture is used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from .assertions import REPORT

if TYPE_CHECKING:
    import twodof


def pytest_addoption(parser: pytest.Parser) -> None:
    """Register the option."""
    text = "folder of plots of failed assertions about runs (none)"
    parser.getgroup("twodof").addoption("--twodof-report", metavar="FOLDER", help=text)


def pytest_configure(config: pytest.Config) -> None:
    """Set the folder of plots."""
    if folder := config.getoption("twodof_report"):
        REPORT.append(Path(folder).absolute())


@pytest.fixture
def run_fmu(tmp_path: Path) -> Callable[..., twodof.Recording]:
    """Return a function that runs an FMU, writes a bag and returns its ``Recording``; keywords as in ``twodof.run``.

    The bag has efforts if the FMU has outputs tau[i].
    """

    def run(fmu: twodof.Experiment | twodof.Fmu | str | Path, **options: Any) -> twodof.Recording:
        import twodof

        bag = tmp_path / f"run{len(list(tmp_path.glob('run*')))}"
        loaded = twodof.load_fmu(fmu) if isinstance(fmu, str | Path) else fmu
        known = loaded.fmu if isinstance(loaded, twodof.Experiment) else loaded
        twodof.run(loaded, twodof.Bag(bag, effort=bool(known.vector("tau"))), **options)
        return twodof.read_bag(bag)

    return run


@pytest.fixture
def check_fmu() -> Callable[..., twodof.Check]:
    """Return a function that checks an FMU by ``twodof.check``, and fails with the failed rows."""

    def check(fmu: str | Path, *, tools: Sequence[str] = ()) -> twodof.Check:
        import twodof

        found = twodof.check(fmu, tools=tools)
        failed = [f"{row.name}: {row.text}" for row in found.rows if row.outcome == "failed"]
        if failed:
            pytest.fail(f"'{fmu}' fails\n" + "\n".join(failed), pytrace=False)
        return found

    return check
