"""Values of all types of FMI, set before initialisation in FMUs of other makers, alone and in systems."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import fmpy
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from native_models import HERE
from systems import NAMESPACES, component, ssd, values, zipped
from tools import needs

import twodof
from twodof.cli.main import main
from twodof.errors import FmuError, InputError

M = 1000003
BITS = (8, 16, 32, 64)
OF_3 = ("Float32", "Float64", *(f"{sign}Int{bits}" for bits in BITS for sign in ("", "U")), "Boolean")
ITEMS = '<Item name="slow" value="-3"/><Item name="fast" value="7"/><Item name="2" value="1"/>'


def parts_2() -> str:
    """The description of native/types.c in FMI 2.0."""
    rows = {
        "r": 'Real start="0"',
        "n": 'Integer start="0" min="-5" max="5"',
        "mode": 'Enumeration declaredType="Mode" start="1"',
        "on": 'Boolean start="false"',
        "text": 'String start=""',
    }
    more = "".join(
        f'<ScalarVariable name="{name}" valueReference="{k}" causality="parameter" variability="fixed"><{kind}/>'
        f'</ScalarVariable><ScalarVariable name="seen_{name}" valueReference="{100 + k}" causality="output"><Real/>'
        "</ScalarVariable>"
        for k, (name, kind) in enumerate(rows.items(), 1)
    )
    states = "".join(
        f'<ScalarVariable name="{name}[1]" valueReference="{vr}" causality="output"><Real/></ScalarVariable>'
        for name, vr in (("q", 90), ("v", 91))
    )
    outputs = "".join(f'<Unknown index="{i}" dependencies=""/>' for i in (1, 2, 4, 6, 8, 10, 12))
    return f"""<fmiModelDescription fmiVersion="2.0" modelName="types" guid="types">
<CoSimulation modelIdentifier="types"/>
<TypeDefinitions><SimpleType name="Mode"><Enumeration>{ITEMS}</Enumeration></SimpleType></TypeDefinitions>
<ModelVariables>{states}{more}</ModelVariables><ModelStructure><Outputs>{outputs}</Outputs></ModelStructure>
</fmiModelDescription>"""


def parts_3() -> str:
    """The description of native/types.c in FMI 3.0."""
    fixed = 'causality="parameter" variability="fixed"'
    rows = [f'<{kind} name="{kind}" valueReference="{k}" {fixed} start="0"/>' for k, kind in enumerate(OF_3, 1)]
    rows[OF_3.index("UInt16")] = f'<UInt16 name="UInt16" valueReference="{OF_3.index("UInt16") + 1}" {fixed} max="9"/>'
    rows[OF_3.index("UInt16")] = rows[OF_3.index("UInt16")].replace("/>", ' start="0"/>')
    rows[OF_3.index("Boolean")] = rows[OF_3.index("Boolean")].replace('"0"', '"false"')
    rows += [
        f'<Enumeration name="mode" valueReference="15" {fixed} declaredType="Mode" start="7"/>',
        f'<String name="text" valueReference="16" {fixed}><Start value="a"/></String>',
        f'<Int64 name="array" valueReference="20" {fixed} start="4 5 6"><Dimension start="3"/></Int64>',
        f'<String name="names" valueReference="30" {fixed}><Dimension start="2"/><Start value="a"/><Start value="b"/>'
        "</String>",
        f'<Binary name="blob" valueReference="31" {fixed}><Start value="00"/></Binary>',
        f'<Float32 name="half" valueReference="17" {fixed} declaredType="Half" start="0"/>',
    ]
    named = {f"seen_{kind}": 101 + k for k, kind in enumerate(OF_3)} | {"seen_mode": 115, "seen_text": 116}
    named |= {"seen_half": 117, **{f"seen_array[{i + 1}]": 120 + i for i in range(3)}, "q[1]": 90, "v[1]": 91}
    outputs = "".join(
        f'<Float64 name="{name}" valueReference="{vr}" causality="output"/>' for name, vr in named.items()
    )
    structure = "".join(f'<Output valueReference="{vr}" dependencies=""/>' for vr in named.values())
    return f"""<fmiModelDescription fmiVersion="3.0" modelName="types" instantiationToken="types">
<CoSimulation modelIdentifier="types"/>
<TypeDefinitions><Float32Type name="Half" min="-0.5" max="0.5"/><EnumerationType name="Mode">{ITEMS}</EnumerationType>
</TypeDefinitions>
<ModelVariables><Float64 name="time" valueReference="0" causality="independent"/>{"".join(rows)}{outputs}
</ModelVariables><ModelStructure>{structure}</ModelStructure></fmiModelDescription>"""


def build(folder: Path, fmi: int) -> bytes:
    """Compile native/types.c."""
    headers = Path(fmpy.__file__).parent / "c-code"
    text = (headers / f"fmi{fmi}Functions.h").read_text()
    names = re.findall(r"TYPE +(fmi3\w+);" if fmi == 3 else r"TYPE +(fmi2\w+);", text)
    rest = folder / f"rest{fmi}.c"
    rest.write_text("".join(f"__attribute__((weak)) int {name}(void) {{ return 0; }}\n" for name in names))
    library = folder / f"types{fmi}.so"
    command = [needs("gcc"), "-shared", "-fPIC", f"-DFMI={fmi}", "-I", headers, "-o", library]
    subprocess.run([*map(str, command), str(HERE / "types.c"), str(rest)], check=True)
    platform = "linux64" if fmi == 2 else fmpy.platform_tuple
    xml = (parts_2() if fmi == 2 else parts_3()).encode()
    return zipped({"modelDescription.xml": xml, f"binaries/{platform}/types.so": library.read_bytes()})


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """The FMU of each version of FMI."""
    folder = tmp_path_factory.mktemp("types")
    found = {}
    for fmi in (2, 3):
        found[fmi] = folder / f"types{fmi}.fmu"
        found[fmi].write_bytes(build(folder, fmi))
    return found


def seen(path: Path, **settings: object) -> dict[str, float]:
    """Values that the FMU received before its initialisation, except 0."""
    last = list(twodof.samples(path, stop_time=0.02, settings=settings, signals=True))[-1]
    names = twodof.experiment(path, signals=True).signals
    found = dict(zip(names, last.signals))
    return {name.rpartition("seen_")[2]: value for name, value in found.items() if "seen_" in name and value}


def weighted(text: str) -> int:
    """The sum by which the FMU shows a text."""
    return sum((i + 1) * byte for i, byte in enumerate(text.encode()))


LARGEST = {kind: 2 ** (bits - (kind[0] == "I")) - 1 for bits in BITS for kind in (f"Int{bits}", f"UInt{bits}")}


def test_each_type_of_fmi_3(fmus: dict[int, Path]) -> None:
    numbers = {**LARGEST, "UInt16": 9, "Float32": 0.25, "Float64": 0.1, "Boolean": True}
    expected = {
        name: value % M if name.endswith("64") and name != "Float64" else value for name, value in numbers.items()
    }
    assert seen(fmus[3], **numbers) == expected
    negative = {kind: -(2 ** (bits - 1)) for bits in BITS if (kind := f"Int{bits}")}
    assert seen(fmus[3], **negative) == {**negative, "Int64": -(2**63 % M)}
    assert seen(fmus[3], text="naïve", half=-0.5) == {"text": weighted("naïve"), "half": -0.5}


def test_an_element_of_an_array_leaves_the_others(fmus: dict[int, Path]) -> None:
    assert seen(fmus[3], **{"array[2]": 2**53 + 1}) == {"array[1]": 4, "array[2]": (2**53 + 1) % M, "array[3]": 6}
    assert seen(fmus[3], array=(1, 2, 3)) == {"array[1]": 1, "array[2]": 2, "array[3]": 3}


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("value, number", [("slow", -3), ("fast", 7), (7, 7), (-3.0, -3), ("-3", -3), ("2", 1)])
def test_an_item_of_an_enumeration_is_named_or_numbered(
    fmus: dict[int, Path], fmi: int, value: object, number: int
) -> None:
    """An item's name comes before a number."""
    assert seen(fmus[fmi], mode=value) == {"mode": number}


def test_the_command_line_gives_texts_items_and_large_numbers(fmus: dict[int, Path], tmp_path: Path) -> None:
    for fmi, options, expected in (
        (3, ("mode=slow", "text=1,true", f"Int64={2**63 - 1}"), {"Int64": (2**63 - 1) % M, "text": weighted("1,true")}),
        (2, ("mode=slow", "text=true", "n=5"), {"n": 5, "text": weighted("true")}),
    ):
        bag, command = tmp_path / f"bag{fmi}", [part for option in options for part in ("--set", option)]
        assert main(["run", str(fmus[fmi]), "-o", str(bag), "--signals", "--stop-time", "0.02", *command]) == 0
        provenance = twodof.read_bag(bag).provenance
        assert provenance["texts"] == {"text": options[1].partition("=")[2]}
        with next(bag.glob("*.mcap")).open("rb") as file:
            messages = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages("/signals/values")
            *_, last = (message.values for *_, message in messages)
        found = {name: value for name, value in zip(provenance["signals"], last) if name.startswith("seen_")}
        assert {k[5:]: v for k, v in found.items() if v and "array" not in k} == {"mode": -3, **expected}
        assert provenance["start_values"]["mode"] == -3


REFUSED = [
    (2, {"mode": 2}, "mode = 2 is not in its enumeration; there are: slow (-3), fast (7), 2 (1)"),
    (3, {"mode": "medium"}, "mode = 'medium' is not in its enumeration; there are: slow (-3)"),
    (2, {"mode": True}, "mode = True is not in its enumeration"),
    (2, {"n": 6}, "n = 6 must be in [-5, 5]"),
    (2, {"n": 2.5}, "n = 2.5 must be a whole number"),
    (2, {"text": 3}, "text = 3: expected a text"),
    (3, {"text": "a\0b"}, "expected a text"),
    (3, {"UInt8": 256}, "UInt8 = 256 must be in [0, 255]"),
    (3, {"UInt32": -1}, "UInt32 = -1 must be in [0, 4294967295]"),
    (3, {"UInt16": 10}, "UInt16 = 10 must be in [0, 9]"),
    (3, {"Int64": 2**63}, "Int64 = 9223372036854775808 must be in [-9223372036854775808, 9223372036854775807]"),
    (3, {"Int8": "fast"}, "Int8 = 'fast': expected a number"),
    (3, {"Float32": 1e39}, "Float32 = 9.9999999999999994e+38 is too large for its type Float32"),
    (3, {"half": 0.6}, "half = 0.59999999999999998 must be in [-0.5, 0.5]"),
    (3, {"names": "a"}, "names[1] is of type String[] and cannot be set"),
    (3, {"blob": 1}, "blob is of type Binary and cannot be set"),
]


@pytest.mark.parametrize("fmi, settings, message", REFUSED)
def test_a_value_that_a_variable_cannot_have_is_refused(
    fmus: dict[int, Path], fmi: int, settings: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        twodof.experiment(fmus[fmi], settings=settings)


def test_a_text_is_not_sent_during_a_run(fmus: dict[int, Path]) -> None:
    with pytest.raises(InputError, match="text is of type String, which can only be set before a run"):
        twodof.experiment(fmus[2], changes=[(0.01, {"text": "b"})])


def system(path: Path, fmu: Path, *rows: str, more: str = "") -> Path:
    """Write a system of an FMU with start values."""
    inside = f"<ssd:ParameterValues>{values(*rows)}</ssd:ParameterValues>{more}"
    bindings = f"<ssd:ParameterBindings><ssd:ParameterBinding>{inside}</ssd:ParameterBinding></ssd:ParameterBindings>"
    structure = ssd(f"<ssd:Elements>{component('c', bindings)}</ssd:Elements>")
    path.write_bytes(zipped({"SystemStructure.ssd": structure, "resources/c.fmu": fmu.read_bytes()}))
    return path


def test_parameter_bindings_give_values_of_each_type(fmus: dict[int, Path], tmp_path: Path) -> None:
    rows = ("mode Enumeration slow", "text String naive", "n Integer 4", "on Boolean true", "r Real 0.5")
    path = system(tmp_path / "two.ssp", fmus[2], *rows)
    assert seen(path) == {"mode": -3, "text": weighted("naive"), "n": 4, "on": 1, "r": 0.5}
    assert seen(path, mode="fast", text="b") == {"mode": 7, "text": weighted("b"), "n": 4, "on": 1, "r": 0.5}
    rows = (
        f"Int64 Integer {2**31 - 1}",
        "UInt8 Integer 200",
        "Float32 Real 0.5",
        "mode Integer 7",
        "Boolean Boolean 1",
    )
    path = system(tmp_path / "three.ssp", fmus[3], *rows)
    expected = {"Int64": (2**31 - 1) % M, "UInt8": 200, "Float32": 0.5, "mode": 7, "Boolean": 1}
    assert seen(path) == expected


def test_a_setting_of_a_system_on_the_command_line(fmus: dict[int, Path], tmp_path: Path) -> None:
    path = system(tmp_path / "two.ssp", fmus[2])
    for name in ("mode", "c.mode"):
        bag = tmp_path / name
        assert main(["run", str(path), "-o", str(bag), "--stop-time", "0.02", "--set", f"{name}=slow"]) == 0
        assert twodof.read_bag(bag).provenance["start_values"]["mode"] == -3


@pytest.mark.parametrize(
    "row, message",
    [
        ("mode Enumeration medium", "c.mode = 'medium' is not in its enumeration; there are: slow (-3), fast (7)"),
        ("mode Integer 2", "c.mode = 2 is not in its enumeration"),
        ("n Integer 6", "c.n = 6 must be in [-5, 5]"),
        ("n String 3", "the value of 'c.n', '3', is a String for another type: not supported"),
        ("mode String slow", "the value of 'c.mode', 'slow', is a String for another type: not supported"),
        ("text Real 3", "c.text = 3.0: expected a text"),
        ("on Integer 1", "c.on = 1: expected true or false"),
        ("n Boolean true", "c.n = True: expected a number"),
    ],
)
def test_a_binding_of_an_impossible_value_is_refused(
    fmus: dict[int, Path], tmp_path: Path, row: str, message: str
) -> None:
    with pytest.raises(FmuError, match=re.escape(message)):
        twodof.experiment(system(tmp_path / "two.ssp", fmus[2], row))


def test_a_text_is_not_transformed(fmus: dict[int, Path], tmp_path: Path) -> None:
    entry = '<ssm:MappingEntry source="label" target="text"><ssc:LinearTransformation factor="2"/></ssm:MappingEntry>'
    inside = f'<ssm:ParameterMapping {NAMESPACES} version="1.0">{entry}</ssm:ParameterMapping>'
    path = system(
        tmp_path / "two.ssp", fmus[2], "label String a", more=f"<ssd:ParameterMapping>{inside}</ssd:ParameterMapping>"
    )
    with pytest.raises(FmuError, match=r"the value of 'c\.text', 'a', is a String transformed: not supported"):
        twodof.experiment(path)
