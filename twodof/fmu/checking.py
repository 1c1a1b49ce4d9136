"""Check a third-party FMU: its description, and trials in a child process."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from subprocess import DEVNULL
from typing import NamedTuple

from ..bounds import MAX_CALL_WAIT, MAX_CHECK_MEMORY, MAX_DESCRIPTIONS, MAX_ROW, MAX_START_WAIT, MIN_STEP
from ..children import Child, limit
from ..errors import ChildError, FmuError, InputError, SspError
from ..export.package import has_member
from ..files import parsed, temporary_folder
from ..notebook import card
from .archives import read_archive
from .description import Fmu, load_any_fmu, problems_of
from .importers import require
from .reference_runs import Reference, references_of
from .ssp_file import STRUCTURE, read_ssp
from .system import load_system
from .trial import UNUSUAL, Trial, UnpassedError
from .trials import FORBIDDEN, TRIALS, reference_run

MOST_PROBLEMS = 20  # of a description, in its row


class Row(NamedTuple):
    """The result of one trial.

    Attributes:
        outcome: "passed"; "failed" (the standard forbids it); "remark" (the standard allows it, but a user would not
            expect it); or "does not apply".
        text: one line with the result, or with the reason.
    """

    name: str
    outcome: str
    text: str


@dataclass(frozen=True)
class Check:
    """The results of a check.

    Attributes:
        path: path of the FMU.
        rows: results of the trials, in order.
    """

    path: Path
    rows: tuple[Row, ...]

    @property
    def passed(self) -> bool:
        """True if no row failed."""
        return all(row.outcome != "failed" for row in self.rows)

    def __str__(self) -> str:
        return "\n".join(f"{row.outcome}: {row.name}: {row.text}" for row in self.rows)

    def _repr_html_(self) -> str:
        return card(f"Check of {self.path}", {row.name: f"{row.outcome}: {row.text}" for row in self.rows})

    def facts(self) -> dict[str, object]:
        """Return the check for JSON."""
        return {**asdict(self), "path": str(self.path), "passed": self.passed, "rows": [r._asdict() for r in self.rows]}


def check(fmu: str | Path, *, tools: Sequence[str] = ()) -> Check:
    """Check an FMU of any vendor: description, states, steps, derivatives, order of calls, and its references.

    The FMU runs in a child process, whose crash is a failed row. An FMU is a program: check only an FMU that you would
    run.

    Args:
        fmu: an FMI 2.0 or 3.0 co-simulation FMU with a binary for this machine; or an SSP 1.0 file, each of whose FMUs
            is checked.
        tools: FMI tools that run the references too: "fmpy", "libcosim", "ecos", "fmuloader" or "pathsim".

    Raises:
        ChildError: this machine cannot start the child process, or not within MAX_START_WAIT.
        FmuError: the file is missing, is not an FMU, is unsafe to unzip, or has no co-simulation.
        InputError: a tool is not installed, or the FMU contains no references for it.
    """
    path = Path(fmu)
    require(tools)
    if not has_member(path, STRUCTURE):
        return Check(path, tuple(_rows(path, "", tools)))
    if tools:
        raise InputError(f"'{path}' is a system; `tools` run the references of an FMU: check its FMUs one by one")
    elements = [element for element in read_ssp(path)[1].walk() if element.source]
    names = {element.source: element.name for element in reversed(elements)}
    size = 0
    for source in names:
        size += len(read_archive(path, source)[0])
        if size > MAX_DESCRIPTIONS:
            most = f"descriptions of more than {MAX_DESCRIPTIONS} bytes together"
            raise FmuError(f"'{path}': its FMUs have {most}; check them one by one")
    try:
        system = load_system(path)
        text, remarks = f"{len(system.components)} components, {len(system.links)} connections", system.remarks()
        first = Row("structure", "remark" if remarks else "passed", "; ".join([text, *remarks]))
    except FmuError as error:
        outcome = "failed" if isinstance(error, SspError) else "remark"
        first = Row("structure", outcome, f"'twodof run' refuses it: {error}")
    rows = ((name, row) for source, name in names.items() for row in _rows(path, source, ()))
    return Check(path, (first, *(row._replace(name=f"{name}: {row.name}") for name, row in rows)))


def _rows(path: Path, inside: str, tools: Sequence[str]) -> Iterator[Row]:
    problems = problems_of(path, inside)
    problems[MOST_PROBLEMS:] = [f"and {len(problems) - MOST_PROBLEMS} more"] * (len(problems) > MOST_PROBLEMS)
    try:
        known = load_any_fmu(path, inside)
    except FmuError as error:
        if not problems and not inside:
            raise
        yield Row("description", *(("failed", "; ".join(problems)) if problems else ("remark", f"{error}")))
        reason = "it was not run; the row of its description has the reason"
        yield from (Row(name, "does not apply", reason) for name in TRIALS)
        return
    described = f"{len(known.variables)} variables, FMI {known.description.fmiVersion}"
    yield Row("description", *(("failed", "; ".join(problems)) if problems else ("passed", described)))
    if known.platform not in known.platforms:
        reason = f"it has no binary for this machine ({known.platform}), only for: {', '.join(known.platforms)}"
        yield from (Row(name, "does not apply", reason) for name in TRIALS)
        unmet = ("failed", f"not run with {' or '.join(tools)}: {reason}") if tools else ("does not apply", reason)
        yield Row("references", *unmet)
        return
    runs = _runs(known, tools)
    yield from _tried(known, [*(_Task(name) for name in TRIALS), *runs])
    if not runs:
        yield Row("references", "does not apply", "the FMU contains no reference experiments (FMI-LS-REF)")


class _Task(NamedTuple):
    """A trial, or the run of a reference experiment in a tool ("": this master)."""

    trial: str
    reference: str = ""
    tool: str = ""

    @property
    def name(self) -> str:
        """Name of its row."""
        return " ".join(filter(None, (self.trial, self.reference, self.tool and f"with {self.tool}")))


def _runs(fmu: Fmu, tools: Sequence[str]) -> list[_Task]:
    """Return the runs of references, one for each experiment and tool."""
    try:
        names = [reference.name for reference in references_of(fmu)]
    except FmuError:  # the row of the references has the error
        names = [""]
    if tools and not names:
        raise InputError(f"'{fmu.path}' carries no references to run; build one with `reference=True`")
    return [_Task("reference", name, tool) for name in names for tool in ("", *tools)]


def _tried(fmu: Fmu, tasks: Sequence[_Task]) -> Iterator[Row]:
    """Yield the row of each trial; after a crash, a new process does the remaining trials.

    A crash at a call that the standard forbids is a remark, because the FMU need not detect it. The start of a process
    calls no FMU.
    """
    waiting = [*tasks]
    while waiting:
        doing = ""
        with (
            temporary_folder() as folder,
            Child(_serve, fmu.path.absolute(), fmu.inside, waiting, folder, output=DEVNULL) as child,
        ):
            try:
                while waiting:
                    kind, *words = parsed(child.receive(MAX_ROW, MAX_CALL_WAIT if doing else MAX_START_WAIT))
                    if kind == "row":
                        yield Row(waiting.pop(0).name, *words)
                    else:
                        (doing,) = words
            except (EOFError, ValueError, TypeError) as end:  # an FMU can write what it likes
                if not doing:
                    what = f"the process that checks it did not start within {MAX_START_WAIT} s: {end}"
                    raise ChildError(f"'{fmu.path}': {what}; repeat the check when this machine is less busy") from end
                limit = f", which may take {MAX_CALL_WAIT} s" if str(end) == "Killed" else ""
                outcome = "remark" if doing.startswith((FORBIDDEN, UNUSUAL)) else "failed"
                yield Row(waiting.pop(0).name, outcome, f"it ended its process at: {doing}{limit}: {end}")


def _serve(pipe: Connection, path: Path, inside: str, tasks: Sequence[_Task], folder: Path) -> None:
    """Do the trials in the child, in a folder; send the name of each call before it, and each result."""
    limit(MAX_CHECK_MEMORY)
    os.chdir(folder)
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder)  # tools leave files there

    def send(*words: str) -> None:
        pipe.send_bytes(json.dumps(words).encode()[:MAX_ROW])

    trial = Trial(load_any_fmu(path, inside), lambda what: send("note", what))

    references: dict[str, Reference] = {}
    trial.note("its first trial")

    def result(task: _Task) -> str:
        if task.trial in TRIALS:
            if not trial.step >= MIN_STEP:
                reason = f"its default step of {trial.step:g} s is below {MIN_STEP:g} s, the smallest that is run"
                raise UnpassedError("does not apply", reason)
            return TRIALS[task.trial](trial)
        if not references:
            references.update({reference.name: reference for reference in references_of(trial.fmu)})
        return reference_run(trial, references[task.reference], task.tool)

    for task in tasks:
        outcome = "passed"
        try:
            text = result(task)
        except UnpassedError as unpassed:
            outcome, text = unpassed.outcome, str(unpassed)
        except Exception as error:  # any exception of FMPy is the result of this trial
            outcome, text = "failed", f"{error}" or type(error).__name__
        send("row", outcome, text[:1000])
