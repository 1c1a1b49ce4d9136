"""info: what is in an FMU or a bag."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import InputError
from .common import controlled, print_table

if TYPE_CHECKING:
    from ..bag.recording import Recording
    from ..fmu import Fmu


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    info = verbs.add_parser("info", help="show what is in an FMU or a bag")
    info.add_argument("path", metavar="FMU|BAG", type=Path)
    info.set_defaults(call=call)


def call(options: argparse.Namespace) -> int:
    """Do it; the exit status."""
    path = options.path
    if path.is_dir():
        from ..bag.reader import read_ends

        _print_bag(*read_ends(path))
    elif path.suffix in (".mcap", ".db3") and path.is_file():
        raise InputError(f"'{path}' is a bag's file; give the bag's folder, '{path.parent}'")
    else:
        from ..fmu import load_fmu

        _print_fmu(load_fmu(path))
    return 0


def _print_fmu(fmu: Fmu) -> None:
    simulation = fmu.description.coSimulation
    capabilities = [
        name
        for name in (
            "needsExecutionTool",
            "canHandleVariableCommunicationStepSize",
            "canGetAndSetFMUstate",
            "canSerializeFMUstate",
            "providesDirectionalDerivative",
        )
        if getattr(simulation, name)
    ]
    print_table(
        ("FMU", f"{fmu.path} ({fmu.name}, {fmu.description.generationTool})"),
        ("digest", fmu.guid),
        ("platforms", ", ".join(fmu.platforms) or "none"),
        ("capabilities", ", ".join(capabilities)),
        ("robot", fmu.robot or "unknown"),
        ("joints", ", ".join(fmu.joints)),
        ("controlled", controlled(fmu)),
    )
    rows = [("variable", "unit", "start", "")]
    for causality in ("input", "output", "parameter"):
        for group, names in fmu.groups(causality).items():
            variables = [fmu.variables[name] for name in names]
            size = "" if names == [group] else f"[{len(names)}]"
            starts = ", ".join(_start(v.start) for v in variables if v.start is not None)
            units = ", ".join(dict.fromkeys(variable.unit or "" for variable in variables))
            rows.append((f"{group}{size}", units, starts, causality))
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    print()
    for row in rows:
        print("  ".join([*(cell.ljust(w) for cell, w in zip(row, widths)), row[3]]).rstrip())


def _start(text: str) -> str:
    try:
        value = float(text)
    except ValueError:
        return text
    return "none" if abs(value) > 1e300 else f"{value:g}"


def _print_bag(run: Recording, count: int) -> None:
    duration = float(run.t[-1])
    rate = (count - 1) / duration if duration else 0.0
    rows = [
        ("bag", str(run.path)),
        ("joints", ", ".join(run.joints)),
        ("duration", f"{duration:g} s, {count} joint states, {rate:g} Hz"),
        ("first stamp", f"{run.stamps[0] / 1e9:.9f} s"),
        ("first state", _state(run, 0)),
        ("last state", _state(run, -1)),
    ]
    if run.provenance:
        fmu = run.provenance["fmu"]
        rows.append(("FMU", f"{fmu['file']} ({fmu['name']}, {fmu['guid']})"))
        rows.append(("made by", run.provenance["command_line"] or "the Python API"))
    print_table(*rows)
    print()
    width = max(len(topic.name) for topic in run.topics)
    for topic in run.topics:
        print(f"{topic.name.ljust(width)}  {topic.count:8d}  {topic.type}")


def _state(run: Recording, k: int) -> str:
    q = ", ".join(f"{value:.6g}" for value in run.q[k])
    v = ", ".join(f"{value:.6g}" for value in run.v[k])
    return f"q = ({q}), v = ({v})"
