"""Experiments with reference results in an FMU, and their runs in this and other FMI tools.

The format is FMI-LS-REF with MA-HS-Experiments (times in the element TransientSimulation or, in drafts, Experiment),
parameter sets of SSP 1.0, and CSV. Deviations are relative to a variable's largest magnitude in the results, or to 1.
"""

import csv
import hashlib
import io
import posixpath
import zipfile
from array import array
from collections.abc import Callable, Iterable, Mapping
from math import inf
from typing import NamedTuple
from urllib.parse import unquote
from xml.etree import ElementTree as ET

import numpy as np
from numpy.typing import NDArray

from ..bounds import MAX_CELLS, MAX_NAME, MAX_PATH, MAX_REFERENCES
from ..errors import FmuError, SimulationError
from ..export.typed_values import WHOLE
from ..files import read_member
from .description import Fmu, opened
from .scalar import Scalar
from .ssp_file import SSV, Unit, units_in
from .validation import NUMBERS, is_plain_xml
from .wiring import conversion, units_of

MANIFEST = "extra/org.fmi-standard.fmi-ls-ref/fmi-ls-manifest.xml"
TIME_TOLERANCE = 1e-6  # fraction of a communication step
TRUTHS = {"true": "1", "false": "0"}
MOST_STEPS = 1_000_000
PER_FILE = 4096  # bytes as which each read of a file counts in addition to its size
Values = dict[str, float | bool | int]
KINDS: dict[str, Callable[[float], float | bool]] = {"Real": float, "Integer": int, "Boolean": bool}
"""Types of values, and functions that convert numbers to them."""
Table = tuple[list[str], NDArray[np.float64]]


class Reference(NamedTuple):
    """An experiment with its reference results.

    Attributes:
        start, stop, step: times, s.
        tolerance: tolerance of the results; NaN if it states none.
        parameters: start values by name.
        stimuli, results: names of the columns without the time, and the numbers, with the time in the first column.
    """

    name: str
    start: float
    stop: float
    step: float
    tolerance: float
    parameters: Values
    stimuli: Table
    results: Table
    variables: Mapping[str, Scalar]

    @property
    def steps(self) -> int:
        """Number of communication steps."""
        return round((self.stop - self.start) / self.step)

    def time(self, k: int) -> float:
        """Return the time after k steps, s."""
        return self.start + k * self.step

    def inputs(self, k: int) -> Values:
        """Return the inputs that apply after k steps, each of its type; those that are not continuous are held."""
        (names, numbers), t = self.stimuli, self.time(k)
        last = max(0, np.searchsorted(numbers[:, 0], t + TIME_TOLERANCE * self.step, side="right") - 1)
        held, following = numbers[last], numbers[min(last + 1, len(numbers) - 1)]
        span = following[0] - held[0]
        part = max(0.0, t - held[0]) / span if span > 0.0 else 0.0
        between = held + part * (following - held)
        inputs: Values = {}
        for name, last_value, value in zip(names, held[1:], between[1:]):
            variable = self.variables[name]
            inputs[name] = KINDS[variable.type](value if variable.variability == "continuous" else last_value)
        return inputs

    def rows(
        self,
        change: Callable[[Values], object],
        step: Callable[[float, float], object],
        read: Callable[[], Iterable[float]],
    ) -> NDArray[np.float64]:
        """Step an initialised tool; return the outputs after each step, and NaN for the start values."""
        held, rows = self.inputs(0), []
        for k in range(self.steps):
            inputs = self.inputs(k)
            change({name: value for name, value in inputs.items() if value != held[name]})
            held = inputs
            step(self.time(k), self.step)
            rows.append([*read()])
        return np.array([[np.nan] * len(rows[0]), *rows])

    def judge(self, rows: NDArray[np.float64], first: int = 1) -> str:
        """Compare the columns of the results, one row for each communication point from ``first`` on; return a line.

        Raises:
            SimulationError: the columns differ by more than the tolerance, or there is nothing to compare.
        """
        names, numbers = self.results
        index = np.rint((numbers[:, 0] - self.start) / self.step).astype(int)
        if np.abs(numbers[:, 0] - self.start - index * self.step).max(initial=0.0) > TIME_TOLERANCE * self.step:
            raise SimulationError("its results are not at communication points")
        if index.max(initial=0) >= len(rows):
            end = f"{self.time(len(rows) - 1):g} s, the end of its run"
            raise SimulationError(f"it has results at {numbers[:, 0].max():g} s, after {end}")
        if index.min(initial=0) < 0:
            raise SimulationError(f"it has results at {numbers[:, 0].min():g} s, before its start")
        if not 0.0 <= self.tolerance < inf:
            raise SimulationError(f"its tolerance {self.tolerance:g} is not finite and >= 0")
        kept = index >= first
        expected, found = numbers[kept, 1:], rows[index[kept]]
        if not expected.size or not index.any():
            raise SimulationError("its results have no values after its start")
        off = np.abs(found - expected) / np.maximum(1.0, np.abs(expected).max(axis=0, initial=0.0))
        k, i = np.unravel_index(np.nanargmax(np.where(np.isnan(off), np.inf, off)), off.shape)
        if not off[k, i] <= self.tolerance:
            text = f"{names[i]} is {found[k, i]:.12g} instead of {expected[k, i]:.12g} at {numbers[kept, 0][k]:g} s"
            raise SimulationError(f"{text}, {off[k, i]:.3g} away; the tolerance is {self.tolerance:g}")
        return f"{off.size} values within {self.tolerance:g}, at most {off[k, i]:.2g} away"


def references_of(fmu: Fmu) -> list[Reference]:
    """Return an FMU's experiments with results, by its manifest of FMI-LS-REF; none without a manifest.

    Raises:
        FmuError: a file is damaged or missing, or has another format; or two experiments have one name.
    """
    if MANIFEST not in fmu.members:
        return []
    with opened(fmu) as archive:
        try:
            files = _Files(fmu, archive)
            related = [*files.xml(posixpath.basename(MANIFEST)).iter("Related")]
            files.digests = {r.get("source", ""): r.get("checksum", "") for r in related if _has_digest(r)}
            sources = [r.get("source", "") for r in related if r.get("role", "").startswith("experiment")]
            found = [files.reference(e) for source in sources for e in files.xml(source).iter("Experiment")]
        except (KeyError, ValueError, csv.Error, ET.ParseError) as error:
            raise FmuError(f"the references in '{fmu.path}' cannot be read: {error}") from error
    kept = [reference for reference in found if reference is not None]
    if len({reference.name for reference in kept}) < len(kept):
        raise FmuError(f"two experiments of the references in '{fmu.path}' have the same name")
    return kept


def _has_digest(related: ET.Element) -> bool:
    return "checksum" in related.attrib and related.get("checksumType", "SHA3-256") == "SHA3-256"


class _Files:
    """Files in the folder of FMI-LS-REF, with SHA3-256 digests by URI as the manifest states them."""

    def __init__(self, fmu: Fmu, archive: zipfile.ZipFile) -> None:
        self._fmu, self._archive, self._folder = fmu, archive, posixpath.dirname(MANIFEST)
        self._room, self._cells, self._steps, self._units = MAX_REFERENCES, MAX_CELLS, MOST_STEPS, units_of(fmu)
        self.digests: dict[str, str] = {}

    def read(self, source: str) -> bytes:
        """Return a file by its relative URI."""
        if len(source) > MAX_PATH:
            raise ValueError(f"{source:.40}… has {len(source)} characters; at most {MAX_PATH} are supported")
        if self._room <= 0:
            raise ValueError(f"their files, each as often as it is read, have more than {MAX_REFERENCES} bytes")
        content = read_member(self._archive, posixpath.normpath(f"{self._folder}/{unquote(source)}"), self._room)
        self._room -= len(content) + PER_FILE
        found = hashlib.sha3_256(content).hexdigest()
        if self.digests.get(source, found).lower() != found:
            raise ValueError(f"{source} is not the file whose checksum is in {posixpath.basename(MANIFEST)}")
        return content

    def xml(self, source: str) -> ET.Element:
        """Return the root of an XML file."""
        content = self.read(source)
        if not is_plain_xml(content):
            raise ValueError(f"{source} declares entities or is not UTF-8")
        return ET.fromstring(content)

    def reference(self, experiment: ET.Element) -> Reference | None:
        """Return an experiment; None if it has no results as CSV, or is not a simulation over time."""
        times = {**experiment.attrib, **getattr(experiment.find("TransientSimulation"), "attrib", {})}
        results, stimuli, parameters = (experiment.find(tag) for tag in ("References", "Stimuli", "Parameters"))
        if results is None or results.get("type", "text/csv") != "text/csv" or "stopTime" not in times:
            return None
        table = self.table(results.get("source", ""))
        default = getattr(self._fmu.description.defaultExperiment, "stepSize", None)
        start, stop = (float(times.get(key, 0.0)) for key in ("startTime", "stopTime"))
        gap = np.diff(np.unique([start, *table[1][:, 0]])).min(initial=stop - start)
        step = float(times.get("stepSize") or default or gap)
        count, name = (stop - start) / step if step > 0.0 else 0.0, experiment.get("name", "")
        if len(name) > MAX_NAME:
            raise ValueError(f"an experiment has a name of more than {MAX_NAME} characters: '{name:.50}'…")
        if not 0.5 < count < self._steps:
            most = f"at most {MOST_STEPS} whole steps, together with those before it"
            raise ValueError(f"experiment '{name:.50}' must be a run of {most}")
        self._steps -= round(count)
        return Reference(
            *(name, start, stop, step, float(times.get("tolerance", "nan"))),
            parameters={} if parameters is None else self.parameters(parameters.get("source", "")),
            stimuli=([], np.zeros((1, 1))) if stimuli is None else self.stimuli(stimuli.get("source", "")),
            results=table,
            variables=self._fmu.variables,
        )

    def parameters(self, source: str) -> Values:
        """Return the numbers and Booleans of a parameter set, in the units of the FMU."""
        read: dict[str, Callable[[str], float | bool]] = {**NUMBERS, "Float64": float, "Int32": int}
        values: Values = {}
        root = self.xml(source)
        units = units_in(root.find(f"{SSV}Units"))
        for parameter in root.iterfind(".//{*}Parameter"):
            for element in parameter:
                name, kind = parameter.get("name", ""), element.tag.rpartition("}")[2]
                if kind in read:
                    value, unit = read[kind](element.get("value", "").strip()), element.get("unit", "")
                    values[name] = self._in_own_unit(source, name, value, units.get(unit, Unit(unit)))
                    self._check(source, name, [values[name]])
                elif kind != "Annotations":
                    raise ValueError(f"{source}: parameter '{name}' is of type {kind}, which cannot be set")
        return values

    def _in_own_unit(self, source: str, name: str, value: float | bool, unit: Unit) -> float | bool:
        """Return a value of a parameter set in the unit of its variable."""
        if (variable := self._fmu.variables.get(name)) is None:
            return value
        own = self._units.get(variable.unit or "", Unit(variable.unit or ""))
        if variable.relative:
            own, unit = own.of_differences, unit.of_differences
        return conversion(f"{self._fmu.path}/{source}", unit, own, f"'{name}' and its value").of(value)

    def stimuli(self, source: str) -> Table:
        """Return the columns of inputs over time."""
        names, numbers = self.table(source)
        if (np.diff(numbers[:, 0]) < 0.0).any():
            raise ValueError(f"{source}: its times do not ascend")
        for name, values in zip(names, numbers.T[1:]):
            self._check(source, name, values)
        return names, numbers

    def _check(self, source: str, name: str, values: Iterable[float]) -> None:
        """Raise for values that a variable cannot have."""
        kind = self._fmu.variables[name].type if name in self._fmu.variables else "Real"
        if kind not in KINDS:
            raise ValueError(f"{source}: '{name}' is of type {kind}, which cannot be set")
        if kind == "Integer" and not all(float(value).is_integer() and int(value) in WHOLE[kind] for value in values):
            raise ValueError(f"{source}: '{name}' has a value that is not a 32-bit integer")

    def table(self, source: str) -> Table:
        """Return the columns of a CSV file."""
        rows = csv.reader(io.StringIO(self.read(source).decode("utf-8"), newline=""))
        head, cells = next(rows, []), array("d")
        for row in rows:
            self._cells -= max(1, len(row))
            if self._cells < 0:
                raise ValueError(f"{source}: the tables have more than {MAX_CELLS} cells")
            if len(row) != len(head):
                raise ValueError(f"{source} has {len(row)} cells in line {rows.line_num}, and {len(head)} in its first")
            cells.extend(float(TRUTHS.get(cell.strip(), cell)) for cell in row)
        numbers = np.array(cells).reshape(-1, max(1, len(head)))
        if not numbers.size or not np.isfinite(numbers).all():
            raise ValueError(f"{source} is not a table of finite numbers")
        return head[1:], numbers
