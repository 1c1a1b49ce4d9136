"""Text summaries of a run's settings."""

from collections.abc import Sequence

from ..bag.recording import Recording
from ..plant.urdf import UNBOUNDED
from ..plant.variables import ROWS

WRITTEN = {"N.m": "N·m", "1/s": "s⁻¹", "1/s2": "s⁻²", "m/s2": "m/s²", "rad/s2": "rad/s²"}
"""FMI units in the spelling of figures."""
UNITS = {group: WRITTEN.get(unit, unit) for group, _, _, unit, *_ in ROWS if unit and "|" not in unit}
"""Units of variables that do not depend on the joint."""
ROUNDING = 1e-14  # an element that is smaller relative to the largest one is 0


def settings_of(bag: Recording) -> dict[str, str]:
    """Return the settings of a run by group, e.g. {"Kp": "50 s⁻²"}; {} if unknown."""
    provenance = bag.provenance
    if not provenance:
        return {}
    step = f"{1e3 * provenance['step']:g} ms"
    settings = {"FMU": provenance["fmu"]["file"], "robot": provenance["robot"], "step": step}
    _, first = bag.schedule[0]
    varied = {_group(n) for _, values in bag.changes for n, value in values.items() if value != first[n]}
    groups: dict[str, list[float | bool]] = {}
    for name, value in first.items():
        groups.setdefault(_group(name), []).append(value)
    for group, values in groups.items():
        unit = f" {UNITS[group]}" if group in UNITS else ""
        settings[group] = "varied" if group in varied else _text(values) + unit
    return settings


def _group(name: str) -> str:
    return name.partition("[")[0]


def _text(values: Sequence[float | bool]) -> str:
    """Return one value if all are equal, as gains often are, else all values."""
    least = ROUNDING * max((abs(v) for v in values if abs(v) < UNBOUNDED), default=0.0)
    texts = [str(v).lower() if isinstance(v, bool) else number(v if abs(v) > least else 0.0) for v in values]
    return texts[0] if len(set(texts)) == 1 else f"({', '.join(texts)})"


def number(value: float) -> str:
    """Format a number with six digits and a typographic minus; the largest double becomes "none"."""
    if abs(value) >= UNBOUNDED:
        return "none"
    return f"{value + 0.0:.6g}".replace("-", "\N{MINUS SIGN}")  # + 0.0: no negative zero
