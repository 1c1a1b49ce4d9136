"""Parameters as inputs: they may change during a run, and the FMU has derivatives with respect to them."""

from __future__ import annotations

import ctypes
import math
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pinocchio as pin
import pytest
from fmpy.fmi2 import FMU2Model
from harness import unzipped

import twodof
from twodof.errors import BuildError
from twodof.files import data_file
from twodof.fmu import instantiate, load_fmu
from twodof.fmu.instance import Instance
from twodof.plant.variables import FREE

VALUES: dict[str, Any] = {
    "payload": [0.3],
    "payload_com": [0.02, -0.05, 0.01],
    "gravity": [0.4, -9.0, 1.0],
    "friction": [0.02, 0.01],
    "damping": [0.05, 0.03],
    "armature": [0.004, 0.002],
}
Q, V, TAU = np.array([0.4, -0.7]), np.array([1.1, -2.3]), np.array([0.3, -0.1])


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The bare arm, with all free parameters as inputs, and with none."""
    folder = tmp_path_factory.mktemp("free")
    return {
        name: twodof.build_fmu(
            folder / f"{name}.fmu",
            twodof.FmuOptions(native=True, control="effort", name=name, free=free, outputs=("M",)),
        )
        for name, free in (("free", FREE), ("fixed", ()))
    }


def inverse_dynamics(values: dict[str, Any], v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Return M a + h with friction, by Pinocchio."""
    model = pin.buildModelFromUrdf(str(data_file("urdf", "2dof.urdf")))
    frame = model.frames[model.getFrameId("EndEffector")]
    point = pin.Inertia(values["payload"][0], np.array(values["payload_com"]), np.zeros((3, 3)))
    model.appendBodyToJoint(frame.parentJoint, point, frame.placement)
    model.gravity.linear = np.array(values["gravity"])
    of_joints = np.sign(v) * values["friction"] + v * values["damping"] + a * values["armature"]
    return np.array(pin.rnea(model, model.createData(), Q, v, a)) + of_joints


@pytest.fixture(scope="module")
def slide(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """1 kg on a horizontal slide, whose friction is an input."""
    folder = tmp_path_factory.mktemp("slide")
    inertia = 'ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"'
    joint = '<parent link="base"/><child link="l"/><axis xyz="1 0 0"/>'
    limit = '<limit lower="-1000" upper="1000" effort="1000" velocity="100"/>'
    (folder / "slide.urdf").write_text(
        f'<robot name="slide"><link name="base"/><link name="l"><inertial><mass value="1"/><inertia {inertia}/>'
        f'</inertial></link><joint name="j" type="prismatic">{joint}{limit}</joint></robot>'
    )
    options = twodof.FmuOptions(folder / "slide.urdf", native=True, control="effort", free=("friction",))
    return twodof.build_fmu(folder / "slide.fmu", options)


class FMU2Arm(FMU2Model):
    """The bare arm in initialization mode, as Model Exchange."""

    def open(self, fmu: Path, **values: Any) -> Any:
        description = fmpy.read_model_description(str(fmu))
        self.vr = {v.name: v.valueReference for v in description.modelVariables}
        super().__init__(
            guid=description.guid, modelIdentifier=fmu.stem, instanceName="arm", unzipDirectory=unzipped(fmu)
        )
        self.instantiate()
        self.put(**values)
        self.setupExperiment(startTime=0.0)
        self.enterInitializationMode()
        return self

    def elements(self, *groups: str) -> list[int]:
        return [vr for name, vr in self.vr.items() for group in groups if name.partition("[")[0] == group]

    def put(self, **values: Any) -> None:
        for group, value in values.items():
            self.setReal(self.elements(group), list(value))


@pytest.mark.parametrize("given", [[0.0, 0.0], [0.02, 0.0]], ids=["none", "one"])
@pytest.mark.parametrize("v", [[1.1, -2.3], [0.0, -2.3], [0.0, 0.0]], ids=["both", "second", "neither"])
def test_a_friction_of_0_has_the_derivatives_of_the_smallest_friction(
    fmus: dict[str, Path], given: list[float], v: list[float]
) -> None:
    """M ∂q̈ = −s with the direction s in which a joint moves or begins to move: friction is never negative."""
    smooth = {**VALUES, "friction": np.zeros(2)}
    arm = FMU2Arm.__new__(FMU2Arm).open(
        fmus["free"], **{**smooth, "friction": given}, q_start=Q, v_start=v, tau_cmd=TAU
    )
    arm.exitInitializationMode()
    rates = [arm.vr["der(v[1])"], arm.vr["der(v[2])"]]
    a = np.array(arm.getReal(rates))
    s = np.sign(np.where(v, v, a))
    np.testing.assert_allclose(inverse_dynamics(smooth, np.array(v), a) + s * given, TAU, atol=1e-12)
    zero = inverse_dynamics(smooth, np.array(v), np.zeros(2))
    M = np.column_stack([inverse_dynamics(smooth, np.array(v), unit) - zero for unit in np.eye(2)])
    for _ in range(2):  # the first derivative at a point is computed alone, others together
        for i, vr in enumerate(arm.elements("friction")):
            found = arm.getDirectionalDerivative(rates, [vr], [1.0])
            np.testing.assert_allclose(found, -np.linalg.inv(M)[:, i] * s[i], rtol=1e-10)


def test_a_clamped_joint_that_has_no_friction_has_the_derivatives_of_the_smallest_friction(
    fmus: dict[str, Path],
) -> None:
    """The second joint acts on the first one as if it fell against its friction: both columns are those of M⁻¹."""
    pressed = {"payload": 0.3, "q_max[2]": 0.3, "q_start[2]": 0.3, "rigid_stops": False, "v_start[1]": 1.0}
    rates, knowns = ["der(v[1])", "der(v[2])"], ["friction[1]", "friction[2]"]

    def answer(size: float) -> tuple[np.ndarray, np.ndarray]:
        with instantiate(load_fmu(fmus["free"])) as arm:
            assert isinstance(arm, Instance)
            arm.initialise(0.0, math.inf, {**pressed, **dict.fromkeys(knowns, size)})
            return np.array(arm.reader(rates)()), np.asarray(arm.derivatives(rates, knowns))

    (a, slopes), (after, close) = answer(0.0), answer(1e-6)
    np.testing.assert_allclose(slopes, close, rtol=1e-9)
    np.testing.assert_allclose(slopes.sum(axis=1), (after - a) / 1e-6, rtol=1e-6)
    assert slopes[0].all() and not slopes[1].any()


def slid(fmu: Path, table: list[tuple[float, float]], v: float, tau: float, stop_time: float) -> np.ndarray:
    """Return the velocities of a slide after each millisecond, by Model Exchange and Heun's method.

    Friction is interpolated in the table, which FMPy's CVode does only after steps. A step in which an indicator
    changes its sign ends with an event.
    """
    slide, times, values = FMU2Arm.__new__(FMU2Arm), *zip(*table)
    slide.open(fmu, v_start=[v], tau_cmd=[tau], friction=values[:1]).exitInitializationMode()
    y, rate, z = (ctypes.c_double * 2)(0.0, v), (ctypes.c_double * 2)(), (ctypes.c_double * 3)()

    def event() -> list[bool]:
        while slide.newDiscreteStates()[0]:
            pass
        slide.enterContinuousTimeMode()
        return signs()

    def signs() -> list[bool]:
        slide.getEventIndicators(z, 3)
        return [x > 0.0 for x in z]

    def rates(t: float, state: np.ndarray) -> np.ndarray:
        slide.setTime(t)
        slide.put(friction=[np.interp(t, times, values)])
        y[:] = state.tolist()
        slide.setContinuousStates(y, 2)
        slide.getDerivatives(rate, 2)
        return np.array(rate)

    before, found, h = event(), [v], 1e-3
    for k in range(round(stop_time / h)):
        first = rates(k * h, np.array(y))
        second = rates((k + 1) * h, (begun := np.array(y)) + h * first)
        rates((k + 1) * h, begun + 0.5 * h * (first + second))
        if slide.completedIntegratorStep()[0] or signs() != before:
            slide.enterEventMode()
            before = event()
            slide.getContinuousStates(y, 2)
        found.append(y[1])
    return np.array(found)


@pytest.mark.parametrize("v", [2.0, -2.0])
def test_a_friction_that_rises_from_0_within_a_run_stops_a_slide(slide: Path, v: float) -> None:
    """A ramp from 0 to 1 N takes 0.05 m/s of 1 kg in 0.1 s; then 1 N decelerates the slide until it rests."""
    found = slid(slide, [(0.5, 0.0), (0.6, 1.0)], v, 0.0, 3.0)
    t = np.arange(0.0, 3.0005, 1e-3)
    lost = np.where(t < 0.6, 5.0 * np.maximum(t - 0.5, 0.0) ** 2, t - 0.55)
    np.testing.assert_allclose(found, np.sign(v) * np.maximum(2.0 - lost, 0.0), atol=1.1e-3)
    assert found[-1] == 0.0


def test_a_friction_that_returns_after_a_reversal_acts_against_the_motion(slide: Path) -> None:
    """−1 N drives 1 kg from 0.5 m/s. Friction takes 0.03 N·s until 0.2 s, vanishes, and returns with 0.5 N at 1 s.

    The velocity reverses at 0.47 s, without friction.
    """
    found = slid(slide, [(0.1, 0.2), (0.2, 0.0), (1.0, 0.0), (1.1, 0.5)], 0.5, -1.0, 2.0)
    np.testing.assert_allclose(found[[200, 1000, 1100, 2000]], [0.27, -0.53, -0.605, -1.055], atol=1e-3)


@pytest.mark.parametrize("rests", [False, True])
def test_derivatives_are_those_of_pinocchio(fmus: dict[str, Path], rests: bool) -> None:
    """M ∂q̈ = −∂(M a + h) at a = q̈, in the rows of joints that move, also where friction holds the first joint.

    Central differences are exact: M a + h is of second order in each value.
    """
    moves = slice(1 if rests else 0, None)
    values = {**VALUES, "friction": [5.0, 0.01]} if rests else VALUES
    v = V * [not rests, True]
    arm = FMU2Arm.__new__(FMU2Arm).open(fmus["free"], **values, q_start=Q, v_start=v, tau_cmd=TAU)
    arm.exitInitializationMode()
    rates = [arm.vr["der(v[1])"], arm.vr["der(v[2])"]]
    a = np.array(arm.getReal(rates))
    np.testing.assert_allclose(inverse_dynamics(values, v, a)[moves], TAU[moves], atol=1e-12)
    zero = inverse_dynamics(values, v, np.zeros(2))
    M = np.column_stack([inverse_dynamics(values, v, unit) - zero for unit in np.eye(2)])
    for group in VALUES:
        for i, vr in enumerate(arm.elements(group)):
            rows = changed(values, group, i)
            change = np.array([inverse_dynamics({**values, group: row}, v, a) for row in rows])
            expected = np.zeros(2)
            expected[moves] = -np.linalg.solve(M[moves, moves], (change[1] - change[0])[moves] / 0.5)
            for _ in range(2):  # the first derivative at a point is computed alone, others together
                found = arm.getDirectionalDerivative(rates, [vr], [1.0])
                np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-11, err_msg=f"{group}, {i}")


def test_variables_that_depend_on_a_free_parameter_follow_it(fmus: dict[str, Path]) -> None:
    """The mass matrix, and in initialization mode the impact on a stop."""
    at_the_limit = {"q_start": [np.pi, 0.3], "v_start": [1.0, 0.5], "q_max": [np.pi, np.pi]}
    values = []
    for first, then in ((0.0, 0.3), (0.3, 0.3)):
        arm = FMU2Arm.__new__(FMU2Arm).open(fmus["free"], **at_the_limit, payload=[first])
        before = arm.getReal(arm.elements("M", "v"))
        arm.put(payload=[then])
        values.append((before, arm.getReal(arm.elements("M", "v"))))
    arm.exitInitializationMode()
    assert arm.getReal(arm.elements("M")) == values[1][0][-4:]
    arm.put(payload=[0.0])
    assert arm.getReal(arm.elements("M")) == values[0][0][-4:]
    assert values[0][1] == values[1][1]
    assert all(a != b for a, b in zip(values[0][0][-3:], values[0][1][-3:]) if b != 0.0)


@pytest.mark.parametrize(
    "control, unknown, knowns",
    [("effort", "der(v[1])", VALUES), ("task", "tau[1]", {*VALUES} - {"friction", "damping"})],
)
def test_the_description_has_their_dependents(
    fmus: dict[str, Path], tmp_path: Path, control: str, unknown: str, knowns: Any
) -> None:
    fmu = fmus["free"]
    if control != "effort":
        fmu = twodof.build_fmu(tmp_path / "a.fmu", twodof.FmuOptions(native=True, control=control, free=FREE))
    description = fmpy.read_model_description(str(fmu))
    unknowns = {each.variable.name: each for each in (*description.outputs, *description.derivatives)}
    names = {each.name.partition("[")[0] for each in unknowns[unknown].dependencies}
    assert names & {*VALUES} == {*knowns}


def changed(values: dict[str, Any], group: str, i: int) -> list[np.ndarray]:
    """Return a group's values with one of them 0.25 less and 0.25 more."""
    return [values[group] + change * np.eye(len(VALUES[group]))[i] for change in (-0.25, 0.25)]


def test_a_payload_that_is_dropped_is_a_run_after_a_run(fmus: dict[str, Path]) -> None:
    fine = {"rtol": 1e-11, "atol": 1e-13, "tau_cmd": (0.4, 0.1)}
    changes = [(0.0, {"payload": 0.3}), (0.2, {"payload": 0.0})]
    whole = [s.q for s in twodof.samples(fmus["free"], step=0.01, stop_time=0.5, settings=fine, changes=changes)]
    first = list(twodof.samples(fmus["fixed"], step=0.01, stop_time=0.2, settings={**fine, "payload": 0.3}))
    start = {"q_start": tuple(first[-1].q), "v_start": tuple(first[-1].v)}
    rest = list(twodof.samples(fmus["fixed"], step=0.01, stop_time=0.3, settings={**fine, **start}))
    np.testing.assert_allclose(whole[:21], [s.q for s in first], atol=1e-9)
    np.testing.assert_allclose(whole[20:], [s.q for s in rest], atol=1e-9)
    assert np.abs(whole[-1] - np.array([s.q for s in first][-1])).max() > 0.1


@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("control", ["task", "joint", "pose"])
def test_an_fmu_with_free_parameters_passes_the_checks(tmp_path: Path, control: str, fmi: int) -> None:
    """These compare all derivatives with central differences."""
    options = twodof.FmuOptions(native=True, control=control, fmi=fmi, free=FREE, outputs=("M", "h"))
    report = twodof.check(twodof.build_fmu(tmp_path / "free.fmu", options))
    assert report.passed, report


@pytest.mark.parametrize(
    "given, message",
    [
        ({"free": ("paylod",), "native": True}, "`free` 'paylod' is not a parameter that can be an input.*payload"),
        ({"free": ("payload",)}, "`native=True`"),
        ({"free": ("payload",), "native": True, "part": "controller"}, "the whole robot"),
    ],
)
def test_an_impossible_free_parameter_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(BuildError, match=message):
        twodof.FmuOptions(**given)
