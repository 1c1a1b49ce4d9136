"""Systems of FMUs: connections, values and nested systems of SSP files, against a loop in Python."""

from __future__ import annotations

import io
import json
import random
import re
import time
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import closing
from itertools import count, pairwise
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from systems import NAMESPACES, WIRES, component, connection, connectors, loop, pd_fmu, ssd, values, zipped

import twodof
from twodof.cli.main import main
from twodof.errors import FmuError, InputError, SimulationError
from twodof.fmu import Instance, load_any_fmu, ssp_file

H, N = 0.01, 50
TARGET = np.array([0.3, 0.2])
GAINS = {"pd.Kp": 0.1, "pd.Kd": 0.01}
DEGREE = '<ssc:Unit name="deg"><ssc:BaseUnit rad="1" factor="0.017453292519943295"/></ssc:Unit>'
BOTH = f"<ssd:Elements>{component('plant')}{component('pd')}</ssd:Elements>"


@pytest.fixture(scope="session")
def plant(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The native effort plant of the default arm."""
    path = tmp_path_factory.mktemp("plant") / "plant.fmu"
    return twodof.build_fmu(path, twodof.FmuOptions(native=True, control="effort")).read_bytes()


@pytest.fixture(scope="session")
def pd() -> bytes:
    """A third-party controller."""
    return pd_fmu()


def law(q: np.ndarray, v: np.ndarray, scale: float = 1.0) -> np.ndarray:
    """Return the effort of native/pd.c, with scaled q_des and q."""
    return scale * 0.1 * (TARGET - q) - 0.01 * v


def by_hand(plant: bytes, path: Path, control=law, **settings: object) -> np.ndarray:
    """Return q of a loop in which Python is the controller, N + 1 × 2."""
    path.write_bytes(plant)
    run = twodof.samples(path, step=H, stop_time=N * H, settings=settings)
    rows = [next(run).q]
    tau = control(*map(np.array, (rows[0], np.zeros(2))))
    for _ in range(N):
        sample = run.send({"tau_cmd": tau})
        rows.append(sample.q)
        tau = control(np.array(sample.q), np.array(sample.v))
    run.close()
    return np.array(rows)


def q_of(path: Path, **settings: object) -> np.ndarray:
    """Return q of a system, N + 1 × 2."""
    given = {name.replace("__", "."): value for name, value in settings.items()}
    return np.array([sample.q for sample in twodof.samples(path, step=H, stop_time=N * H, settings=given)])


def binding(content: str = "", mapping: str = "", attributes: str = "") -> str:
    """Return the XML of an inline binding, or of one with attributes such as a source."""
    inline = f"<ssd:ParameterValues>{content}</ssd:ParameterValues>" if content else ""
    return (
        f"<ssd:ParameterBindings><ssd:ParameterBinding {attributes}>{inline}{mapping}</ssd:ParameterBinding>"
        "</ssd:ParameterBindings>"
    )


def mapping(*rows: str) -> str:
    """Return the XML of an inline parameter mapping, of rows "source target"."""
    entries = "".join('<ssm:MappingEntry source="{}" target="{}"/>'.format(*row.split()) for row in rows)
    inner = f'<ssm:ParameterMapping {NAMESPACES} version="1.0">{entries}</ssm:ParameterMapping>'
    return f"<ssd:ParameterMapping>{inner}</ssd:ParameterMapping>"


GIVEN = values("q_des[1] Real 0.3", "q_des[2] Real 0.2", "Kp Real 0.1", "Kd Real 0.01")


@pytest.mark.parametrize("order", ["plant pd", "pd plant"])
def test_a_loop_is_that_of_its_controller_in_python(plant: bytes, pd: bytes, tmp_path: Path, order: str) -> None:
    """An output with direct feedthrough is of the same instant, in any order of components."""
    elements = "".join(component(name, binding(GIVEN) if name == "pd" else "") for name in order.split())
    structure = ssd(f"<ssd:Elements>{elements}</ssd:Elements><ssd:Connections>{WIRES}</ssd:Connections>")
    system = loop(tmp_path / "loop.ssp", plant, pd, structure)
    expected = by_hand(plant, tmp_path / "plant.fmu", payload=0.02)
    assert np.ptp(expected) > 0.1
    np.testing.assert_array_equal(q_of(system, plant__payload=0.02), expected)
    np.testing.assert_array_equal(q_of(system, payload=0.02), expected)


def test_units_are_converted_and_not_where_that_is_suppressed(plant: bytes, tmp_path: Path) -> None:
    degrees = pd_fmu(unit="deg", factor=np.pi / 180.0)
    settings = dict(pd__Kp=0.1, pd__Kd=0.01, pd__q_des=np.rad2deg(TARGET))
    scaled = by_hand(plant, tmp_path / "plant.fmu", lambda q, v: law(q, v, 180.0 / np.pi))
    system = loop(tmp_path / "loop.ssp", plant, degrees)
    np.testing.assert_allclose(q_of(system, **settings), scaled, rtol=0, atol=1e-9)
    wires = "".join(
        connection(f"{a}[{i}]", f"{b}[{i}]", more='suppressUnitConversion="true"')
        for i in (1, 2)
        for a, b in (("plant.q", "pd.q"), ("plant.v", "pd.v"), ("pd.tau", "plant.tau_cmd"))
    )
    system = loop(tmp_path / "loop.ssp", plant, degrees, ssd(f"{BOTH}<ssd:Connections>{wires}</ssd:Connections>"))
    plain = by_hand(plant, tmp_path / "plant.fmu")
    np.testing.assert_array_equal(q_of(system, **{**settings, "pd__q_des": TARGET}), plain)


@pytest.mark.parametrize("inherits", ['declaredType="Angle"', 'declaredType="Turn" unit="deg"'])
def test_a_unit_may_come_from_a_declared_type_and_the_unit_of_a_variable_precedes_it(
    inherits: str, plant: bytes, tmp_path: Path
) -> None:
    """FMI 2.0.4, section 2.2.7: attributes of the type are the defaults of the variable's."""
    types = '<SimpleType name="Angle"><Real unit="deg"/></SimpleType><SimpleType name="Turn"><Real unit="N.m"/>'
    replaced = {'unit="deg"/>': f"{inherits}/>", "<TypeDefinitions>": f"<TypeDefinitions>{types}</SimpleType>"}
    own, declared = (pd_fmu(unit="deg", factor=np.pi / 180.0, replaced=r) for r in ({}, replaced))
    settings = dict(pd__Kp=0.1, pd__Kd=0.01, pd__q_des=np.rad2deg(TARGET))
    expected = by_hand(plant, tmp_path / "plant.fmu", lambda q, v: law(q, v, 180.0 / np.pi))
    for controller in (own, declared):
        found = q_of(loop(tmp_path / "loop.ssp", plant, controller), **settings)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("by", ["variable", "type"])
def test_a_difference_has_no_offset_of_its_unit(by: str, plant: bytes, tmp_path: Path) -> None:
    """FMI 2.0.4, section 2.2.3: 10 degree Celsius = 10 Kelvin if relativeQuantity is true. As values and connected."""
    relative = 'unit="far" relativeQuantity="true"/>'
    typed = f'<TypeDefinitions><SimpleType name="Far"><Real {relative}</SimpleType>'
    replaced = {'factor="1.0"': 'offset="1.0"'}
    replaced |= (
        {'unit="far"/>': relative}
        if by == "variable"
        else {'unit="far"/>': 'declaredType="Far"/>', "<TypeDefinitions>": typed}
    )
    controller = pd_fmu(unit="far", replaced=replaced)
    units = "<ssc:Unit name='rad'><ssc:BaseUnit rad='1'/></ssc:Unit>"
    units += "<ssc:Unit name='farther'><ssc:BaseUnit rad='1' offset='7'/></ssc:Unit>"
    wires = WIRES.replace(connection("plant.q[1]", "pd.q[1]"), connection("plant.q[1]", "in.a"))
    wires += connection("in.b", "pd.q[1]") + connection("goal", "pd.q_des[2]")
    inner = connectors({"a": "input farther", "b": "output farther"})
    inner = f'<ssd:System name="in">{inner}<ssd:Connections>{connection("a", "b")}</ssd:Connections></ssd:System>'
    more = f"<ssv:Units>{units}</ssv:Units>"
    given = binding(values("q_des[1] Real 0.3 farther", "Kp Real 0.1", "Kd Real 0.01", more=more))
    goal = connectors({"goal": "input farther"}) + binding(values("goal Real 0.2 rad", more=more))
    parts = BOTH.replace(component("pd"), component("pd", given)).replace("</ssd:Elements>", f"{inner}</ssd:Elements>")
    structure = ssd(f"{goal}{parts}<ssd:Connections>{wires}</ssd:Connections>", f"<ssd:Units>{units}</ssd:Units>")
    found = q_of(loop(tmp_path / "loop.ssp", plant, controller, structure))
    np.testing.assert_allclose(found, by_hand(plant, tmp_path / "plant.fmu"), rtol=0, atol=1e-12)


def test_arrays_of_fmi_3_have_the_attributes_of_their_declared_type(tmp_path: Path) -> None:
    """FMI 3.0.2, section 2.4.4."""
    variable = '<Float64 name="q" valueReference="1" causality="output" declaredType="A"{}><Dimension start="2"/>'
    variable += '</Float64><Float64 name="time" valueReference="2" causality="independent" variability="continuous"/>'
    units = '<UnitDefinitions><Unit name="deg"/><Unit name="rad"/></UnitDefinitions>'
    declared = '<TypeDefinitions><Float64Type name="A" unit="deg" relativeQuantity="true" min="-1" max="2"/>'
    declared = f"{units}{declared}</TypeDefinitions>"
    for own, unit in (("", "deg"), (' unit="rad"', "rad")):
        fmu = described(variable.format(own), '<Output valueReference="1"/>', "3.0", types=declared)
        (tmp_path / "a.fmu").write_bytes(fmu)
        found = load_any_fmu(tmp_path / "a.fmu")
        assert [(v.unit, v.relative) for v in found.variables.values()][:2] == [(unit, True)] * 2
        assert (found.description.modelVariables[0].min, found.description.modelVariables[0].max) == ("-1", "2")


def test_a_connector_may_repeat_the_unit_of_its_variable(plant: bytes, tmp_path: Path) -> None:
    """It has few digits or another name; values have the unit of the FMU's variable."""
    rounded = '<ssc:Unit name="degree"><ssc:BaseUnit rad="1" factor="0.0174533"/></ssc:Unit>'
    settings = dict(pd__Kp=0.1, pd__Kd=0.01, pd__q_des=np.rad2deg(TARGET))
    degrees, plain = pd_fmu(unit="deg", factor=np.pi / 180.0), ssd(f"{BOTH}<ssd:Connections>{WIRES}</ssd:Connections>")
    expected = q_of(loop(tmp_path / "plain.ssp", plant, degrees, plain), **settings)
    for unit in ("degree", "deg"):
        own = component("pd", connectors({f"q[{i}]": f"input {unit}" for i in (1, 2)}))
        both = BOTH.replace(component("pd"), own)
        text = ssd(f"{both}<ssd:Connections>{WIRES}</ssd:Connections>", f"<ssd:Units>{DEGREE}{rounded}</ssd:Units>")
        np.testing.assert_array_equal(q_of(loop(tmp_path / f"{unit}.ssp", plant, degrees, text), **settings), expected)


def test_probable_mistakes_get_a_remark(
    plant: bytes, pd: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    """A vector is connected in part, or a setting of the plant without a component is also in the other FMU."""
    system = loop(tmp_path / "loop.ssp", plant, pd)
    twodof.experiment(system, settings=GAINS)
    assert not caplog.records
    part = WIRES.replace(connection("plant.v[2]", "pd.v[2]"), "")
    system = loop(tmp_path / "part.ssp", plant, pd, ssd(f"{BOTH}<ssd:Connections>{part}</ssd:Connections>"))
    twodof.experiment(system)
    line = "not all elements of an input are connected: pd.v[2] keeps its value"
    assert [record.getMessage() for record in caplog.records] == [f"'{system}': {line}"]
    assert line in str(twodof.check(system).rows[0])
    assert main(["info", str(system)]) == 0 and line in capsys.readouterr().out
    caplog.clear()
    twodof.experiment(system, settings={"pd.v[2]": 0.1})
    assert not caplog.records
    elements = component("plant") + component("plant").replace('name="plant"', 'name="left"')
    two = loop(tmp_path / "two.ssp", plant, pd, ssd(f"<ssd:Elements>{elements}</ssd:Elements>"))
    fmu = twodof.load_fmu(two, "plant")
    twodof.experiment(fmu, settings={"plant.control_period": 0.02})
    twodof.experiment(fmu, settings={"control_period": 0.02, "left.control_period": 0.02})
    assert not caplog.records
    twodof.experiment(fmu, settings={"control_period": 0.02})
    line = "control_period is set in 'plant' alone: left.control_period keeps its value"
    assert [record.getMessage() for record in caplog.records] == [f"'{two}': {line}"]


@pytest.mark.parametrize("names", ["payload plant.payload", "pd.q_des q_des", "q_des[2] pd.q_des[2]"])
def test_a_variable_under_two_names_is_refused(names: str, plant: bytes, pd: bytes, tmp_path: Path) -> None:
    """In settings, and in the answer to a sample."""
    system, (first, second) = loop(tmp_path / "loop.ssp", plant, pd), names.split()
    line = re.escape(f"is given twice, as '{first}' and as '{second}'; leave one out")
    with pytest.raises(InputError, match=line):
        twodof.experiment(system, settings={first: 0.1, second: 0.2})
    with closing(twodof.samples(system, step=H, stop_time=N * H)) as run, pytest.raises(InputError, match=line):
        next(run)
        run.send({first: 0.1, second: 0.2})


def test_an_unknown_name_gets_those_of_components_or_elements(plant: bytes, tmp_path: Path) -> None:
    """There are two controllers, or a vector whose first element is connected."""
    controller = pd_fmu(replaced={f'name="q_des[{i}]"': f'name="goal[{i}]"' for i in (1, 2)})
    spare = component("pd").replace('name="pd"', 'name="spare"')
    both, wires = BOTH.replace("</ssd:Elements>", f"{spare}</ssd:Elements>"), connection("plant.q[1]", "pd.goal[1]")
    for elements, name, end in (
        (both, "Kp", "there are: pd.Kp, spare.Kp"),
        (both, "goal", "there are: pd.goal, spare.goal"),
        (BOTH, "Kp", "did you mean 'pd.Kp'?"),
        (BOTH, "goal", "did you mean 'goal[2]'?"),
    ):
        structure = ssd(f"{elements}<ssd:Connections>{wires}</ssd:Connections>")
        path = loop(tmp_path / "loop.ssp", plant, controller, structure)
        with pytest.raises(InputError, match=re.escape(f"there is no variable '{name}'; {end}")):
            twodof.experiment(path, settings={name: 0.1})


def test_a_damaged_system_is_no_zip_archive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "loop.ssp").write_bytes(b"PK")
    for verb in ("info", "run"):
        assert main([verb, str(tmp_path / "loop.ssp")]) == 1
        assert "it is not a valid zip archive" in capsys.readouterr().err


def test_systems_as_other_tools_write_them_are_read(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    """They have annotations, geometry, empty or unknown units, further kinds of connectors, or SSP 2.0's number."""
    note = '<ssd:Annotations><ssc:Annotation type="x"><o:Step xmlns:o="o" size="1"/></ssc:Annotation></ssd:Annotations>'
    where = '<ssc:Real unit=""/><ssd:ConnectorGeometry x="0" y="0.5"/>'
    extent = '<ssd:ElementGeometry x1="0" y1="0" x2="1" y2="1"/>'
    ports = connectors({"q[1]": "input", "tau[1]": "output"}, where)
    given = binding(values("q_des[1] Real 0.3", "q_des[2] Real 0.2", "Kp Real 0.1 -", "Kd Real 0.01", "more String x"))
    elements = component("plant", connectors({"c": "calculatedParameter"}, "")) + component(
        "pd", ports + extent + given
    )
    turned = "".join(
        f'<ssd:Connection endElement="pd" endConnector="{g}[{i}]" startElement="plant" startConnector="{g}[{i}]">'
        '<ssd:ConnectionGeometry pointsX="0 1" pointsY="0 1"/></ssd:Connection>'
        for g in "qv"
        for i in (1, 2)
    )
    turned += "".join(connection(f"plant.tau_cmd[{i}]", f"pd.tau[{i}]") for i in (1, 2))
    top = '<ssd:Connection startElement="" startConnector="on" endElement="pd" endConnector="enabled"/>'
    on = connectors({"on": "input"}, "<ssc:Boolean/>") + binding(values("on Boolean true"))
    system = f"{on}<ssd:Elements>{elements}</ssd:Elements><ssd:Connections>{turned}{top}</ssd:Connections>{note}"
    default = f'<ssd:DefaultExperiment stopTime="0.5">{note}</ssd:DefaultExperiment>'
    expected = by_hand(plant, tmp_path / "plant.fmu")
    for version in (b"1.0", b"2.0"):
        text = ssd(system, default).replace(b'version="1.0" name', b'version="%s" name' % version)
        path = loop(tmp_path / "loop.ssp", plant, pd, text)
        assert twodof.experiment(path, step=H).steps == N
        np.testing.assert_array_equal(q_of(path), expected)


def test_a_system_in_the_form_of_libcosim_ecos_and_omsimulator_runs(plant: bytes, tmp_path: Path) -> None:
    """Names with dots, a later start, a stated implementation, and a map of version 2.0 with a target that is none."""
    names = {'name="tau[': 'name="p_Crane.e[', 'name="Kp"': 'name="C.kP"'}
    component_of_others = component("pd").replace(
        "source=", 'type="application/x-fmu-sharedlibrary" implementation="CoSimulation" source='
    )
    entries = "".join(
        f'<ssm:MappingEntry source="mapped_k" target="pd.{target}"><ssc:LinearTransformation factor="{factor}"'
        f' offset="{offset}"/></ssm:MappingEntry>'
        for target, factor, offset in (("C.kP", 4, 0.02), ("Kd", 0.5, 0.0), ("foo", 1, 0.0))
    )
    entries += "".join(f'<ssm:MappingEntry source="goal{i}" target="pd.q_des[{i}]"/>' for i in (1, 2))
    given = binding(
        mapping='<ssd:ParameterMapping source="resources/map.ssm"/>', attributes='source="resources/set.ssv"'
    )
    step = '<ssc:Annotation type="com.opensimulationplatform"><osp:Step xmlns:osp="osp" size="1e-4"/></ssc:Annotation>'
    default = f'<ssd:DefaultExperiment startTime="10"><ssd:Annotations>{step}</ssd:Annotations></ssd:DefaultExperiment>'
    wires = WIRES.replace('startConnector="tau[', 'startConnector="p_Crane.e[')
    elements = f"<ssd:Elements>{component_of_others}{component('plant')}</ssd:Elements>"
    files = {
        "resources/set.ssv": values("mapped_k Real 0.02", "goal1 Real 0.3", "goal2 Real 0.2"),
        "resources/map.ssm": f'<ssm:ParameterMapping {NAMESPACES} version="1.0">{entries}</ssm:ParameterMapping>',
    }
    texts = {name: text.replace('version="1.0"', 'version="2.0"').encode() for name, text in files.items()}
    structure = ssd(f"{given}{elements}<ssd:Connections>{wires}</ssd:Connections>", default)
    system = loop(tmp_path / "loop.ssp", plant, pd_fmu(replaced=names), structure, **texts)
    samples = [*twodof.samples(system, step=H, stop_time=10.0 + N * H)]
    assert samples[0].t == 10.0
    expected = by_hand(plant, tmp_path / "plant.fmu")
    np.testing.assert_allclose([sample.q for sample in samples], expected, rtol=0, atol=1e-12)


def test_a_robot_in_other_units_than_those_of_a_bag_is_refused(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(plant)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    text, scaled = files["modelDescription.xml"], rb'\1 factor="0.0174533"'
    text = re.sub(rb'(<Unit name="rad/s">\s*<BaseUnit[^>]*) factor="1"', scaled, text)
    typed = re.sub(rb' unit="rad/s"(?=[^>]* declaredType=)', b"", text)
    assert typed.count(b'unit="rad/s"') == 1  # of the type
    for files["modelDescription.xml"] in (text, typed):
        (tmp_path / "plant.fmu").write_bytes(degrees := zipped(files))
        for path in (tmp_path / "plant.fmu", loop(tmp_path / "loop.ssp", degrees, pd)):
            with pytest.raises(FmuError, match=r"v\[1\] is in rad/s; a robot needs SI units"):
                twodof.load_fmu(path)


def test_degrees_without_a_base_unit_are_refused(plant: bytes, tmp_path: Path) -> None:
    with zipfile.ZipFile(io.BytesIO(plant)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    text = re.sub(rb'<Unit name="rad">.*?</Unit>', b'<Unit name="deg"/>', files["modelDescription.xml"], flags=re.S)
    files["modelDescription.xml"] = text.replace(b'unit="rad"', b'unit="deg"')
    (tmp_path / "plant.fmu").write_bytes(zipped(files))
    with pytest.raises(FmuError, match=r"q\[1\] is in deg; a robot needs SI units"):
        twodof.load_fmu(tmp_path / "plant.fmu")


def test_a_table_sets_whole_numbers_and_booleans(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    """The output "steps" of native/pd.c counts, and its input "enabled" switches the effort off."""
    path, table = loop(tmp_path / "loop.ssp", plant, pd), tmp_path / "in.csv"
    settings = {**GAINS, "pd.q_des": TARGET}
    table.write_text(f"time,pd.enabled,pd.seen\n0,true,1\n{20 * H},false,2\n")
    given = [sample.q for sample in twodof.samples(path, step=H, stop_time=N * H, settings=settings, input_file=table)]
    with closing(twodof.samples(path, step=H, stop_time=N * H, settings=settings)) as run:
        rows = [next(run).q]
        while len(rows) <= N:
            rows.append(run.send({"pd.enabled": False} if len(rows) == 21 else {}).q)
    np.testing.assert_array_equal(given, rows)
    for column, cell, text in (
        ("enabled", "1", "row 2: pd.enabled = '1' is not true or false"),
        ("seen", "4294967299", "row 2: pd.seen = '4294967299' is not a whole number of 32 bits"),
        ("seen", "1.5", "row 2: pd.seen = '1.5' is not a whole number of 32 bits"),
        ("mode", "1", "pd.mode is not an input that is a number or a Boolean"),
    ):
        table.write_text(f"time,pd.{column}\n0,{cell}\n")
        with pytest.raises(InputError, match=re.escape(text)):
            twodof.experiment(path, input_file=table)


@pytest.mark.parametrize("units", [f"<ssd:Units>{DEGREE}</ssd:Units>", ""], ids=["defined", "undefined"])
def test_a_connector_gives_a_unit_to_a_robot_without_one(units: str, tmp_path: Path) -> None:
    outputs = "".join(
        f'<ScalarVariable name="{name}[1]" valueReference="{k}" causality="output"><Real/></ScalarVariable>'
        for k, name in enumerate("qv", 1)
    )
    robot = described(outputs, '<Outputs><Unknown index="1"/><Unknown index="2"/></Outputs>')
    part = component("plant", connectors({"q[1]": "output deg"}))
    structure = ssd(f"<ssd:Elements>{part}</ssd:Elements>", units)
    with pytest.raises(FmuError, match=r"plant\.q\[1\] is in deg; a robot needs SI units"):
        twodof.load_fmu(loop(tmp_path / "loop.ssp", robot, robot, structure))


def test_only_a_target_in_si_units_that_drives_the_robot_is_its_target(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    """A verdict, a bag and a plot compare q_des with q, in rad."""
    reads = connection("plant.q[1]", "pd.q[1]")
    wired, apart = (ssd(f"{BOTH}<ssd:Connections>{wires}</ssd:Connections>") for wires in (WIRES, reads))
    degrees = pd_fmu(unit="deg", factor=np.pi / 180.0)
    truths = {}
    for i in (1, 2):
        number = f'valueReference="{3 + i}" causality="input" variability="continuous"><Real start="0.0" unit="rad"/>'
        truth = f'valueReference="{51 + i}" causality="input" variability="discrete"><Boolean start="true"/>'
        truths[f'name="q_des[{i}]" {number}'] = f'name="q_des[{i}]" {truth}'
    for controller, structure, is_target in (
        (pd, wired, True),
        (degrees, wired, False),
        (pd, apart, False),
        (pd_fmu(replaced=truths), wired, False),
    ):
        path = loop(tmp_path / "loop.ssp", plant, controller, structure)
        system = twodof.load_fmu(path)
        assert [bool(system.vector(name)) for name in ("q_des", "pd.q_des")] == [is_target, True]
        assert (twodof.run(path, step=H, stop_time=N * H).verdict.outcome != "no target") == is_target


@pytest.mark.parametrize(
    ("unit", "factor", "wires", "name"),
    [
        ("rad", 1.0, WIRES, "q_des"),
        ("deg", 1.0, WIRES, "system.q_des"),
        ("rad", 2.0, WIRES, "system.q_des"),
        ("rad", 1.0, connection("plant.q[1]", "pd.q[1]"), "system.q_des"),
    ],
)
def test_a_connector_is_the_target_only_in_si_units_if_it_drives_the_robot(
    unit: str, factor: float, wires: str, name: str, plant: bytes, pd: bytes, tmp_path: Path
) -> None:
    ports = connectors({f"q_des[{i}]": f"input {unit}" for i in (1, 2)})
    plain = loop(tmp_path / "plain.ssp", plant, pd, ssd(f"{BOTH}<ssd:Connections>{wires}</ssd:Connections>"))
    scaled = f'<ssc:LinearTransformation factor="{factor}"/>' if factor != 1.0 else ""
    wires += "".join(connection(f"q_des[{i}]", f"pd.q_des[{i}]", scaled) for i in (1, 2))
    structure = ssd(f"{ports}{BOTH}<ssd:Connections>{wires}</ssd:Connections>", f"<ssd:Units>{DEGREE}</ssd:Units>")
    path = loop(tmp_path / "loop.ssp", plant, pd, structure)
    system = twodof.load_fmu(path)
    assert {*system.groups("input")} >= {name} and bool(system.vector("q_des")) == (name == "q_des")
    goal, gains = {name: (np.rad2deg(TARGET) if unit == "deg" else TARGET) / factor}, dict(pd__Kp=0.1, pd__Kd=0.01)
    expected = q_of(plain, **gains, pd__q_des=TARGET)
    np.testing.assert_allclose(q_of(path, **gains, **goal), expected, rtol=0.0, atol=1e-14)
    assert (twodof.run(path, step=H, stop_time=N * H).verdict.outcome != "no target") == (name == "q_des")


def _wires(rows: str) -> str:
    """Return the XML of connections, of lines "start end" or "start end factor"."""
    texts = []
    for start, end, *factor in map(str.split, rows.split(",")):
        inside = f'<ssc:LinearTransformation factor="{factor[0]}"/>' if factor else ""
        texts.append(connection(start, end, inside))
    return "".join(texts)


STRAIGHT = "plant.q[1] pd.q[1], plant.q[2] pd.q[2]"
GEARED = "plant.q[1] pd.q[1] 10, plant.q[2] pd.q[2] 10"


@pytest.mark.parametrize(
    ("measured", "given", "name"),
    [
        (STRAIGHT, "", "q_des"),
        (STRAIGHT.replace("pd.q", "pd.angle"), "", "q_des"),
        ("plant.q[1] pd.q[2], plant.q[2] pd.q[1]", "", "pd.q_des"),
        (GEARED, "", "pd.q_des"),
        ("plant.q[1] pd.q[1]", "", "pd.q_des"),
        ("plant.q[1] pd.q[1], plant.q[2] pd.q[2] 10", "", "pd.q_des"),
        (STRAIGHT, "q_des[1] pd.q_des[1], q_des[2] pd.q_des[2]", "q_des"),
        (GEARED, "q_des[1] pd.q_des[1] 10, q_des[2] pd.q_des[2] 10", "q_des"),
        (GEARED, "q_des[1] pd.q_des[1], q_des[2] pd.q_des[2]", "system.q_des"),
        (STRAIGHT, "q_des[1] pd.q_des[2], q_des[2] pd.q_des[1]", "system.q_des"),
        (STRAIGHT, "q_des[1] pd.q_des[1], q_des[2] pd.q_des[2] 2", "system.q_des"),
        (STRAIGHT, "q_des[1] pd.q_des[1]", "system.q_des[1]"),
    ],
)
def test_a_target_is_in_the_coordinates_in_which_its_controller_reads_the_robot(
    measured: str, given: str, name: str, plant: bytes, pd: bytes, tmp_path: Path
) -> None:
    """A gear, a reversed order of the joints, or an element that is not connected leaves no target."""
    names = {f'name="q[{i}]"': f'name="angle[{i}]"' for i in (1, 2)} if "angle" in measured else {}
    effort = "pd.tau[1] plant.tau_cmd[1], pd.tau[2] plant.tau_cmd[2]"
    wires = "".join(_wires(rows) for rows in (measured, effort, given) if rows)
    ports = connectors({f"q_des[{i}]": "input" for i in (1, 2)}) if given else ""
    structure = ssd(f"{ports}{BOTH}<ssd:Connections>{wires}</ssd:Connections>")
    path = loop(tmp_path / "loop.ssp", plant, pd_fmu(replaced=names) if names else pd, structure)
    system = twodof.load_fmu(path)
    assert system.vector(name) and bool(system.vector("q_des")) == (name == "q_des")
    outcome = twodof.run(path, step=H, stop_time=N * H, settings={name: 0.3}).verdict.outcome
    assert (outcome != "no target") == (name == "q_des")


EFFORT = "pd.tau[1] plant.tau_cmd[1], pd.tau[2] plant.tau_cmd[2]"
BEHIND = "plant.q[1] gear.q[1], plant.q[2] gear.q[2], gear.tau[1] pd.q[1], gear.tau[2] pd.q[2]"
SEEN = "plant.q[1] pd.monitor[1], plant.q[2] pd.monitor[2]"
AS_ANGLE = {f'name="q[{i}]"': f'name="angle[{i}]"' for i in (1, 2)}


@pytest.mark.parametrize(
    ("measured", "renamed", "why"),
    [
        (f"{STRAIGHT}, plant.q[2] pd.elbow", {'name="v[1]"': 'name="elbow"'}, ""),
        (f"{STRAIGHT}, plant.q[1] pd.elbow 10", {'name="v[1]"': 'name="elbow"'}, ""),
        (f"{STRAIGHT}, plant.q[1] pd.monitor[2], plant.q[2] pd.monitor[1]", {}, ""),
        (f"{STRAIGHT}, plant.q[1] pd.monitor[1] 10, plant.q[2] pd.monitor[2] 10", {}, ""),
        (BEHIND.replace("pd.q", "pd.monitor") + f", {STRAIGHT}", {}, ""),
        (BEHIND, {}, "q reads the robot through gear"),
        (f"{BEHIND}, {SEEN}", {}, "q reads the robot through gear"),
        (
            BEHIND.replace("pd.q", "pd.monitor") + ", " + STRAIGHT.replace("pd.q", "pd.angle"),
            AS_ANGLE,
            "monitor reads the robot through gear",
        ),
        (f"{BEHIND}, {SEEN}".replace("pd.q", "pd.angle"), AS_ANGLE, "angle reads the robot through gear"),
        (f"{GEARED}, {SEEN}", {}, "q reads the robot in another order, with another conversion, or in part"),
        (
            f"{GEARED}, {SEEN}".replace("pd.q", "pd.angle"),
            AS_ANGLE,
            "angle reads the robot in another order, with another conversion, or in part",
        ),
        ("plant.q[1] pd.elbow", {'name="v[1]"': 'name="elbow"'}, "the controller reads no positions of the robot"),
        (
            f"plant.q[1] pd.angle[1], {SEEN}",
            AS_ANGLE,
            "angle reads the robot in another order, with another conversion, or in part",
        ),
        (f"{STRAIGHT}, gear.tau[1] pd.q_des[1], gear.tau[2] pd.q_des[2]", {}, "its values come from gear"),
    ],
)
def test_further_inputs_of_a_controller_neither_remove_a_target_nor_prove_one(
    measured: str, renamed: dict[str, str], why: str, plant: bytes, tmp_path: Path
) -> None:
    """Monitors, and positions that come through a gear; a verdict says why it judges no target."""
    replaced = {'unit="rad/s"': 'unit="rad"', **renamed}
    if not any('"v[' in name for name in renamed):
        replaced |= {f'name="v[{i}]"': f'name="monitor[{i}]"' for i in (1, 2)}
    controller, scaled = pd_fmu(replaced=replaced), {'unit="N.m"': 'unit="rad"', 'name="q_des': 'name="level'}
    gear = {"resources/gear.fmu": pd_fmu(effort="10.0 * c->value[Q + i]", replaced=scaled)}
    elements = BOTH.replace("</ssd:Elements>", f"{component('gear')}</ssd:Elements>")
    structure = ssd(f"{elements}<ssd:Connections>{_wires(measured)}{_wires(EFFORT)}</ssd:Connections>")
    path = loop(tmp_path / "loop.ssp", plant, controller, structure, **gear)
    assert bool(twodof.load_fmu(path).vector("q_des")) == (not why)
    verdict = twodof.run(path, step=H, stop_time=N * H).verdict
    assert (verdict.outcome == "no target") == bool(why)
    notes = [line for line in verdict.lines if "is not judged" in line]
    assert notes == ([f"note: pd.q_des is not judged: {why}"] if why else [])


def test_a_target_of_an_inner_system_has_its_short_name(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    """The names with the inner system and with the controller are those of the same input."""
    kinds = {"q": "input", "v": "input", "q_des": "input", "tau": "output"}
    ports = connectors({f"{name}[{i}]": kind for i in (1, 2) for name, kind in kinds.items()})
    pairs = [(f"{name}[{i}]", f"pd.{name}[{i}]") for name in kinds for i in (1, 2)]
    wires = "".join(connection(*(pair[::-1] if "tau" in pair[0] else pair)) for pair in pairs)

    def system(name: str) -> str:
        parts = f"<ssd:Elements>{component('pd')}</ssd:Elements><ssd:Connections>{wires}</ssd:Connections>"
        return f'<ssd:System name="{name}">{ports}{parts}</ssd:System>'

    outer = WIRES.replace('"pd"', '"ctl"')
    elements = f"<ssd:Elements>{component('plant')}{system('ctl')}</ssd:Elements>"
    path = loop(tmp_path / "loop.ssp", plant, pd, ssd(f"{elements}<ssd:Connections>{outer}</ssd:Connections>"))
    gains = {"ctl__pd__Kp": 0.1, "ctl__pd__Kd": 0.01}
    expected = by_hand(plant, tmp_path / "plant.fmu")
    for name in ("q_des", "ctl__q_des"):
        np.testing.assert_array_equal(q_of(path, **gains, **{name: TARGET}), expected)
    assert twodof.run(path, step=H, stop_time=N * H).verdict.outcome != "no target"
    second = connection("ctl.tau[1]", "plant.tau_cmd[1]") + connection("more.tau[2]", "plant.tau_cmd[2]")
    read = "".join(_wires(f"plant.{g}[{i}] {s}.{g}[{i}]") for g in "qv" for i in (1, 2) for s in ("ctl", "more"))
    both = f"<ssd:Elements>{component('plant')}{system('ctl')}{system('more')}</ssd:Elements>"
    path = loop(tmp_path / "two.ssp", plant, pd, ssd(f"{both}<ssd:Connections>{read}{second}</ssd:Connections>"))
    found = twodof.load_fmu(path)
    assert found.vector("ctl.q_des") and found.vector("more.q_des") and not found.vector("q_des")
    assert found.unjudged == tuple(
        f"{name}.pd.q_des is not judged: there are several such targets" for name in ("ctl", "more")
    )


def test_only_the_controllers_of_the_chosen_robot_have_its_target(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    """A second robot with its own controller, and a spare controller."""
    left = [text.replace('"p', '"left_p') for text in (component("plant"), component("pd"), WIRES)]
    parts = "".join(left[:2]).replace("resources/left_", "resources/")
    spare = component("pd").replace('name="pd"', 'name="spare"')
    elements = BOTH.replace("</ssd:Elements>", f"{parts}{spare}</ssd:Elements>")
    path = loop(tmp_path / "two.ssp", plant, pd, ssd(f"{elements}<ssd:Connections>{WIRES}{left[2]}</ssd:Connections>"))
    for robot, controller in (("plant", "pd"), ("left_plant", "left_pd")):
        system = twodof.load_fmu(path, robot)
        target = [f"q_des[{i}]" for i in (1, 2)]
        assert system.vector("q_des") == system.vector(f"{controller}.q_des") == target


def test_a_connector_does_not_hide_a_vector_of_the_robot(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    ports = connectors({"q[1]": "input"})
    wires = f"<ssd:Connections>{WIRES}{connection('q[1]', 'pd.q_des[1]')}</ssd:Connections>"
    system = twodof.load_fmu(loop(tmp_path / "loop.ssp", plant, pd, ssd(ports + BOTH + wires)))
    assert [system.variables[name].causality for name in ("q[1]", "system.q[1]")] == ["output", "input"]


def test_the_guid_of_a_system_depends_on_its_parameter_sets_and_the_files_of_its_fmus(
    plant: bytes, pd: bytes, tmp_path: Path
) -> None:
    with zipfile.ZipFile(io.BytesIO(pd)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    rebuilt = zipped({**files, "resources/gains": b"2"})
    own = BOTH.replace(component("pd"), component("pd", binding(attributes='source="pd.ssv"')))
    guids = []
    for fmu, gain in ((pd, 1), (pd, 2), (rebuilt, 1), (pd, 1)):
        path = loop(tmp_path / "loop.ssp", plant, fmu, ssd(own), **{"pd.ssv": values(f"Kp Real {gain}").encode()})
        guids.append(twodof.load_fmu(path).guid)
    assert len({*guids}) == 3 and guids[0] == guids[3]


def test_a_run_has_the_times_of_the_default_experiment(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    wired = f"{BOTH}<ssd:Connections>{WIRES}</ssd:Connections>"
    for times, expected in (('startTime="1" stopTime="1.5"', (1.0, 1.5)), ('startTime="-1"', (-1.0, 4.0))):
        text = ssd(wired, f"<ssd:DefaultExperiment {times}/>")
        run = twodof.experiment(loop(tmp_path / "loop.ssp", plant, pd, text), step=H)
        assert (run.start_time, run.time(run.steps)) == expected
    with closing(twodof.samples(run)) as samples:
        assert next(samples).t == -1.0
    assert twodof.experiment(tmp_path / "loop.ssp", step=H, stop_time=0.0).steps == 100


def nested(plant: bytes, pd: bytes, path: Path, top_values: str = "", inner_values: str = "") -> Path:
    """Write a system whose controller is two systems deep, with a gain and an offset before its target."""
    kinds = {"q": "input", "v": "input", "goal": "input deg", "tau": "output"}
    ports = connectors({f"{name}[{i}]": kind for i in (1, 2) for name, kind in kinds.items()})
    down = [(f"{n}[{i}]", f"{{}}.{n}[{i}]") for i in (1, 2) for n in ("q", "v")]
    up = [(f"{{}}.tau[{i}]", f"tau[{i}]") for i in (1, 2)]
    scaled = '<ssc:LinearTransformation factor="2" offset="0.1"/>'
    wires = {
        name: "".join(connection(a.format(name), b.format(name)) for a, b in down + up) for name in ("pd", "inner")
    }
    wires["pd"] += "".join(connection(f"goal[{i}]", f"pd.q_des[{i}]", scaled) for i in (1, 2))
    wires["inner"] += "".join(connection(f"goal[{i}]", f"inner.goal[{i}]") for i in (1, 2))
    inner, body = component("pd"), ""
    for name, own, given in (("inner", "pd", inner_values), ("outer", "inner", "")):
        body = (
            f'<ssd:System name="{name}">{ports}{given}<ssd:Elements>{inner}</ssd:Elements>'
            f"<ssd:Connections>{wires[own]}</ssd:Connections></ssd:System>"
        )
        inner = body
    top = WIRES.replace('"pd"', '"outer"')
    top += "".join(connection(f"goal[{i}]", f"outer.goal[{i}]") for i in (1, 2))
    units = (
        '<ssd:Units><ssc:Unit name="deg"><ssc:BaseUnit rad="1" factor="0.017453292519943295"/></ssc:Unit></ssd:Units>'
    )
    system = (
        connectors({f"goal[{i}]": "input deg" for i in (1, 2)})
        + f"{top_values}<ssd:Elements>{component('plant')}{body}</ssd:Elements><ssd:Connections>{top}</ssd:Connections>"
    )
    return loop(path, plant, pd, ssd(system, units))


def test_nested_systems_are_flattened_and_transformations_come_after_units(
    plant: bytes, pd: bytes, tmp_path: Path
) -> None:
    system = nested(plant, pd, tmp_path / "nested.ssp")
    fmu = twodof.load_fmu(system)
    assert next(iter(fmu.groups("input"))) == "goal"
    assert fmu.variables["goal[1]"].unit == "deg"
    np.testing.assert_allclose(fmu.start_values["goal[1]"], np.rad2deg(-0.1 / 2.0), rtol=1e-12)  # where q_des is 0
    settings = {"outer__inner__pd__Kp": 0.1, "outer__inner__pd__Kd": 0.01, "goal": np.rad2deg((TARGET - 0.1) / 2.0)}
    expected = by_hand(plant, tmp_path / "plant.fmu")
    np.testing.assert_allclose(q_of(system, **settings), expected, rtol=0, atol=1e-12)
    run = twodof.samples(system, step=H, stop_time=H, settings={"goal": 0.0, **{"outer.inner.pd.Kp": 0.1}})
    first = next(run)
    moved = run.send({"goal": 90.0})
    assert (first.inputs["goal[1]"], moved.inputs["goal[1]"]) == (0.0, 90.0)


def test_a_connector_without_a_value_passes_none(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    """The connected variables keep their own values, or have those of an inner connector."""
    wires = {"K": ("Kp", "Kd"), "goal": ("q_des[1]", "q_des[2]")}
    wired = WIRES + "".join(connection(start, f"pd.{end}") for start, ends in wires.items() for end in ends)
    ports = connectors({"K": "parameter", "goal": "input"})
    parts = BOTH.replace(component("pd"), component("pd", binding(GIVEN)))
    text = ssd(f"{ports}{parts}<ssd:Connections>{wired}</ssd:Connections>")
    system, expected = loop(tmp_path / "loop.ssp", plant, pd, text), by_hand(plant, tmp_path / "plant.fmu")
    assert not {"K", "goal"} & {*twodof.load_fmu(system).start_values}
    np.testing.assert_array_equal(q_of(system), expected)
    gains = {"outer__inner__pd__Kp": 0.1, "outer__inner__pd__Kd": 0.01}
    goals = np.rad2deg((TARGET - 0.1) / 2.0)
    right, wrong = (
        binding(values(*(f"goal[{i + 1}] Real {x!r}" for i, x in enumerate(g.tolist())))) for g in (goals, -goals)
    )
    for given in ({"inner_values": right}, {"top_values": right, "inner_values": wrong}):
        system = nested(plant, pd, tmp_path / "nested.ssp", **given)
        np.testing.assert_allclose(twodof.load_fmu(system).start_values["goal[1]"], goals[0], rtol=1e-12)
        np.testing.assert_allclose(q_of(system, **gains), expected, rtol=0, atol=1e-12)


def test_values_come_from_sets_and_mappings_the_outermost_last(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    units = (
        '<ssv:Units><ssc:Unit name="deg"><ssc:BaseUnit rad="1" factor="0.017453292519943295"/></ssc:Unit></ssv:Units>'
    )
    angles = [f"goal{i + 1} Real {float(np.rad2deg(angle))!r} deg" for i, angle in enumerate(TARGET)]
    mapped = "".join(
        f'<ssm:MappingEntry source="{source}" target="{target}">{inside}</ssm:MappingEntry>'
        for source, target, inside in (
            ("my.goal1", "pd.q_des[1]", ""),
            ("my.goal2", "pd.q_des[2]", ""),
            ("my.half", "pd.Kp", '<ssc:LinearTransformation factor="2"/>'),
        )
    )
    ssm = f'<ssm:ParameterMapping {NAMESPACES} version="1.0">{mapped}</ssm:ParameterMapping>'
    outer = binding(
        mapping='<ssd:ParameterMapping source="maps/map.ssm"/>', attributes='source="sets/my%20set.ssv" prefix="my."'
    )
    own = values("Kp Real 77", "Kd Real 0.01", "unknown Real 1")
    elements = f"<ssd:Elements>{component('plant')}{component('pd', binding(own))}</ssd:Elements>"
    structure = ssd(f"{outer}{elements}<ssd:Connections>{WIRES}</ssd:Connections>")
    text = values(*angles, "half Real 0.05", "Kd Real 5", more=units)
    files = {"sets/my set.ssv": text.encode(), "maps/map.ssm": ssm.encode()}
    system = loop(tmp_path / "loop.ssp", plant, pd, structure, **files)
    starts = twodof.load_fmu(system).start_values
    assert (starts["pd.Kp"], starts["pd.Kd"]) == (0.1, 0.01)
    np.testing.assert_allclose(q_of(system), by_hand(plant, tmp_path / "plant.fmu"), rtol=0, atol=1e-12)


def test_names_in_bindings_that_do_not_exist_are_in_a_warning(
    plant: bytes, pd: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """They are a misspelt name, a vector without an index, and a source that the parameter set does not have."""
    given = values("Kq Real 1", "q_des Real 1", "Kp Real 0.1")
    parts = [binding(given), binding(given, mapping("absent Kd", "Kp Kp"))]
    lines = ["pd.Kq, pd.q_des (name its elements: pd.q_des[1])", "absent"]
    for part, line in zip(parts, lines):
        elements = f"<ssd:Elements>{component('plant')}{component('pd', part)}</ssd:Elements>"
        structure = ssd(f"{elements}<ssd:Connections>{WIRES}</ssd:Connections>")
        system = loop(tmp_path / "loop.ssp", plant, pd, structure)
        caplog.clear()
        twodof.experiment(system)
        text = "parameter bindings name no variable that can be set, and are ignored"
        assert [record.getMessage() for record in caplog.records] == [f"'{system}': {text}: {line}"]


def test_truth_values_are_connected(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    on = connectors({"on": "input"}, "<ssc:Boolean/>")
    wires = WIRES + connection("on", "pd.enabled")
    system = loop(tmp_path / "loop.ssp", plant, pd, ssd(f"{on}{BOTH}<ssd:Connections>{wires}</ssd:Connections>"))
    settings = dict(pd__Kp=0.1, pd__Kd=0.01, pd__q_des=TARGET)
    np.testing.assert_array_equal(q_of(system, on=True, **settings), by_hand(plant, tmp_path / "plant.fmu"))
    free = by_hand(plant, tmp_path / "plant.fmu", lambda q, v: np.zeros(2))
    np.testing.assert_array_equal(q_of(system, on=False, **settings), free)


@pytest.mark.parametrize("on", [True, False])
def test_discrete_outputs_are_connected(plant: bytes, pd: bytes, tmp_path: Path, on: bool) -> None:
    """The second controller receives from the first a Boolean that enables it, and the number of steps, up to 20."""
    twin = component("pd").replace('name="pd"', 'name="twin"')
    wires = WIRES.replace('"pd"', '"twin"') + connection("pd.on", "twin.enabled") + connection("pd.steps", "twin.seen")
    elements = BOTH.replace("</ssd:Elements>", f"{twin}</ssd:Elements>")
    system = loop(tmp_path / "loop.ssp", plant, pd, ssd(f"{elements}<ssd:Connections>{wires}</ssd:Connections>"))
    samples = count()
    expected = by_hand(
        plant, tmp_path / "plant.fmu", lambda q, v: law(q, v) if next(samples) < 20 and on else np.zeros(2)
    )
    settings = dict(twin__Kp=0.1, twin__Kd=0.01, twin__q_des=TARGET, pd__enabled=on)
    np.testing.assert_array_equal(q_of(system, **settings), expected)


@pytest.mark.parametrize("fmi", [2, 3])
def test_an_output_may_go_to_several_inputs_and_to_a_part_of_an_array(pd: bytes, tmp_path: Path, fmi: int) -> None:
    options = twodof.FmuOptions(native=True, fmi=fmi, control="effort")
    plant = twodof.build_fmu(tmp_path / "plant.fmu", options).read_bytes()
    wires = WIRES.replace(connection("plant.q[2]", "pd.q[2]"), connection("plant.q[1]", "pd.q[2]"))
    wires = wires.replace(connection("pd.tau[1]", "plant.tau_cmd[1]"), "")
    system = loop(tmp_path / "loop.ssp", plant, pd, ssd(f"{BOTH}<ssd:Connections>{wires}</ssd:Connections>"))
    expected = by_hand(plant, tmp_path / "plant.fmu", lambda q, v: np.array([0.02, law(q[[0, 0]], v)[1]]))
    settings = {**GAINS, "pd.q_des": TARGET, "plant.tau_cmd[1]": 0.02}
    run = twodof.samples(system, step=H, stop_time=N * H, settings=settings)
    np.testing.assert_array_equal([sample.q for sample in run], expected)


def test_an_array_of_whole_numbers_is_set_with_whole_numbers(tmp_path: Path) -> None:
    """The elements that are not set start at 0 or at no value; FMPy refuses a float."""
    variables = '<Float64 name="time" valueReference="9" causality="independent" variability="continuous"/>'
    for k, start in enumerate((' start="0 0"', "")):
        kind = 'causality="parameter" variability="fixed"' if start else 'causality="local"'
        variables += f'<Int32 name="n{k}" valueReference="{k}" {kind}{start}><Dimension start="2"/></Int32>'
    (tmp_path / "n.fmu").write_bytes(described(variables, version="3.0"))
    set_to: list[list[object]] = []

    class WithoutLibrary(Instance):
        def _instantiate(self, **what: str) -> Any:
            self._rest = ()
            self._setters = {"Integer": lambda references, numbers: set_to.append(numbers)}
            return SimpleNamespace(component=None)

    instance = WithoutLibrary(load_any_fmu(tmp_path / "n.fmu"), tmp_path)
    instance.set({"n0[2]": 4})
    instance.set({"n1[1]": 4})
    assert set_to == [[0, 4], [4, 0]] and {type(number) for numbers in set_to for number in numbers} == {int}


@pytest.mark.parametrize("first", [1, 2])
@pytest.mark.parametrize("fmi", [2, 3])
def test_elements_of_an_array_may_come_at_different_depths_of_feedthrough(
    pd: bytes, tmp_path: Path, fmi: int, first: int
) -> None:
    """One element is a velocity, the other the output of a controller that depends on it."""
    options = twodof.FmuOptions(native=True, fmi=fmi, control="effort")
    plant = twodof.build_fmu(tmp_path / "plant.fmu", options).read_bytes()
    wires = WIRES.replace(connection(f"pd.tau[{first}]", f"plant.tau_cmd[{first}]"), "")
    wires += connection("plant.v[1]", f"plant.tau_cmd[{first}]", more='suppressUnitConversion="true"')
    system = loop(tmp_path / "loop.ssp", plant, pd, ssd(f"{BOTH}<ssd:Connections>{wires}</ssd:Connections>"))
    efforts = (lambda q, v: np.array([v[0], law(q, v)[1]]), lambda q, v: np.array([law(q, v)[0], v[0]]))
    expected = by_hand(plant, tmp_path / "plant.fmu", efforts[first - 1])
    run = twodof.samples(system, step=H, stop_time=N * H, settings={**GAINS, "pd.q_des": TARGET})
    np.testing.assert_array_equal([sample.q for sample in run], expected)


def test_an_input_that_changes_acts_from_that_instant(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    targets = [TARGET if k < 20 else -TARGET for k in range(N + 1)]
    system = loop(tmp_path / "loop.ssp", plant, pd)
    run = twodof.samples(system, step=H, stop_time=N * H, settings={**GAINS, "pd.q_des": TARGET})
    rows = [next(run).q]
    for target in targets[:-1]:
        rows.append(run.send({"pd.q_des": target}).q)
    (tmp_path / "plant.fmu").write_bytes(plant)
    other = twodof.samples(tmp_path / "plant.fmu", step=H, stop_time=N * H)
    sample, expected = next(other), []
    for target in targets[:-1]:
        expected.append(sample.q)
        sample = other.send({"tau_cmd": 0.1 * (target - np.array(sample.q)) - 0.01 * np.array(sample.v)})
    np.testing.assert_array_equal(rows, [*expected, sample.q])


def test_the_bag_of_a_system_names_its_fmus_and_info_draws_it(
    plant: bytes, pd: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    system, bag = loop(tmp_path / "loop.ssp", plant, pd), tmp_path / "bag"
    gains = [text for name, value in GAINS.items() for text in ("--set", f"{name}={value}")]
    times = ["--stop-time", "0.5", "--set", "plant.payload=0.02", "--set", "pd.q_des=0.3,0.2"]
    assert main(["run", str(system), "-o", str(bag), *times, *gains, "--scene", "--effort"]) == 0
    recorded = twodof.read_bag(bag)
    np.testing.assert_array_equal(recorded.q, by_hand(plant, tmp_path / "plant.fmu", payload=0.02))
    provenance = json.loads((bag / "run.json").read_text())
    assert provenance["start_values"]["pd.Kp"] == 0.1
    assert provenance["start_values"]["payload"] == 0.02
    assert [*provenance["system"]["components"]] == ["plant", "pd"]
    capsys.readouterr()
    assert main(["info", str(system)]) == 0
    assert "pd.tau -> plant.tau_cmd, 2 values" in capsys.readouterr().out


def test_signals_of_all_fmus_are_in_a_topic(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    """They have names, by which PlotJuggler plots them; this includes a robot's own FMU."""
    system, bag = loop(tmp_path / "loop.ssp", plant, pd), tmp_path / "bag"
    given = [text for name, value in {**GAINS, "pd.q_des": "0.3,0.2"}.items() for text in ("--set", f"{name}={value}")]
    assert main(["run", str(system), "-o", str(bag), "--stop-time", "0.5", "--signals", "--scene", *given]) == 0
    messages = [(topic, message) for topic, message in decoded(bag) if topic.startswith("/signals")]
    (_, named), *valued = messages  # the names come first
    names, rows = named.names, np.array([message.values for _, message in valued])
    assert {topic for topic, _ in valued} == {"/signals/values"}
    assert {message.names_version for _, message in valued} == {named.names_version} != {0}
    assert names == json.loads((bag / "run.json").read_text())["signals"]
    signals, recorded = dict(zip(names, rows.T, strict=True)), twodof.read_bag(bag)
    assert len(rows) == recorded.count == N + 1
    for i in range(2):
        np.testing.assert_array_equal(signals[f"q[{i + 1}]"], recorded.q[:, i])
        expected = 0.1 * (TARGET[i] - recorded.q[:, i]) - 0.01 * recorded.v[:, i]
        np.testing.assert_allclose(signals[f"pd.tau[{i + 1}]"], expected, rtol=0, atol=1e-15)
    alone = tmp_path / "plant.fmu"
    alone.write_bytes(plant)
    run = twodof.experiment(alone, signals=True, stop_time=0.02)
    for sample in twodof.samples(run):
        assert dict(zip(run.signals, sample.signals))["x[1]"] == sample.x[0]


def decoded(bag: Path) -> list[tuple[str, Any]]:
    """Return topics and messages of an MCAP bag by the MCAP project's reader."""
    with next(bag.glob("*.mcap")).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [(channel.topic, message) for _, channel, _, message in reader.iter_decoded_messages()]


def test_of_several_robots_one_is_chosen(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    elements = component("plant") + component("plant").replace('name="plant"', 'name="left"')
    two = loop(tmp_path / "two.ssp", plant, pd, ssd(f"<ssd:Elements>{elements}</ssd:Elements>"))
    with pytest.raises(FmuError, match=r"choose one by `robot` of 'twodof run', .* load_fmu: plant, left"):
        twodof.load_fmu(two)
    fmu = twodof.load_fmu(two, "left")
    assert fmu.start_values["plant.payload"] == fmu.start_values["payload"] == 0.0
    free = by_hand(plant, tmp_path / "plant.fmu", lambda q, v: np.zeros(2), payload=0.1)
    rows = [s.q for s in twodof.samples(fmu, step=H, stop_time=N * H, settings={"left.payload": 0.1})]
    np.testing.assert_array_equal(rows, free)
    with pytest.raises(FmuError, match="no component 'lefd'; did you mean 'left'"):
        twodof.load_fmu(two, "lefd")


def crossed(unit: str = 'suppressUnitConversion="true"') -> bytes:
    """Return a structure in which two controllers are connected in a loop."""
    twin = component("pd").replace('name="pd"', 'name="twin"')
    wires = WIRES + connection("pd.tau[1]", "twin.q[1]", more=unit)
    wires = wires.replace(connection("plant.q[1]", "pd.q[1]"), connection("twin.tau[1]", "pd.q[1]", more=unit))
    return ssd(
        f"<ssd:Elements>{component('plant')}{component('pd')}{twin}</ssd:Elements>"
        f"<ssd:Connections>{wires}</ssd:Connections>"
    )


def test_an_algebraic_loop_is_named(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    way = r"(?=.*pd\.q\[1\] -> pd\.tau\[1\])(?=.*twin\.q\[1\] -> twin\.tau\[1\])"
    for controller in (pd, pd_fmu(feedthrough="")):  # without dependencies an output depends on every input
        with pytest.raises(FmuError, match=f"algebraic loop: {way}"):
            twodof.load_fmu(loop(tmp_path / "loop.ssp", plant, controller, crossed()))
    delays = pd_fmu(feedthrough='dependencies=""')
    assert len(q_of(loop(tmp_path / "loop.ssp", plant, delays, crossed()))) == N + 1


@pytest.mark.parametrize("initial", ['dependencies="{}"', "", None])
def test_start_values_pass_in_the_order_of_initial_unknowns(plant: bytes, tmp_path: Path, initial: str | None) -> None:
    """Outputs that depend on inputs only at the start, three in a row, are right at the start, stated or not."""
    row = ["pd", "twin", "third"]
    parts = "".join(component("pd").replace('name="pd"', f'name="{name}"') for name in row[::-1])
    wires = connection("plant.q[1]", "pd.q[1]") + connection("third.tau[1]", "plant.tau_cmd[1]")
    free = 'suppressUnitConversion="true"'
    wires += "".join(connection(f"{a}.tau[1]", f"{b}.q[1]", more=free) for a, b in pairwise(row))
    text = f"<ssd:Elements>{parts}{component('plant')}</ssd:Elements><ssd:Connections>{wires}</ssd:Connections>"
    system = loop(tmp_path / "loop.ssp", plant, pd_fmu('dependencies=""', initial=initial), ssd(text))
    run = twodof.experiment(system, signals=True, settings={f"{name}.Kp": 2.0 for name in row} | {"q_start": 0.5})
    with closing(twodof.samples(run)) as samples:
        first = dict(zip(run.signals, next(samples).signals))
    assert [first["pd.tau[1]"], first["twin.tau[1]"], first["third.tau[1]"], first["tau[1]"]] == [-1.0, 2.0, -4.0, -4.0]


def test_an_algebraic_loop_at_the_start_is_refused(plant: bytes, tmp_path: Path) -> None:
    stated = pd_fmu('dependencies=""', initial='dependencies="{}"')
    way = r"(?=.*pd\.q\[1\] -> pd\.tau\[1\])(?=.*twin\.q\[1\] -> twin\.tau\[1\])"
    with pytest.raises(FmuError, match=f"algebraic loop at its start: {way}"):
        twodof.load_fmu(loop(tmp_path / "loop.ssp", plant, stated, crossed()))
    unstated = loop(tmp_path / "loop.ssp", plant, pd_fmu('dependencies=""', initial=""), crossed())
    with pytest.raises(SimulationError, match=r"'(pd|twin)\.tau\[1\]' changes with each evaluation in initialis"):
        q_of(unstated, pd__Kp=1.0, pd__q_des=0.3)


def refusals() -> Iterator[tuple[str, bytes | None, dict[str, bytes], str]]:
    """Yield names, structures, files and messages of systems that are refused."""
    wired = f"{BOTH}<ssd:Connections>{WIRES}</ssd:Connections>"
    yield "units", crossed(""), {}, "units of different dimensions, 'N.m' and 'rad'"
    more = f"{BOTH}<ssd:Connections>{WIRES}{{}}</ssd:Connections>"
    yield "twice", ssd(more.format(connection("pd.tau[1]", "plant.tau_cmd[2]"))), {}, "two connections end at"
    yield "no variable", ssd(more.format(connection("pd.tau[9]", "plant.tau_ext[1]"))), {}, r"did you mean 'tau\["
    yield "no element", ssd(more.format(connection("dp.tau[1]", "plant.tau_ext[1]"))), {}, "names 'dp'"
    yield "outputs", ssd(more.format(connection("pd.tau[1]", "plant.q[1]"))), {}, "not from an output to an input"
    yield "types", ssd(more.format(connection("pd.steps", "plant.tau_ext[1]"))), {}, "of type Integer and Real"
    for kind, name in (("String", "text"), ("Enumeration", "mode")):
        own = connectors({"word": "input"}, "")
        system = ssd(own + more.format(connection("word", f"pd.{name}")))
        yield kind, system, {}, f"'word' and 'pd.{name}' are of type {kind}: not supported"
    parts = wired.replace(component("pd"), component("pd", binding(values("text Binary 00"))))
    yield "Binary value", ssd(parts), {}, r"the value of 'pd\.text', '00', is a Binary for another type: not supported"
    negation = '><ssc:LinearTransformation factor="-1" offset="1"/></ssm:MappingEntry></ssm'
    turned = mapping("a limit_effort").replace("/></ssm", negation, 1)
    own = component("plant", binding(values("a Boolean true"), turned))
    parts = wired.replace(component("plant"), own)
    yield "Boolean value", ssd(parts), {}, r"the value of 'plant\.limit_effort' is a Boolean, which is not transformed"
    me = wired.replace("source=", 'implementation="ModelExchange" source=', 1)
    yield "Model Exchange", ssd(me), {}, "component 'plant' is a Model Exchange FMU"
    yield "version", ssd(wired).replace(b'version="1.0" name', b'version="3.0" name'), {}, "The value '3.0' is not"
    own = '<ssc:MapEntry source="true" target="false"/>'.join(
        ("<ssc:BooleanMappingTransformation>", "</ssc:BooleanMappingTransformation>")
    )
    yield "mapping", ssd(more.format(connection("pd.steps", "plant.seed", own))), {}, "BooleanMappingTransformation"
    far = 'source="file:///etc/passwd"'
    yield "far", ssd(wired.replace('source="resources/pd.fmu"', far)), {}, "is not a file in it"
    yield "up", ssd(wired.replace("resources/pd.fmu", "../pd.fmu")), {}, "is not a file in it"
    proxy = "proxyfmu://localhost?file=resources/pd.fmu"
    yield "proxy", ssd(wired.replace("resources/pd.fmu", proxy)), {}, r"'proxyfmu://.*' of 'pd' is not a file in it"
    dictionary = '<ssb:SignalDictionary xmlns:ssb="http://ssp-standard.org/SSP1/SystemStructureSignalDictionary" '
    entry = '<ssb:DictionaryEntry name="speed"><ssc:Real/></ssb:DictionaryEntry>'
    bus = f'{dictionary}version="1.0">{entry}</ssb:SignalDictionary>'
    bus = f'<ssd:SignalDictionary name="bus">{bus}</ssd:SignalDictionary>'
    bus = f"{wired}<ssd:SignalDictionaries>{bus}</ssd:SignalDictionaries>"
    yield "dictionary", ssd(bus), {}, "system 'of all' has signal dictionaries: not supported"
    own = binding(attributes='source="set.ssv" sourceBase="component"')
    parts = wired.replace(component("pd"), component("pd", own))
    yield "set in an FMU", ssd(parts), {}, "'pd' has a parameter file inside its FMU: not supported"
    parts = wired.replace(component("pd"), component("pd", binding(attributes='source="set.ssv"')))
    bare = b'<ssv:ParameterSet version="1.0" name="s"><ssv:Parameters/></ssv:ParameterSet>'
    yield "no namespace", ssd(parts), {"set.ssv": bare}, r"set\.ssv is not valid SSP 1\.0: .* root\.$"
    note = '<ssd:Annotations><ssc:Annotation type="x"/></ssd:Annotations>'
    yield "order", ssd(note + wired), {}, r"Elements': This element is not expected\.$"
    alone = ssd(f"<ssd:Elements>{component('pd')}</ssd:Elements>")
    yield "no robot", alone, {}, r"no components with outputs q\[i\] and v\[i\] among pd"
    package = 'type="application/x-ssp-package" source='
    yield "package", ssd(wired.replace("source=", package, 1)), {}, "of type application/x-ssp-package"
    dotted, inner = (component("pd").replace('name="pd"', f'name="{name}"') for name in ("a.b", "b"))
    inner = f'<ssd:System name="a"><ssd:Elements>{inner}</ssd:Elements></ssd:System>'
    elements = BOTH.replace("</ssd:Elements>", f"{dotted}{inner}</ssd:Elements>")
    yield "names", ssd(elements), {}, "two elements have the name 'a.b'"
    yield "schema", ssd(wired.replace("ssd:Elements", "ssd:Parts")), {}, "is not valid SSP 1.0"
    yield "entities", b"<!DOCTYPE x [<!ENTITY a 'b'>]>" + ssd(wired), {}, "declares entities"
    many = "".join(f'<ssd:Component name="c{i}" source="resources/pd.fmu"/>' for i in range(10_000))
    yield "many", ssd(f"<ssd:Elements>{many}</ssd:Elements>"), {}, "more than 100 components"
    deep = '<ssd:System name="s"><ssd:Elements>' * 500 + "</ssd:Elements></ssd:System>" * 500
    yield "deep", ssd(f"<ssd:Elements>{deep}</ssd:Elements>"), {}, "is not valid SSP 1.0"
    yield "slip", None, {"../out": b""}, "is outside of its folder"
    units = f"<ssd:Units>{DEGREE}<ssc:Unit name='turn'><ssc:BaseUnit/></ssc:Unit></ssd:Units>"
    for kind, text, message in (
        ("<ssc:Real{}/>", "input deg", r"'pd\.q\[1\]' states the unit 'deg', and its FMU another, 'rad'"),
        ("<ssc:Real{}/>", "input turn", r"'pd\.q\[1\]' states the unit 'turn', and its FMU another, 'rad'"),
        ("<ssc:Real{}/>", "input furlong", r"the unit 'furlong' without a definition, and its FMU 'rad'"),
        ("<ssc:Real/>", "output", r"'pd\.q\[1\]' states the kind output, and its FMU input"),
        ("<ssc:Integer/>", "input", r"'pd\.q\[1\]' states the type Integer, and its FMU Real"),
    ):
        parts = wired.replace(component("pd"), component("pd", connectors({"q[1]": text}, kind)))
        yield f"connector {text} {kind[5:9]}", ssd(parts, units), {}, message
    for name, inner in (
        ("set", binding(values("Kp Real 1", "Kd Real 2", "Kp Real 3"))),
        ("map", binding(values("a Real 1", "b Real 2"), mapping("a Kp", "b Kp"))),
    ):
        parts = wired.replace(component("pd"), component("pd", inner))
        yield f"{name} twice", ssd(parts), {}, r"of 'pd' sets 'Kp' twice"
    parts = wired.replace(component("pd"), component("pd", binding(values("seen Real 4294967299"))))
    yield "32 bits", ssd(parts), {}, "seen = 4294967299 must be in .-2147483648, 2147483647."
    both = connection("k", "pd.q_des[1]") + connection("k", "pd.seen")
    own = connectors({"k": "input"}) + more.format(both)
    yield "two types", ssd(own), {}, "the connector 'k' goes to variables of type Integer and Real"
    yield "no FMU", None, {"resources/pd.fmu": b"PK no zip"}, "resources/pd.fmu' is not an FMU"
    slip = zipped({"modelDescription.xml": b"<a/>", "../out": b""})
    yield "FMU slips", None, {"resources/pd.fmu": slip}, "is outside of its folder"
    circle = "".join(
        f'<ssd:System name="{a}">{connectors({"x": "input", "y": "output"})}<ssd:Connections>{connection("x", "y")}'
        "</ssd:Connections></ssd:System>"
        for a in "ab"
    )
    ring = connection("a.y", "b.x") + connection("b.y", "a.x") + WIRES
    ring = ring.replace(connection("plant.q[1]", "pd.q[1]"), connection("a.y", "pd.q[1]"))
    parts = BOTH.replace("</ssd:Elements>", circle + "</ssd:Elements>")
    yield "circle", ssd(f"{parts}<ssd:Connections>{ring}</ssd:Connections>"), {}, "cycle of systems"
    ends = [*range(120)]
    through = connectors({f"x{k}": "input" for k in ends} | {f"y{k}": "output" for k in ends})
    within = "".join(connection(f"x{k}", f"y{k}") for k in ends)
    row = "".join(connection(f"a.y{k}", f"a.x{k + 1}") for k in ends[:-1]) + connection("a.y119", "pd.q_des[1]")
    snake = f'<ssd:System name="a">{through}<ssd:Connections>{within}</ssd:Connections></ssd:System>'
    parts = BOTH.replace("</ssd:Elements>", snake + "</ssd:Elements>")
    yield "long", ssd(f"{parts}<ssd:Connections>{row}</ssd:Connections>"), {}, "or longer than 100"
    empty = "".join(f'<ssd:System name="s{k}"/>' for k in range(101))
    yield "systems", ssd(f"<ssd:Elements>{empty}</ssd:Elements>"), {}, "more than 100 components and systems"
    kilobytes = values(*(f"p{k} Real 1" for k in range(2000)))
    again = '<ssd:ParameterBinding source="p.ssv"/>' * 100
    again = f"<ssd:ParameterBindings>{again}</ssd:ParameterBindings>"
    yield "bound again", ssd(again + BOTH), {"p.ssv": kilobytes.encode()}, "have more than 8388608 bytes"
    deep = f"<ssd:Elements>{component('plant')}</ssd:Elements>"
    for k in range(80):
        deep = f'<ssd:Elements><ssd:System name="{"n" * 50_000}{k}">{deep}</ssd:System></ssd:Elements>'
    yield "long names", ssd(deep), {}, "has a name of more than 1000 characters"
    offset = "<ssd:Units><ssc:Unit name='u'><ssc:BaseUnit rad='1' {}/></ssc:Unit></ssd:Units>"
    own = connectors({"x": "input u"}) + BOTH + f"<ssd:Connections>{connection('x', 'pd.q[1]')}</ssd:Connections>"
    yield "infinite offset", ssd(own, offset.format("offset='INF'")), {}, "have no finite conversion"
    yield "factor 0", ssd(own, offset.format("factor='0'")), {}, "has no valid factor"
    yield from large_systems()


def described(
    variables: str,
    structure: str = "",
    version: str = "2.0",
    files: Mapping[str, bytes] = MappingProxyType({}),
    types: str = "",
) -> bytes:
    """Return an FMU of its description and other files."""
    identity = "guid" if version == "2.0" else "instantiationToken"
    xml = (
        f'<fmiModelDescription fmiVersion="{version}" modelName="m" {identity}="m">'
        f'<CoSimulation modelIdentifier="m"/>{types}<ModelVariables>{variables}</ModelVariables>'
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )
    return zipped({"modelDescription.xml": xml.encode(), **files})


def large_systems() -> Iterator[tuple[str, bytes, dict[str, bytes], str]]:
    """Yield systems of a few files in which the number of values multiplies."""
    array = described(
        '<Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>'
        '<Float64 name="u" valueReference="1" causality="input" start="0"><Dimension start="49000"/></Float64>',
        version="3.0",
    )
    many = "".join(component(f"c{k}").replace(f"c{k}.fmu", "u.fmu") for k in range(99))
    variables = "components have more than 200000 variables"
    yield "arrays", ssd(f"<ssd:Elements>{many}</ssd:Elements>"), {"resources/u.fmu": array}, variables

    names = [f"u{k}" for k in range(15_000)]
    scalars = "".join(
        f'<ScalarVariable name="{name}" valueReference="{k}" causality="input" variability="continuous">'
        '<Real start="0"/></ScalarVariable>'
        for k, name in enumerate(names)
    )
    parts = component("u")
    inside = "".join(connection("x", f"u.{name}") for name in names)
    for _ in range(95):
        parts = (
            f'<ssd:System name="s">{connectors({"x": "input"})}<ssd:Elements>{parts}</ssd:Elements>'
            f"<ssd:Connections>{inside}</ssd:Connections></ssd:System>"
        )
        inside = connection("x", "s.x")
    wiring = "more than 1000000 connections"
    yield "row", ssd(f"<ssd:Elements>{parts}</ssd:Elements>"), {"resources/u.fmu": described(scalars)}, wiring

    numbers = random.Random(1)
    scalars = "".join(
        f'<ScalarVariable name="{name}" valueReference="{k}" causality="input" variability="continuous">'
        '<Real start="0"/></ScalarVariable>'
        for k, name in enumerate(format(numbers.getrandbits(180), "0180b") for _ in range(20_000))
    )
    wires = f"<ssd:Connections>{connection('u.' + '01' * 90, 'u.x')}</ssd:Connections>"
    system = ssd(f"<ssd:Elements>{component('u')}</ssd:Elements>{wires}")
    yield (
        "names",
        system,
        {"resources/u.fmu": described(scalars)},
        "there is no 'u.0101.* there are: .{3000,5000} in all$",
    )

    scalar = '<ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>'
    full = described(scalar, files={f"x{i}": b"" for i in range(9900)})
    several = "".join(component(f"c{k}") for k in range(6))
    fmus = {f"resources/c{k}.fmu": full for k in range(6)}
    yield "files", ssd(f"<ssd:Elements>{several}</ssd:Elements>"), fmus, "FMUs have more than 50000 files together"

    few = range(1500)
    kinds = {"u": ("input", "start='0'"), "y": ("output", "")}
    both = "".join(
        f'<ScalarVariable name="{name}{k}" valueReference="{2 * k + (name == "y")}" causality="{kind}"'
        f' variability="continuous"><Real {start}/></ScalarVariable>'
        for k in few
        for name, (kind, start) in kinds.items()
    )
    unknown = "".join(f'<Unknown index="{2 * k + 2}"/>' for k in few)
    wires = "".join(connection(f"{a}.y{k}", f"{b}.u{k}") for k in few for a, b in ("ab", "bc"))
    parts = "".join(component(name).replace(f"{name}.fmu", "u.fmu") for name in "abc")
    system = ssd(f"<ssd:Elements>{parts}</ssd:Elements><ssd:Connections>{wires}</ssd:Connections>")
    yield "feedthrough", system, {"resources/u.fmu": described(both, f"<Outputs>{unknown}</Outputs>")}, wiring


@pytest.mark.parametrize(
    ("structure", "files", "message"), [row[1:] for row in refusals()], ids=[row[0] for row in refusals()]
)
def test_invalid_systems_are_refused_at_once(
    plant: bytes, pd: bytes, tmp_path: Path, structure: bytes | None, files: dict[str, bytes], message: str
) -> None:
    system = loop(tmp_path / "bad.ssp", plant, pd, structure, **files)
    begun = time.process_time()
    with pytest.raises(FmuError, match=re.compile(message)):
        twodof.load_fmu(system)
    assert time.process_time() - begun < 10.0  # the budget of docs/guarantees.md; the slowest needs 1.5 s
    assert [*tmp_path.iterdir()] == [system]


def test_the_fmus_of_a_system_have_a_limited_size(
    plant: bytes, pd: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = loop(tmp_path / "loop.ssp", plant, pd)
    monkeypatch.setattr(ssp_file, "MAX_FMUS", len(plant) + len(pd))
    twodof.load_fmu(system)
    monkeypatch.setattr(ssp_file, "MAX_FMUS", len(plant) + len(pd) - 1)
    with pytest.raises(FmuError, match="its FMUs have more than 0 MiB together"):
        twodof.load_fmu(system)


def test_an_fmu_that_is_a_link_is_refused(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    system = loop(tmp_path / "link.ssp", plant, pd)
    link = zipfile.ZipInfo("resources/link.fmu")
    link.external_attr = 0o120777 << 16
    with zipfile.ZipFile(system, "a") as archive:
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(FmuError, match="is outside of its folder"):
        twodof.load_fmu(system)


def test_a_refused_step_names_its_component(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    system = loop(tmp_path / "loop.ssp", plant, pd)
    with pytest.raises(InputError, match=r"pd\.q\[1\] cannot be set: a connection drives it from plant\.q\[1\]"):
        twodof.experiment(system, settings={"pd.q": 1.0})
    with pytest.raises(FmuError, match=r"'pd', the `robot`, has no outputs q\[i\] and v\[i\]; there are: plant"):
        twodof.load_fmu(system, "pd")
    with pytest.raises(InputError, match=r"pd\.tau"):
        twodof.experiment(system, settings={"pd.tau[1]": 1.0})
    with pytest.raises(twodof.TwoDofError, match=r"'plant': tau_cmd\[1\] = inf is not finite"):
        twodof.simulate(system, step=H, stop_time=N * H, settings={"pd.Kp": 1e300, "pd.q_des": 1e300})


def test_options_of_a_single_fmu_are_refused_for_a_system(plant: bytes, pd: bytes, tmp_path: Path) -> None:
    system = loop(tmp_path / "loop.ssp", plant, pd)
    with pytest.raises(InputError, match="is a system"):
        twodof.linearise(system)
    with pytest.raises(twodof.TwoDofError, match="is not a native FMU of twodof"):
        twodof.page(system, tmp_path / "page.html")
    with pytest.raises(FmuError, match="no outputs q"):
        (tmp_path / "pd.fmu").write_bytes(pd)
        twodof.load_fmu(tmp_path / "pd.fmu")


def test_a_check_reads_descriptions_of_limited_size(tmp_path: Path) -> None:
    """Each of a hundred small FMUs can have a description that takes seconds to check."""
    large = zipped({"modelDescription.xml": b"<fmiModelDescription/>".ljust(6_000_000)})
    names = [f"c{i}" for i in range(3)]
    structure = ssd(f"<ssd:Elements>{''.join(map(component, names))}</ssd:Elements>")
    path = tmp_path / "large.ssp"
    path.write_bytes(zipped({"SystemStructure.ssd": structure, **{f"resources/{n}.fmu": large for n in names}}))
    with pytest.raises(twodof.TwoDofError, match=r"large.ssp': its FMUs have descriptions of more than 16777216 bytes"):
        twodof.check(path)
