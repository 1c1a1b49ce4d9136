"""The pytest plugin and its assertions, in separate runs of pytest."""

import dataclasses
import os
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from harness import python
from native_models import robots_folder
from scipy.spatial.transform import Rotation
from test_pose import BENT, UR

import twodof
from twodof.testing import assert_equal, assert_settles, assert_within_limits

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def runs(tmp_path_factory, native_path):
    """Bags of the default arm: one that settles, a slow one, and one with an external effort."""
    folder = tmp_path_factory.mktemp("runs")
    settings = {"good": {}, "slow": {"Kp": 5.0}, "pushed": {"tau_ext[1]": 1e-3}}
    for name, values in settings.items():
        twodof.run(native_path, twodof.Bag(folder / name, effort=True), stop_time=4.0, settings=values)
    return {name: folder / name for name in settings}


@pytest.fixture(scope="module")
def posed(tmp_path_factory):
    """A UR under pose control, and its first sample."""
    options = twodof.FmuOptions(
        urdf=robots_folder() / UR, frame="tool0", control="pose", native=True, meshes=False, q_start=BENT
    )
    fmu = twodof.load_fmu(twodof.build_fmu(tmp_path_factory.mktemp("posed") / "ur.fmu", options))
    return fmu, next(twodof.samples(fmu))


def test_a_run_that_is_as_asserted_passes(runs):
    assert_settles(runs["good"], within=3.1)
    assert_within_limits(twodof.read_bag(runs["good"]))
    assert_equal(runs["good"], twodof.read_bag(runs["good"]), within=0.0)


def test_settling_is_that_of_the_error(runs):
    """The time in the message is that of the last sample whose distance exceeds 2 % of the first."""
    bag = twodof.read_bag(runs["good"])
    distance = ((bag.x - (0.2, 0.05)) ** 2).sum(axis=1) ** 0.5
    outside = bag.t[distance > 0.02 * distance[0]][-1]
    with pytest.raises(AssertionError) as caught:
        assert_settles(bag, within=outside)
    (time,) = re.findall(r"settles after ([\d.]+) s, but must settle within", str(caught.value))
    assert 0.0 < float(time) - outside <= 0.0101
    slow = twodof.read_bag(runs["slow"])
    off = float(((slow.x[300] - (0.2, 0.05)) ** 2).sum() ** 0.5)
    with pytest.raises(AssertionError, match=rf"does not settle, .* at 3 s its error is {off:.3g};"):
        assert_settles(slow, within=3.0)


def test_the_error_that_settles_last_is_named(tmp_path, posed):
    """The position settles before the orientation, whose gains are low."""
    fmu, first = posed
    goal = (Rotation.from_rotvec([0.0, 0.0, 0.5]) * Rotation.from_quat(first.quat)).as_quat()
    settings = {
        "x_des": np.add(first.x, (0.0, 0.05, 0.0)),
        "quat_des": goal,
        "Kp_rot": (2.0,) * 3,
        "Kd_rot": (3.0,) * 3,
    }
    twodof.run(fmu, twodof.Bag(tmp_path / "pose"), stop_time=4.0, settings=settings)
    samples = twodof.samples(fmu, stop_time=4.0, settings=settings)
    angle = 2.0 * np.arccos([min(1.0, abs(np.dot(sample.quat, goal))) for sample in samples])
    assert angle[-1] > 0.02 * angle[0] and angle[0] == pytest.approx(0.5)
    with pytest.raises(AssertionError, match=rf"at 3.3 s its angle from the target orientation is {angle[330]:.3g};"):
        assert_settles(tmp_path / "pose", within=3.3)


def test_an_orientation_that_drifts_from_its_target_does_not_settle(tmp_path, posed):
    """The position settles; the last joint turns under an external effort, without a gain of the orientation."""
    fmu, first = posed
    held = {"x_des": np.add(first.x, (0.0, 0.05, 0.0)), "quat_des": first.quat}
    drifts = {"Kp_rot": (0.0,) * 3, "Kd_rot": (3.0,) * 3, "tau_ext[6]": 0.5}
    verdict = twodof.run(fmu, twodof.Bag(tmp_path / "held"), stop_time=4.0, settings=held).verdict
    assert verdict.outcome == "reached"
    assert_settles(tmp_path / "held", within=verdict.numbers["settling_time"])
    verdict = twodof.run(fmu, twodof.Bag(tmp_path / "drifts"), stop_time=4.0, settings=held | drifts).verdict
    assert verdict.numbers["final_error"] < 0.02 * 0.05 and verdict.numbers["final_turn_error"] > 0.1
    assert "the error of the orientation grew from 0 rad to" in str(verdict)
    with pytest.raises(AssertionError, match=r"does not settle, .* its angle from the target orientation is"):
        assert_settles(tmp_path / "drifts", within=4.0)


def test_an_orientation_near_its_target_is_not_judged_by_its_rounding_error(tmp_path, posed):
    """At the second target the error of the orientation is 2e-7 rad, and at the end 5e-5 rad."""
    fmu, first = posed
    goal = (Rotation.from_rotvec([0.0, 0.0, 0.2]) * Rotation.from_quat(first.quat)).as_quat()
    fast = {"Kp": (50.0,) * 3, "Kd": (15.0,) * 3, "quat_des": goal, "x_des": np.add(first.x, (0.0, 0.05, 0.0))}
    verdict = twodof.run(
        fmu,
        twodof.Bag(tmp_path / "two"),
        stop_time=6.0,
        settings=fast | {"Kp_rot": (40.0,) * 3, "Kd_rot": (13.0,) * 3},
        changes=[(3.0, {"x_des": first.x, "tau_ext[6]": 1e-6})],
    ).verdict
    error = dict(twodof.read_bag(tmp_path / "two").errors())["quat"][1]
    assert 1e-9 < error[300] < 1e-4 and error[-1] > error[300]
    assert verdict.outcome == "reached" and verdict.numbers["settling_time"] < 3.0
    assert_settles(tmp_path / "two", within=2.0)


def test_a_limit_that_is_exceeded_is_named(tmp_path, native_path):
    twodof.run(native_path, twodof.Bag(tmp_path / "fast"), stop_time=0.3, settings={"v_start": (0.0, 30.0)})
    bag = twodof.read_bag(tmp_path / "fast")
    limit = bag.setup.limits.velocity[1]
    assert abs(bag.v[0, 1]) > limit
    with pytest.raises(AssertionError, match=f"v of joint 'joint2' is 30 at 0 s, its limit is {limit:g}"):
        assert_within_limits(bag)


def test_a_limit_of_efforts_that_are_not_recorded_is_not_held(tmp_path):
    robot = """<robot name="r"><link name="a"/><link name="b"><inertial><origin xyz="0.5 0 0"/><mass value="1"/>
        <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j"
        type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/><limit effort="0.5"/></joint></robot>"""
    (tmp_path / "r.urdf").write_text(robot)
    options = twodof.FmuOptions(urdf=tmp_path / "r.urdf", frame="b", control="joint", native=True)
    fmu = twodof.build_fmu(tmp_path / "r.fmu", options)
    for effort, message in (
        (False, "no limit is known of its q, v: "),
        (True, "tau of joint 'j' is .* its limit is 0.5"),
    ):
        bag = twodof.Bag(tmp_path / f"bag{effort}", effort=effort)
        twodof.run(fmu, bag, stop_time=0.1, settings={"q_des": 2.0, "Kp": 500.0})
        with pytest.raises(AssertionError, match=message):
            assert_within_limits(bag.path)


@pytest.mark.parametrize("value", [float("inf"), float("nan")])
def test_a_position_that_is_not_finite_exceeds_its_limit(runs, value):
    bag = twodof.read_bag(runs["good"])
    q = bag.q.copy()
    q[7, 1] = value
    with pytest.raises(AssertionError, match=f"q of joint 'joint2' is {value} at 0.07 s, its limit is"):
        assert_within_limits(dataclasses.replace(bag, q=q))


def test_velocities_in_one_of_two_bags_fail(runs):
    bag = twodof.read_bag(runs["good"])
    with pytest.raises(AssertionError, match="v is missing in the run or in its reference"):
        assert_equal(dataclasses.replace(bag, v=bag.v[:, :0]), bag, within=1.0)


def test_a_deviation_is_named_with_its_time(runs):
    good, pushed = (twodof.read_bag(runs[name]) for name in ("good", "pushed"))
    k = int((abs(good.q - pushed.q) > 1e-5).any(axis=1).argmax())
    i = int((abs(good.q - pushed.q)[k] > 1e-5).argmax())
    text = f"q of joint '{good.joints[i]}' is {pushed.q[k, i]:.9g} instead of {good.q[k, i]:.9g} at {good.t[k]:.6g} s"
    with pytest.raises(AssertionError, match=re.escape(text)):
        assert_equal(pushed, good, within=1e-5)


def test_incomparable_bags_fail(runs):
    """A run without limits, a target or equal samples fails the assertion."""
    good = twodof.read_bag(runs["good"])
    unknown = dataclasses.replace(good, provenance={})
    shorter = dataclasses.replace(good, stamps=good.stamps[:-1], q=good.q[:-1], v=good.v[:-1])
    with pytest.raises(AssertionError, match="no limit is known of its q, v, tau"):
        assert_within_limits(unknown)
    with pytest.raises(AssertionError, match="the run cannot settle"):
        assert_settles(unknown, within=9.0)
    forged = dataclasses.replace(good, provenance={**good.provenance, "start_values": {}}, received=None)
    for within in (9.0, 1e-3):
        with pytest.raises(AssertionError, match="the run cannot settle: the bag has no target"):
            assert_settles(forged, within=within)
    with pytest.raises(AssertionError, match=r"400 samples in 3\.99 s, and its reference 401 samples in 4 s"):
        assert_equal(shorter, good, within=1.0)
    with pytest.raises(AssertionError, match="the joints are a, b, those of the reference joint1, joint2"):
        assert_equal(dataclasses.replace(good, joints=("a", "b")), good, within=1.0)


TEST = """
from twodof.testing import assert_equal, assert_settles

def test_good(run_fmu, check_fmu):
    bag = run_fmu({fmu!r}, stop_time=4.0)
    assert_settles(bag, within=3.1)
    assert_equal(bag, run_fmu({fmu!r}, stop_time=4.0), within=0.0)
    assert check_fmu({fmu!r}).passed

def test_late(run_fmu):
    assert_settles(run_fmu({fmu!r}, stop_time=4.0), within=1.0)
"""


def pytest_of_a_user(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    options = ["-p", "twodof.testing.plugin", "-p", "no:cacheprovider", "--basetemp", folder / "temporary"]
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    return python("-m", "pytest", *arguments, *options, cwd=folder, env=environment)


def test_a_users_tests_have_fixtures_messages_and_plots(tmp_path, native_path):
    (tmp_path / "test_arm.py").write_text(TEST.format(fmu=str(native_path)))
    done = pytest_of_a_user(tmp_path, "--twodof-report", "report")
    assert "1 failed, 1 passed" in done.stdout, done.stdout + done.stderr
    assert "but must settle within 1 s" in done.stdout
    (plot,) = (tmp_path / "report").iterdir()
    assert plot.name == "test_arm.py_test_late.html" and str(plot) in done.stdout
    assert plot.read_text().count("<polyline") == 1


def test_each_failed_test_has_its_own_plot(tmp_path, native_path):
    """Names of tests may be equal after their last slash, in two folders, or in their first 100 characters."""
    text = f"""
import pytest
from twodof.testing import assert_settles

@pytest.mark.parametrize("name", ["arm/x", "leg/x", "{"n" * 100}1", "{"n" * 100}2"])
def test_late(run_fmu, name):
    assert_settles(run_fmu({str(native_path)!r}, stop_time=1.0), within=0.1)
"""
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "__init__.py").write_text("")
        (tmp_path / folder / "test_arm.py").write_text(text)
    done = pytest_of_a_user(tmp_path, "--twodof-report", "report")
    assert "8 failed" in done.stdout and len([*(tmp_path / "report").iterdir()]) == 8, done.stdout


ARM = """
from helper import ACCELERATION
from pythonfmu import Fmi2Causality, Fmi2Slave, Real

class Arm(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.q = self.v = 0.0
        for name, own in (("q[1]", "q"), ("v[1]", "v")):
            getter = lambda own=own: getattr(self, own)
            self.register_variable(Real(name, causality=Fmi2Causality.output, getter=getter))

    def do_step(self, time, step):
        self.v += ACCELERATION * step
        self.q += self.v * step
        return True
"""
VERSIONS = """
import pytest
from twodof.testing import assert_equal

def test_versions(run_fmu):
    old, new, again = (run_fmu(f"{k}/Arm.fmu", stop_time=1.0, step=0.01) for k in (1, 5, 1))
    assert [run.v[-1, 0] for run in (old, new, again)] == pytest.approx([1.0, 5.0, 1.0])
    with pytest.raises(AssertionError):
        assert_equal(new, old, within=1e-9)
"""


def test_two_versions_of_a_python_fmu_run_their_own_code(tmp_path):
    """Their modules have equal names; they have no efforts to record."""
    for k in (1, 5):
        folder = tmp_path / str(k)
        folder.mkdir()
        (folder / "arm.py").write_text(ARM)
        (folder / "helper.py").write_text(f"ACCELERATION = {k}.0\n")
        python("-m", "pythonfmu", "build", "-f", "arm.py", "helper.py", cwd=folder, check=True)
    (tmp_path / "test_arm.py").write_text(VERSIONS)
    done = pytest_of_a_user(tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_bag_whose_name_is_not_text_has_a_plot_of_its_failure(runs, tmp_path, monkeypatch):
    bag = dataclasses.replace(twodof.read_bag(runs["good"]), path=Path(os.fsdecode(b"b\xff")))
    monkeypatch.setattr("twodof.testing.assertions.REPORT", [tmp_path])
    with pytest.raises(AssertionError, match="plot: "):
        assert_settles(bag, within=0.1)
    (page,) = tmp_path.glob("*.html")
    assert "b\\xff" in page.read_text("utf-8")


def test_a_plot_replaces_a_link_and_not_its_target(runs, tmp_path, monkeypatch):
    """Others may have put links to any file into the folder of plots."""
    kept, plot = tmp_path / "kept", tmp_path / "report" / "test_arm.py_test_late.html"
    kept.write_text("kept")
    plot.parent.mkdir()
    plot.symlink_to(kept)
    monkeypatch.setenv("PYTEST_CURRENT_TEST", "test_arm.py::test_late (call)")
    monkeypatch.setattr("twodof.testing.assertions.REPORT", [plot.parent])
    with pytest.raises(AssertionError, match="plot: "):
        assert_settles(runs["good"], within=0.1)
    assert kept.read_text() == "kept"
    assert "<polyline" in plot.read_text() and not plot.is_symlink()


def test_the_plugin_imports_nothing_heavy(tmp_path):
    (tmp_path / "test_light.py").write_text(
        "import sys\n\ndef test_light():\n    assert not {'numpy', 'fmpy', 'pinocchio', 'rosbags'} & {*sys.modules}\n"
    )
    assert pytest_of_a_user(tmp_path).returncode == 0
    entry = 'pytest11]\n"twodof.testing.plugin" = "twodof.testing.plugin"'
    assert entry in (ROOT / "pyproject.toml").read_text()
