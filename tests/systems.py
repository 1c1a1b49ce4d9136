"""SSP files for tests, and a third-party controller FMU in C."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from twodof.export.compiler import compile_library, standard_headers

HERE = Path(__file__).parent
NAMESPACES = " ".join(
    f'xmlns:{key}="http://ssp-standard.org/SSP1/SystemStructure{name}"'
    for key, name in (
        ("ssd", "Description"),
        ("ssc", "Common"),
        ("ssv", "ParameterValues"),
        ("ssm", "ParameterMapping"),
    )
)


def pd_fmu(
    feedthrough: str = 'dependencies="{}"',
    unit: str = "rad",
    factor: float = 1.0,
    initial: str | None = None,
    replaced: Mapping[str, str] = MappingProxyType({}),
    effort: str = "",
) -> bytes:
    """Return the FMU of native/pd.c, with q in a given unit of angle, stated dependencies, and replaced texts.

    ``effort`` is another expression of C for its outputs.
    """
    rows = [
        *(
            (f"{name}[{i + 1}]", 2 * k + i, "input", f'Real start="0.0" unit="{unit if k != 1 else "rad/s"}"')
            for k, name in enumerate(("q", "v", "q_des"))
            for i in range(2)
        ),
        *((f"tau[{i + 1}]", 6 + i, "output", 'Real unit="N.m"') for i in range(2)),
        ("Kp", 8, "parameter", 'Real start="10.0"'),
        ("Kd", 9, "parameter", 'Real start="2.0"'),
        ("enabled", 50, "input", 'Boolean start="true"'),
        ("steps", 60, "output", "Integer"),
        ("on", 51, "output", "Boolean"),
        ("seen", 61, "input", 'Integer start="0"'),
        ("text", 70, "input", 'String start=""'),
        ("mode", 71, "input", 'Enumeration declaredType="Mode" start="1"'),
    ]
    kinds = ("Boolean", "Integer", "String", "Enumeration")
    varies = {"parameter": "fixed"} | dict.fromkeys(kinds, "discrete")
    variables = "".join(
        f'<ScalarVariable name="{name}" valueReference="{vr}" causality="{causality}"'
        f' variability="{varies.get(causality, varies.get(kind.split()[0], "continuous"))}"><{kind}/></ScalarVariable>'
        for name, vr, causality, kind in rows
    )
    outputs, initially = (
        "".join(f'<Unknown index="{i}" {stated.format(f"{i - 6} {i - 4} {i - 2} 11 14")}/>' for i in (7, 8))
        for stated in (feedthrough, initial or "")
    )
    xml = f"""<fmiModelDescription fmiVersion="2.0" modelName="pd" guid="pd">
<CoSimulation modelIdentifier="pd"/>
<UnitDefinitions><Unit name="{unit}"><BaseUnit rad="1" factor="{factor!r}"/></Unit>
<Unit name="rad/s"><BaseUnit rad="1" s="-1"/></Unit>
<Unit name="N.m"><BaseUnit kg="1" m="2" s="-2"/></Unit></UnitDefinitions>
<TypeDefinitions><SimpleType name="Mode"><Enumeration><Item name="a" value="1"/></Enumeration></SimpleType>
</TypeDefinitions>
<ModelVariables>{variables}</ModelVariables>
<ModelStructure><Outputs>{outputs}<Unknown index="12" dependencies=""/><Unknown index="13" dependencies="11"/>
</Outputs>{"" if initial is None else f"<InitialUnknowns>{initially}</InitialUnknowns>"}</ModelStructure>
</fmiModelDescription>"""
    for old, new in replaced.items():
        assert old in xml
        xml = xml.replace(old, new)
    code = (HERE / "native/pd.c").read_text("utf-8")
    if effort:
        code = re.sub(r"(?<=c->value\[TAU \+ i\] = )[^;]+", effort, code, count=1)
    sources = {**standard_headers(), "pd.c": code.encode()}
    library = compile_library(sources, "linux64", "pd", units=["pd.c"], flags=["-fvisibility=default"])
    return zipped({"modelDescription.xml": xml.encode(), "binaries/linux64/pd.so": library})


def zipped(files: Mapping[str, bytes]) -> bytes:
    """Return a zip archive."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return content.getvalue()


def connection(start: str, end: str, inside: str = "", more: str = "") -> str:
    """Return the XML of a connection of "element.connector" with another, "connector" being the system's own."""
    attributes = []
    for side, text in (("start", start), ("end", end)):
        element, dot, connector = text.partition(".")
        attributes += [f'{side}Element="{element}"'] if dot else []
        attributes.append(f'{side}Connector="{connector if dot else element}"')
    return f"<ssd:Connection {' '.join(attributes)} {more}>{inside}</ssd:Connection>"


def connectors(rows: Mapping[str, str], kind: str = "<ssc:Real{}/>") -> str:
    """Return the XML of connectors, "kind" or "kind unit" by name."""
    texts = []
    for name, text in rows.items():
        causality, _, unit = text.partition(" ")
        own = kind.format(f' unit="{unit}"' if unit else "")
        texts.append(f'<ssd:Connector name="{name}" kind="{causality}">{own}</ssd:Connector>')
    return f"<ssd:Connectors>{''.join(texts)}</ssd:Connectors>"


def values(*rows: str, more: str = "") -> str:
    """Return the XML of a parameter set, of rows "name kind value [unit]"."""
    parameters = ""
    for name, kind, value, *unit in map(str.split, rows):
        units = f' unit="{unit[0]}"' if unit else ""
        parameters += f'<ssv:Parameter name="{name}"><ssv:{kind} value="{value}"{units}/></ssv:Parameter>'
    return (
        f'<ssv:ParameterSet {NAMESPACES} version="1.0" name="set"><ssv:Parameters>{parameters}</ssv:Parameters>'
        f"{more}</ssv:ParameterSet>"
    )


def component(name: str, more: str = "") -> str:
    """Return the XML of a component, whose FMU is resources/name.fmu."""
    return f'<ssd:Component name="{name}" source="resources/{name}.fmu">{more}</ssd:Component>'


def ssd(system: str, more: str = "") -> bytes:
    """Return the text of SystemStructure.ssd."""
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><ssd:SystemStructureDescription {NAMESPACES} version="1.0" name="loop">'
        f'<ssd:System name="loop">{system}</ssd:System>{more}</ssd:SystemStructureDescription>'
    ).encode()


WIRES = "".join(
    connection(f"{start}[{i}]", f"{end}[{i}]")
    for i in (1, 2)
    for start, end in (("plant.q", "pd.q"), ("plant.v", "pd.v"), ("pd.tau", "plant.tau_cmd"))
)


def loop(path: Path, plant: bytes, controller: bytes, structure: bytes | None = None, **more: bytes) -> Path:
    """Write the SSP of a plant and a controller; by default connected, without connectors of the system."""
    elements = f"<ssd:Elements>{component('plant')}{component('pd')}</ssd:Elements>"
    structure = structure or ssd(f"{elements}<ssd:Connections>{WIRES}</ssd:Connections>")
    files = {"SystemStructure.ssd": structure, "resources/plant.fmu": plant, "resources/pd.fmu": controller}
    path.write_bytes(zipped({**files, **more}))
    return path
