"""Results of the benchmarks other than times: all engines compute the same."""

import importlib
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp
from tools import needs

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="module")
def benchmarks():
    """The modules of the benchmarks, whose folder is not a package."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(BENCHMARKS)
        names = ("arms", "steps", "engine", "generated", "listing", "mpc", "report")
        yield SimpleNamespace(**{name: importlib.import_module(name) for name in names})
    for name in names:
        del sys.modules[name]


def test_exact_solution_begins_at_rest_and_obeys_its_equation(benchmarks):
    steps, h = benchmarks.steps, benchmarks.arms.STEP
    e = np.array([steps.exact(k) - steps.X_DES for k in range(0, 500)])
    np.testing.assert_allclose(e[0], steps.position(steps.Q_START) - steps.X_DES)
    # e'' + 40 e' + 50 e = 0 from rest, as a recurrence that is exact for any step
    fast, slow = np.roots([1.0, 40.0, 50.0])
    a, b = np.exp(fast * h), np.exp(slow * h)
    np.testing.assert_allclose(e[2:], (a + b) * e[1:-1] - a * b * e[:-2], atol=1e-14)
    np.testing.assert_allclose(e[1], e[0] * (fast * b - slow * a) / (fast - slow), rtol=1e-13)


def test_the_listing_deviates_by_centimetres_and_the_fmu_does_not(benchmarks, native_path, tmp_path):
    steps = benchmarks.steps
    assert 0.035 <= steps.accuracy(steps.Listing()) <= 0.055
    fmu = steps.FmuInFmpy(native_path, tmp_path, outputs=True)
    assert steps.accuracy(fmu) <= 1e-12
    assert all(time > 0.0 for time in steps.step_times([fmu], passes=1))
    fmu.free()


def test_robots_are_measured_as_they_come(benchmarks, robots):
    urdf = ET.parse(robots / "panda_description/urdf/panda.urdf")
    damping = [
        float(dynamics.attrib["damping"])
        for joint in urdf.iter("joint")
        if joint.get("type") == "revolute" and (dynamics := joint.find("dynamics")) is not None
    ]
    assert list(benchmarks.arms.panda().robot.damping) == damping and len(damping) == 7
    assert list(benchmarks.arms.chain(16).robot.damping) == [0.0] * 16


@pytest.fixture(scope="module")
def mujoco(benchmarks, tmp_path_factory):
    needs("gcc")
    return benchmarks.engine.mujoco_runner(tmp_path_factory.mktemp("mujoco"))


def test_mujoco_has_the_same_arm(benchmarks, mujoco):
    """In free fall from the start, MuJoCo's motion is that of Pinocchio's dynamics."""
    model = benchmarks.arms.shipped_arm().robot.model.copy()
    model.gravity.linear = np.array(benchmarks.arms.STARTS["gravity"])
    data = model.createData()

    def motion(_t: float, y: np.ndarray) -> np.ndarray:
        return np.concatenate([y[2:], pin.aba(model, data, y[:2], y[2:], np.zeros(2))])

    start = [*benchmarks.arms.Q_START, 0.0, 0.0]
    expected = solve_ivp(motion, (0.0, 0.3), start, "DOP853", rtol=1e-12, atol=1e-12).y[:2, -1]
    assert mujoco("free", 30)[1] == pytest.approx(expected, abs=1e-7)


def test_mujoco_has_the_same_controller(benchmarks, mujoco):
    for steps in (1, 50, 500):
        x = benchmarks.steps.position(mujoco("controlled", steps)[1])
        assert x == pytest.approx(benchmarks.steps.exact(steps), abs=1e-9)


def test_mujoco_is_measured_without_its_python_package():
    """The package makes the library read the clock, at more than the cost of a step."""
    code = "import sys, engine; sys.exit('mujoco' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=BENCHMARKS, check=True)


def test_the_rival_has_the_same_right_hand_side(benchmarks):
    arm = benchmarks.arms.chain(4)
    plant = benchmarks.arms.Plant(
        arm.robot, benchmarks.arms.variable_table(arm.robot, {**arm.starts, "tau_ext": (0.1,) * 4})
    )
    plant.initialise()
    q, v = plant.q, [0.3, -0.2, 0.1, 0.4]
    expected = plant.equations_of_motion().acceleration(np.array(q), np.array(v), None, [0] * len(q))[0]
    inputs = [getattr(plant, name) for name in benchmarks.generated.INPUTS]
    for way in benchmarks.generated.WAYS:
        rival = benchmarks.generated.right_hand_side(arm.robot, way)(q, v, *inputs)
        np.testing.assert_allclose(np.array(rival).ravel(), expected, rtol=1e-9)


def test_the_engine_is_timed_in_c(benchmarks, tmp_path):
    arm = benchmarks.arms.shipped_arm()
    costs = [benchmarks.arms.native_cost(arm, tmp_path)()]
    rival = benchmarks.generated.with_rival(arm, None)
    costs += [benchmarks.arms.native_cost(arm, tmp_path, rival)()]
    costs += benchmarks.engine.derivative_costs(benchmarks.arms.shipped_arm("pose"), tmp_path, 100)
    assert all(0.0 < cost < 1e-3 for cost in costs)


def test_a_plan_differs_from_the_fmu_by_runge_kuttas_error(benchmarks, tmp_path):
    """The method has order 4: sixteen steps instead of one divide the error by 16⁴."""
    mpc = benchmarks.mpc
    fmu, sides = mpc.models(tmp_path)
    stops = mpc.joint_stops(fmu)
    plans = [mpc.solve(side, stops, "Gauss-Newton") for side in sides.values()]
    assert {plan.status for plan in plans} == {"Solve_Succeeded"}
    for plan, within in zip(plans[1:], (1e-9, 1e-4)):
        np.testing.assert_allclose(plan.states, plans[0].states, atol=within)
    error, fine = mpc.errors(fmu, sides[mpc.FMU], plans[0])
    assert 0.5 < error / fine / 16**4 < 2.0


def test_growth_is_the_largest_exponent(benchmarks):
    growth = benchmarks.engine.growth
    assert growth([2, 7, 16], [4.0, 49.0, 256.0]) == pytest.approx(2.0)
    assert growth([1, 2, 4], [1.0, 2.0, 16.0]) == pytest.approx(3.0)


def test_tables_are_aligned(benchmarks, capsys):
    benchmarks.report.print_rows("of all", ("", "time"), ("a", "1 s"), ("bcd", "10 s"))
    assert capsys.readouterr().out == "\nof all\n\n       time\n  a     1 s\n  bcd  10 s\n"
