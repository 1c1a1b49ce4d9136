"""The FMU's files: description, digest, reproducibility, and dependencies of variables."""

import hashlib
import io
import os
import re
import shutil
import subprocess
import sys
import zipfile
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from fmpy import read_model_description
from fmpy.validation import validate_fmu
from harness import Driver, in_child_process
from lxml import etree
from tools import needs

from twodof import FmuOptions, TwoDofError, build_fmu
from twodof.export.compiler import host_platform
from twodof.files import data_file

SHAPES = re.compile(r"<mesh [^>]*>")


@pytest.fixture(scope="module")
def description(fmu_path):
    with zipfile.ZipFile(fmu_path) as archive:
        return etree.fromstring(archive.read("modelDescription.xml"))


def test_fmpy_finds_no_problem(fmu_path):
    assert validate_fmu(str(fmu_path)) == []


def test_every_name_unit_and_start_is_as_designed(fmu_path):
    variables = {v.name: v for v in read_model_description(str(fmu_path)).modelVariables}
    assert [v.valueReference for v in variables.values()] == list(range(1, len(variables) + 1))
    pi = repr(np.pi)
    expected = {
        ("input", "m"): {"x_des[1]": "0.2", "x_des[2]": "0.05"},
        ("input", "m/s"): {"xd_des[1]": "0.0", "xd_des[2]": "0.0"},
        ("input", "m/s2"): {"xdd_des[1]": "0.0", "xdd_des[2]": "0.0"},
        ("input", "1/s2"): {"Kp[1]": "50.0", "Kp[2]": "50.0"},
        ("input", "1/s"): {"Kd[1]": "40.0", "Kd[2]": "40.0", "Kn": "0.0"},
        ("input", "N.m"): {"tau_ext[1]": "0.0", "tau_ext[2]": "0.0"},
        ("input", "N"): {"f_ext[1]": "0.0", "f_ext[2]": "0.0", "f_ext[3]": "0.0"},
        ("output", "rad"): {"q[1]": "0.5", "q[2]": "0.35", "q_meas[1]": None, "q_meas[2]": None},
        ("output", "rad/s"): {"v[1]": "0.0", "v[2]": "0.0", "v_meas[1]": None, "v_meas[2]": None},
        ("output", "m"): {"x[1]": None, "x[2]": None},
        ("output", "m/s"): {"xd[1]": None, "xd[2]": None},
        ("output", "N.m"): {"tau[1]": None, "tau[2]": None},
        ("local", "rad/s"): {"der(q[1])": None, "der(q[2])": None},
        ("local", "rad/s2"): {"der(v[1])": None, "der(v[2])": None},
        ("parameter", "rad"): {
            "q_start[1]": "0.5",
            "q_start[2]": "0.35",
            "q_min[1]": f"-{pi}",
            "q_min[2]": f"-{pi}",
            "q_max[1]": pi,
            "q_max[2]": pi,
            **{f"q_{what}[{i}]": "0.0" for what in ("resolution", "noise") for i in (1, 2)},
        },
        ("parameter", "rad/s"): {f"v_{what}[{i}]": "0.0" for what in ("start", "noise") for i in (1, 2)},
        ("parameter", "m/s2"): {"gravity[1]": "0.0", "gravity[2]": "-9.81", "gravity[3]": "0.0"},
        ("parameter", "s"): {"max_step": "0.001", "control_period": "0.0", "control_delay": "0.0"},
        ("parameter", "kg"): {"payload": "0.0"},
        ("parameter", "N.m"): {"friction[1]": "0.0", "friction[2]": "0.0"},
        ("parameter", "N.m.s/rad"): {"damping[1]": "0.0", "damping[2]": "0.0"},
        ("parameter", "kg.m2"): {"armature[1]": "0.0", "armature[2]": "0.0"},
        ("parameter", "m"): {f"payload_com[{i}]": "0.0" for i in (1, 2, 3)},
        ("parameter", None): {
            "rcond": "0.01",
            "rtol": "0.001",
            "atol": "1e-06",
            "seed": "0",
            "integrator": "0",
            "v_from_q": "false",
            "limit_effort": "false",
            "rigid_stops": "false",
            "payload_known": "false",
        },
    }
    by_unit: dict = {}
    for v in variables.values():
        by_unit.setdefault((v.causality, v.unit), {})[v.name] = v.start
        assert v.description
        assert v.variability == ("fixed" if v.causality == "parameter" else "continuous")
    assert by_unit == expected


def test_units_are_given_in_si_base_units(description):
    dimensions = {
        unit.get("name"): {key: int(x) for key, x in unit[0].attrib.items() if key != "factor"}
        for unit in description.iter("Unit")
    }
    assert dimensions == {
        "m": {"m": 1},
        "m/s": {"m": 1, "s": -1},
        "m/s2": {"m": 1, "s": -2},
        "rad": {"rad": 1},
        "rad/s": {"rad": 1, "s": -1},
        "N.m": {"kg": 1, "m": 2, "s": -2},
        "s": {"s": 1},
        "1/s": {"s": -1},
        "1/s2": {"s": -2},
        "N": {"kg": 1, "m": 1, "s": -2},
        "kg": {"kg": 1},
        "kg.m2": {"kg": 1, "m": 2},
        "N.m.s/rad": {"kg": 1, "m": 2, "s": -1, "rad": -1},
        "rad/s2": {"rad": 1, "s": -2},
    }
    assert {base.get("factor") for base in description.iter("BaseUnit")} == {"1"}


def test_attributes_that_tools_rely_on(description):
    simulation = description.find("CoSimulation")
    for capability in (
        "canHandleVariableCommunicationStepSize",
        "canGetAndSetFMUstate",
        "canSerializeFMUstate",
        "needsExecutionTool",
    ):
        assert simulation.get(capability) == "true"
    assert description.get("generationDateAndTime") is None
    assert description.get("variableNamingConvention") == "structured"
    assert dict(description.find("DefaultExperiment").attrib) == {
        "startTime": "0.0",
        "stopTime": "5.0",
        "stepSize": "0.01",
    }
    names = [j.get("name") for j in description.iterfind("VendorAnnotations/Tool/Robot/Joint")]
    assert names == ["joint1", "joint2"]


def test_guid_is_the_digest_of_description_sources_and_resources(fmu_path):
    with zipfile.ZipFile(fmu_path) as archive:
        xml = archive.read("modelDescription.xml")
        guid = etree.fromstring(xml).get("guid")
        digest = hashlib.sha256(xml.replace(f'guid="{guid}"'.encode(), b'guid=""'))
        for name in sorted(archive.namelist()):
            if name.startswith(("resources/", "sources/")):
                digest.update(name.encode() + b"\0" + archive.read(name))
    assert guid == digest.hexdigest()


def test_the_zip_has_the_files_that_tools_and_people_expect(fmu_path):
    with zipfile.ZipFile(fmu_path) as archive:
        names = archive.namelist()
        urdf = archive.read("resources/robot.urdf").decode()
        page = archive.read("documentation/index.html").decode()
        assert archive.read("model.png").startswith(b"\x89PNG")
        for info in archive.infolist():
            assert info.date_time == (1980, 1, 1, 0, 0, 0)
    assert names == sorted(names)
    assert {
        "binaries/linux64/TwoDof.so",
        "documentation/externalDependencies.txt",
        "documentation/licenses/license.txt",
        "documentation/licenses/pythonfmu.txt",
        "resources/requirements.txt",
    } < set(names)
    meshes = set(re.findall(r"package://([^\"]+)", urdf))
    assert len(meshes) == 4
    assert {f"resources/{name}" for name in meshes} < set(names)
    assert "x_des[1]" in page
    assert not re.search(r"\$\w", page)


def test_the_same_inputs_give_the_same_bytes(fmu_path, native_path, tmp_path):
    """Process, folder, time zone, locale and hash seed differ."""
    code = """import twodof
twodof.build_fmu("python.fmu")
twodof.build_fmu("native.fmu", twodof.FmuOptions(native=True))
"""
    environment = {**os.environ, "PYTHONHASHSEED": "7", "TZ": "Asia/Tokyo", "LC_ALL": "C"}
    package = str(Path(data_file("plant")).parents[1])
    environment["PYTHONPATH"] = os.pathsep.join([package, environment.get("PYTHONPATH", "")])
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)
    assert (tmp_path / "python.fmu").read_bytes() == fmu_path.read_bytes()
    assert (tmp_path / "native.fmu").read_bytes() == native_path.read_bytes()


def test_an_fmu_that_is_up_to_date_is_left_alone(fmu_path, tmp_path):
    path = tmp_path / "A.fmu"
    path.write_bytes(fmu_path.read_bytes())
    os.utime(path, (1e9, 1e9))
    build_fmu(path)
    assert path.stat().st_mtime == 1e9
    build_fmu(path, FmuOptions(gravity=(0.0, 0.0, 0.0)))
    assert path.stat().st_mtime > 1e9


@pytest.mark.parametrize("native", [False, True])
def test_a_doctored_fmu_does_not_count_as_the_one_that_is_built(native, tmp_path):
    """Its code would run, though the user named a URDF only. The default arm's FMU is made again."""
    urdf = Path(shutil.copy(data_file("urdf", "2dof.urdf"), tmp_path / "my.urdf"))
    robot = FmuOptions(urdf=urdf, native=native, meshes=False)
    for options in (robot, FmuOptions(native=native)):
        path = tmp_path / "A.fmu"
        path.unlink(missing_ok=True)
        good = build_fmu(path, options).read_bytes()
        for part in ("resources/", "binaries/linux64/"):
            with zipfile.ZipFile(io.BytesIO(good)) as archive, zipfile.ZipFile(path, "w") as other:
                other.comment = archive.comment
                names = archive.namelist()
                victim = next(name for name in names if name.startswith(part))
                for name in names:
                    other.writestr(name, archive.read(name) + b"\n" * (name == victim))
            doctored = path.read_bytes()
            if options is robot:
                with pytest.raises(TwoDofError, match=r"A\.fmu' has the description of this FMU and other contents"):
                    build_fmu(path, options)
                assert path.read_bytes() == doctored
            assert build_fmu(path, options, overwrite=options is robot).read_bytes() == good


def test_an_fmu_of_other_settings_is_replaced_on_request_alone(fmu_path, tmp_path):
    """This holds for any name and builder; only the default arm's FMU is built again."""
    path = tmp_path / "A.fmu"
    path.write_bytes(fmu_path.read_bytes())
    other = build_fmu(path, FmuOptions(control="effort")).read_bytes()
    for options in (None, FmuOptions(native=True), FmuOptions(control="joint")):
        with pytest.raises(TwoDofError, match=r"A\.fmu' is another FMU, and is not replaced"):
            build_fmu(path, options)
    assert path.read_bytes() == other
    assert build_fmu(path, overwrite=True).read_bytes() == fmu_path.read_bytes()
    (tmp_path / "B.fmu").write_text("notes")
    with pytest.raises(TwoDofError, match=r"B\.fmu' is not an FMU, and is not replaced"):
        build_fmu(tmp_path / "B.fmu")
    assert build_fmu(tmp_path / "B.fmu", overwrite=True).read_bytes() == fmu_path.read_bytes()


@pytest.mark.parametrize(
    ("file", "name"), [("ur5.urdf", "ur5"), ("ur-5.urdf.xacro", "ur_5"), ("5.urdf", "robot_5"), (None, "TwoDof")]
)
def test_a_model_is_named_after_its_robot(file, name):
    assert FmuOptions(urdf=file).name == name
    assert FmuOptions(urdf=file, name="Own").name == "Own"


def test_a_link_into_the_environment_changes_the_digest(fmu_path, tmp_path):
    linked = build_fmu(tmp_path / "L.fmu", FmuOptions(link_environment=True))
    guids = {read_model_description(str(path)).guid for path in (fmu_path, linked)}
    assert len(guids) == 2


def test_a_urdf_of_ones_own_gets_the_documented_defaults(panda, tmp_path):
    urdf = tmp_path / "panda.urdf"
    urdf.write_text(SHAPES.sub("<sphere radius='0.01'/>", panda))
    fmu = build_fmu(tmp_path / "P.fmu", FmuOptions(urdf=urdf, frame="panda_hand_tcp", name="P"))
    start = {v.name: v.start for v in read_model_description(str(fmu)).modelVariables}
    assert [float(start[f"gravity[{i}]"]) for i in (1, 2, 3)] == [0.0, 0.0, -9.81]
    middle = (-3.0718 - 0.0698) / 2  # joint 4's limits leave 0 out
    q = [float(start[f"q_start[{i}]"]) for i in range(1, 8)]
    assert q == pytest.approx([0, 0, 0, middle, 0, 0, 0])
    assert float(start["Kn"]) == 10.0
    # the hand's position by the arm's published lengths, for this pose of the elbow
    assert [float(start[f"x_des[{k}]"]) for k in (1, 2, 3)] == pytest.approx(_panda_hand(middle), abs=1e-9)


def _panda_hand(elbow):
    """Planar chain in x-z: shoulder 0.333, upper arm 0.316, elbow offset 0.0825, forearm 0.384,
    wrist offset 0.088, flange 0.107 and hand 0.1034; m. Joint 4 turns about −y."""
    x, z = 0.0825, 0.333 + 0.316
    c, s = np.cos(-elbow), np.sin(-elbow)
    # in the forearm's frame: back by the offset, out by the forearm, then the wrist hangs down
    forward, up = -0.0825 + 0.088, 0.384 - 0.107 - 0.1034
    return [x + c * forward + s * up, 0.0, z - s * forward + c * up]


@pytest.mark.parametrize(
    "options, message",
    [
        ({"axes": "xyz"}, "the shipped arm moves in the x-y plane"),
        ({"name": "Two Dof"}, "name 'Two Dof' must be an identifier"),
        ({"frame": "hand"}, "no frame 'hand' in the URDF; there are: .*EndEffector"),
        ({"frame": ""}, "no frame ''"),
        ({"axes": ""}, "axes ''"),
        ({"q_start": (1.0,)}, "q_start has 1 values, the robot has 2 joints: joint1, joint2"),
        ({"gravity": (0.0, float("nan"), 0.0)}, r"gravity\[2\] = nan is not finite"),
        ({"gravity": (0.0, -9.81)}, "gravity has 3 elements, 2 were given"),
        ({"mesh_dir": "nowhere"}, "the mesh folder 'nowhere' does not exist"),
        ({"urdf": ""}, "is not a URDF: it is a folder"),
        ({"urdf": Path("nowhere.urdf")}, "there is no URDF 'nowhere.urdf'"),
    ],
)
def test_bad_options_are_refused_and_leave_nothing(options, message, tmp_path):
    with pytest.raises(TwoDofError, match=message):
        build_fmu(tmp_path / "A.fmu", FmuOptions(**options))
    assert list(tmp_path.iterdir()) == []


def test_an_fmu_contains_only_files_of_its_robot(tmp_path):
    urdf, uri = tmp_path / "in/arm.urdf", "package://etc/passwd"
    urdf.parent.mkdir()
    urdf.write_text(SHAPES.sub(f"<mesh filename='{uri}'/>", data_file("urdf", "2dof.urdf").read_text()))
    with pytest.raises(TwoDofError, match=f"mesh '{uri}' not found in '{urdf.parent}', .*`mesh_dir`"):
        build_fmu(tmp_path / "A.fmu", FmuOptions(urdf=urdf, axes="xy"))
    assert list(tmp_path.iterdir()) == [urdf.parent]


def test_compilation_is_logged(tmp_path, caplog):
    needs("ziglang")
    caplog.set_level("INFO", "twodof.export")
    build_fmu(tmp_path / "TwoDof.fmu", FmuOptions(native=True))
    assert set(caplog.messages) == {f"compiling for {host_platform()}"}


def test_ignored_elements_of_a_urdf_are_reported(tmp_path, caplog):
    urdf = tmp_path / "rough.urdf"
    text = SHAPES.sub("<sphere radius='0.01'/>", data_file("urdf", "2dof.urdf").read_text())
    text = text.replace("<limit ", '<dynamics friction="0.3"/><limit ', 1)
    urdf.write_text(re.sub('ixx="[^"]*"', 'ixx="1"', text, count=1))
    build_fmu(tmp_path / "A.fmu", FmuOptions(urdf=urdf, axes="xy"))
    (record,) = caplog.records
    assert "no body can have these inertias" in record.getMessage()


NAMES = (
    '*/ static int evil; /* "??/ \\ <script>evil()</script> &amp; ${name} %s%n',
    "two\nlines\t\r\x7f7 é1 \u2028 \U0001f916 " + "j" * 900,
)


class Page(HTMLParser):
    """The tags and the text of a page."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.text = [], ""
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)

    def handle_data(self, data):
        self.text += data


@pytest.mark.parametrize("native", [True, False], ids=["native", "python"])
@in_child_process
def test_names_of_a_urdf_are_text_in_all_that_the_fmu_holds(native, tmp_path):
    robot = etree.fromstring(SHAPES.sub("<sphere/>", data_file("urdf", "2dof.urdf").read_text()))
    robot.set("name", NAMES[0])
    names = dict(zip(("joint1", "joint2", "EndEffector"), (*NAMES, NAMES[1])))
    for element in robot.iter():
        for key, value in element.attrib.items():
            element.set(key, names.get(value, value))
    urdf = tmp_path / "arm.urdf"
    urdf.write_bytes(etree.tostring(robot))
    options = FmuOptions(urdf=urdf, axes="xy", frame=NAMES[1], name="Arm", native=native)
    fmu = build_fmu(tmp_path / "Arm.fmu", options)
    with zipfile.ZipFile(fmu) as archive:
        described = etree.fromstring(archive.read("modelDescription.xml")).find(".//Robot")
        page = Page(archive.read("documentation/index.html").decode())
        if native:
            header = archive.read("sources/model.h").decode()
            assert header.isascii()
            code = re.sub(r'(/\*.*?\*/)|"(?:\\.|[^"\\\n])*"', r"\1", header, flags=re.DOTALL)
            assert "evil" not in code  # nor in a comment
    assert [joint.get("name") for joint in described.iter("Joint")] == list(NAMES)
    assert (described.get("name"), described.get("frame")) == NAMES
    assert "script" not in page.tags
    for name in NAMES:
        assert f"position, joint {name}" in page.text
    log = Driver(fmu).initialise(q_start=(4.0, 4.0)).log
    for joint, (_, message) in zip(NAMES, log, strict=True):
        assert f"of joint '{joint}"[:400] in message


def test_joints_are_to_stay_where_they_start(tmp_path):
    """A start position beyond the limits is clamped, and so is the target that it gives."""
    fmu = build_fmu(tmp_path / "x.fmu", FmuOptions(control="joint", settings={"q_start": 9.0}))
    variables = {v.name: v.start for v in read_model_description(str(fmu)).modelVariables}
    assert [float(variables[f"q_des[{i}]"]) for i in (1, 2)] == [np.pi, np.pi]


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(TwoDofError, match=r"cannot write '.*nowhere/A\.fmu'"):
        build_fmu(tmp_path / "nowhere" / "A.fmu")


# --- dependencies, by moving one variable at a time ---

PERTURBATION = {
    "q_start": 0.05,
    "v_start": 0.3,
    "x_des": 0.01,
    "xd_des": 0.1,
    "xdd_des": 0.5,
    "Kp": 5.0,
    "Kd": 5.0,
    "tau_ext": 0.3,
    "Kn": 1.0,
    "gravity": 1.0,
    "rtol": 1e-4,
    "atol": 1e-7,
    "max_step": 1e-4,
    "f_ext": 0.3,
    "payload": 0.05,
    "payload_com": 0.02,
    "control_period": 0.01,
    "control_delay": 0.002,
    "q_resolution": 0.03,
    "q_noise": 0.01,
    "v_noise": 0.01,
    "seed": 1,
    "integrator": 1,
    "friction": 0.05,
    "damping": 0.1,
    "armature": 0.01,
}
NEEDS_A_PERIOD = ("control_delay", "q_resolution", "q_noise", "v_noise", "v_from_q")


def declared(description, element):
    """Names of the variables on which each unknown depends, by its name."""
    names = [v.get("name") for v in description.find("ModelVariables")]
    return {
        names[int(unknown.get("index")) - 1]: {names[int(i) - 1] for i in unknown.get("dependencies").split()}
        for unknown in description.find(f"ModelStructure/{element}")
    }


def moved(before, after):
    return {name for name in before if before[name] != after[name]}


def outputs(driver):
    names = [n for n in driver.vr if re.match(r"(q|v|x|xd|tau|q_meas|v_meas)\[|der", n)]
    return dict(zip(names, driver.call("getReal", [driver.vr[n] for n in names])))


def start_values(driver):
    return {
        v.name: v.start == "true" if v.type == "Boolean" else int(v.start) if v.type == "Integer" else float(v.start)
        for v in driver.description.modelVariables
        if v.start is not None and v.causality != "output"
    }


def put(driver, name, value):
    kind = {bool: "Boolean", int: "Integer", float: "Real"}[type(value)]
    driver.call(f"set{kind}", [driver.vr[name]], [value])


@in_child_process
def test_initial_unknowns_have_exactly_the_declared_dependencies(fmu_path):
    """Joints are inside their ranges and at limits, move in both directions, and are saturated or not."""
    with zipfile.ZipFile(fmu_path) as archive:
        description = etree.fromstring(archive.read("modelDescription.xml"))
    causes: dict = {name: set() for name in declared(description, "InitialUnknowns")}
    generic = {"v_start[1]": 0.7, "v_start[2]": -0.4, "xd_des[1]": 0.1, "xd_des[2]": 0.2}
    generic |= {"payload": 0.3, "payload_known": True}
    rubs = {"friction": 0.1, "damping": 0.2, "armature": 0.02}
    generic |= {f"{group}[{i}]": value for group, value in rubs.items() for i in (1, 2)}
    back = {**generic, "v_start[1]": -0.7, "v_start[2]": 0.4}
    limits = {"q_max[1]": 0.5, "q_min[2]": 0.35}
    stopped = [{**generic, **limits}, {**back, **limits}]
    into = [
        {**generic, "q_min[2]": 0.35},
        {**back, "q_max[2]": 0.35},
        {**generic, "q_max[1]": 0.5},
        {**back, "q_min[1]": 0.5},
    ]
    rigid = [{**base, "rigid_stops": True} for base in into]
    noise = {f"{kind}_noise[{i}]": 0.01 for kind in "qv" for i in (1, 2)}
    for k, base in enumerate((generic, back, *stopped, *rigid)):
        for saturated in (False, True):
            driver = Driver(fmu_path)
            start = {**start_values(driver), **base, "limit_effort": saturated, "Kp[1]": 60.0}
            if not saturated:
                start |= {"control_period": 0.01, **(noise if k % 2 else {})}
            if saturated:
                start["xdd_des[1]"] = 40000.0
            for name, value in start.items():
                put(driver, name, value)
            driver.call("setupExperiment", startTime=0.0)
            driver.call("enterInitializationMode")
            before = outputs(driver)
            for name, value in start.items():
                for changed in candidates(name, start):
                    put(driver, name, changed)
                    for output in moved(before, outputs(driver)):
                        causes[output].add(name)
                put(driver, name, value)
            assert outputs(driver) == before
            driver.free()
    expected = declared(description, "InitialUnknowns")
    # of no effect on this arm, but on others: gravity along the joints' axes, and null-space
    # damping where there is no null space; of two joints, an impact of one moves the other by M₁₂/M₁₁ or M₁₂/M₂₂
    idle = {"gravity[3]", "payload_com[3]", "Kn", "f_ext[3]"}
    moving = ("v[{}]", "der(q[{}])", "v_meas[{}]")
    other = {name.format(i): {f"armature[{3 - i}]"} for name in moving for i in (1, 2)}
    for output, names in causes.items():
        none = idle | other.get(output, set())
        assert names | none == expected[output] | none, (output, names ^ expected[output])
        assert not names & {"rtol", "atol", "max_step"}


def candidates(name, start):
    """Other valid values of a variable."""
    group, _, index = name.partition("[")
    value = start[name]
    if group in NEEDS_A_PERIOD and not start["control_period"]:
        return []
    if group in ("v_from_q", "v_noise") and start["v_noise[1]"] * (group == "v_from_q") + start["v_from_q"]:
        return []
    if isinstance(value, bool):
        return [not value]
    if group == "control_period":
        return [0.02] if start["q_noise[1]"] else [0.02, 0.0] if value else [0.01]
    if group in ("q_min", "q_max"):  # on either side of the start
        near = [start[f"q_start[{index}"] + step for step in (-0.02, 0.02)]
        low, high = start[f"q_min[{index}"], start[f"q_max[{index}"]
        return [x for x in near if (x <= high if group == "q_min" else x >= low)]
    if group == "rcond":
        return [0.9]
    positive = group in (*NEEDS_A_PERIOD, "seed", "integrator")
    lower = [] if value < PERTURBATION[group] and positive else [value - PERTURBATION[group]]
    return [value + PERTURBATION[group], *lower]


@in_child_process
def test_outputs_have_exactly_the_declared_dependencies(fmu_path):
    with zipfile.ZipFile(fmu_path) as archive:
        description = etree.fromstring(archive.read("modelDescription.xml"))
    expected = declared(description, "Outputs") | declared(description, "Derivatives")
    driver = Driver(fmu_path).initialise(v_start=(0.7, -0.4), rcond=0.5)  # one direction dropped
    driver.run(5)
    before = outputs(driver)
    causes: dict = {name: set() for name in expected}
    inputs = [v.name for v in driver.description.modelVariables if v.causality == "input"]
    start = start_values(driver)
    for name in inputs:
        put(driver, name, start[name] + PERTURBATION[name.partition("[")[0]])
        for output in moved(before, outputs(driver)):
            causes[output].add(name)
        put(driver, name, start[name])
    assert outputs(driver) == before
    idle = {"f_ext[3]"}  # of no effect on this arm, across the plane in which it moves
    for name, others in expected.items():
        assert causes[name] | (idle & others) == others & {*inputs}, name


# --- sizes, ranges and types ---

QUANTITY = {"rad": "Angle", "rad/s": "AngularVelocity", "N.m": "Torque", "m": "Length"}


def test_types_have_quantities_and_angles_are_shown_in_degrees(fmu_path):
    description = read_model_description(str(fmu_path))
    for variable in description.modelVariables:
        if variable.unit in QUANTITY:
            declared = variable.declaredType
            assert (declared.quantity, declared.unit) == (QUANTITY[variable.unit], variable.unit)
            assert declared.displayUnit == ("deg" if variable.unit == "rad" else None)
    (deg,) = [u for unit in description.unitDefinitions for u in unit.displayUnits]
    assert deg.name == "deg" and float(deg.factor) == pytest.approx(np.rad2deg(1.0))
    assert description.author and description.copyright


def test_sizes_are_those_of_the_robot(fmu_path):
    variables = {v.name: v for v in read_model_description(str(fmu_path)).modelVariables}

    def size(name):
        variable = variables[name]
        return tuple(x and float(x) for x in (variable.min, variable.max, variable.nominal))

    assert size("q[1]") == (-np.pi, np.pi, None)
    assert size("v[1]") == size("x[1]") == size("q_start[1]") == (None, None, None)
    assert size("tau[1]") == size("tau_ext[2]") == (None, None, 10.0)
    assert size("Kp[2]") == size("Kn") == size("payload") == (0.0, None, None)
    assert size("rtol") == (np.finfo(float).tiny, None, 1e-3)
    assert size("rcond") == (0.0, np.nextafter(1.0, 0.0), None)


@pytest.mark.parametrize("flavour", ["python", "native"])
def test_calls_that_the_description_excludes_are_refused_and_no_others(flavour, fmu_path, native_path):
    driver = Driver(native_path if flavour == "native" else fmu_path)
    ranged = {
        v.name: side
        for v in driver.description.modelVariables
        for side in ((float(v.min or -np.inf), -np.inf), (float(v.max or np.inf), np.inf))
        if np.isfinite(side[0]) and v.causality != "output"
    }
    assert len(ranged) == 26
    for name, (end, beyond) in ranged.items():
        whole = name in ("seed", "integrator")  # the upper end of the seed is the type's
        for value in (int(end), -1) if whole else (end, float(np.nextafter(end, beyond))):
            driver.log.clear()
            driver.initialise(**{name: value})
            driver.call("reset")
            refusals = [message for status, message in driver.log if status == 3]
            assert [message.startswith(f"{name} = ") for message in refusals] == ([] if value == end else [True])
    driver.free()


def test_a_member_of_another_fmu_at_the_output_is_not_read(tmp_path, monkeypatch):
    """It may unpack to gigabytes."""
    (tmp_path / "robot.urdf").write_text(data_file("urdf", "2dof.urdf").read_text("utf-8"), "utf-8")
    path = build_fmu(tmp_path / "robot.fmu", FmuOptions(urdf=tmp_path / "robot.urdf"))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("large", b"")
    read, names = zipfile.ZipFile.read, list[str]()

    def spy(archive, name, *more):
        names.append(name)
        return read(archive, name, *more)

    monkeypatch.setattr(zipfile.ZipFile, "read", spy)
    with pytest.raises(TwoDofError, match="other contents"):
        build_fmu(path, FmuOptions(urdf=tmp_path / "robot.urdf"))
    assert "large" not in names
