"""FMUs with a forged description: each command prints one line that names the culprit."""

import re

import pytest
from harness import forged, python

import twodof
from twodof.cli.main import main
from twodof.errors import PageError, TwoDofError
from twodof.pages.arm import arm_of


@pytest.mark.parametrize(
    ("pattern", "text", "culprit"),
    [
        ('axes="xy"', 'axes="xw"', "its axes 'xw' must be different letters of 'xyz'"),
        ('axes="xy"', 'axes="x"', "x has 2 elements for the axes 'x'"),
        ('axes="xy"', 'axes="xyz"', "x has 2 elements for the axes 'xyz'"),
        ('axes="xy"', 'axes="xx"', "its axes 'xx' must be different letters of 'xyz'"),
        (r'name="x\[', 'name="xx[', "x has 0 elements for the axes 'xy'"),
        (r'name="x_des\[2', 'name="xx_des[2', "x_des has 1 elements for the axes 'xy'"),
        ('frame="EndEffector"', 'frame="Nope"', "it has no link 'Nope'"),
        (r'name="q_min\[1', 'name="qq_min[1', r"has no variable 'q_min\[1\]'"),
        (r'name="q_max\[', 'name="qq_max[', r"has no variable 'q_max\[1\]'"),
        (r'name="der\(q\[2\]\)', 'name="der(qq[2])', r"has no variable 'der\(q\[2\]\)'"),
        (r'name="der\(v\[1\]\)', 'name="der(vv[1])', r"has no variable 'der\(v\[1\]\)'"),
        ('valueReference="1"', 'valueReference="99999"', "99999|failed"),
    ],
)
def test_a_forged_fmu_is_refused_in_a_line(native_path, tmp_path, capsys, pattern, text, culprit):
    """At least one command refuses it; the others refuse it or do not use the forged part."""
    fmu = forged(native_path, tmp_path, pattern, text)
    lines = []
    bag = str(tmp_path / "bag")
    run = ["run", str(fmu), "--stop-time", "0.05", "-o", bag, "--overwrite"]
    for command in (run, [*run, "--scene"], ["linearise", str(fmu)], ["info", str(fmu)]):
        if main(command):
            lines += capsys.readouterr().err.splitlines()
        capsys.readouterr()
    try:
        arm_of(twodof.experiment(fmu))
    except TwoDofError as error:
        lines.append(str(error))
    assert lines
    for line in lines:
        assert re.search(culprit, line), line


@pytest.fixture(scope="module")
def of_fmi3(tmp_path_factory):
    options = twodof.FmuOptions(native=True, fmi=3)
    return twodof.build_fmu(tmp_path_factory.mktemp("forged") / "Arm3.fmu", options)


@pytest.mark.parametrize(
    ("pattern", "text", "culprit"),
    [
        ('start="0.2 0.05"', 'start="0.2 0.05 0.1"', "x_des has 3 start values; expected one, or one"),
        ('start="0.2 0.05"', 'start=""', "x_des has no start values"),
        ('(name="Kn"[^>]*start=")[^"]*', r"\g<1>1 2", "start value of Kn, '1 2', is not a number"),
    ],
)
def test_a_list_of_start_values_that_is_none_is_refused(of_fmi3, tmp_path, pattern, text, culprit):
    with pytest.raises(twodof.TwoDofError, match=culprit):
        twodof.load_fmu(forged(of_fmi3, tmp_path, pattern, text))


def test_a_page_of_a_frame_that_its_robot_has_not_is_refused(native_path, tmp_path):
    fmu = forged(native_path, tmp_path, 'frame="EndEffector"', 'frame="Nope"')
    with pytest.raises(PageError, match="its robot cannot be shown: it has no link 'Nope'"):
        twodof.page(fmu, tmp_path / "arm.html")


def test_variables_of_one_enumeration_share_its_items(native_path, tmp_path):
    """A copy of 10,000 items for each of 10,000 variables would take gigabytes."""
    items = "".join(f'<Item name="i{i}" value="{i}"/>' for i in range(10_000))
    types = rf'\g<0><SimpleType name="E"><Enumeration>{items}</Enumeration></SimpleType>'
    kind = 'causality="parameter" variability="fixed"><Enumeration declaredType="E" start="1"/></ScalarVariable>'
    variables = "".join(f'<ScalarVariable name="e{i}" valueReference="{10_000 + i}" {kind}' for i in range(10_000))
    (tmp_path / "typed").mkdir()
    typed = forged(native_path, tmp_path / "typed", "<TypeDefinitions>", types)
    fmu = forged(typed, tmp_path, "</ModelVariables>", variables + r"\g<0>")
    program = (
        f"import re, twodof\nfmu = twodof.load_fmu({str(fmu)!r})\n"
        "print(fmu.type_of('e9999').value('i7', 'e9999'))\n"
        "print(re.search(r'VmHWM:\\s+(\\d+)', open('/proc/self/status').read())[1])"
    )
    item, peak = python("-c", program, check=True).stdout.split()
    assert item == "7" and int(peak) < 400_000  # KiB


def test_a_long_start_value_is_cut_and_does_not_widen_the_table(native_path, tmp_path, capsys):
    text = "<String start=" + '"' + "a" * 1_000_000 + '"/>'
    named = '<ScalarVariable name="text" valueReference="9999" causality="parameter" variability="fixed">'
    fmu = forged(native_path, tmp_path, "</ModelVariables>", f"{named}{text}</ScalarVariable></ModelVariables>")
    assert main(["info", str(fmu)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(len(line) > 200 for line in lines) == 1 and max(map(len, lines)) < 1200
    assert any("… (1000000 characters)" in line for line in lines)


LONG = "u" * 1001
TEXTS = {
    "a unit": (r'<Unit name="m"', rf'<Unit name="{LONG}"/>\g<0>', "name 'uuu.*of a <Unit> has more than 1000"),
    "a variable": (r'name="Kn"', rf'name="{LONG}"', "name 'uuu.* has more than 1000"),
    "a maximum": (r'(name="Kn"[^>]*?) min="', r"\g<1> min=" + '"' + " " * 1001, "min '.*has more than 1000"),
    "a scalar": (r'(name="Kn"[^>]*start=")', r"\g<1>" + " " * 1001, "start '.*has more than 1000"),
    "a word of an array": (r'start="0.2 ', 'start="0.2' + "0" * 1001 + " ", "start '0.2.*has more than 1000"),
    "display units": (
        r'<Unit name="m"',
        r'<Unit name="M">' + "".join(f'<DisplayUnit name="d{i}"/>' for i in range(101)) + r"</Unit>\g<0>",
        "unit 'M' has more than 100 display units",
    ),
}
"""Texts that each variable, element or alias would repeat or search."""


@pytest.mark.parametrize(("pattern", "text", "culprit"), TEXTS.values(), ids=TEXTS)
def test_a_text_that_others_repeat_is_limited(of_fmi3, tmp_path, pattern, text, culprit):
    with pytest.raises(twodof.TwoDofError, match=culprit):
        twodof.load_fmu(forged(of_fmi3, tmp_path, pattern, text))


def test_the_description_of_an_array_is_cut(of_fmi3, tmp_path):
    fmu = twodof.load_fmu(forged(of_fmi3, tmp_path, r'(name="x_des"[^>]*description=")', r"\g<1>" + LONG))
    assert {len(fmu.variables[f"x_des[{i}]"].description) for i in (1, 2)} == {1000}
