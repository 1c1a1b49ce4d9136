"""Checks of FMUs of this project, and of a third-party FMU with one fault at a time."""

from __future__ import annotations

import json
import re
import subprocess
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET
from xml.sax.saxutils import quoteattr

import fmpy
import pytest
from fmpy.model_description import ModelDescription, ModelVariable
from fmpy.validation import _validate_variable_names
from systems import component, connection, loop, pd_fmu, ssd, zipped
from tools import needs

import twodof
from twodof.cli.main import main
from twodof.errors import ChildError, InputError
from twodof.fmu import Instance, checking, instantiate, load_any_fmu
from twodof.fmu.description import problems_of
from twodof.fmu.trials import TRIALS
from twodof.fmu.validation import problems_of_names

DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="Foreign" guid="1" numberOfEventIndicators="0">
<CoSimulation modelIdentifier="Foreign" canHandleVariableCommunicationStepSize="true" canGetAndSetFMUstate="true"
 canSerializeFMUstate="true" providesDirectionalDerivative="true"/>
<DefaultExperiment startTime="0" stopTime="1" stepSize="0.01"/>
<ModelVariables>
<ScalarVariable name="u" valueReference="1" causality="input"><Real start="0"/></ScalarVariable>
<ScalarVariable name="x" valueReference="2" initial="exact"><Real start="1"/></ScalarVariable>
<ScalarVariable name="der(x)" valueReference="3"><Real derivative="2"/></ScalarVariable>
<ScalarVariable name="y" valueReference="4" causality="output"><Real/></ScalarVariable>
<ScalarVariable name="p" valueReference="5" causality="parameter" variability="fixed"><Real start="1"/></ScalarVariable>
</ModelVariables>
<ModelStructure>
<Outputs><Unknown index="4"/></Outputs><Derivatives><Unknown index="3"/></Derivatives>
<InitialUnknowns><Unknown index="3"/><Unknown index="4"/></InitialUnknowns>
</ModelStructure>
</fmiModelDescription>
"""
COUNT = """<ScalarVariable name="n" valueReference="6" causality="output" variability="discrete"><Integer/>
</ScalarVariable></ModelVariables>"""
DISCRETE = """<ScalarVariable name="k" valueReference="7" causality="input" variability="discrete">
<Integer start="3" max="3"/></ScalarVariable>
<ScalarVariable name="b" valueReference="8" causality="parameter" variability="fixed"><Boolean start="false"/>
</ScalarVariable></ModelVariables>"""
TYPED = """<ScalarVariable name="item" valueReference="11" causality="input" variability="discrete">
<Enumeration declaredType="E" start="2"/></ScalarVariable>
<ScalarVariable name="text" valueReference="12" causality="parameter" variability="fixed">
<String start="text"/></ScalarVariable><ScalarVariable name="z" valueReference="8" causality="output"><Real/>
</ScalarVariable><ScalarVariable name="c" valueReference="13" causality="output" variability="discrete"><Boolean/>
</ScalarVariable>
</ModelVariables>"""
ITEMS = '<Item name="a" value="2"/><Item name="b" value="1"/>'
ALSO_INDEX = '<Unknown index="4"/>', '<Unknown index="4"/><Unknown index="6"/>'
MODEL_EXCHANGE = re.sub("<CoSimulation.*?/>", '<ModelExchange modelIdentifier="F"/>', DESCRIPTION, flags=re.DOTALL)
MORE = """<ScalarVariable name="t" valueReference="9" causality="independent"><Real/></ScalarVariable>
<ScalarVariable name="g" valueReference="10" variability="constant"><Real start="9.81"/></ScalarVariable>
</ModelVariables>"""
DESCRIPTION_3 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="Foreign" instantiationToken="1">
<CoSimulation modelIdentifier="Foreign" canHandleVariableCommunicationStepSize="true" canGetAndSetFMUState="true"
 canSerializeFMUState="true" providesDirectionalDerivatives="true"/>
<DefaultExperiment startTime="0" stopTime="1" stepSize="0.01"/>
<ModelVariables>
<Float64 name="u" valueReference="1" causality="input" start="0"/>
<Float64 name="x" valueReference="2" initial="exact" start="1"/>
<Float64 name="der(x)" valueReference="3" derivative="2"/>
<Float64 name="y" valueReference="4" causality="output"/>
<Float64 name="p" valueReference="5" causality="parameter" variability="fixed" start="1"/>
<Float64 name="t" valueReference="9" causality="independent"/>
<Float64 name="g" valueReference="10" variability="constant" start="9.81"/>
</ModelVariables>
<ModelStructure>
<Output valueReference="4"/><ContinuousStateDerivative valueReference="3"/>
<InitialUnknown valueReference="3"/><InitialUnknown valueReference="4"/>
</ModelStructure>
</fmiModelDescription>
"""
OVERWRITTEN = "at the state that was saved into an existing one: y is"
STATES = "state", "serialised state"
OF_BOTH_VERSIONS = {
    "DESTROYS": ({*STATES}, "at the restored state, restored again: y is"),
    "KEEPS_HANDLE": ({*STATES}, OVERWRITTEN),
    "READS_STEER": ({"simulation"}, "in a run without reads between its steps: y is"),
    "NOT_EXACT": ({"start values"}, "x is 1.5 before it is set, and its start value is 1.0"),
    "NOT_CONSTANT": ({"start values"}, "g is 9.8 before it is set, and its start value is 9.81"),
    "WRONG_TIME": ({"simulation"}, "t, the independent variable, is 0.0101 at 0.01 s"),
}
FAULTS = {
    "KEEPS": ("reset", "after a reset: y is"),
    "SHARES": ("two instances", "beside a second instance: y is"),
    "SHARES_PARAMETER": ("two instances", "beside a second instance: y is"),
    "RESTORES_NOTHING": ("state", "at the restored state: y is"),
    "LOSES_BYTES": ("serialised state", "at the restored state: y is"),
    "WRONG_SLOPE": ("derivatives", "∂y/∂u is 2, and it gives 2.00002"),
    "CRASHES": ("state", "it ended its process at: restoring the state: Aborted"),
    "NOT_FINITE": ("simulation", "y is nan after 1 steps"),
    "DISCARDS": ("simulation", "a call failed, status discard: try another step size"),
    "READS_CHANGE": ("simulation", "in a second read at one time: y is"),
    "COUNTS": ("reset", "after a reset: n is"),
    "KEEPS_INPUT": ("reset", "u is 0.0001 after a reset, and its start value is 0.0"),
    "KEEPS_PARAMETER": ("reset", "p is 1.0001 after a reset, and its start value is 1.0"),
    "RESTORES_NO_INPUT": ("state", "at the restored state: y is"),
    "OLD_SLOPE": ("derivatives", "∂y/∂u is 3.937 after 19 steps, and it gives 2"),
    "KEEPS_INTEGER": ("reset", "k is 2 after a reset, and its start value is 3"),
    "KEEPS_BOOLEAN": ("reset", "b is True after a reset, and its start value is False"),
    "LOSES_TUNABLE": ("state", "at the restored state: y is"),
    "LOSES_INTEGER": ("state", "at the restored state: y is"),
    "ONE_SEED": ("derivatives", "the derivative of y with a seed of several variables is 2"),
}
ALSO = {
    "SHARES": ("state", "serialised state"),
    "SHARES_PARAMETER": ("serialised state",),
    "RESTORES_NOTHING": ("serialised state",),
    "RESTORES_NO_INPUT": ("serialised state",),
    "LOSES_TUNABLE": ("serialised state",),
    "LOSES_INTEGER": ("serialised state",),
    "CRASHES": ("serialised state",),
    "COUNTS": ("simulation", "two instances", "state", "serialised state", "derivatives"),
}
OF_ZEROS = {
    "NONE": ({}, {}),
    "KEEPS_ZERO": ({"reset": "w is 0.0001 after a reset, and its start value is 0.0"}, {}),
    "SHARES_ZERO": ({"two instances": "beside a second", "serialised state": "at the restored"}, {}),
    "LOSES_ZERO": ({"serialised state": "at the restored state: y is"}, {"state": "at the restored state: y is"}),
}
ZEROS = """<Real name="w" valueReference="14" causality="parameter" variability="fixed" start="0"/>
<Real name="s" valueReference="15" causality="parameter" variability="fixed" min="0" start="0"/></ModelVariables>"""
OF_OTHER_KINDS = "KEEPS_INTEGER", "KEEPS_BOOLEAN", "LOSES_TUNABLE", "LOSES_INTEGER"
OF_MORE_TYPES = {
    "NONE": (set(), ""),
    "ONE_STATE": ({*STATES}, "at the restored state: y is"),
    "NOT_FINITE_AT_START": ({"simulation"}, "y is nan after 0 steps"),
    "SMALL_SLOPE": ({"derivatives"}, "∂z/∂u is 1e-08, and it gives 5e-08"),
    "WRONG_TEXT": ({"start values"}, "text is 'wrong' before it is set, and its start value is 'text'"),
    "WRONG_ITEM": ({"start values"}, "item is 1 before it is set, and its start value is 2"),
    "KEEPS_TEXT": ({"reset"}, "text is 'text_' after a reset, and its start value is 'text'"),
    "LOSES_ITEM": ({*STATES}, "at the restored state: y is"),
    "READS_TWO": ({"simulation"}, "c is 2 after 0 steps"),
    "ROUNDS": (set(), ""),  # it adds and subtracts 3e5 within
    "DERIVATIVES_STEER": ({"derivatives"}, "after directional derivatives: y is"),
}
REMARK = "it accepts the end of an initialisation that was not begun, a step of a negative size, a step from another"


def foreign(folder: Path, fault: str = "NONE", description: str = DESCRIPTION, x: float = 1.0) -> Path:
    library, path = folder / "Foreign.so", folder / "Foreign.fmu"
    headers = Path(fmpy.__file__).parent / "c-code"
    fmi, text = 3 if 'fmiVersion="3.0"' in description else 2, ""
    source = Path(__file__).parent / "native" / ("foreign3.c" if fmi == 3 else "foreign.c")
    if fmi == 3:
        names = re.findall(r"TYPE +(fmi3\w+);", (headers / "fmi3Functions.h").read_text())
        own = source.read_text()
        text = "".join(
            f"int {name}(void) {{ return 3; }}\n"
            for name in names
            if f" {name}(" not in own and name != "fmi3GetVersion"
        )
    (folder / "rest.c").write_text(f'const char *fmi3GetVersion(void) {{ return "3.0"; }}\n{text}')
    defined = [f"-DFAULT={fault}", f"-DX={x}"]
    command = [needs("gcc"), "-shared", "-fPIC", *defined, f"-I{headers}", source, folder / "rest.c", "-o", library]
    subprocess.run([*map(str, command)], check=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        archive.write(library, f"binaries/{fmpy.platform_tuple if fmi == 3 else 'linux64'}/Foreign.so")
    return path


def failed(check: twodof.Check) -> dict[str, str]:
    return {row.name: row.text for row in check.rows if row.outcome == "failed"}


@pytest.mark.parametrize("kind", ["python", "2", "3", "scalars"])
def test_fmus_of_this_project_pass(kind: str, tmp_path: Path, fmu_path: Path, native_path: Path) -> None:
    options = twodof.FmuOptions(native=True, fmi=3, arrays=kind == "3", control="pose")
    paths = {"python": fmu_path, "2": native_path}
    path = paths.get(kind) or twodof.build_fmu(tmp_path / "arm.fmu", options)
    check = twodof.check(path)
    outcomes = {row.name: row.outcome for row in check.rows}
    assert {name for name, outcome in outcomes.items() if outcome != "passed"} == (
        {"references", "derivatives", *STATES} if kind == "python" else {"references"}
    ), str(check)
    assert len(outcomes) == 12 and check.passed


@pytest.mark.parametrize("more", ["</ModelVariables>", DISCRETE])
def test_a_third_party_fmu_passes_with_a_remark(more: str, tmp_path: Path) -> None:
    check = twodof.check(foreign(tmp_path, description=DESCRIPTION.replace("</ModelVariables>", more)))
    others = {row.name: row.outcome for row in check.rows if row.outcome != "passed"}
    assert others == {"call order": "remark", "references": "does not apply"}
    assert check.rows[-2].text.startswith(REMARK)


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_fails_its_row(fault: str, tmp_path: Path) -> None:
    """A crash affects no other row."""
    row, text = FAULTS[fault]
    described = DESCRIPTION
    if fault == "COUNTS":
        described = DESCRIPTION.replace("</ModelVariables>", COUNT).replace(*ALSO_INDEX)
    if fault in OF_OTHER_KINDS:
        described = DESCRIPTION.replace("</ModelVariables>", DISCRETE).replace('="fixed"><Real', '="tunable"><Real')
    check = twodof.check(foreign(tmp_path, fault, described))
    assert failed(check)[row].startswith(text)
    if fault not in ("NOT_FINITE", "DISCARDS", "READS_CHANGE"):
        assert {*failed(check)} == {row, *ALSO.get(fault, ())}
    assert not check.passed and len(check.rows) == 12


@pytest.mark.parametrize("description", [DESCRIPTION.replace("</ModelVariables>", MORE), DESCRIPTION_3], ids="23")
@pytest.mark.parametrize("fault", ["NONE", *OF_BOTH_VERSIONS])
def test_a_fault_fails_its_row_in_both_versions(fault: str, description: str, tmp_path: Path) -> None:
    """FMI 2.0.5, sections 2.1.8 and 2.2.7; FMI 3.0.2, sections 2.2.5 and 2.4.7."""
    found = failed(twodof.check(foreign(tmp_path, fault, description)))
    rows, text = OF_BOTH_VERSIONS.get(fault, (set(), ""))
    assert {*found} >= rows and all(found[row].startswith(text) for row in rows), found
    assert fault in ("READS_STEER", "WRONG_TIME") or {*found} == rows


def typed(dependencies: str = "") -> str:
    """Return the description with inputs, parameters and outputs of more types."""
    types = f'<TypeDefinitions><SimpleType name="E"><Enumeration>{ITEMS}</Enumeration></SimpleType></TypeDefinitions>'
    described = DESCRIPTION.replace("</ModelVariables>", TYPED).replace("<DefaultExp", f"{types}<DefaultExp")
    known = f'<Unknown index="8"/><Unknown index="9"{dependencies}/>'
    for end in ("</Outputs>", "</InitialUnknowns>"):
        described = described.replace(end, known + end)
    return described


@pytest.mark.parametrize("fault", OF_MORE_TYPES)
def test_a_fault_of_more_types_fails_its_row(fault: str, tmp_path: Path) -> None:
    """FMI 2.0.5, sections 2.1.3 to 2.1.9 and 2.2.7."""
    rows, text = OF_MORE_TYPES[fault]
    found = failed(twodof.check(foreign(tmp_path, fault, typed())))
    assert {*found} >= rows and all(found[row].startswith(text) for row in rows), found
    assert rows or not found, found


@pytest.mark.parametrize("largest", [3, 4])
def test_integers_stay_in_their_range(largest: int, tmp_path: Path) -> None:
    """FMI 2.0.5, section 2.2.7: a value must be between min and max. The FMU aborts if its integer is not 3."""
    described = DESCRIPTION.replace("</ModelVariables>", DISCRETE.replace('max="3"', f'min="3" max="{largest}"'))
    found = failed(twodof.check(foreign(tmp_path, "STRICT", described)))
    assert bool(found) == (largest == 4), found


def test_an_undeclared_dependency_on_a_discrete_real_input_fails(tmp_path: Path) -> None:
    described = DESCRIPTION.replace('causality="input"', 'causality="input" variability="discrete"')
    described = described.replace('<Unknown index="4"/>', '<Unknown index="4" dependencies="2"/>')
    texts = failed(twodof.check(foreign(tmp_path, description=described)))
    assert texts == {"inputs": "y depends on u, and its InitialUnknown does not declare it"}


@pytest.mark.parametrize("output", ["c", "y"])
def test_undeclared_dependencies_of_and_on_discrete_variables_fail(output: str, tmp_path: Path) -> None:
    """A Boolean depends on a real input, or a real output on an enumeration."""
    described = typed(' dependencies="2"' if output == "c" else ' dependencies="1"')
    if output == "y":
        described = described.replace('<Unknown index="4"/>', '<Unknown index="4" dependencies="1 2"/>')
    found = failed(twodof.check(foreign(tmp_path, "LOSES_ITEM" if output == "y" else "NONE", described)))
    on = "item" if output == "y" else "u"
    assert found["inputs"] == f"{output} depends on {on}, and its InitialUnknown does not declare it"


@pytest.mark.parametrize("fault", ["NONE", "WRONG_TEXT", "WRONG_ITEM", "KEEPS_TEXT"])
def test_start_values_of_more_types_of_fmi_3_are_compared(fault: str, tmp_path: Path) -> None:
    more = '<UInt8 name="item" valueReference="11" causality="parameter" variability="fixed" start="2"/>'
    more += '<String name="text" valueReference="12" causality="parameter" variability="fixed"><Start value="text"/>'
    described = DESCRIPTION_3.replace("</ModelVariables>", f"{more}</String></ModelVariables>")
    found = failed(twodof.check(foreign(tmp_path, fault, described)))
    rows, text = OF_MORE_TYPES[fault]
    assert {*found} >= rows and all(found[row].startswith(text) for row in rows), found
    assert rows or not found, found


def test_a_process_that_does_not_start_is_no_fault_of_the_fmu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = foreign(tmp_path)
    monkeypatch.setattr(checking, "MAX_START_WAIT", 0.001)
    with pytest.raises(ChildError, match=r"did not start within 0.001 s: Killed; repeat the check when this machine"):
        twodof.check(path)


@pytest.mark.parametrize("description", [DESCRIPTION, DESCRIPTION_3], ids="23")
def test_a_pointer_to_a_freed_state_is_a_remark(description: str, tmp_path: Path) -> None:
    """FMI 2.0.5, section 2.1.8: fmi2FreeFMUstate returns a null pointer; pythonfmu's wrapper does not."""
    rows = {row.name: row for row in twodof.check(foreign(tmp_path, "LEAVES_POINTER", description)).rows}
    text = "the pointer to a state is not null after the state was freed; FMI demands null"
    assert {rows[name][1:] for name in STATES} == {("remark", text)}


@pytest.mark.parametrize("fault", ["KEEPS", "SHARES", "RESTORES_NOTHING"])
def test_a_fault_of_an_fmu_at_rest_fails_its_row(fault: str, tmp_path: Path) -> None:
    """Its state and its input are 0."""
    row, text = FAULTS[fault]
    assert failed(twodof.check(foreign(tmp_path, fault, x=0.0)))[row].startswith(text)


def test_a_state_is_restored_only_if_steps_announce_it(tmp_path: Path) -> None:
    """FMI 2.0.4, section 4.2.2: with noSetFMUStatePriorToCurrentPoint, an FMU may forget what it would restore."""
    assert not failed(twodof.check(foreign(tmp_path, "FLUSHES")))


def test_an_output_with_an_alias_passes(tmp_path: Path) -> None:
    """FMI 3.0.1, section 2.4.8: the model structure refers to value references, which an alias shares."""
    path = twodof.build_fmu(tmp_path / "arm.fmu", twodof.FmuOptions(native=True, fmi=3))
    assert not problems_of(path)
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    text = files["modelDescription.xml"].decode()
    found = re.search(r'<Float64 name="q" .*?>', text)
    assert found
    end = text.index("</Float64>", found.start())
    text = f'{text[:end]}<Alias name="angle" displayUnit="deg"/>{text[end:]}'
    path.write_bytes(zipped({**files, "modelDescription.xml": text.encode()}))
    assert not problems_of(path)
    path.write_bytes(zipped({**files, "modelDescription.xml": text.replace("angle", "q").encode()}))
    assert problems_of(path)


def test_derivatives_of_a_large_output_are_compared_within_its_rounding(tmp_path: Path) -> None:
    check = twodof.check(foreign(tmp_path, "HIGH"))
    assert check.passed and {row.name: row for row in check.rows}["derivatives"].outcome == "passed", check


def test_a_serialised_state_is_restored_without_the_instance_that_saved_it(tmp_path: Path) -> None:
    """FMI 2.0.4, section 2.1.8: the bytes hold the state, and can be stored in a file; these hold its address."""
    path = foreign(tmp_path, "POINTS")
    assert {*failed(twodof.check(path))} == {"serialised state"}


def test_a_run_ends_at_the_stop_time_of_the_default_experiment(tmp_path: Path) -> None:
    """The FMU discards steps beyond it, as FMI 2.0.4, section 4.2.2, allows."""
    path = foreign(tmp_path, "ENDS", DESCRIPTION.replace('stopTime="1"', 'stopTime="0.1"'))
    rows = {row.name: row for row in twodof.check(path).rows}
    assert not [row for row in rows.values() if row.outcome == "failed"]
    assert rows["simulation"].text.startswith("10 steps")
    assert rows["variable steps"].text.startswith("steps of 0.25 to 3 times 0.01 s")


def test_instances_of_a_process_have_different_names(tmp_path: Path) -> None:
    """FMI 2.0.4, section 2.1.5: instanceName is a unique identifier."""
    path = foreign(tmp_path, "NAMED")
    assert not failed(twodof.check(path))
    fmu = load_any_fmu(path)
    with instantiate(fmu) as first, instantiate(fmu) as second:
        assert isinstance(first, Instance) and isinstance(second, Instance)
        assert (first.slave.instanceName, second.slave.instanceName) == ("Foreign", "Foreign 2")


def test_a_discarded_large_step_is_a_remark(tmp_path: Path) -> None:
    check = twodof.check(foreign(tmp_path, "DISCARDS_LARGE"))
    rows = {row.name: row for row in check.rows}
    assert check.passed and rows["variable steps"][1:] == ("remark", "it discards a step of 0.02 s at 0.02 s")


def test_a_start_value_that_is_not_a_number_is_equal_to_itself(tmp_path: Path) -> None:
    described = DESCRIPTION.replace('variability="fixed"><Real start="1"/>', 'variability="fixed"><Real start="NaN"/>')
    assert twodof.check(foreign(tmp_path, "UNSET", described)).passed


@pytest.mark.parametrize("bounds", ['min="-1" max="0"', 'declaredType="Bounded"'])
def test_inputs_stay_within_the_bounds_of_the_variable_or_its_type(bounds: str, tmp_path: Path) -> None:
    """The FMU refuses values above 0."""
    types = '<TypeDefinitions><SimpleType name="Bounded"><Real min="-1" max="0"/></SimpleType></TypeDefinitions>'
    described = DESCRIPTION.replace("<DefaultExp", f"{types}<DefaultExp")
    described = described.replace('causality="input"><Real', f'causality="input"><Real {bounds}')
    assert not failed(twodof.check(foreign(tmp_path, "BOUNDED", described)))


def test_an_fmu_without_outputs_is_not_compared(tmp_path: Path) -> None:
    described = DESCRIPTION.replace('causality="output"', "").replace('<Outputs><Unknown index="4"/></Outputs>', "")
    described = described.replace('<Unknown index="4"/></Init', "</Init")
    rows = {row.name: row.outcome for row in twodof.check(foreign(tmp_path, description=described)).rows}
    assert {name for name in ("reset", "two instances", "state") if rows[name] != "does not apply"} == set()


def test_a_variable_with_an_alias_is_tried(tmp_path: Path) -> None:
    """A local variable has the value reference of the output or of the input."""
    for reference in (1, 4):
        alias = f'<ScalarVariable name="same" valueReference="{reference}"><Real/></ScalarVariable></ModelVariables>'
        described = DESCRIPTION.replace("</ModelVariables>", alias)
        assert [*failed(twodof.check(foreign(tmp_path, "KEEPS", described)))] == ["reset"]
        rows = {row.name: row.text for row in twodof.check(foreign(tmp_path, description=described)).rows}
        assert rows["simulation"] == "20 steps of 0.01 s, 1 real outputs, all finite"
        assert rows["inputs"].startswith("1 inputs;")


def test_another_start_value_than_the_stated_one_fails(tmp_path: Path) -> None:
    described = DESCRIPTION.replace('variability="fixed"><Real start="1"/>', 'variability="fixed"><Real start="2"/>')
    texts = failed(twodof.check(foreign(tmp_path, description=described)))
    assert texts == {"start values": "p is 1.0 before it is set, and its start value is 2.0"}


def test_integers_and_truth_values_have_their_start_values(tmp_path: Path) -> None:
    """FMI 2.0.4, section 2.2.7; those of native/pd.c are 0 and true."""
    integer, truth = {'Integer start="0"': 'Integer start="2"'}, {'Boolean start="true"': 'Boolean start="false"'}
    changes: list[dict[str, str]] = [{}, integer, truth]
    for changed in changes:
        (tmp_path / "pd.fmu").write_bytes(pd_fmu(replaced=changed))
        found = failed(twodof.check(tmp_path / "pd.fmu"))
        assert ("start values" in found) == bool(changed)


OMITTED = [
    ('<Outputs><Unknown index="4"', "1", "y depends on x, and its Output"),
    ('<Derivatives><Unknown index="3"', "1", "der(x) depends on x, and its Derivative"),
    ('<Derivatives><Unknown index="3"', "2", "der(x) depends on u, and its Derivative"),
    ('<InitialUnknowns><Unknown index="3"', "2", "der(x) depends on u, and its InitialUnknown"),
    ('<InitialUnknowns><Unknown index="3"/><Unknown index="4"', "1", "y depends on x, and its InitialUnknown"),
    ('<Output valueReference="4"', "1", "y depends on x, and its Output"),
    ('<ContinuousStateDerivative valueReference="3"', "2", "der(x) depends on u, and its Derivative"),
    ('<InitialUnknown valueReference="3"', "2", "der(x) depends on u, and its InitialUnknown"),
]


@pytest.mark.parametrize(("unknown", "known", "text"), OMITTED)
def test_a_dependency_that_derivatives_show_must_be_declared(
    unknown: str, known: str, text: str, tmp_path: Path
) -> None:
    """ẋ = u − x, and y = x + 2 u."""
    described = DESCRIPTION_3 if "valueReference" in unknown else DESCRIPTION
    for dependencies in (known, "1 2"):
        changed = described.replace(unknown, f'{unknown} dependencies="{dependencies}"', 1)
        assert changed != described
        found = failed(twodof.check(foreign(tmp_path, description=changed)))
        assert found == ({} if dependencies == "1 2" else {"derivatives": f"{text} does not declare it"})


@pytest.mark.parametrize("kind", ["constant", "fixed", "dependent"])
@pytest.mark.parametrize("fmi", [2, 3])
def test_a_constant_dependency_has_one_derivative(kind: str, fmi: Any, tmp_path: Path, native_path: Path) -> None:
    """x = cos q₁ + … is nonlinear, and y = x + 2 u linear."""
    described = DESCRIPTION if fmi == 2 else DESCRIPTION_3
    linear = '<Outputs><Unknown index="4"' if fmi == 2 else '<Output valueReference="4"'
    stated = f'{linear} dependencies="1 2" dependenciesKind="{kind} {kind}"'
    assert not failed(twodof.check(foreign(tmp_path, description=described.replace(linear, stated))))
    path, files = arm(tmp_path, fmi, native_path)
    text = files["modelDescription.xml"].decode()
    kinds = rf'\1 dependenciesKind="{kind} {kind}"'
    changed = re.sub(r'((?:<Unknown index|<Output valueReference)="\d+" dependencies="\d+ \d+")', kinds, text, count=1)
    assert changed != text
    path.write_bytes(zipped({**files, "modelDescription.xml": changed.encode()}))
    found = failed(twodof.check(path))
    assert {*found} == (set() if kind == "dependent" else {"derivatives"}), found
    assert kind == "dependent" or found["derivatives"].endswith(f"and its dependency is declared as {kind}"), found


def arm(folder: Path, fmi: Any, native_path: Path) -> tuple[Path, dict[str, bytes]]:
    """Return the path of a native arm to be changed, and the files of the arm with scalar variables."""
    path = folder / "arm.fmu"
    options = twodof.FmuOptions(native=True, fmi=3, arrays=False)
    built = twodof.build_fmu(path, options) if fmi == 3 else native_path
    with zipfile.ZipFile(built) as archive:
        return path, {name: archive.read(name) for name in archive.namelist()}


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("states", ["q", "v"])
def test_exchanged_derivatives_of_states_fail(states: str, fmi: Any, tmp_path: Path, native_path: Path) -> None:
    path, files = arm(tmp_path, fmi, native_path)
    text = files["modelDescription.xml"].decode()
    places = {}
    for name in (f"{states}[1]", f"{states}[2]"):
        found = re.search(rf'name="der\({re.escape(name)}\)".*?derivative="(\d+)"', text, re.DOTALL)
        assert found
        places[found[1]] = found.span(1)
    (one, (low, high)), (two, (start, end)) = places.items()
    text = f"{text[:low]}{two}{text[high:start]}{one}{text[end:]}"
    path.write_bytes(zipped({**files, "modelDescription.xml": text.encode()}))
    texts = failed(twodof.check(path))
    assert {*texts} == {"derivatives"} and "stated as the derivative of" in texts["derivatives"], texts


def with_zeros(description: str, variability: str) -> str:
    """Return a description with parameters that start at 0."""
    zeros = ZEROS.replace('"fixed"', f'"{variability}"', 1)
    if 'fmiVersion="3.0"' in description:
        zeros = zeros.replace("Real", "Float64")
    else:
        zeros = re.sub("<Real (.*?)((?: min.*)? start.*)/>", r"<ScalarVariable \1><Real\2/></ScalarVariable>", zeros)
    return description.replace("</ModelVariables>", zeros)


@pytest.mark.parametrize("description", [DESCRIPTION, DESCRIPTION_3], ids="23")
@pytest.mark.parametrize("variability", ["fixed", "tunable"])
@pytest.mark.parametrize("fault", OF_ZEROS)
def test_parameters_that_start_at_0_are_changed(fault: str, variability: str, description: str, tmp_path: Path) -> None:
    """The FMU refuses one of them, and allows no further call then."""
    found = failed(twodof.check(foreign(tmp_path, fault, with_zeros(description, variability))))
    texts, tunable = OF_ZEROS[fault]
    expected = {**texts, **tunable} if variability == "tunable" else texts
    assert {*found} == {*expected} and all(found[row].startswith(text) for row, text in expected.items()), found


def test_a_crash_after_a_change_of_a_parameter_from_0_is_a_remark(tmp_path: Path) -> None:
    """A parameter of 0 can be a switch."""
    check = twodof.check(foreign(tmp_path, "SWITCH_ABORTS", with_zeros(DESCRIPTION, "fixed")))
    rows = {row.name: row for row in check.rows if "changed from 0" in row.text}
    assert {*rows} == {"reset", "two instances", *STATES} and {row.outcome for row in rows.values()} == {"remark"}
    assert check.passed and "changed from 0, step 1: Aborted" in rows["reset"].text, check


@pytest.mark.parametrize("delay", [0.0, 0.002])
@pytest.mark.parametrize("part", ["all", "controller"])
def test_a_sampled_controller_passes(part: Any, delay: float, tmp_path: Path) -> None:
    """Its effort depends on the target at a sampling instant, or a delay later, and not between two samples."""
    settings = {"control_period": 0.01, "control_delay": delay}
    options = twodof.FmuOptions(native=True, part=part, settings=settings)
    check = twodof.check(twodof.build_fmu(tmp_path / "arm.fmu", options))
    assert not failed(check), str(check)


@pytest.mark.parametrize("limit", [0.5, 0.50025])
def test_derivatives_are_compared_inside_a_limit_that_a_parameter_states(limit: float, tmp_path: Path) -> None:
    """The start position is 0.5, and the description's range of q[1] is that of the URDF."""
    options = twodof.FmuOptions(native=True, control="joint", settings={"q_max": (limit, 3.0)})
    check = twodof.check(twodof.build_fmu(tmp_path / "arm.fmu", options))
    row = {row.name: row for row in check.rows}["derivatives"]
    assert row.outcome == "passed" and ("at a jump" in row.text) == (limit > 0.5), str(check)


def test_derivatives_over_a_state_that_cannot_change_are_not_compared(tmp_path: Path) -> None:
    """Stock robots have joints whose limits are equal."""
    settings = {"q_min": (0.5, -3.0), "q_max": (0.5, 3.0)}
    options = twodof.FmuOptions(native=True, control="effort", settings=settings)
    row = {row.name: row for row in twodof.check(twodof.build_fmu(tmp_path / "arm.fmu", options)).rows}["derivatives"]
    assert row.outcome == "passed" and "agree" in row.text, row


def test_a_crash_at_a_forbidden_call_is_a_remark(tmp_path: Path) -> None:
    row = twodof.check(foreign(tmp_path, "FRAGILE")).rows[-2]
    text = "it ended its process at: a forbidden call, a read of a variable that does not exist: Aborted"
    assert row == ("call order", "remark", text)


def test_a_call_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checking, "MAX_CALL_WAIT", 15)  # a start on a busy machine takes seconds
    texts = failed(twodof.check(foreign(tmp_path, "HANGS")))
    assert texts["reset"] == "it ended its process at: reset, which may take 15 s: Killed"
    assert "state" not in texts


def test_an_fmu_has_limited_memory_and_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = foreign(Path(), "GREEDY")
    before = {*tmp_path.iterdir()}
    texts = failed(twodof.check(path))
    assert texts["reset"] == "it ended its process at: reset: Aborted"
    assert {*tmp_path.iterdir()} == before


def test_an_undeclared_dependency_fails(tmp_path: Path) -> None:
    described = DESCRIPTION.replace('<Unknown index="4"/></InitialUnknowns>', '<Unknown index="4" dependencies="2"/>')
    described = described.replace('dependencies="2"/>', 'dependencies="2"/></InitialUnknowns>')
    texts = failed(twodof.check(foreign(tmp_path, description=described)))
    assert texts == {"inputs": "y depends on u, and its InitialUnknown does not declare it"}


def test_an_undeclared_feedthrough_fails(tmp_path: Path) -> None:
    """An output states that it depends only on a state, after the start."""
    described = DESCRIPTION.replace('<Outputs><Unknown index="4"/>', '<Outputs><Unknown index="4" dependencies="2"/>')
    texts = failed(twodof.check(foreign(tmp_path, description=described)))
    assert texts == {"inputs": "y depends on u, and its Output does not declare it"}


def test_a_row_without_a_claimed_feature_does_not_apply(tmp_path: Path) -> None:
    described = DESCRIPTION
    for claim in ("canHandleVariableCommunicationStepSize", "canGetAndSetFMUstate", "canSerializeFMUstate"):
        described = described.replace(f'{claim}="true"', "")
    described = described.replace('providesDirectionalDerivative="true"', 'canBeInstantiatedOnlyOncePerProcess="true"')
    check = twodof.check(foreign(tmp_path, "ALONE", described))
    assert check.passed, check
    rows = {row.name: row for row in check.rows}
    left = {name: row.text for name, row in rows.items() if row.outcome == "does not apply"}
    assert left == {
        "two instances": "it states canBeInstantiatedOnlyOncePerProcess",
        "state": "it does not state canGetAndSetFMUstate",
        "serialised state": "it does not state canGetAndSetFMUstate",
        "variable steps": "it does not state canHandleVariableCommunicationStepSize",
        "derivatives": "it does not state providesDirectionalDerivative",
        "references": "the FMU contains no reference experiments (FMI-LS-REF)",
    }


def test_a_description_with_problems_fails(tmp_path: Path) -> None:
    """The FMU runs all the same if its schema is valid."""
    described = DESCRIPTION.replace('<Real derivative="2"/>', '<Real derivative="2" unit="furlong"/>')
    check = twodof.check(foreign(tmp_path, description=described))
    assert failed(check) == {"description": 'The unit "furlong" of variable "der(x)" (line 9) is not defined.'}
    check = twodof.check(foreign(tmp_path, description=DESCRIPTION.replace("<ModelStructure>", "<Structure>")))
    outcomes = {row.name: (row.outcome, row.text) for row in check.rows}
    assert outcomes.pop("description")[0] == "failed"
    assert {*outcomes} == {*TRIALS}
    assert {*outcomes.values()} == {("does not apply", "it was not run; the row of its description has the reason")}


def test_a_step_that_is_too_small_is_not_run(tmp_path: Path) -> None:
    check = twodof.check(foreign(tmp_path, description=DESCRIPTION.replace('"0.01"', '"1e-300"')))
    texts = {row.text for row in check.rows if row.name in TRIALS}
    assert texts == {"its default step of 1e-300 s is below 1e-06 s, the smallest that is run"}


NAMES = """a _a1 1a a.b a[1] a[1,2].b_2[3] a[] a. der(x) der(x[1]) der(x,2) der(x,) der(a.b[1],3) der(der(x)) 'a-b'
'a''b' 'it\\'s' '\\n' '' 'ö' ö a-b 'a'.b['1'] x' 'a[1].der(x)'[2] der der( der() der(x).y ٣ a٣ a[٣]"""


@pytest.mark.parametrize("kind", ["flat", "structured"])
def test_names_are_those_that_fmpy_allows(kind: str) -> None:
    """FMPy's parser of names would take a minute for the 20,000 names that follow."""
    names = [*NAMES.split(), "a\tb"]
    variables = "".join(f"<Real name={quoteattr(name)}/>" for name in names)
    root = ET.fromstring(f'<fmi variableNamingConvention="{kind}"><ModelVariables>{variables}</ModelVariables></fmi>')
    known = [ModelVariable(name=name, valueReference=0) for name in names]
    theirs = _validate_variable_names(ModelDescription(modelVariables=known, variableNamingConvention=kind))
    wrong = [text.partition(" is no legal")[0] for text in problems_of_names(root)]
    assert wrong == [re.sub(r'[^"]*("[^"]*").*', r"\1", text, flags=re.DOTALL) for text in theirs]
    many = "".join(f'<Real name="part{k}.q[{k},1]"/>' for k in range(20_000))
    root = ET.fromstring(f'<fmi variableNamingConvention="{kind}"><ModelVariables>{many}</ModelVariables></fmi>')
    assert problems_of_names(root) == []


def test_a_description_of_many_problems_has_some_in_its_row(tmp_path: Path) -> None:
    variables = "".join(
        f'<ScalarVariable name="{k}" valueReference="{100 + k}"><Real unit="u"/></ScalarVariable>' for k in range(500)
    )
    described = DESCRIPTION.replace("</ModelVariables>", f"{variables}</ModelVariables>")
    assert failed(twodof.check(foreign(tmp_path, description=described)))["description"].endswith("; and 480 more")


def test_an_fmu_for_another_machine_is_not_run(tmp_path: Path) -> None:
    path = foreign(tmp_path)
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(tmp_path / "other.fmu", "w") as other:
        other.writestr("modelDescription.xml", archive.read("modelDescription.xml"))
        other.writestr("binaries/win64/Foreign.dll", b"")
    check = twodof.check(tmp_path / "other.fmu")
    assert {row.outcome for row in check.rows[1:]} == {"does not apply"} and len(check.rows) == 12
    assert "only for: win64" in check.rows[1].text
    asked = twodof.check(tmp_path / "other.fmu", tools=["fmpy"])
    assert failed(asked)["references"].startswith("not run with fmpy: it has no binary for this machine")
    assert main(["check", str(tmp_path / "other.fmu"), "--with", "fmpy"]) == 1


def test_the_command_prints_a_table_or_json(
    tmp_path: Path, native_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["check", str(native_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:2] == ["passed", "description"] and lines[-1].endswith("passes")
    assert main(["check", str(foreign(tmp_path, "KEEPS")), "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert facts["kind"] == "check" and facts["passed"] is False
    assert [row["name"] for row in facts["rows"] if row["outcome"] == "failed"] == ["reset"]
    assert main(["check", str(tmp_path / "none.fmu")]) == 1
    assert "there is no FMU" in capsys.readouterr().err
    with pytest.raises(SystemExit) as ended:
        main(["check"])
    assert ended.value.code == 2


@pytest.mark.parametrize(
    ("start", "end", "text"),
    [
        ("pd.nothing", "pd.q[1]", "there is no 'pd.nothing'"),
        ("pd.q[1]", "pd.v[1]", "is not from an output to an input"),
        ("pd.on", "pd.enabled", "has an algebraic loop"),
    ],
)
def test_only_connections_that_ssp_forbids_fail(start: str, end: str, text: str, tmp_path: Path) -> None:
    wire = connection(start, end)
    structure = ssd(f"<ssd:Elements>{component('pd')}</ssd:Elements><ssd:Connections>{wire}</ssd:Connections>")
    row = twodof.check(loop(tmp_path / "loop.ssp", b"", pd_fmu(), structure)).rows[0]
    assert text in row.text and row.outcome == ("remark" if "loop" in text else "failed")


@pytest.mark.parametrize("by", ["system", "FMU"])
def test_a_model_exchange_component_is_a_remark_and_the_other_fmus_are_checked(by: str, tmp_path: Path) -> None:
    """The system states the implementation, or the FMU has no other one."""
    stated = component("pd").replace("source=", 'implementation="ModelExchange" source=')
    elements = f"{component('own')}{stated if by == 'system' else component('pd')}"
    structure = ssd(f"<ssd:Elements>{elements}</ssd:Elements>")
    own = {"resources/own.fmu": foreign(tmp_path).read_bytes()}
    form = DESCRIPTION if by == "system" else MODEL_EXCHANGE
    check = twodof.check(
        loop(tmp_path / "loop.ssp", b"", foreign(tmp_path, description=form).read_bytes(), structure, **own)
    )
    rows = {row.name: row for row in check.rows}
    assert rows["structure"].outcome == "remark" and check.passed, check
    assert rows["own: reset"].outcome == "passed"
    if by == "system":
        assert "component 'pd' is a Model Exchange FMU; a co-simulation FMU is needed" in rows["structure"].text
        assert rows["pd: reset"].outcome == "passed"  # its FMU has both
    else:
        assert (
            rows["pd: description"].outcome == "remark" and "is FMI 2.0 model exchange" in rows["pd: description"].text
        )
        assert rows["pd: reset"].outcome == "does not apply"


@pytest.mark.parametrize("feature", ["package", "dictionary", "parameters"])
def test_a_feature_that_no_run_has_is_a_remark(feature: str, tmp_path: Path) -> None:
    other, own, top = "", "", ""
    if feature == "package":
        other = '<ssd:Component name="other" type="application/x-ssp-package" source="resources/other.ssp"/>'
    elif feature == "dictionary":
        top = '<ssd:SignalDictionaries><ssd:SignalDictionary name="bus" source="bus.ssb"/></ssd:SignalDictionaries>'
    else:
        bound = '<ssd:ParameterBinding source="set.ssv" sourceBase="component"/>'
        own = f"<ssd:ParameterBindings>{bound}</ssd:ParameterBindings>"
    structure = ssd(f"<ssd:Elements>{component('pd', own)}{other}</ssd:Elements>{top}")
    rows = {row.name: row for row in twodof.check(loop(tmp_path / "loop.ssp", b"", pd_fmu(), structure)).rows}
    texts = {"package": "of type", "dictionary": "signal dictionaries", "parameters": "a parameter file inside its FMU"}
    assert rows["structure"].outcome == "remark" and texts[feature] in rows["structure"].text
    assert rows["pd: reset"].outcome == "passed"


@pytest.mark.parametrize(
    ("times", "text"),
    [
        ('stepSize="-0.01"', "its step of -0.01 s is not > 0"),
        ('stepSize="NaN"', "its step of nan s is not > 0"),
        ('startTime="2" stopTime="1"', "its stop time 1 s is before its start at 2 s"),
    ],
)
def test_times_that_no_run_can_have_fail(times: str, text: str, tmp_path: Path) -> None:
    described = re.sub("<DefaultExperiment.*/>", f"<DefaultExperiment {times}/>", DESCRIPTION)
    assert failed(twodof.check(foreign(tmp_path, description=described)))["description"] == f"DefaultExperiment: {text}"


def test_each_fmu_of_a_system_is_checked(tmp_path: Path) -> None:
    """They are a plant of this project and a third-party controller without states."""
    plant = twodof.build_fmu(tmp_path / "plant.fmu", twodof.FmuOptions(native=True, control="effort"))
    path = loop(tmp_path / "loop.ssp", plant.read_bytes(), pd_fmu())
    check = twodof.check(path)
    assert check.rows[0] == ("structure", "passed", "2 components, 6 connections")
    outcomes = {row.name: row.outcome for row in check.rows}
    assert {outcomes[f"plant: {name}"] for name in TRIALS} == {"passed"}
    assert outcomes["pd: reset"] == outcomes["pd: simulation"] == "passed", str(check)
    assert outcomes["pd: state"] == "does not apply"
    with pytest.raises(InputError, match="check its FMUs one by one"):
        twodof.check(path, tools=["fmpy"])
