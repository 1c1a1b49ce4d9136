"""Linear models: against closed forms, at equilibria, and refusals."""

import json
import re

import fmpy
import numpy as np
import oracles
import pinocchio as pin
import pytest
from harness import forged
from native_models import model as model_of
from native_models import robots_folder
from scipy.linalg import expm

import twodof
from twodof import FmuOptions, build_fmu
from twodof.cli.main import main
from twodof.plant.robot import load_robot

UPRIGHT = [np.pi / 2, 0.0]


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    return build_fmu(tmp_path_factory.mktemp("bare") / "Bare.fmu", FmuOptions(native=True, control="effort"))


def test_a_target_reached_has_the_poles_of_its_gains(native_path):
    """The polynomial is s² + Kd s + Kp; the equilibrium is found from another start."""
    at = {"Kp": [50.0, 80.0], "Kd": [10.0, 30.0]}
    model = twodof.linearise(native_path, at)
    expected = [*np.roots([1.0, 10.0, 50.0]), *np.roots([1.0, 30.0, 80.0])]
    found = [mode.eigenvalue for mode in model.modes]
    assert max(np.abs(np.array(found) - root).min() for root in expected) <= 1e-9
    mode = min(model.modes, key=lambda m: abs(m.eigenvalue - expected[0]))
    assert mode.damping == pytest.approx(10.0 / (2.0 * np.sqrt(50.0)))
    assert mode.frequency == pytest.approx(np.sqrt(50.0))
    assert np.abs(model.rates).max() <= 1e-8 and model.remarks == ()
    x = model.outputs.index("x[1]")  # follows its target: unit gain at s = 0
    gain = model.D - model.C @ np.linalg.solve(model.A, model.B)
    assert gain[x, model.inputs.index("x_des[1]")] == pytest.approx(1.0, abs=1e-9)
    assert model.units["x_des[1]"] == "m" and model.units["v[2]"] == "rad/s"


def test_the_linear_model_predicts_the_first_tenth_of_a_second(bare):
    model = twodof.linearise(bare, {"q": UPRIGHT}, inputs=["tau_cmd"], outputs=["q"])
    assert model.A.shape == (4, 4) and model.B.shape == (4, 2) and model.C.shape == (2, 4)
    starts = {"q_start": [UPRIGHT[0] + 0.01, 0.0], "rtol": 1e-9, "atol": 1e-9}
    last = [*twodof.samples(bare, stop_time=0.1, settings=starts)][-1]
    moved = np.array(last.q) - UPRIGHT
    predicted = (expm(0.1 * model.A) @ [0.01, 0.0, 0.0, 0.0])[:2]
    assert np.abs(moved - predicted).max() <= 0.01 * np.abs(moved).max()


def test_an_equilibrium_holds_still(bare):
    model = twodof.linearise(bare, {"tau_cmd": [0.02, 0.01]})
    q = [model.point[f"q[{i}]"] for i in (1, 2)]
    starts = {"q_start": q, "tau_cmd": [0.02, 0.01]}
    last = [*twodof.samples(bare, stop_time=0.05, settings=starts)][-1]
    assert np.abs(np.array(last.q) - q).max() <= 1e-9


@pytest.mark.parametrize(
    "fmu, at, message",
    [
        ("bare", {"q": [0.0, np.pi]}, "joint 'joint2' is at its limit 3.14159"),
        ("bare", {"tau_cmd": 90.0}, "there is no equilibrium near q_start = "),
        ("bare", {"Kp": 1.0}, "it belongs to control 'task' or "),
        ("task", {"q": [0.3, 0.8], "rcond": "ratio"}, "jumps here"),
        ("python", {}, "has no directional derivatives; build a native FMU"),
    ],
)
def test_a_state_without_a_linear_model_is_refused(fmu, at, message, bare, native_path, fmu_path):
    path = {"bare": bare, "task": native_path, "python": fmu_path}[fmu]
    if at.get("rcond") == "ratio":
        s, c = np.sin([0.3, 1.1]), np.cos([0.3, 1.1])
        sigma = np.linalg.svd([[-s[0] - s[1], -s[1]], [c[0] + c[1], c[1]]])[1]
        at = {**at, "rcond": sigma[1] / sigma[0]}
    with pytest.raises(twodof.TwoDofError, match=message):
        twodof.linearise(path, at)


def test_a_singular_pose_and_a_motion_are_remarked(native_path):
    model = twodof.linearise(native_path, {"q": [0.3, 0.001]})
    assert [remark[:15] for remark in model.remarks] == ["a singular pose", "no equilibrium:"]


def test_a_joint_that_sticks_is_remarked_and_stays_and_one_that_begins_to_slip_is_refused(bare):
    model = twodof.linearise(bare, {"q": [0.3, 0.2], "v": [0.0, 1.0], "friction": [50.0, 0.1]})
    assert "joint 'joint1' sticks by its friction 50: in the model it stays at rest" in model.remarks
    assert not model.A[2].any() and model.A[3].any()
    with pytest.raises(twodof.TwoDofError, match="'joint1' begins to slip against its friction"):
        twodof.linearise(bare, {"q": [0.3, 0.2], "friction": 0.1, "tau_cmd": [9.0, 0.0]})


def test_a_free_joint_has_no_damping_and_a_falling_arm_is_unstable(bare, capsys):
    """Without gravity, joints are free; upright, two of four eigenvalues are unstable."""
    free = twodof.linearise(bare, {"q": [0.3, 0.3], "gravity": 0.0})
    assert [mode.eigenvalue for mode in free.modes] == [0.0] * 4
    assert all(np.isnan(mode.damping) for mode in free.modes) and free.remarks == ()
    assert main(["linearise", str(bare), "--at", "q=0.3,0.3", "--at", "gravity=0"]) == 0
    assert re.findall("^0 +– +0$", capsys.readouterr().out, re.M) == ["0" + 30 * " " + "–  0"] * 4
    upright = twodof.linearise(bare, {"q": UPRIGHT})
    fastest = np.linalg.eigvals(upright.A).real.max()
    (remark,) = upright.remarks
    assert remark.startswith("an unstable equilibrium: 2 of 4 eigenvalues grow")
    assert float(remark.split()[-2]) == pytest.approx(fastest, rel=1e-5)
    assert twodof.linearise(bare, {"q": [-np.pi / 2, 0.0]}).remarks == ()  # hanging


def test_a_pole_of_rounding_is_zero(native_path):
    """With Kp = 0 on one axis, only velocity is controlled, and rounding gave a nonzero pole."""
    q = [0.4, 0.9]
    at = {"q": q, "x_des": oracles.position(np.array(q)), "Kp": [0.0, 50.0], "Kd": [10.0, 20.0]}
    model = twodof.linearise(native_path, at)
    still, *others = model.modes
    assert (still.eigenvalue, still.frequency) == (0.0, 0.0) and np.isnan(still.damping)
    expected = [-10.0, *np.roots([1.0, 20.0, 50.0])]
    found = [mode.eigenvalue for mode in others]
    assert np.sort_complex(np.array(found)) == pytest.approx(np.sort_complex(np.array(expected)), abs=1e-9)


@pytest.fixture(scope="module")
def ur10(tmp_path_factory):
    options = FmuOptions(
        urdf=robots_folder() / "ur_description/urdf/ur10_joint_limited_robot.urdf",
        frame="tool0",
        control="pose",
        native=True,
        meshes=False,
    )
    return build_fmu(tmp_path_factory.mktemp("ur10") / "UR10.fmu", options)


def singular_ratio(fmu, q):
    """σ_min/σ_max of all six rows, by Pinocchio."""
    robot = load_robot(str(twodof.load_fmu(fmu).urdf), "tool0", "xyz")
    data, frame = robot.model.createData(), robot.model.getFrameId("tool0")
    aligned = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    sigma = np.linalg.svd(pin.computeFrameJacobian(robot.model, data, np.array(q), frame, aligned))
    return sigma[1][-1] / sigma[1][0]


def test_singularities_of_the_orientation_count(ur10):
    """The wrist is singular; positions alone can still be controlled."""
    wrist = [0.3, -1.2, 1.4, 0.2, 0.0, 0.3]
    (remark, _) = twodof.linearise(ur10, {"q": wrist}).remarks
    assert remark.startswith("a singular pose: σ_min/σ_max = ")
    near = [*wrist[:4], 0.15, 0.3]
    ratio = singular_ratio(ur10, near)
    assert 0.01 < ratio < 0.1
    with pytest.raises(twodof.TwoDofError, match=f"J⁺ jumps here: σ_min/σ_max = {ratio:.6g} is"):
        twodof.linearise(ur10, {"q": near, "rcond": ratio})
    found = [twodof.linearise(ur10, {"q": near, "rcond": f * ratio}) for f in (0.99, 1.01)]
    assert [model.remarks[0][:15] for model in found] == ["no equilibrium:", "a singular pose"]


def test_half_a_turn_from_the_target_is_refused(ur10):
    """The shortest rotation changes its direction there."""
    q = [0.3, -1.2, 1.4, 0.2, 0.8, 0.3]
    robot = load_robot(str(twodof.load_fmu(ur10).urdf), "tool0", "xyz")
    data, frame = robot.model.createData(), robot.model.getFrameId("tool0")
    pin.framesForwardKinematics(robot.model, data, np.array(q))
    rotation = pin.Quaternion(data.oMf[frame].rotation)

    def away(angle):
        target = pin.Quaternion(pin.AngleAxis(angle, np.array([0.6, 0.0, 0.8]))) * rotation
        return {"q": q, "quat_des": (3.0 * target.coeffs()).tolist()}

    with pytest.raises(twodof.TwoDofError, match="half a turn from quat_des, where the orientation error jumps"):
        twodof.linearise(ur10, away(np.pi))
    for angle in (np.pi - 1e-4, np.pi + 1e-4):
        assert np.isfinite(twodof.linearise(ur10, away(angle)).A).all()


@pytest.mark.parametrize(("tau", "told"), [(9.9, ""), (10.0, "refused"), (-12.0, "saturated")])
def test_an_effort_limit_is_refused_or_reported(tau, told, bare):
    """The URDF's limit is 10 N·m."""
    at = {"q": [0.3, 0.4], "tau_cmd": [tau, 0.1], "limit_effort": True}
    if told == "refused":
        with pytest.raises(twodof.TwoDofError, match="joint 'joint1' is at its effort limit 10"):
            twodof.linearise(bare, at)
        return
    model = twodof.linearise(bare, at, inputs=["tau_cmd"])
    saturated = "joint 'joint1' is saturated: its effort stays at 10, the controller asks for -12"
    assert (saturated in model.remarks) == (told == "saturated")
    assert (model.B[2, 0] == 0.0) == (told == "saturated")


def test_a_state_is_given_by_its_elements_too(bare):
    """Other positions are at their start, and velocities are 0."""
    model = twodof.linearise(bare, {"q[1]": 1.0, "v_start[2]": 0.2, "v[1]": 0.5, "tau_cmd[2]": 0.1})
    point = [model.point[name] for name in ("q[1]", "q[2]", "v[1]", "v[2]", "tau_cmd[2]")]
    assert point == [1.0, 0.35, 0.5, 0.2, 0.1]
    model = twodof.linearise(bare, {"q": 0.2, "q[2]": 0.3})
    assert [model.point[f"{name}[{i}]"] for name in "qv" for i in (1, 2)] == [0.2, 0.3, 0.0, 0.0]
    for name, value, told in (
        ("q[3]", 1.0, "there is no variable 'q[3]': q has 2 elements"),
        ("v", [1.0, 2.0, 3.0], "v has 2 elements, 3 were given"),
        ("q_start[3]", 1.0, "there is no variable 'q_start[3]': q_start has 2 elements"),
    ):
        with pytest.raises(twodof.TwoDofError, match=f"^{re.escape(told)}$"):
            twodof.linearise(bare, {name: value})


def test_groups_that_are_chosen(bare):
    model = twodof.linearise(bare, {"q": UPRIGHT}, inputs=["tau_cmd"], outputs=["x", "tau"])
    assert model.inputs == ("tau_cmd[1]", "tau_cmd[2]")
    assert model.outputs == ("x[1]", "x[2]", "tau[1]", "tau[2]")
    with pytest.raises(twodof.TwoDofError, match="there is no 'Kp'; there are: tau_cmd"):
        twodof.linearise(bare, inputs=["Kp"])


def test_names_of_an_fmu_are_no_commands_to_the_terminal(bare, tmp_path, capsys):
    other = forged(bare, tmp_path, r'"f_ext\[1\]"', '"\x9b2J[1]"')
    assert main(["linearise", str(other), "--at", "q=0.1,0.2"]) == 0
    text = capsys.readouterr().out
    assert text.count(r"\x9b2J[1]") == 3  # of the point, of B and of D
    assert all(c.isprintable() or c == "\n" for c in text)


def test_the_command_prints_the_model(bare, capsys):
    assert main(["linearise", str(bare), "--at", f"q={UPRIGHT[0]},0", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    model = twodof.linearise(bare, {"q": UPRIGHT})
    assert printed["A"] == model.A.tolist() and printed["inputs"] == [*model.inputs]
    assert printed["modes"][0]["frequency"] == model.modes[0].frequency
    assert main(["linearise", str(bare), "--at", f"q={UPRIGHT[0]},0"]) == 0
    text = capsys.readouterr().out
    assert not re.search(r" -0( |$)", text, re.M)
    assert "q[1]        1.5708 rad" in text and "eigenvalue, 1/s" in text
    assert main(["linearise", str(bare), "--at", "q"]) == 2
    assert "--at q: expected NAME=VALUE" in capsys.readouterr().err


@pytest.mark.parametrize("control", ["task", "effort"])
def test_casadi_takes_the_fmu_and_has_the_same_jacobian(control, native_path, bare, tmp_path):
    """It sets states by fmi2SetReal from their start attributes, and reads derivatives by fmi2GetReal.

    The Jacobian agrees with differences of the law in Python.
    """
    import casadi

    path = {"task": native_path, "effort": bare}[control]
    dae = casadi.DaeBuilder("arm", str(fmpy.extract(str(path), str(tmp_path / "unzipped"))), {})
    assert [dae.start(name)[0] for name in dae.x()] == [0.5, 0.35, 0.0, 0.0]
    jacobian = dae.create("f", ["x", "u"], ["ode"]).factory("J", ["x", "u"], ["jac:ode:x"])
    state, inputs = [0.4, 0.3, 0.1, -0.2], [dae.start(name)[0] for name in dae.u()]
    model = twodof.linearise(path, {"q": state[:2], "v": state[2:]})
    theirs = np.array(jacobian(state, inputs))
    assert np.abs(theirs - model.A).max() <= 1e-9 * np.abs(model.A).max()
    plant, columns = model_of("twodof", control).plant(), []
    for i in range(4):
        rates = []
        for h in (1e-4, -1e-4):
            y = np.add(state, h * np.eye(4)[i]).tolist()
            plant.q, plant.v = y[:2], y[2:]
            rates.append(np.r_[plant.der_q, plant.der_v])
        columns.append((rates[0] - rates[1]) / 2e-4)
    assert np.abs(theirs - np.transpose(columns)).max() <= 1e-6 * np.abs(model.A).max()
