"""Verb info: show the contents of an FMU, a system, a bag or a sweep."""

from __future__ import annotations

import argparse
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError, kind_of, neighbour, no_such
from .help import Parser
from .options import CommandLineError, add_options
from .printing import print_json, print_table, say
from .run import verdict_rows
from .sweep import best_facts, print_best

if TYPE_CHECKING:
    from pandas import DataFrame

    from ..bag.recording import Recording
    from ..fmu import Fmu, System
    from ..simulation.expressions import Expression
    from ..simulation.verdict import Verdict


MOST_CROSSED = 10  # elements of a connection of vectors
MOST_JUDGED = 200_000  # samples of up to 10 joints without a stored verdict, which take a second to judge


def add(info: Parser) -> None:
    info.add_argument("path", metavar="FMU|SSP|BAG|SWEEP", type=Path, help="FMU, system, bag or sweep to describe")
    add_options(info, "--robot", "--cost", "--json")


def call(options: argparse.Namespace) -> int:
    path = options.path
    folder = Path(str(path).rpartition(":")[0] or path)
    if not path.exists() and not folder.exists() and (near := neighbour(path, "FMU", "bag", "sweep")):
        raise InputError(f"there is no '{path}'; did you mean '{near}'?")
    is_sweep = path.is_dir() and any(path.glob("*.parquet"))
    if options.cost and not is_sweep:
        raise CommandLineError(f"--cost ranks the runs of a sweep, and '{path}' is not a sweep; leave it out")
    if is_sweep:
        from ..sweeps.ranking import cost_of
        from ..sweeps.results import read_sweep

        (_print_sweep_json if options.json else _print_sweep)(path, read_sweep(path), cost_of(options.cost))
    elif path.is_dir() or path.suffix == ".mcap" or (folder.is_dir() and not path.exists()):
        _show_bags(path, options.json)
    elif path.suffix in (".db3", ".parquet") and path.is_file():
        what = "sweep" if path.suffix == ".parquet" else "bag"
        raise InputError(f"'{path}' is a {what}'s file; give the {what}'s folder, '{path.parent}'")
    elif path.suffix != ".fmu" and not path.exists():
        raise InputError(no_such("FMU", path, "bag", "sweep"))
    elif path.suffix not in (".fmu", ".ssp") and path.is_file() and not zipfile.is_zipfile(path):
        other = f"'{path}' is neither an FMU nor the folder of a bag or a sweep"
        raise InputError(no_such("FMU", path) if kind_of(path) else other)
    else:
        from ..fmu import load_fmu

        (_print_fmu_json if options.json else _print_fmu)(load_fmu(path, options.robot))
    return 0


def _show_bags(path: Path, as_json: bool) -> None:
    from ..bag.provenance import each_robot
    from ..bag.reader import read_all_ends

    bags = read_all_ends(each_robot(path))
    verdicts = _verdicts_of(bags)
    if as_json:
        facts = [*map(_bag_facts, bags, verdicts)]
        print_json(**facts[0] if len(facts) == 1 else dict(kind="bag", path=str(path), robots=facts))
        return
    for i, (bag, verdict) in enumerate(zip(bags, verdicts)):
        if i > 0:
            say()
        _print_bag(bag, verdict)


def _print_fmu_json(fmu: Fmu) -> None:
    from ..fmu import System

    print_json(
        kind="system" if isinstance(fmu, System) else "FMU",
        **(dict(components=[*fmu.components], connections=_connections(fmu)) if isinstance(fmu, System) else {}),
        path=str(fmu.path),
        **{key: getattr(fmu, key) for key in ("name", "guid")},
        tool=fmu.description.generationTool,
        **{key: getattr(fmu, key) for key in ("platforms", "robot", "joints", "frame", "root", "axes")},
        variables=[
            {key: getattr(v, key) for key in ("name", "causality", "type", "unit", "start")}
            for v in fmu.variables.values()
        ],
    )


def _bag_facts(bag: Recording, verdict: Verdict | None) -> dict[str, object]:
    return dict(
        kind="bag",
        path=str(bag.path),
        joints=bag.joints,
        joint_states=bag.count,
        first_stamp=int(bag.stamps[0]),
        last_stamp=int(bag.stamps[-1]),
        q=[bag.q[0].tolist(), bag.q[-1].tolist()],
        v=[bag.v[0].tolist(), bag.v[-1].tolist()],
        topics=[{"name": t.name, "type": t.type, "count": t.count} for t in bag.topics],
        fmu=bag.provenance.get("fmu"),
        command_line=bag.provenance.get("command_line"),
        verdict=verdict and verdict.facts(),
    )


def _print_sweep_json(path: Path, table: DataFrame, cost: Expression | None) -> None:
    provenance = table.attrs["provenance"]
    print_json(
        kind="sweep",
        path=str(path),
        runs=len(table),
        outcomes=table["outcome"].value_counts().to_dict(),
        **best_facts(table, cost),
        **{key: provenance[key] for key in ("fmu", "design", "options")},
        command_line=provenance.get("command_line"),
    )


def _print_sweep(path: Path, table: DataFrame, cost: Expression | None) -> None:
    provenance = table.attrs["provenance"]
    counts = table["outcome"].value_counts()
    fmu, times = provenance["fmu"], provenance["options"]
    varied = [*table.columns[1 : [*table.columns].index("settling_time")]]
    print_table(
        ("sweep", str(path)),
        ("runs", ", ".join(f"{count} {outcome}" for outcome, count in counts.items()) or "none"),
        *((name, f"{table[name].min():g} to {table[name].max():g}") for name in varied),
        ("of", f"{times['stop_time']:g} s in steps of {times['step']:g} s"),
        ("FMU", f"{fmu['file']} ({fmu['name']}, {fmu['guid']})"),
        ("made by", provenance.get("command_line") or "the Python API"),
    )
    print_best(table, cost)


def _print_fmu(fmu: Fmu) -> None:
    from ..fmu import System

    if isinstance(fmu, System):
        _print_system(fmu)
    else:
        _print_head(fmu)
    rows = [("variable", "unit", "start", "")]
    for causality in ("input", "output", "parameter"):
        for group, names in fmu.groups(causality).items():
            variables = [fmu.variables[name] for name in names]
            size = "" if names == [group] else f"[{len(names)}]"
            starts = ", ".join(_start(v.start) for v in variables if v.start is not None)
            units = ", ".join(dict.fromkeys(variable.unit or "" for variable in variables))
            rows.append((f"{group}{size}", units, starts, causality))
    say()
    print_table(*rows)


def _print_head(fmu: Fmu) -> None:
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
        ("FMU", f"{fmu.path} ({_origin(fmu)})"),
        ("FMI", fmu.description.fmiVersion),
        ("digest", fmu.guid),
        ("platforms", ", ".join(fmu.platforms) or "none"),
        ("capabilities", ", ".join(capabilities)),
        ("robot", fmu.robot or "unknown"),
        ("joints", ", ".join(fmu.joints)),
        ("controlled", controlled(fmu)),
    )


def _print_system(system: System) -> None:
    from ..simulation.setup import unconnected

    robot, parts = system.recorded, system.components.items()
    remarks = [*system.remarks(), *unconnected(system), *system.unjudged]
    print_table(
        ("system", f"{system.path} ({system.name})"),
        ("digest", system.guid),
        ("robot", f"{robot}: {', '.join(system.joints)}"),
        *(("" if i else "FMUs", f"{name}: {_origin(fmu)}, FMI {fmu.version}.0") for i, (name, fmu) in enumerate(parts)),
        *(("" if i else "connections", text) for i, text in enumerate(_connections(system) or ["none"])),
        *(("" if i else "remarks", text) for i, text in enumerate(remarks)),
    )


def _connections(system: System) -> list[str]:
    """Return the texts of the connections, with the elements of vectors whose indices differ."""
    crossed: dict[tuple[object, ...], list[str]] = {}
    for source, target, affine in system.links:
        (start, _, i), (end, _, j) = (str(node).partition("[") for node in (source, target))
        elements = crossed.setdefault((start, end, affine), [])
        if i and j and i != j:
            elements.append(f"[{i} -> [{j}")
    more = [
        ", ".join(each[:MOST_CROSSED]) + f" and {len(each) - MOST_CROSSED} more" * (len(each) > MOST_CROSSED)
        for each in crossed.values()
    ]
    return [f"{text}: {own}" if own else text for text, own in zip(system.connections, more)]


def _origin(fmu: Fmu) -> str:
    return ", ".join(filter(None, (fmu.name, fmu.description.generationTool)))


def controlled(fmu: Fmu) -> str:
    """Return frame, axes and control law of an FMU as text."""
    if not fmu.frame:
        return "unknown"
    of = f"{fmu.frame}, axes {' '.join(fmu.axes)} of {fmu.root}"
    law = "task control with --orientation" if fmu.control == "pose" else f"{fmu.control} control"
    return f"{of}; {law}" if fmu.control else of


def _start(text: str) -> str:
    try:
        value = float(text)
    except ValueError:
        return text
    return "none" if abs(value) > 1e300 else f"{value:g}"


def _print_bag(run: Recording, verdict: Verdict | None) -> None:
    duration = float(run.t[-1])
    rate = (run.count - 1) / duration if duration else 0.0
    rows = [
        ("bag", str(run.path)),
        ("joints", ", ".join(run.joints)),
        ("duration", f"{duration:g} s, {run.count} joint states, {rate:g} Hz"),
        ("first stamp", f"{run.stamps[0] / 1e9:.9f} s"),
        ("first state", _state(run, 0)),
        ("last state", _state(run, -1)),
    ]
    if run.provenance:
        fmu = run.provenance["fmu"]
        rows.append(("FMU", f"{fmu['file']} ({fmu['name']}, {fmu['guid']})"))
        rows.append(("made by", run.provenance["command_line"] or "the Python API"))
    if verdict is not None:
        rows += verdict_rows(verdict.lines)
    print_table(*rows)
    say()
    print_table(*((topic.name, f"{topic.count:8d}", topic.type) for topic in run.topics))


def _verdicts_of(runs: Sequence[Recording]) -> list[Verdict | None]:
    """Return the verdicts of a bag's robots: the stored ones, or those of the samples if there are few."""
    from ..bag.reader import read_bags

    stored = [run.stored_verdict for run in runs]
    unknown = [run for run, verdict in zip(runs, stored) if verdict is None]
    if not unknown or sum(run.count * max(10, len(run.joints)) for run in unknown) > 10 * MOST_JUDGED:
        return stored
    read = iter(read_bags([run.path for run in unknown]))
    return [next(read).verdict if verdict is None else verdict for verdict in stored]


def _state(run: Recording, k: int) -> str:
    q = ", ".join(f"{value:.6g}" for value in run.q[k])
    v = ", ".join(f"{value:.6g}" for value in run.v[k])
    return f"q = ({q}), v = ({v})"
