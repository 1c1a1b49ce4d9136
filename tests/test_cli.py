"""The command line without errors: its output and its files."""

import io
import json
import math
import os
import re
import shlex
import subprocess
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from harness import python

import twodof
from twodof.cli.help import EXAMPLES
from twodof.cli.main import VERBS, main, parser

COMMAND = [sys.executable, "-m", "twodof"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
RUN = ["run", "arm.fmu", "-o", "out", "--stop-time", "0.02"]


def twodof_command(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    """The command in its own process."""
    return python("-m", "twodof", *arguments, cwd=cwd, env=ENVIRONMENT)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Return the output of a session that builds, runs and shows."""
    cwd = tmp_path_factory.mktemp("session")
    outputs = {"cwd": str(cwd)}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(cwd)
        for name, line in {
            "build": "build",
            "run": "run TwoDof.fmu -o bag --stop-time 1.5 --set Kp=80 --stamp-start 1000",
            "info bag": "info bag",
            "info fmu": "info TwoDof.fmu",
        }.items():
            with redirect_stdout(io.StringIO()) as out:
                assert main(line.split()) == 0
            outputs[name] = out.getvalue()
    return outputs


def rows(output: str) -> dict[str, str]:
    """The labelled rows of an output's first paragraph."""
    first, _, _ = output.partition("\n\n")
    return dict(re.split(r"  +", line, maxsplit=1) for line in first.splitlines())


def test_build_prints_its_result_and_the_next_commands(session):
    found = rows(session["build"])
    size = (Path(session["cwd"]) / "TwoDof.fmu").stat().st_size / 1024
    assert found["FMU"] == f"TwoDof.fmu ({size:.0f} KB, linux64)"
    assert found["robot"] == "2dof: joint1, joint2"
    assert found["controlled"] == "EndEffector, axes x y of world; task control"
    assert "twodof run TwoDof.fmu" in session["build"].partition("\nnext\n")[2]


def test_run_leaves_the_messages_that_it_promises(session):
    found = rows(session["run"])
    bag = twodof.read_bag(Path(session["cwd"]) / "bag")
    promised = re.fullmatch(r"bag \((\d+) messages on /joint_states, mcap\)", found["bag"])
    assert promised is not None
    assert int(promised[1]) == len(bag.t) == bag.topics[0].count == 151
    assert found["FMU"] == "TwoDof.fmu"
    assert bag.stamps[0] == 1000 * 10**9


def test_run_prints_the_distance_of_the_end_effector_from_its_target(session):
    found = rows(session["run"])["verdict"]
    promised = re.match(r"not reached: (\S+) m from the target \(0.2, 0.05\) m; the position still approaches", found)
    assert promised is not None
    (last,) = twodof.read_bag(Path(session["cwd"]) / "bag").q[-1:]
    a, b = last[0], last[0] + last[1]
    x = (0.15 * (math.cos(a) + math.cos(b)), 0.15 * (math.sin(a) + math.sin(b)))
    assert float(promised[1]) == pytest.approx(math.dist(x, (0.2, 0.05)), rel=5e-3)


def test_run_prints_its_speed_and_the_next_commands(session):
    timing = re.fullmatch(r"1\.5 s simulated in ([\d.]+) s, ([\d.]+) × real time", rows(session["run"])["time"])
    assert timing is not None
    assert float(timing[2]) == pytest.approx(1.5 / float(timing[1]), rel=0.1, abs=0.05)  # it has one decimal
    following = session["run"].partition("\nnext\n")[2]
    assert [line.strip() for line in following.splitlines()] == ["twodof plot bag", "twodof view bag"]


@pytest.mark.parametrize("activated", [True, False])
@pytest.mark.parametrize("missing", [[], ["matplotlib", "websockets"]])
def test_suggested_commands_can_be_typed(activated, missing, native_path, tmp_path):
    """The shell finds the program or not; the extras for figures and pages are installed or not."""
    here = str(Path(sys.executable).parent)
    path = [p for p in os.environ["PATH"].split(os.pathsep) if Path(p) != Path(here)]
    spec = f"import importlib.util as u; f = u.find_spec; absent = {missing!r}; "
    spec += "u.find_spec = lambda n, *a: None if n in absent else f(n, *a); "
    code = f"{spec}import sys; from twodof.__main__ import main; sys.exit(main())"
    run = ["run", native_path, "--stop-time", "0.1", "-o", "bag"]
    environment = {**os.environ, "PATH": os.pathsep.join([here] * activated + path)}
    done = python("-c", code, *run, cwd=tmp_path, check=True, env=environment)
    following = done.stdout.partition("\nnext\n")[2]
    program = "twodof" if activated else f"{here}/twodof"
    commands = [line.strip() for line in following.partition("\n\n")[0].splitlines()]
    shown = [] if missing else [f"{program} plot bag", f"{program} view bag"]
    assert commands == shown
    remedy = f"to plot and view: install the extra 'view': {sys.executable} -m pip install "
    assert (remedy in done.stdout) == bool(missing)
    assert not re.search(r"(?<!/)twodof\[", done.stdout)  # a folder, no name for an index


def test_info_of_a_bag_shows_its_contents(session):
    found = rows(session["info bag"])
    bag = twodof.read_bag(Path(session["cwd"]) / "bag")
    assert found["joints"] == "joint1, joint2"
    assert found["duration"] == "1.5 s, 151 joint states, 100 Hz"
    assert found["first stamp"] == "1000.000000000 s"
    assert found["first state"] == "q = (0.5, 0.35), v = (0, 0)"
    assert found["last state"].startswith(f"q = ({bag.q[-1, 0]:.6g}, {bag.q[-1, 1]:.6g}), v = (")
    command = "twodof run TwoDof.fmu -o bag --stop-time 1.5 --set Kp=80 --stamp-start 1000"
    assert found["made by"] == command
    topics = session["info bag"].partition("\n\n")[2].split()
    assert topics == ["/joint_states", "151", "sensor_msgs/msg/JointState"]


def test_info_of_an_fmu_shows_its_contents(session):
    found = rows(session["info fmu"])
    assert found["digest"] == twodof.load_fmu(Path(session["cwd"]) / "TwoDof.fmu").guid
    assert found["platforms"] == "linux64"
    assert found["joints"] == "joint1, joint2"
    for capability in ("canGetAndSetFMUstate", "canSerializeFMUstate", "needsExecutionTool"):
        assert capability in found["capabilities"]
    table = session["info fmu"].partition("\n\n")[2]
    for line in (
        r"x_des\[2\] +m +0\.2, 0\.05 +input",
        r"tau\[2\] +N\.m +output",
        r"q_min\[2\] +rad +-3\.14159, -3\.14159 +parameter",
        r"gravity\[3\] +m/s2 +0, -9\.81, 0 +parameter",
        r"limit_effort +false +parameter",
    ):
        assert re.search(f"^{line}$", table, re.MULTILINE), line


def test_default_run_builds_the_fmu_again_only_if_it_differs(folder, capfd):
    fmu_file = folder / "TwoDof.fmu"

    def run(bag: str) -> int:
        assert main(["run", "--stop-time", "0.01", "-o", bag]) == 0
        return fmu_file.stat().st_mtime_ns

    first, content = run("one"), fmu_file.read_bytes()
    assert run("two") == first
    said = "no FMU is named: using TwoDof.fmu, the default planar arm\n"
    assert capfd.readouterr().err == 2 * said
    assert main(["build", "--q-start", "0.1", "0.2"]) == 0
    other = fmu_file.read_bytes()
    assert other != content
    assert main(["run", "--stop-time", "0.01", "-o", "three"]) != 0
    assert fmu_file.read_bytes() == other  # somebody wanted it so
    assert main(["build", "--overwrite"]) == 0
    assert fmu_file.read_bytes() == content


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_overwrite_replaces_a_bag(storage, folder, capfd):
    assert main([*RUN, "-o", "bag"]) == 0
    assert main([*RUN, "-o", "bag", "--overwrite", "--stop-time", "0.04", "--storage", storage]) == 0
    assert len(twodof.read_bag("bag").t) == 5
    assert capfd.readouterr().err == ""


def test_bag_without_a_name_is_named_after_the_date(folder, capfd, monkeypatch):
    """A second one in the same second has another name."""
    run = ["run", "arm.fmu", "--stop-time", "0.01"]
    assert main(run) == 0
    (bag,) = (path for path in folder.iterdir() if path.is_dir())
    assert re.fullmatch(r"rosbag2_\d{4}(_\d\d){2}-\d\d(_\d\d){2}", bag.name)
    assert bag.name in capfd.readouterr().out
    monkeypatch.setattr(time, "strftime", lambda form: form.partition("%")[0] + "now")
    assert main(run) == main(run) == 0
    assert {path.name for path in folder.glob("*now*")} == {"rosbag2_now", "rosbag2_now-2"}


@pytest.mark.parametrize(
    "command",
    [["build", "-o", "far.fmu", "--q-start", "9", "0"], [*RUN, "--set", "q_start=9,0"]],
    ids=lambda command: command[0],
)
def test_warnings_of_the_robot_and_the_fmu_are_shown(command, folder):
    done = twodof_command(*command, cwd=folder)
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert re.match(r"WARNING: q_start\[1\] = 9 of joint 'joint1' is outside its lim", line)


def test_a_refusal_of_the_fmu_is_one_line_and_leaves_no_bag(folder):
    done = twodof_command(*RUN, "--set", "q_min=1", "--set", "q_max=0", cwd=folder)
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(r"twodof: error: .*q_min\[1\] = 1 > q_max\[1\] = 0.*\n", done.stderr)
    assert [path.name for path in folder.iterdir()] == ["arm.fmu"]


def test_control_laws_are_named_as_in_the_options(folder, capfd):
    assert main([*RUN, "--set", "quat_des=1"]) == 1
    told = "it belongs to control 'task --orientation'; this FMU has control 'task'\n"
    assert capfd.readouterr().err.endswith(told)
    for command in (["build", "--orientation", "-o", "six.fmu"], ["info", "six.fmu"]):
        assert main(command) == 0
        of = rows(capfd.readouterr().out)["controlled"]
        assert of == "EndEffector, axes x y of world; task control with --orientation"


# --- output that nobody reads ---


@pytest.mark.parametrize("line", ["info arm.fmu", "--help", "run arm.fmu -o bag --stop-time 0.01"])
def test_reader_that_leaves_early_gets_no_traceback(line, folder):
    reading, writing = os.pipe()
    os.close(reading)
    process = subprocess.Popen(
        [*COMMAND, *line.split()],
        cwd=folder,
        env=ENVIRONMENT | {"PYTHONUNBUFFERED": ""},
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
    )
    os.close(writing)
    _, err = process.communicate(timeout=120)
    assert err == ""


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("arguments", ["info arm.fmu", "--help", "--version", "help run", "run --help"])
def test_a_full_disk_under_the_output_is_an_error(arguments, unbuffered, folder):
    assert redirected(arguments, ">/dev/full", folder, unbuffered) == (1, "twodof: error: No space left on device\n")


def test_a_closed_output_is_no_error(folder):
    assert redirected("info arm.fmu", ">&-", folder) == (0, "")


def redirected(arguments: str, redirect: str, folder: Path, unbuffered: str = "") -> tuple[int, str]:
    """Exit status and errors of a command with redirected output."""
    done = subprocess.run(
        ["sh", "-c", f'"$0" "$@" {redirect}', *COMMAND, *arguments.split()],
        cwd=folder,
        env={**ENVIRONMENT, "PYTHONUNBUFFERED": unbuffered},
        stderr=subprocess.PIPE,
        text=True,
        timeout=120,
        check=False,
    )
    return done.returncode, done.stderr


@pytest.mark.parametrize("verb", ["", *(verb.__name__.rpartition(".")[2] for verb in VERBS)])
def test_help_is_printed_by_verb_and_option(verb, capsys):
    assert main(["help", verb] if verb else ["help"]) == 0
    out = capsys.readouterr().out
    with pytest.raises(SystemExit) as end:
        main([verb, "--help"] if verb else ["--help"])
    assert end.value.code == 0 and capsys.readouterr().out == out
    assert out.startswith(f"usage: twodof {verb}")


def test_facts_as_json(native_path, tmp_path, capsys):
    def facts(*arguments: object) -> dict[str, object]:
        assert main([*map(str, arguments), "--json"]) == 0
        told: dict[str, object] = json.loads(capsys.readouterr().out)
        return told

    bag, table = tmp_path / "bag", tmp_path / "sweep"
    run = facts("run", native_path, "-o", bag, "--stop-time", 0.5, "--scene")
    (last,) = (twodof.samples(native_path, stop_time=0.5),)
    *_, sample = last
    assert (run["joint_states"], run["q"], run["error"]) == (51, [*sample.q], math.dist(sample.x, sample.target or ()))
    info = facts("info", bag)
    assert (info["kind"], info["joint_states"]) == ("bag", 51)
    assert {topic["name"] for topic in info["topics"]} >= {"/tf", "/target"}  # type: ignore[attr-defined]
    assert facts("info", native_path)["guid"] == twodof.load_fmu(native_path).guid
    swept = facts("sweep", native_path, "--grid", "Kp=20:60:3", "--stop-time", 0.2, "-o", table)
    assert (swept["runs"], swept["outcomes"]) == (3, {"finished": 3})
    assert facts("info", table)["best"] == swept["best"]


def test_messages_name_arguments_in_python_and_options_on_the_command_line(native_path, tmp_path, capsys):
    twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.01)
    with pytest.raises(twodof.TwoDofError, match=r"`path` or give `overwrite=True`"):
        twodof.Bag(tmp_path / "bag")
    assert main(["run", str(native_path), "-o", str(tmp_path / "bag")]) == 1
    assert "choose another with -o or give --overwrite" in capsys.readouterr().err


def test_one_value_for_a_vector_is_reported_for_all_elements(native_path, tmp_path, capsys):
    options = ["-o", str(tmp_path / "bag"), "--stop-time", "0.1", "--set", "Kp=60"]
    assert main(["run", str(native_path), *options]) == 0
    assert "Kp       60, all 2 elements\n" in capsys.readouterr().out
    given = twodof.read_bag(tmp_path / "bag").provenance["start_values"]
    assert given["Kp[1]"] == given["Kp[2]"] == 60.0


def test_a_column_for_a_vector_is_reported_for_all_elements(native_path, tmp_path, caplog):
    (tmp_path / "x.csv").write_text("time,Kp,x_des[1]\n0,60,0.2\n")
    options = ["-o", str(tmp_path / "bag"), "--stop-time", "0.1", "--input", str(tmp_path / "x.csv")]
    assert main(["run", str(native_path), *options]) == 0
    assert [text.partition("': ")[2] for text in caplog.messages] == ["the column 'Kp' sets all 2 elements"]


def test_the_shell_completes_verbs_options_variables_frames_and_joints(native_path, tmp_path):
    answer, urdf = tmp_path / "answer", Path(__file__).parents[1] / "urdf/2dof.urdf"
    twodof.simulate(native_path, twodof.Bag(tmp_path / "bag"), stop_time=0.02)
    hostile = tmp_path / "hostile.urdf"
    hostile.write_text(urdf.read_text().replace('"joint1"', '"joint\u202e1"').replace('"link1"', '"link\x9b1"'))
    for line, expected in {
        "twodof pu": ["publish"],
        "twodof run --stor": ["--storage"],
        f"twodof run {native_path} --set x_": ["x_des="],
        f"twodof run {native_path} --set K": ["Kp=", "Kd=", "Kn="],
        f"twodof linearise {native_path} --at q_st": ["q_start="],
        f"twodof sweep {native_path} --grid Kp": ["Kp="],
        "twodof build --robot panda": ["panda", "panda_collision"],
        f"twodof build {urdf} --frame En": ["EndEffector"],
        f"twodof build {urdf} --lock jo": ["joint1", "joint2"],
        f"twodof build {hostile} --lock jo": ["joint2"],
        f"twodof build {hostile} --frame li": ["link2"],
        f"twodof plot {tmp_path / 'bag'} --joints jo": ["joint1", "joint2"],
        f"twodof plot {tmp_path / 'bag'} --frame li": ["link1", "link2"],
    }.items():
        shell = {"_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": "\n", "_ARGCOMPLETE_STDOUT_FILENAME": str(answer)}
        shell |= {"COMP_LINE": line, "COMP_POINT": str(len(line)), "COMP_TYPE": "9"}
        python("-m", "twodof", env={**os.environ, **shell}, check=True)
        assert {word.strip() for word in answer.read_text().split("\n")} == {*expected}, line


@pytest.mark.parametrize("verb", EXAMPLES)
def test_the_examples_of_each_help_are_commands(verb):
    program, verbs = parser()
    assert len(EXAMPLES[verb]) > 1 and {*EXAMPLES} == {"", *verbs} - {"help"}
    for line in EXAMPLES[verb]:
        name, *arguments = shlex.split(line)
        assert name == "twodof" and arguments[0] == (verb or arguments[0])
        program.parse_args(arguments)  # which exits where there is no such option
        assert f"  {line}\n" in verbs.get(verb, program).format_help()


def test_compilation_shows_progress(tmp_path):
    """A line appears within a second, counts seconds on a terminal, and is cleared at the end."""
    code = "import time; from twodof.cli.printing import busy\nwith busy('compiling'): time.sleep(1.7)"
    done = python("-c", code, env=ENVIRONMENT, check=True)
    assert done.stderr == "compiling …\n"
    terminal = ["script", "-qec", shlex.join([sys.executable, "-c", code]), "/dev/null"]
    shown = subprocess.run(terminal, env=ENVIRONMENT, capture_output=True, text=True, check=True)
    seconds = [*map(int, re.findall(r"compiling: (\d+) s", shown.stdout))]
    assert len(seconds) > 1 and seconds == sorted(seconds) and seconds[-1] >= 1
    assert shown.stdout.endswith("\x1b[K")


@pytest.mark.parametrize("verb", ["live", "page", "view"])
def test_a_line_is_printed_before_libraries_are_loaded(verb):
    code = (
        "import sys; from twodof.cli import main, live, page, view\n"
        "live.busy = page.busy = view.busy = lambda *_, **__: sys.exit('loaded: ' + str('numpy' in sys.modules))\n"
        f"main.main(['{verb}', 'bag'])"
    )
    assert python("-c", code, env=ENVIRONMENT).stderr == "loaded: False\n"


def test_each_help_begins_with_a_sentence_about_its_command():
    program, verbs = parser()
    for verb in (program, *(verb for name, verb in verbs.items() if name != "help")):
        assert re.match(r"[A-Z].*\.$", verb.description or "", re.DOTALL), verb.prog


def test_help_texts_are_phrases_that_stand_alone():
    """A default or a unit alone explains no option."""
    for verb, its_parser in parser()[1].items():
        for action in its_parser._actions:
            assert action.help, f"{verb} {action.dest}"
            assert not re.match(r"\(|of |s |the same$|its ", action.help), f"{verb} {action.dest}: {action.help}"
