"""FMUs with a forged description: each command prints one line that names the culprit."""

import re

import pytest
from harness import forged

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
