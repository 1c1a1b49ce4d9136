"""A temporary folder for each run of the tests; a file that a test leaves there fails the run."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from multiprocessing.util import Finalize, get_temp_dir
from pathlib import Path

import pytest

from twodof.files import temporary_folder


def run_folder() -> Path:
    """The folder of this run; the last hook below removes it."""
    return Path(os.environ.get("TWODOF_TESTS", tempfile.gettempdir()))


class Scratch:
    """Hooks of the process that the user starts; workers inherit its environment."""

    def __init__(self, config: pytest.Config) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="twodof-"))
        self.left: list[str] = []
        self.failed = False
        os.environ["TWODOF_TESTS"] = str(self.folder)
        os.environ["TMPDIR"] = str(self.folder / "tmp")
        (self.folder / "tmp").mkdir()
        tempfile.tempdir = None  # read TMPDIR again
        if config.option.basetemp is None:
            config.option.basetemp = str(self.folder / "pytest")

    @pytest.hookimpl(wrapper=True, trylast=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> Iterator[None]:
        """Check the folder after all workers have ended, before the summary."""
        yield
        with temporary_folder():  # removes those of processes that tests have killed, as the next process does
            pass
        own = Path(get_temp_dir()).name  # multiprocessing removes it when this process ends
        self.left = sorted({path.name for path in (self.folder / "tmp").iterdir()} - {own})
        if self.left and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED
        self.failed = session.exitstatus == pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        if self.left:
            terminalreporter.section("left in the temporary folder", red=True)
            terminalreporter.write_line("\n".join(self.left))

        if self.failed:
            terminalreporter.write_line(f"Temporary files of this run: {self.folder}")

    def pytest_unconfigure(self) -> None:
        """Remove the folder, unless files in it failed the run.

        multiprocessing looks for its own folder in it at exit, by a finaliser of priority -100.
        """
        if not self.failed:
            remove = shutil.rmtree
            Finalize(None, remove, (self.folder,), {"ignore_errors": True}, exitpriority=-200)
