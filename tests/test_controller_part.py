"""The controller as a separate FMU, in closed loop with the bare plant, compared with the FMU of both."""

from __future__ import annotations

import ctypes
import os
import re
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import fmpy.validation
import numpy as np
import pytest
from fmpy import fmi2
from fmpy.ssp.simulation import simulate_ssp
from harness import in_child_process
from scipy.integrate import solve_ivp
from systems import component, connection, loop, pd_fmu, ssd
from tools import needs

import twodof
from twodof.errors import BuildError
from twodof.export.split import SSD
from twodof.fmu import System
from twodof.fmu.ssp_file import STRUCTURE
from twodof.fmu.system_instance import instantiate_fmu
from twodof.plots.track import read_tracks

TARGETS: dict[str, dict[str, Any]] = {"task": {"x_des": (0.25, 0.1)}, "joint": {"q_des": (0.1, 0.9)}}
EXACT: dict[str, Any] = {"rtol": 1e-10, "atol": 1e-12}
STOP = 1.0
FREE = 'suppressUnitConversion="true"'


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A plant and, for each law, the controller, the FMU of both, and the system of plant and controller."""
    folder, built = tmp_path_factory.mktemp("parts"), {}

    def build(name: str, **options: Any) -> Path:
        return twodof.build_fmu(folder / f"{name}.fmu", twodof.FmuOptions(native=True, name=name, **options))

    built["plant"] = build("plant", control="effort")
    wires = "".join(
        connection(f"{a}[{i}]", f"{b}[{i}]")
        for i in (1, 2)
        for a, b in (("plant.q", "pd.q"), ("plant.v", "pd.v"), ("pd.tau_cmd", "plant.tau_cmd"))
    )
    structure = ssd(
        f"<ssd:Elements>{component('pd')}{component('plant')}</ssd:Elements><ssd:Connections>{wires}</ssd:Connections>"
    )
    for law in TARGETS:
        built[f"{law} law"] = build(f"law_{law}", control=law, part="controller")
        built[f"{law} both"] = build(f"both_{law}", control=law, settings={"rigid_stops": True})
        parts = built["plant"].read_bytes(), built[f"{law} law"].read_bytes()
        built[f"{law} split"] = loop(folder / f"{law}.ssp", *parts, structure)
    return built


def q_of(path: Path, step: float = 0.01, **settings: Any) -> np.ndarray:
    """Return q at every 10 ms; an array of N + 1 × 2."""
    given = {name.replace("__", "."): value for name, value in settings.items()}
    rows = [sample.q for sample in twodof.samples(path, step=step, stop_time=STOP, settings=given)]
    return np.array(rows)[:: round(0.01 / step)]


def split_settings(law: str, **settings: object) -> dict[str, Any]:
    """Return settings of a system from those of the controller."""
    return {f"pd__{name}": value for name, value in {**TARGETS[law], **settings}.items()}


@pytest.mark.parametrize("law", TARGETS)
def test_a_split_loop_converges_to_the_whole_with_order_1(fmus: dict[str, Path], law: str) -> None:
    expected = q_of(fmus[f"{law} both"], **TARGETS[law], **EXACT)
    given = {**split_settings(law), **EXACT}
    errors = [np.abs(q_of(fmus[f"{law} split"], 0.01 / n, **given) - expected).max() for n in (1, 2, 4, 8)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[0] > 1e-4
    assert ((orders > 0.9) & (orders < 1.1)).all(), orders


@pytest.mark.parametrize("law", TARGETS)
@pytest.mark.parametrize(("period", "delay"), [(0.01, 0.0), (0.02, 0.0), (0.03, 0.01), (0.01, 0.03)])
def test_a_sampled_split_loop_is_the_whole(fmus: dict[str, Path], law: str, period: float, delay: float) -> None:
    sampling = {"control_period": period, "control_delay": delay}
    sensors = {"q_resolution": 1e-4, "q_noise": 1e-4, "seed": 7}
    for more in ({}, sensors, {"v_from_q": True}):
        whole = q_of(fmus[f"{law} both"], **TARGETS[law], **sampling, **more)
        split = q_of(fmus[f"{law} split"], **split_settings(law, **sampling, **more))
        assert np.ptp(whole) > 0.3
        np.testing.assert_allclose(split, whole, rtol=0, atol=1e-12)


def test_the_controller_may_know_the_payload(fmus: dict[str, Path]) -> None:
    """The plant's payload is known to the controller, or not."""
    for known in (False, True):
        loads = {"payload": 0.2, "payload_known": known}
        whole = q_of(fmus["joint both"], **TARGETS["joint"], **loads, control_period=0.01)
        given = split_settings("joint", **loads, control_period=0.01)
        split = q_of(fmus["joint split"], **given, plant__payload=0.2)
        np.testing.assert_allclose(split, whole, rtol=0, atol=1e-12)


@pytest.mark.parametrize("fmi", [2, 3])
def test_its_description_is_that_of_a_law(tmp_path: Path, fmi: int) -> None:
    options = twodof.FmuOptions(native=True, fmi=fmi, control="pose", part="controller", name="law")
    path = twodof.build_fmu(tmp_path / "law.fmu", options)
    assert fmpy.validation.validate_fmu(path) == []
    description = fmpy.read_model_description(path)
    groups = {v.name.partition("[")[0]: v.causality for v in description.modelVariables}
    assert {"q", "v", "x_des", "Kp", "Kp_rot"} <= {name for name, kind in groups.items() if kind == "input"}
    assert {name for name, kind in groups.items() if kind == "output"} == {"tau_cmd", "q_meas", "v_meas"}
    assert not groups.keys() & {"x", "q_start", "max_step", "friction", "tau_ext", "der(q"}
    assert not description.derivatives


@pytest.mark.parametrize(
    ("key", "inside"), [("plant", [False, True]), ("task law", [True, False]), ("task both", [True] * 2)]
)
def test_its_documentation_draws_the_loop(fmus: dict[str, Path], key: str, inside: list[bool]) -> None:
    """The part of the loop that is not in the FMU is dashed."""
    with zipfile.ZipFile(fmus[key]) as archive:
        drawn = re.findall("<svg.*</svg>", archive.read("documentation/index.html").decode(), re.DOTALL)
    blocks = ET.fromstring(drawn[0]).iter("rect")
    assert [block.get("class") for block in blocks] == ["inside" if here else "outside" for here in inside]


def test_its_effort_is_that_of_the_whole_at_once(fmus: dict[str, Path]) -> None:
    """In co-simulation before any step, and in Model Exchange at any state."""
    whole = next(twodof.samples(fmus["joint both"], settings={"q_start": (0.3, -0.4), **TARGETS["joint"]}))
    starts = {"q[1]": 0.3, "q[2]": -0.4, "q_des[1]": 0.1, "q_des[2]": 0.9}
    for kind in ("CoSimulation", "ModelExchange"):
        result = fmpy.simulate_fmu(
            fmus["joint law"], fmi_type=kind, stop_time=0.01, start_values=starts, output=["tau_cmd[1]", "tau_cmd[2]"]
        )
        np.testing.assert_allclose([*result[0]][1:], whole.tau, rtol=1e-13)


class Model:
    """An FMU of Model Exchange in continuous-time mode."""

    def __init__(self, path: Path, folder: Path, **starts: float) -> None:
        description = fmpy.read_model_description(path)
        self.references = {v.name: v.valueReference for v in description.modelVariables}
        fmpy.extract(path, folder)
        self.fmu = fmi2.FMU2Model(
            guid=description.guid,
            unzipDirectory=str(folder),
            modelIdentifier=description.modelExchange.modelIdentifier,
            instanceName="model",
        )
        self.fmu.instantiate()
        self.set(starts)
        self.fmu.setupExperiment(startTime=0.0)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        self.fmu.newDiscreteStates()
        self.fmu.enterContinuousTimeMode()

    def set(self, values: Mapping[str, float]) -> None:
        self.fmu.setReal([self.references[name] for name in values], [*values.values()])

    def get(self, *names: str) -> list[float]:
        return list(self.fmu.getReal([self.references[name] for name in names]))

    def rates(self, y: np.ndarray) -> np.ndarray:
        """Return the derivatives of q and v at a state."""
        self.fmu.setContinuousStates((ctypes.c_double * len(y))(*y), len(y))
        rates = (ctypes.c_double * len(y))()
        self.fmu.getDerivatives(rates, len(y))
        return np.array(rates)


@pytest.mark.parametrize("law", TARGETS)
def test_in_one_solver_a_split_loop_is_the_whole(fmus: dict[str, Path], tmp_path: Path, law: str) -> None:
    (group, target), names = next(iter(TARGETS[law].items())), ("q[1]", "q[2]", "v[1]", "v[2]")
    starts = {f"{group}[{i + 1}]": value for i, value in enumerate(target)}
    whole = Model(fmus[f"{law} both"], tmp_path / "whole", **starts)
    plant, controller = Model(fmus["plant"], tmp_path / "plant"), Model(fmus[f"{law} law"], tmp_path / "law", **starts)

    def rates(_t: float, y: np.ndarray) -> np.ndarray:
        controller.set(dict(zip(names, y)))
        plant.set(dict(zip(("tau_cmd[1]", "tau_cmd[2]"), controller.get("tau_cmd[1]", "tau_cmd[2]"))))
        return plant.rates(y)

    start = np.array([0.5, 0.35, 0.0, 0.0])
    ends = [
        solve_ivp(rate, (0.0, STOP), start, rtol=1e-11, atol=1e-13).y[:, -1]
        for rate in (rates, lambda _t, y: whole.rates(y))
    ]
    assert np.abs(ends[0] - start).max() > 0.1
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-9)
    for model in (whole, plant, controller):
        model.fmu.terminate()
        model.fmu.freeInstance()


def test_a_controller_is_native_and_has_a_law(tmp_path: Path) -> None:
    for options in ({"control": "effort", "native": True}, {"control": "task"}):
        with pytest.raises(BuildError, match="the controller alone must be native"):
            twodof.FmuOptions(part="controller", **options)
    with pytest.raises(BuildError, match="`part` 'law' is unknown"):
        twodof.FmuOptions(part="law")


@pytest.fixture(scope="module", params=[2, 3])
def fmi(request: pytest.FixtureRequest) -> int:
    """The version of FMI of a split robot."""
    return int(request.param)


@pytest.fixture(scope="module")
def ssp(tmp_path_factory: pytest.TempPathFactory, fmi: int) -> Path:
    """The split default arm, whose controller has a period."""
    settings = {"control_period": 0.01, "payload": 0.1, "Kp": 60.0}
    options = twodof.FmuOptions(part="split", fmi=fmi, settings=settings)
    return twodof.build_fmu(tmp_path_factory.mktemp("ssp") / "arm.ssp", options)


@pytest.mark.parametrize(
    ("known", "words"),
    [
        ({}, "set controller.payload_known=true and controller.payload=0.05"),
        ({"controller.payload_known": True}, "; set controller.payload=0.05"),
    ],
)
def test_the_verdict_names_the_settings_by_which_a_controller_knows_the_payload(
    ssp: Path, known: dict[str, bool], words: str
) -> None:
    settings: dict[str, Any] = {"plant.payload": 0.05, **known}
    lines = twodof.simulate(ssp, settings=settings).verdict.lines
    assert lines[0].endswith(words)
    settings |= {"controller.payload_known": True, "controller.payload": 0.05}
    assert twodof.simulate(ssp, settings=settings).verdict.outcome == "reached"


def test_a_payload_that_only_the_controller_has_is_named(ssp: Path) -> None:
    settings: dict[str, Any] = {"plant.payload": 0.0, "controller.payload": 1.0, "controller.payload_known": True}
    head = twodof.simulate(ssp, settings=settings).verdict.lines[0]
    assert "assumes a payload of 1 kg, which the plant does not have (without it: " in head
    assert head.endswith("; set controller.payload=0")
    cured = twodof.simulate(ssp, settings={**settings, "controller.payload": 0.0}).verdict
    assert cured.outcome == "reached" and not cured.causes


def pushed(ssp: Path, path: Path, value: float, *ends: str) -> Path:
    """Add an FMU to a split robot, with constant outputs that are connected to inputs."""
    wires = (connection(f"push.tau[{i}]", end, more=FREE) for i, end in enumerate(ends, 1))
    with zipfile.ZipFile(ssp) as arm, zipfile.ZipFile(path, "w") as whole:
        for name in arm.namelist():
            text = arm.read(name)
            if name == STRUCTURE:
                for more, end in ((component("push"), b"</ssd:Elements>"), ("".join(wires), b"</ssd:Connections>")):
                    assert text.count(end) == 1
                    text = text.replace(end, more.encode() + end)
            whole.writestr(name, text)
        whole.writestr("resources/push.fmu", pd_fmu(effort=repr(value), replaced={"q_des": "level"}))
    return path


@pytest.mark.parametrize("ends", ["tau_ext[1] tau_ext[2]", "tau_ext[2]", "f_ext[1]", "f_ext[2] f_ext[1]"])
def test_a_verdict_does_without_efforts_of_another_fmu(ssp: Path, tmp_path: Path, ends: str) -> None:
    """A push of 0.3 N·m or N moves the arm away; its values are not known to the verdict."""
    path = pushed(ssp, tmp_path / "pushed.ssp", 0.3, *(f"plant.{end}" for end in ends.split()))
    verdict = twodof.simulate(path, stop_time=8.0, settings={"x_des": (0.25, 0.1)}).verdict
    assert verdict.outcome == "not reached" and verdict.numbers["final_error"] > 1e-3
    assert not any(cause.kind == "load" and "_ext" in cause.subject for cause in verdict.causes)


@pytest.mark.parametrize("driven", ["Kp[2]", "Kd[2]", "xd_des[2]", "x_des[2]"])
def test_a_plot_has_no_closed_form_if_another_fmu_gives_a_gain(ssp: Path, tmp_path: Path, driven: str) -> None:
    path = pushed(ssp, tmp_path / "pushed.ssp", 0.1, f"controller.{driven}")
    twodof.run(path, twodof.Bag(tmp_path / "bag", scene=True), stop_time=0.2)
    (track,) = read_tracks([tmp_path / "bag"])
    assert track.task is None or track.task.closed_form is None


@pytest.mark.parametrize(
    ("step", "period", "delay", "late"),
    [
        (0.01, 0.02, 0.01, ""),
        (0.01, 0.0, 0.0, ""),
        (0.001, 0.007, 0.003, ""),
        (0.015, 0.02, 0.0, "pd.control_period = 0.02 s"),
        (0.02, 0.01, 0.0, "pd.control_period = 0.01 s"),
        (0.01, 0.02, 0.005, "pd.control_delay = 0.005 s"),
    ],
)
def test_times_of_a_controller_between_steps_are_warned_of(
    fmus: dict[str, Path], caplog: pytest.LogCaptureFixture, step: float, period: float, delay: float, late: str
) -> None:
    """Plant and controller exchange signals at communication points alone: up to 0.03 rad from the whole robot."""
    settings = {"pd.control_period": period, "pd.control_delay": delay}
    twodof.experiment(fmus["joint split"], step=step, stop_time=0.6, settings=settings)
    texts = [text for text in caplog.messages if "whole number of communication steps" in text]
    assert [text.partition(" is not")[0] for text in texts] == [late] * bool(late)


def test_a_split_robot_measures_what_its_controller_sees(ssp: Path, tmp_path: Path) -> None:
    settings: dict[str, Any] = {"controller.q_noise": 0.01, "controller.q_resolution": 0.02}
    samples = list(twodof.samples(ssp, stop_time=0.2, settings=settings, signals=True))
    names = twodof.experiment(ssp, signals=True).signals
    seen = np.array([sample.q_meas for sample in samples])
    q = np.array([sample.q for sample in samples])
    assert 0.002 < np.abs(seen - q).max() < 0.06
    plain = names.index("plant.q_meas[1]")
    assert [sample.signals[plain] for sample in samples] == q[:, 0].tolist()
    twodof.run(ssp, twodof.Bag(tmp_path / "bag", measured=True), stop_time=0.2, settings=settings)
    assert (twodof.read_bag(tmp_path / "bag").q == seen).all()


def test_a_split_robot_is_the_whole(ssp: Path, fmi: int, tmp_path: Path) -> None:
    """Each start value goes to its FMU; names are those of the FMU of both."""
    system = twodof.load_fmu(ssp)
    assert isinstance(system, System)
    assert [fmu.version for fmu in system.components.values()] == [fmi, fmi]
    settings = {"payload": 0.1, "Kp": 60.0, "control_period": 0.01}
    whole = twodof.build_fmu(tmp_path / "whole.fmu", twodof.FmuOptions(native=True, settings=settings))
    expected = q_of(whole, **TARGETS["task"])
    np.testing.assert_allclose(q_of(ssp, **TARGETS["task"]), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(q_of(ssp, controller__x_des=(0.25, 0.1)), expected, rtol=0, atol=1e-12)
    lines = "\n".join(twodof.simulate(ssp, settings=TARGETS["task"]).verdict.lines)
    known = "controller.payload_known=true and controller.payload=0.1", "payload_known=true"
    assert lines.replace(*known) == str(twodof.simulate(whole, settings=TARGETS["task"]).verdict)
    late = {**TARGETS["task"], "Kp": 342.0, "Kd": 30.8}
    delays = {"control_delay": 0.05}, {"controller.control_delay": 0.05}
    for fmu, delay in zip((whole, ssp), delays, strict=True):
        verdict = twodof.simulate(fmu, settings={**late, **delay}).verdict
        assert verdict.causes[0].kind == "unstable" and "control_delay = 0.05 s" in verdict.causes[0].text
    starts = twodof.load_fmu(ssp).start_values
    assert (starts["controller.control_period"], starts["control_period"]) == (0.01, 0.0)
    assert (starts["controller.payload"], starts["payload"], starts["rigid_stops"]) == (0.1, 0.1, False)


@pytest.mark.parametrize("turn", [0.3, 1.2])
def test_the_orientation_of_a_split_robot_is_judged_as_that_of_the_whole(fmi: int, turn: float, tmp_path: Path) -> None:
    """The final error is the angle between the target and the arm, which rotates about z by the sum of its joints."""
    options: dict[str, Any] = {"native": True, "control": "pose", "fmi": fmi, "settings": {"control_period": 0.01}}
    verdicts = []
    for part, name in (("all", "arm.fmu"), ("split", "arm.ssp")):
        path = twodof.build_fmu(tmp_path / name, twodof.FmuOptions(part=part, **options))
        settings = {"quat_des": (0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2)), "Kp_rot": 1e-3}
        verdicts.append(twodof.simulate(path, settings=settings).verdict)
        *_, last = twodof.samples(path, settings=settings)
        error = verdicts[-1].numbers["final_turn_error"]
        np.testing.assert_allclose(error, abs(turn - sum(last.q)), rtol=0, atol=1e-9)
    assert verdicts[0].outcome == verdicts[1].outcome == "not reached" and error > 0.1
    assert verdicts[0].numbers == pytest.approx(verdicts[1].numbers, rel=1e-9, abs=1e-12)


def test_a_split_robot_has_a_picture_of_its_components_and_connections(ssp: Path) -> None:
    """In the documentation, and as the geometry of a diagram, in which components do not overlap."""
    with zipfile.ZipFile(ssp) as archive:
        page = archive.read("documentation/index.html").decode()
        structure = ET.fromstring(archive.read("SystemStructure.ssd"))
    tree = ET.fromstring(page[page.index("<body>") : page.index("</html>")])
    texts = {text.text for text in tree.iter("text")}
    rows = [[cell.text for cell in row] for row in tree.iter("tr")]
    assert {"controller", "plant", "effort", "q, v"} <= texts and ["plant.q", "controller.q"] in rows
    boxes = [box.attrib for box in structure.iter(f"{SSD}ElementGeometry")]
    left, right = sorted((float(box["x1"]), float(box["x2"])) for box in boxes)
    assert left[0] < left[1] < right[0] < right[1]


def test_a_split_robot_is_built_again_byte_by_byte(ssp: Path, fmi: int, tmp_path: Path) -> None:
    settings = {"control_period": 0.01, "payload": 0.1, "Kp": 60.0}
    options = twodof.FmuOptions(part="split", fmi=fmi, settings=settings)
    again = twodof.build_fmu(tmp_path / "arm.ssp", options)
    assert again.read_bytes() == ssp.read_bytes()
    twodof.build_fmu(again, options)
    with pytest.raises(BuildError, match="is another file, and is not replaced"):
        twodof.build_fmu(again, twodof.FmuOptions(part="split"))
    with pytest.raises(BuildError, match="a split robot needs a control law"):
        twodof.FmuOptions(part="split", control="effort")


def delayed(path: Path, h: float = 0.01, *, at_start: bool = True) -> list[float]:
    """Return q at STOP of a system whose FMUs receive at each instant the previous outputs, in any order.

    At the start, the outputs are those of the start values, or 0.
    """
    system, steps = twodof.load_fmu(path), round(STOP / h)
    assert isinstance(system, System)
    with ExitStack() as stack:
        parts = {name: stack.enter_context(instantiate_fmu(fmu)) for name, fmu in system.components.items()}
        for name, part in parts.items():
            starts = {node.connector: value for node, value in system.bound.items() if node.element == name}
            part.initialise(0.0, STOP, starts)
        ends = [(link.target, parts[link.source.element].reader([link.source.connector])) for link in system.links]
        for k in range(steps):
            for target, value in [(target, read()[0] if k or at_start else 0.0) for target, read in ends]:
                parts[target.element].set({target.connector: value})
            for part in parts.values():
                part.step(k * h, h)
        return [*parts["plant"].reader(["q[1]", "q[2]"])()]


def test_fmpy_runs_a_split_robot(tmp_path: Path) -> None:
    """FMPy delays connections by one step, which is an error of first order."""
    path = twodof.build_fmu(tmp_path / "arm.ssp", twodof.FmuOptions(part="split"))
    errors = []
    for h in (0.01, 0.005):
        rows = simulate_ssp(path, stop_time=STOP - h / 2, step_size=h)
        theirs = [rows[f"plant.q[{i}]"][-1] for i in (1, 2)]
        np.testing.assert_allclose(theirs, delayed(path, h, at_start=False), rtol=0, atol=1e-12)
        errors.append(np.abs(np.subtract(theirs, [*twodof.samples(path, step=h, stop_time=STOP)][-1].q)).max())
    assert 1.6 < errors[0] / errors[1] < 2.4, errors


def test_libcosim_runs_a_split_robot(tmp_path: Path) -> None:
    needs("libcosimpy")
    needs("libatomic")
    in_libcosim(tmp_path)


@in_child_process
def in_libcosim(tmp_path: Path) -> None:
    """libcosim also delays connections by one step."""
    from libcosimpy.CosimExecution import CosimExecution
    from libcosimpy.CosimObserver import CosimObserver

    path = twodof.build_fmu(tmp_path / "arm.ssp", twodof.FmuOptions(part="split"))
    system = twodof.load_fmu(path)
    assert isinstance(system, System)
    references = {v.name: v.reference for v in system.components["plant"].variables.values()}
    with zipfile.ZipFile(path) as archive:
        archive.extractall(tmp_path / "arm")
    run = CosimExecution.from_ssp_file(ssp_path=str(tmp_path / "arm"), step_size=10_000_000)
    last = CosimObserver.create_last_value()
    run.add_observer(last)
    assert run.simulate_until(round(STOP * 1e9))
    plant = run.slave_index_from_instance_name("plant")
    theirs = last.last_real_values(plant, [references[f"q[{i}]"] for i in (1, 2)])
    np.testing.assert_allclose(theirs, delayed(path), rtol=0, atol=1e-12)


@pytest.mark.parametrize("fmi", [2, 3])
def test_ecos_runs_a_split_robot(fmi: int, tmp_path: Path) -> None:
    needs("ecospy")
    needs("tbb")
    in_ecos(fmi, tmp_path)


@in_child_process
def in_ecos(fmi: int, tmp_path: Path) -> None:
    """ecos also delays connections by one step."""
    from ecospy import EcosSimulation

    path = twodof.build_fmu(tmp_path / "arm.ssp", twodof.FmuOptions(part="split", fmi=fmi))
    os.environ["TMPDIR"] = str(tmp_path)  # where ecos leaves the files of the SSP
    with EcosSimulation(step_size=0.01, ssp_path=str(path)) as simulation:
        simulation.init(parameter_set="initialValues")
        simulation.step(round(STOP / 0.01))
        theirs = [simulation.get_real(f"plant::q[{i}]") for i in (1, 2)]
    np.testing.assert_allclose(theirs, delayed(path), rtol=0, atol=1e-12)
