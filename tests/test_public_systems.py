"""Structures of systems in public repositories, rebuilt with small FMUs: they run as by hand, or are refused by name.

Element names, nesting, forms of connections and bindings, files, annotations and attributes are those of the project
that a row names. The FMUs are a robot and the controller of native/pd.c, whose output is Kp (q_des - q) - Kd v.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import pytest
from systems import NAMESPACES, connection, connectors, loop, pd_fmu, ssd, values
from test_systems import TARGET, H, N, binding, by_hand, law, mapping

import twodof

FMU = 'type="application/x-fmu-sharedlibrary"'
GAINS = ("Kp Real 0.1", "Kd Real 0.01")
GOAL = tuple(f"q_des[{i + 1}] Real {x!r}" for i, x in enumerate(TARGET.tolist()))
NO_UNITS = {'unit="rad"/>': "/>", 'unit="rad/s"/>': "/>", '<Real unit="N.m"/>': "<Real/>"}
LOAD = (0.01, -0.02)


class Case(NamedTuple):
    """A system, and its motion by hand or the line that refuses it."""

    structure: bytes
    refusal: str = ""
    control: Callable = law
    plant: Mapping[str, object] = MappingProxyType({})
    pd: str = "plain"
    files: Mapping[str, str] = MappingProxyType({})
    start: float = 0.0
    warnings: tuple[str, ...] = ()


def part(name: str, more: str = "", fmu: str = "resources/pd.fmu", attributes: str = FMU) -> str:
    return f'<ssd:Component name="{name}" source="{fmu}" {attributes}>{more}</ssd:Component>'


def system(name: str, elements: str, wires: str, more: str = "", after: str = "") -> str:
    inside = f"<ssd:Elements>{elements}</ssd:Elements><ssd:Connections>{wires}</ssd:Connections>"
    return f'<ssd:System name="{name}">{more}{inside}{after}</ssd:System>'


def top(elements: str, wires: str, more: str = "", after: str = "", end: str = "") -> bytes:
    inside = f"<ssd:Elements>{elements}</ssd:Elements><ssd:Connections>{wires}</ssd:Connections>"
    return ssd(f"{more}{inside}{after}", end)


def wires(*rows: str, more: str = "") -> str:
    """Return connections for both joints, of rows "start end" in which # is the index."""
    ends = [row.replace("#", str(i)).split() for row in rows for i in (1, 2)]
    return "".join(connection(start, end, more=more) for start, end in ends)


def both(**kinds: str) -> dict[str, str]:
    """Return connectors for both joints."""
    return {f"{name}[{i}]": kind for name, kind in kinds.items() for i in (1, 2)}


def note(content: str, kind: str) -> str:
    return f'<ssd:Annotations><ssc:Annotation type="{kind}">{content}</ssc:Annotation></ssd:Annotations>'


def parameter_map(*rows: str) -> str:
    entries = "".join('<ssm:MappingEntry source="{}" target="{}"/>'.format(*row.split(" ")) for row in rows)
    return f'<ssm:ParameterMapping {NAMESPACES} version="1.0">{entries}</ssm:ParameterMapping>'


def stimulus(name: str, outputs: tuple[float, ...] | np.ndarray, fmu: str = "resources/pd.fmu", more: str = "") -> str:
    """Return a component whose outputs tau are constant: its inputs q and v are not connected."""
    rows = [f"q_des[{i + 1}] Real {float(x)!r}" for i, x in enumerate(outputs)]
    return part(name, more + binding(values("Kp Real 1", *rows)), fmu)


def dc_motor(version: str = "1.0", attributes: str = 'implementation="CoSimulation"') -> bytes:
    """Return the DC-Motor of SSP Traceability, written by easySSP; also a test of OMSimulator, with version 2.0.

    A motor is nested beside its stimuli. The unit Nm of connectors is the N.m of the FMUs. Other variants of the
    values are in annotations, as parameter bindings. Parameter sets may be empty, and endElement is absent.
    """
    other = binding(values("Kp Real 77", "q_des[1] Real 9"))
    variants = f'<e:Containers xmlns:e="e"><e:Container variant="R">{other}</e:Container></e:Containers>'
    variants = note(variants, "com.easy-ssp.easy.ssp-model")
    unit = '<ssc:Unit name="{}"><ssc:BaseUnit kg="1" m="2" s="{}" A="0" K="0" rad="{}" factor="1.0" offset="0.0"/>'
    stiffness = f"<ssv:Units>{unit.format('N.m/rad', -2, -1)}</ssc:Unit></ssv:Units>"
    empty = binding(values(), attributes='prefix=""')
    given = binding(values("Kp Real 0.1 N.m/rad", "Kd Real 0.01", *GOAL, more=stiffness), attributes='prefix=""')
    drive = connectors(both(tau="output N.m", q="input rad")) + given + variants
    inner = part("emachine", drive, attributes=f"{FMU} {attributes}") + part("mass", fmu="resources/plant.fmu")
    inside = wires("mass.q[#] emachine.q[#]", "mass.v[#] emachine.v[#]", "emachine.tau[#] mass.tau_cmd[#]")
    inside += wires("M_load[#] mass.tau_ext[#]", "emachine.tau[#] M_mot[#]", more='suppressUnitConversion="false"')
    ports = connectors(both(M_load="input Nm", M_mot="output Nm"))
    tested = system("SuT", inner, inside, ports + empty, variants)
    outer = wires("SuT.M_mot[#] M_mot[#]", "stimuli.tau[#] SuT.M_load[#]", more='suppressUnitConversion="false"')
    defined = f"<ssd:Units>{''.join(unit.format(n, -2, 0) + '</ssc:Unit>' for n in ('Nm', 'N.m'))}</ssd:Units>"
    ports = connectors(both(M_mot="output Nm")) + empty
    text = top(tested + stimulus("stimuli", LOAD), outer, ports, variants, defined + variants)
    return text.replace(b'version="1.0"', f'version="{version}"'.encode())


def traceability_demo() -> bytes:
    """Return the TraceabilityDemo of SSP Traceability, written by PMSF FMI Bench.

    Connectors have no type, connections inside the nested system begin at inputs, metadata are files of annotations.
    """
    meta = note('<m:ModelMetaData xmlns:m="m" source="resources/mass.smmd"/>', "net.pmsf.ssp.sspmd")
    drive = part("emachine", connectors(both(tau="output", q="input", v="input"), "") + binding(values(*GAINS)) + meta)
    mass = part("mass", connectors(both(q="output", tau_cmd="input"), "") + meta, "resources/plant.fmu")
    inside = wires("U[#] emachine.q_des[#]", "mass.q[#] phi[#]", "emachine.q[#] mass.q[#]", "emachine.v[#] mass.v[#]")
    inside += wires("mass.tau_cmd[#] emachine.tau[#]")
    tested = system("SuT", drive + mass, inside, connectors(both(U="input", phi="output"), ""))
    outer = wires("Stimuli.tau[#] SuT.U[#]")
    text = top(stimulus("Stimuli", TARGET, more=connectors(both(tau="output"), "")) + tested, outer)
    root = b'xmlns:i="http://www.w3.org/2001/XMLSchema-instance" i:schemaLocation="a b" generationTool="FMI Bench" '
    return text.replace(b'version="1.0" name="loop"', root + b'version="1.0" name="loop"', 1)


def embrace(more: str = "") -> bytes:
    """Return the aircraft cooling system "embrace" of OMSimulator and pyssp-standard."""
    files = binding(mapping='<ssd:ParameterMapping source="resources/HW.ssm"/>', attributes='source="resources/T.ssv"')
    kinds = connectors({"q[1]": "input"}, '<ssc:Real/><ssd:ConnectorGeometry x="0.000000" y="0.5"/>')
    kinds += connectors({"Kp": "parameter"})
    elements = part("ECS_SW", kinds.replace("</ssd:Connectors><ssd:Connectors>", "")) + part("AdaptionUnit")
    elements += part("ECS_HW", fmu="resources/plant.fmu")
    ring = wires("ECS_HW.q[#] ECS_SW.q[#]", "ECS_HW.v[#] ECS_SW.v[#]", "ECS_SW.tau[#] ECS_HW.tau_cmd[#]")
    master = '<o:Annotations xmlns:o="o"><o:Master description="oms-ma" stepSize="0.001"/></o:Annotations>'
    times = f'<ssd:DefaultExperiment startTime="0.0" stopTime="1.0">{note(master, "org.openmodelica")}'
    end = f"{times}</ssd:DefaultExperiment>"
    return top(elements, ring + more, files, note(master, "org.openmodelica"), end)


# The map has an entry without a source for each variable, and one source for several of them.
LENGTH = "product.subAssembly1.part_pipe1.parameter_length"
EMBRACE = {
    "resources/T.ssv": values(f"{LENGTH} Real 0.1", *GOAL, "c Real 0.01"),
    "resources/HW.ssm": parameter_map(
        *(f" {name}" for name in ("ECS_HW.payload", "ECS_HW.q[1]", "ECS_SW.text", "ECS_HW.none")),
        *(f"{LENGTH} {name}" for name in ("ECS_SW.Kp", "AdaptionUnit.Kp")),
        *(f"q_des[{i}] ECS_SW.q_des[{i}]" for i in (1, 2)),
        "c ECS_SW.Kd",
    ),
}


def nested_files() -> bytes:
    """Return the nested systems of ssp_references: a signal passes through one, whose values are in SSV and SSM files.

    Connectors of parameters have units that nothing defines.
    """
    files = binding(mapping='<ssd:ParameterMapping source="resources/in.ssm"/>', attributes='source="resources/in.ssv"')
    gain = connectors(both(q_des="input") | {"Kp": "parameter Hz", "Kd": "parameter s"})
    inside = wires("in[#] gain.q_des[#]", "q[#] gain.q[#]", "v[#] gain.v[#]", "gain.tau[#] out[#]")
    ports = connectors({**both(q="input", v="input", out="output"), "in[1]": "input", "in[2]": "input"})
    inner = system(
        "inner", part("gain", gain, attributes=f'{FMU} implementation="CoSimulation"'), inside, ports + files
    )
    outer = wires("step.tau[#] inner.in[#]", "inner.out[#] add.tau_cmd[#]", "add.q[#] inner.q[#]")
    outer += wires("add.v[#] inner.v[#]", "inner.out[#] y[#]")
    elements = stimulus("step", TARGET) + part("add", fmu="resources/plant.fmu") + inner
    return top(elements, outer, connectors(both(y="output")), end='<ssd:DefaultExperiment startTime="0.0"/>')


NESTED = {
    "resources/in.ssv": values("gain_k Real 0.1", "gain_d Real 0.01"),
    "resources/in.ssm": parameter_map("gain_k gain.Kp", "gain_d gain.Kd"),
}


def itself() -> bytes:
    """Return the inline set with a map file of ssp_references, in which an output is connected to itself."""
    files = binding(values("a Real 1"), '<ssd:ParameterMapping source="resources/in.ssm"/>')
    return top(part("step"), connection("step.tau[1]", "step.tau[1]"), files)


def nested_loops() -> bytes:
    """Return the nested algebraic loops of ssp_references."""
    parts = "".join(map(part, ("gain_outer", "gain_inner", "add_outer", "add_inner")))
    pairs = ("add_inner add_outer", "add_outer gain_outer", "gain_outer add_inner", "add_inner gain_inner")
    ring = "".join(connection(f"{a}.tau[1]", f"{b}.q[1]") for a, b in map(str.split, pairs))
    return top(parts, ring + connection("gain_inner.tau[1]", "add_inner.q_des[1]"))


def linear_transformation() -> bytes:
    """Return the linear transformation of libcosim, with an output among the initial values."""
    given = binding(values("tau[1] Real 2", *GAINS, *GOAL))
    scaled = '<ssc:LinearTransformation offset="0.01" factor="1.3"/>'
    ring = wires("identity2.q[#] identity1.q[#]", "identity2.v[#] identity1.v[#]")
    ring += "".join(connection(f"identity1.tau[{i}]", f"identity2.tau_cmd[{i}]", scaled) for i in (1, 2))
    return top(part("identity1", given, attributes="") + part("identity2", "", "resources/plant.fmu", ""), ring)


def dp_ship() -> bytes:
    """Return the ship of ecos: names with spaces, a folder models, fan-out, and a scenario in the experiment."""
    names = "Reference Generator", "DP Controller", "Ship", "Observer"
    event = '<s:action t="0.1"><s:variable id="DP Controller::Kp"><s:real value="7"/></s:variable></s:action>'
    scenario = note(
        f'<s:Scenario xmlns:s="s" name="waypoints">{event}</s:Scenario>', "com.github.ecos-platform.scenario"
    )
    control = part(names[1], binding(values(*GAINS)), "models/pd.fmu", "")
    elements = control + stimulus(names[0], TARGET, "models/pd.fmu") + part(names[2], "", "models/plant.fmu", "")
    elements += part(names[3], "", "models/pd.fmu", "")
    ring = wires("0.tau[#] 1.q_des[#]", "2.q[#] 1.q[#]", "2.v[#] 1.v[#]", "1.tau[#] 2.tau_cmd[#]", "1.tau[#] 3.v[#]")
    for k, name in enumerate(names):
        ring = ring.replace(f'Element="{k}"', f'Element="{name}"')
    return top(elements, ring, end=f"<ssd:DefaultExperiment>{scenario}</ssd:DefaultExperiment>")


def parameters() -> bytes:
    """Return the parameter tests of OMSimulator (import_export_parameters3, importParameterMappingInline, ...).

    Values of system connectors pass to parameters and inputs, startElement is empty, nested systems have no elements,
    sets follow each other, and one source of an inline map has several targets.
    """
    one = mapping("cosim_inputs Input_1", "cosim_inputs Input_2", "Input_3 Input_3", "k_cref k_cref")
    sets = binding(values("cosim_inputs Real 0.3", "Input_3 Real 9", "k_cref Real 0.1", "unused Real 1"), one)
    later = binding(values("Input_3 Real 0.2", "T_cref Real 0.01"))
    sets = (sets + later).replace("</ssd:ParameterBindings><ssd:ParameterBindings>", "")
    ports = connectors({"Input_1": "input", "Input_2": "input", "Input_3": "input", "Output_cref": "output"})
    ports += connectors({"T_cref": "parameter", "k_cref": "parameter"})
    ports = ports.replace("</ssd:Connectors><ssd:Connectors>", "")
    empty = connectors({"F_cref": "parameter"}) + binding(values("F_cref Real 40"))
    elements = f'<ssd:System name="foo">{empty}</ssd:System>' + part("addP", binding(values("Kp Real 77")))
    elements += part("P", fmu="resources/plant.fmu")
    pairs = ("T_cref Kd", "k_cref Kp", "Input_1 q_des[1]", "Input_3 q_des[2]")
    inputs = "".join(connection(f".{start}", f"addP.{end}") for start, end in map(str.split, pairs))
    ring = wires("P.q[#] addP.q[#]", "P.v[#] addP.v[#]", "addP.tau[#] P.tau_cmd[#]")
    return top(elements, inputs + ring + connection("addP.tau[1]", ".Output_cref"), ports + sets)


def quarter_truck() -> bytes:
    """Return the quarter truck of Vico, libcosim and ecos: a chain with power ports, values in a folder ssv."""
    sets = "".join(f"<ssd:ParameterBinding source='ssv/{name}.ssv'/>" for name in ("gains", "goal"))
    sets = f"<ssd:ParameterBindings>{sets}</ssd:ParameterBindings>"
    wheel = part(
        "wheel", connectors({"p.f": "input", "p1.e": "input", "p.e": "output", "p1.f": "output"}) + sets, attributes=""
    )
    elements = part("chassis", "", "resources/plant.fmu", "") + wheel + stimulus("ground", (0.0, 0.5))
    pairs = (
        *("chassis.q[1] wheel.p1.e", "chassis.q[2] wheel.q[2]", "wheel.p1.f chassis.tau_cmd[1]"),
        *("wheel.p.e chassis.tau_cmd[2]", "wheel.p.e ground.p1.e", "ground.p.e wheel.p.f"),
    )
    ring = "".join(connection(*pair.split()) for pair in pairs)
    step = note('<o:FixedStepAlgorithm xmlns:o="o" baseStepSize="1e-4"/>', "com.opensimulationplatform")
    return top(elements, ring, end=f'<ssd:DefaultExperiment startTime="10">{step}</ssd:DefaultExperiment>')


TRUCK = {f"ssv/{name}.ssv": values(*rows) for name, rows in (("gains", GAINS), ("goal", GOAL))}
PORTS = {
    f'name="{old}"': f'name="{new}"'
    for old, new in (("q[1]", "p1.e"), ("v[1]", "p.f"), ("tau[1]", "p1.f"), ("tau[2]", "p.e"))
}


def alone(name: str, source: str) -> bytes:
    """Return a system whose FMU is outside of the file (bouncingBall of Vico) or at a server (gunnerus of ecos)."""
    return ssd(f"<ssd:Elements>{part(name, '', source, '')}</ssd:Elements>")


def mixed_example() -> bytes:
    """Return the mixed example of pyssp-standard, in which bindings of the system name a target component."""
    given = binding(attributes='target="Plant" source="external.ssv"')
    return ssd(f"{given}<ssd:Elements>{part('Plant', attributes='')}</ssd:Elements>")


CASES = {
    "DC-Motor, SSP Traceability": Case(dc_motor(), plant={"tau_ext": LOAD}),
    "DC-Motor, OMSimulator": Case(dc_motor("2.0"), plant={"tau_ext": LOAD}),
    "DC-Motor, as published": Case(
        dc_motor(attributes='implementation="ModelExchange"'),
        r"component 'SuT\.emachine' is a Model Exchange FMU; a co-simulation FMU is needed$",
    ),
    "TraceabilityDemo": Case(traceability_demo(), pd="no units"),
    "embrace, numbers": Case(embrace(), files=EMBRACE),
    "embrace, as published": Case(
        embrace(connection("AdaptionUnit.steps", "ECS_SW.mode")),
        r"'AdaptionUnit\.steps' and 'ECS_SW\.mode' are of type Integer and Enumeration: not supported$",
        files=EMBRACE,
    ),
    "nested files, ssp_references": Case(nested_files(), pd="no units", files=NESTED),
    "to itself, ssp_references": Case(
        itself(),
        r"the connection of 'step\.tau\[1\]' and 'step\.tau\[1\]' is not from an output to an input$",
        files={"resources/in.ssm": parameter_map("a step.Kp")},
    ),
    "nested loops, ssp_references": Case(
        nested_loops(), r"algebraic loop: .*add_inner\.tau\[1\].* has to delay its output", pd="no units"
    ),
    "LinearTransformation, libcosim": Case(
        linear_transformation(),
        control=lambda q, v: 1.3 * law(q, v) + 0.01,
        warnings=("parameter bindings name no variable that can be set, and are ignored: identity1.tau[1] (output)",),
    ),
    "bouncingBall, Vico": Case(
        alone("bouncingBall", "../../../../test-fmus/fmus/1.0/BouncingBall.fmu"),
        r"'\.\./\.\./\.\./\.\./test-fmus/fmus/1\.0/BouncingBall\.fmu' of 'bouncingBall' is not a file in it$",
    ),
    "gunnerus, ecos": Case(
        alone("azimuth0", "proxyfmu://localhost?file=resources/pd.fmu"),
        r"'proxyfmu://localhost\?file=resources/pd\.fmu' of 'azimuth0' is not a file in it$",
    ),
    "dp_ship, ecos": Case(dp_ship(), pd="no units"),
    "parameters, OMSimulator": Case(parameters()),
    "quarter-truck, stated dependencies": Case(
        quarter_truck(), pd="ports", files=TRUCK, start=10.0, control=lambda q, v: law(q, np.array([0.5, 0.0]))
    ),
    "quarter-truck, no dependencies": Case(
        quarter_truck(),
        r"algebraic loop: (?=.*ground\.p1\.e -> ground\.p\.e).* has to delay its output",
        pd="no dependencies",
        files=TRUCK,
    ),
    "mixed_example, pyssp-standard": Case(
        mixed_example(), r"SystemStructure\.ssd is not valid SSP 1\.0: .*The attribute 'target' is not allowed\.$"
    ),
}


@cache
def controller(kind: str) -> bytes:
    """Return an FMU of native/pd.c."""
    if kind == "plain":
        return pd_fmu()
    replaced = NO_UNITS if kind == "no units" else NO_UNITS | PORTS
    return pd_fmu(replaced=replaced, **{"feedthrough": ""} if kind == "no dependencies" else {})  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the native effort plant of the default arm."""
    path = tmp_path_factory.mktemp("plant") / "plant.fmu"
    return twodof.build_fmu(path, twodof.FmuOptions(native=True, control="effort")).read_bytes()


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_structures_of_public_repositories_run_as_by_hand_or_are_refused_by_name(
    case: Case, plant: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pd = controller(case.pd)
    files = {name: text.encode() for name, text in case.files.items()}
    path = loop(
        tmp_path / "x.ssp", plant, pd, case.structure, **files, **{"models/plant.fmu": plant, "models/pd.fmu": pd}
    )
    if case.refusal:
        with pytest.raises(twodof.TwoDofError, match=re.compile(case.refusal)) as refused:
            twodof.experiment(path)
        assert str(path) in str(refused.value) and "\n" not in str(refused.value)
        return
    run = twodof.experiment(path, step=H, stop_time=case.start + N * H)
    assert [record.getMessage() for record in caplog.records] == [f"'{path}': {text}" for text in case.warnings]
    expected = by_hand(plant, tmp_path / "plant.fmu", case.control, **case.plant)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose([sample.q for sample in twodof.samples(run)], expected, rtol=0, atol=1e-12)
