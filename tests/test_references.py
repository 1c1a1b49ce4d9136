"""Reference trajectories in an FMU: their form, and the faults that they detect."""

from __future__ import annotations

import hashlib
import logging
import re
import subprocess
import zipfile
from collections.abc import Callable
from itertools import product
from pathlib import Path
from unittest.mock import Mock

import fmpy
import lxml.etree
import numpy as np
import pinocchio as pin
import pytest
from friction_oracle import Rubbing
from native_models import robots_folder
from scipy.integrate import solve_ivp
from systems import pd_fmu, values
from tools import needs

import twodof
from twodof.cli.main import main
from twodof.errors import BuildError, FmuError, InputError, SimulationError
from twodof.export.compiler import UNITS
from twodof.fmu import checking
from twodof.fmu.description import load_any_fmu
from twodof.fmu.importers import TOOLS, in_this_master
from twodof.fmu.reference_runs import Reference, references_of
from twodof.fmu.wiring import units_of

FOLDER = "extra/org.fmi-standard.fmi-ls-ref/"
MANIFEST = f"{FOLDER}fmi-ls-manifest.xml"
EXPERIMENTS = ("move", "push", "sample", "rest")
DOWN = {"gravity": (0.0, -9.81, 0.0)}
NEEDED = {
    "libcosim": ("libcosimpy", "libatomic"),
    "ecos": ("ecospy", "tbb"),
    "fmuloader": ("fmuloader",),
    "pathsim": ("pathsim",),
}
ALL_PASSED = {f"reference {name}": "passed" for name in EXPERIMENTS}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default arm's native FMU with references."""
    options = twodof.FmuOptions(native=True, reference=True)
    return twodof.build_fmu(tmp_path_factory.mktemp("references") / "arm.fmu", options)


def members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def packed(files: dict[str, bytes], path: Path) -> Path:
    """Write an FMU whose manifest of references has the files' checksums."""
    manifest = files.get(MANIFEST, b"").decode()
    for name, text in files.items():
        digest = hashlib.sha3_256(text).hexdigest()
        manifest = re.sub(rf'(source="{name.removeprefix(FOLDER)}"[^>]*checksum=")\w*', rf"\g<1>{digest}", manifest)
    files = {**files, **({MANIFEST: manifest.encode()} if manifest else {})}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def rows(path: Path, *tools: str) -> dict[str, checking.Row]:
    """Only the rows of references."""
    fmu = load_any_fmu(path)
    return {row.name: row for row in checking._tried(fmu, checking._runs(fmu, tools))}


def test_the_files_have_the_form_of_the_standards(built: Path) -> None:
    files = members(built)
    manifest = lxml.etree.fromstring(files[MANIFEST])
    named = {name.partition("}")[2]: value for name, value in manifest.attrib.items()}
    assert named["fmi-ls-name"] == "org.fmi-standard.fmi-ls-ref"
    related = {element.get("source"): element for element in manifest}
    assert {FOLDER + source for source in related} | {MANIFEST} == {name for name in files if name.startswith("extra/")}
    for source, element in related.items():
        assert element.get("checksum") == hashlib.sha3_256(files[FOLDER + source]).hexdigest()
    assert [s for s, e in related.items() if e.get("role") == "experiment/smoke-test"] == ["references.exp"]
    schema = next(Path(fmpy.__file__).parent.rglob("SystemStructureParameterValues.xsd"))
    for name in EXPERIMENTS:
        lxml.etree.XMLSchema(file=str(schema)).assertValid(lxml.etree.fromstring(files[f"{FOLDER}{name}.ssv"]))


def test_parameters_that_are_inputs_have_the_values_of_their_experiment(tmp_path: Path) -> None:
    free = ("payload", "payload_com", "armature", "damping", "mass:link2")
    options = twodof.FmuOptions(native=True, reference=True, free=free)
    found = rows(twodof.build_fmu(tmp_path / "arm.fmu", options))
    assert {name: row.outcome for name, row in found.items()} == ALL_PASSED


def test_builds_are_identical_and_references_come_and_go(tmp_path: Path, native_path: Path, built: Path) -> None:
    options = twodof.FmuOptions(native=True, reference=True)
    again = twodof.build_fmu(tmp_path / "arm.fmu", options)
    assert again.read_bytes() == built.read_bytes()
    plain = {name: content for name, content in members(built).items() if not name.startswith("extra/")}
    assert plain == members(native_path)
    python = twodof.build_fmu(tmp_path / "python.fmu")
    before = python.read_bytes()
    twodof.build_fmu(python, twodof.FmuOptions(reference=True))
    assert f"{FOLDER}references.exp" in members(python)
    assert twodof.build_fmu(python).read_bytes() == before


@pytest.mark.parametrize("control", ["task", "pose", "joint", "effort"])
@pytest.mark.parametrize("kind", ["python", "3"])
def test_fmus_meet_their_references(control: str, kind: str, tmp_path: Path) -> None:
    options = twodof.FmuOptions(control=control, reference=True, native=kind == "3", fmi=3 if kind == "3" else None)
    found = rows(twodof.build_fmu(tmp_path / "arm.fmu", options))
    assert {name: row.outcome for name, row in found.items()} == ALL_PASSED


def test_a_panda_meets_its_references_in_the_closed_form(panda: str, tmp_path: Path) -> None:
    (tmp_path / "panda.urdf").write_text(panda)
    start = (0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8)
    options = twodof.FmuOptions(
        tmp_path / "panda.urdf", frame="panda_hand_tcp", q_start=start, meshes=False, native=True, reference=True
    )
    path = twodof.build_fmu(tmp_path / "panda.fmu", options)
    assert b"xd[3] in closed form" in members(path)[f"{FOLDER}references.exp"]
    assert {row.outcome for row in rows(path).values()} == {"passed"}


Changed = Callable[[str, str, str], Path]


@pytest.fixture(scope="module")
def rough(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A native FMU with references; its URDF has friction and damping."""
    folder = tmp_path_factory.mktemp("rough")
    urdf = (
        (Path(__file__).parents[1] / "urdf/2dof.urdf")
        .read_text()
        .replace("<limit", '<dynamics friction="0.002" damping="0.001"/><limit')
    )
    (folder / "arm.urdf").write_text(urdf)
    options = twodof.FmuOptions(
        folder / "arm.urdf", native=True, reference=True, meshes=False, q_start=(0.5, 0.35), settings=DOWN
    )
    return twodof.build_fmu(folder / "arm.fmu", options)


@pytest.fixture
def changed(rough: Path, tmp_path: Path) -> Changed:
    """An FMU whose source has the first match of a pattern after some marks multiplied by 1 + 1e-6."""

    def change(file: str, mark: str, pattern: str) -> Path:
        files = members(rough)
        sources = {Path(name).name: text for name, text in files.items() if name.startswith("sources/")}
        code, place = sources[file].decode(), 0
        for part in mark.split("|"):
            place = code.index(part, place) + len(part)
        match = re.compile(pattern).search(code, place)
        assert match
        sources[file] = f"{code[: match.start()]}({match[0]} * (1.0 + 1e-6)){code[match.end() :]}".encode()
        for name, text in sources.items():
            (tmp_path / name).write_bytes(text)
        command = [needs("gcc"), "-std=c99", "-shared", "-fPIC", *UNITS, "-o", "arm.so", "-lm"]
        subprocess.run(command, check=True, cwd=tmp_path)
        (library,) = (name for name in files if name.endswith(".so"))
        return packed({**files, library: (tmp_path / "arm.so").read_bytes()}, tmp_path / "changed.fmu")

    return change


NUMBER = r"\d+\.\d+(e-?\d+)?"
CONSTANTS = {
    "mass": ("mechanism.c", "end_body->mass = ", NUMBER),
    "centre of mass": ("mechanism.c", "void load_end_body(|#else|end_body->moment[0] = ", NUMBER),
    "inertia": ("mechanism.c", "void load_end_body(|#else|end_body->inertia[5] = ", NUMBER),
    "length": ("mechanism.c", "void task_frame(|#else", NUMBER),
    "inverse dynamics": ("mechanism.c", "void inverse_dynamics(|#else", NUMBER),
    "forward dynamics": ("mechanism.c", "void acceleration_of_effort(|#else", NUMBER),
    "Dormand-Prince": ("dormand_prince.c", "{", r"19372\.0 / 6561"),
    "sine": ("turn.c", "const double s =", r"1\.0 / 6"),
    "noise": ("noise.c", "LN2 = ", NUMBER),
}


@pytest.mark.parametrize("kind", CONSTANTS)
def test_a_constant_that_is_off_by_a_millionth_fails(kind: str, changed: Changed) -> None:
    found = rows(changed(*CONSTANTS[kind]))
    texts = [row.text for row in found.values() if row.outcome == "failed"]
    assert texts and all("the tolerance is 1e-" in text for text in texts), found


@pytest.mark.parametrize("name", ["Kp[1]", "Kd[1]", "gravity[2]", "friction[1]", "damping[2]", "q_start[1]"])
def test_a_start_value_that_is_off_by_a_millionth_fails(name: str, rough: Path, changed: Changed) -> None:
    """No file of the references has it."""
    index = [*load_any_fmu(rough).variables].index(name)
    found = rows(changed("model.h", "double START[|" + "{" + "|," * index, NUMBER))
    texts = [row.text for row in found.values() if row.outcome == "failed"]
    assert texts and all("the tolerance is 1e-" in text for text in texts), found


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("Kp[1]", "Kp[2]"),
        ("Kd[1]", "Kd[2]"),
        ("xdd_des[1]", "xdd_des[2]"),
        ("q_meas[1]", "q_meas[2]"),
        ("v_meas[1]", "v_meas[2]"),
        ("v_start[1]", "v_start[2]"),
        ("armature[1]", "armature[2]"),
        ("payload", "payload_com[1]"),
    ],
)
def test_two_variables_that_are_exchanged_fail(one: str, other: str, built: Path, tmp_path: Path) -> None:
    files = members(built)
    text, swapped = files["modelDescription.xml"].decode(), {one: other, other: one}
    numbers = {name: re.search(rf'name="{re.escape(name)}" valueReference="(\d+)"', text) for name in swapped}
    for name, of in swapped.items():
        number = numbers[of]
        assert number
        text = re.sub(rf'(name="{re.escape(name)}" valueReference=")\d+', rf"\g<1>{number[1]}", text)
    changed = packed({**files, "modelDescription.xml": text.encode()}, tmp_path / "swapped.fmu")
    assert {name: row.outcome for name, row in rows(changed).items()}["reference push"] == "failed"


def of_experiment(name: str, control: str, path: Path) -> tuple[Reference, dict[str, np.ndarray]]:
    """Return an experiment of the default arm, and its results by vector, with the numbers of the steps as "k"."""
    options = twodof.FmuOptions(control=control, reference=True, settings=DOWN)
    fmu = load_any_fmu(twodof.build_fmu(path / "arm.fmu", options))
    (reference,) = (each for each in references_of(fmu) if each.name == name)
    names, numbers = reference.results
    groups = {group: [f"{group}[1]", f"{group}[2]"] for group in ("q", "v", "tau", "q_meas", "v_meas")}
    found = {group: numbers[:, [1 + names.index(own) for own in members]] for group, members in groups.items()}
    return reference, {**found, "k": np.rint(numbers[:, 0] / reference.step).astype(int)}


def pair(reference: Reference, k: int, group: str) -> np.ndarray:
    """Return the values of a parameter or input after k steps."""
    values = {**reference.parameters, **reference.inputs(k)}
    names = (f"{group}[1]", f"{group}[2]")
    return np.array([values.get(name, reference.variables[name].start_value) for name in names], dtype=float)


@pytest.mark.parametrize("control", ["joint", "effort"])
def test_friction_and_stops_are_those_of_an_event_driven_solution(control: str, tmp_path: Path) -> None:
    """Joints stick, slip in both directions, and reach and leave stops."""
    reference, found = of_experiment("rest", control, tmp_path)
    model = pin.buildModelFromXML(twodof.load_fmu(tmp_path / "arm.fmu").urdf)
    model.gravity.linear = np.array(DOWN["gravity"])
    rows, q, v = [], pair(reference, 0, "q_start"), np.zeros(2)
    for block in range(0, 50, 5):
        given = {name: pair(reference, block, name) for name in ("q_des", "v_des", "Kp", "Kd") if control == "joint"}
        pushed = pair(reference, block, "tau_ext") + (0.0 if given else pair(reference, block, "tau_cmd"))

        def effort(q, v, M, h, given=given, pushed=pushed):
            if not given:
                return pushed
            return pushed + h + M @ (given["Kp"] * (given["q_des"] - q) + given["Kd"] * (given["v_des"] - v))

        limits = (pair(reference, 0, name) for name in ("friction", "damping", "armature", "q_min", "q_max"))
        states, _ = Rubbing(model, effort, *limits).run(q, v, 0.01 * np.arange(1, 6))
        rows += [*states]
        q, v = states[-1][:2], states[-1][2:]
    expected = np.array(rows)[found["k"] - 1]
    np.testing.assert_allclose(np.hstack([found["q"], found["v"]]), expected, rtol=0.0, atol=1e-9)
    at = np.isclose(found["q"], pair(reference, 0, "q_min")) | np.isclose(found["q"], pair(reference, 0, "q_max"))
    still = found["v"] == 0.0
    assert all(kind.any() for kind in (still & at, still & ~at, found["v"] > 0.0, found["v"] < 0.0))


def test_a_sampled_motion_is_that_of_its_held_efforts(tmp_path: Path) -> None:
    """Between samples the robot moves under a constant effort, that of the law at the previous measured state."""
    reference, found = of_experiment("sample", "joint", tmp_path)
    model = pin.buildModelFromXML(twodof.load_fmu(tmp_path / "arm.fmu").urdf)
    model.gravity.linear, data = np.array(DOWN["gravity"]), model.createData()
    seen = {k // 3: (q, v) for k, q, v in zip(found["k"], found["q_meas"], found["v_meas"])}
    y, efforts, tau = np.r_[pair(reference, 0, "q_start"), np.zeros(2)], [], np.zeros(2)
    noise = []
    for k in range(50):
        if k % 3 == 0:
            q, v = seen[k // 3]
            noise += [*(q - 1e-3 * np.round(y[:2] / 1e-3)) / 1e-3, *(v - y[2:]) / 1e-2]
            off = [pair(reference, k, f"{g}_des") - x for g, x in (("q", q), ("v", v))]
            efforts.append(pin.rnea(model, data, q, v, 25.0 * off[0] + 10.0 * off[1]).copy())
        if k % 3 == 1:
            tau = efforts[-1]

        def rates(t, y, tau=tau):
            return np.r_[y[2:], pin.aba(model, data, y[:2], y[2:], tau)]

        y = solve_ivp(rates, (0.0, 0.01), y, "LSODA", rtol=1e-12, atol=1e-13).y[:, -1]
        for row in np.flatnonzero(found["k"] == k + 1):
            np.testing.assert_allclose(np.r_[found["q"][row], found["v"][row]], y, rtol=0.0, atol=1e-9)
            if (k + 1) % 3 != 1:
                np.testing.assert_allclose(found["tau"][row], tau, rtol=0.0, atol=1e-9)
    assert len({*np.round(noise, 6)}) == len(noise) and 0.7 < np.std(noise) < 1.3


SAME = ({"q", "q_meas"}, {"v", "v_meas", "der(q)"})
"""Vectors that are equal, because the controller has no noise, and by their definition."""
SYMMETRIC, LEVER = {"M[1,2]", "M[2,1]"}, {"x[1]", "J[2,1]"}
"""Further equal outputs of the arm: its mass matrix, and ∂y/∂q₁ = x of a joint at the origin about z."""


def is_noticed(reference: Reference, rows: np.ndarray) -> bool:
    """Return whether the results of a run fail the reference."""
    try:
        reference.judge(rows)
    except SimulationError:
        return True
    return False


@pytest.mark.parametrize("control", ["task", "joint", "effort"])
def test_an_output_in_the_place_of_another_fails(control: str, tmp_path: Path) -> None:
    """The same holds for 0 in its place. Equal outputs are an exception, and have reasons."""
    options = twodof.FmuOptions(control=control, native=True, reference=True, outputs=("M", "h", "J", "drift"))
    fmu = load_any_fmu(twodof.build_fmu(tmp_path / "arm.fmu", options))
    of_states = [name for name in fmu.variables if name.startswith("der(")]
    unnoticed, all_noticed = set[tuple[str, ...]](), set[tuple[str, ...]]()
    for reference in references_of(fmu):
        names = reference.results[0]
        rows = in_this_master(fmu, reference, names)
        assert not is_noticed(reference, rows)
        for (i, name), other in product(enumerate(names), (None, *range(len(names)))):
            if i != other:
                changed = rows.copy()
                changed[:, i] = 0.0 if other is None else rows[:, other]
                pair: tuple[str, ...] = (name,) if other is None else (name, names[other])
                (all_noticed if is_noticed(reference, changed) else unnoticed).add(pair)
    assert {name for name, *_ in all_noticed} == {*fmu.real_outputs, *of_states}
    for pair in unnoticed - all_noticed:
        alike = {re.sub(r"\[.*?\]", "", name) for name in pair}
        own = len({re.sub(r"\D", "", name) for name in pair}) == 1 and any(alike <= vectors for vectors in SAME)
        assert own or {*pair} in (SYMMETRIC, LEVER), pair


@pytest.mark.parametrize("damping", [2.0, 50.0])
def test_a_stiff_joint_meets_its_references_at_the_usual_tolerance(damping: float, tmp_path: Path) -> None:
    """In its acceleration, damping / inertia multiplies an error of its velocity, here by 1e4 or more per second."""
    options = twodof.FmuOptions(native=True, reference=True, settings={"damping": (0.0, damping)})
    path = twodof.build_fmu(tmp_path / "arm.fmu", options)
    assert {name: row.outcome for name, row in rows(path).items()} == ALL_PASSED, rows(path)
    tolerances = {reference.name: reference.tolerance for reference in references_of(load_any_fmu(path))}
    assert tolerances == {**dict.fromkeys(("move", "push", "sample"), 1e-10), "rest": 1e-8}


@pytest.mark.parametrize("control", ["task", "joint", "effort"])
def test_each_input_acts_on_results(control: str, tmp_path: Path) -> None:
    """0 in its place fails. Only a force across the plane of the arm, and damping of no redundant joint, do nothing."""
    options = twodof.FmuOptions(control=control, native=True, reference=True)
    fmu = load_any_fmu(twodof.build_fmu(tmp_path / "arm.fmu", options))
    idle = {name for name, variable in fmu.variables.items() if variable.causality == "input"}
    for reference in references_of(fmu):
        names, numbers = reference.stimuli
        for i, name in enumerate(names, 1):
            changed = numbers.copy()
            changed[:, i] = 0.0
            stimulated = reference._replace(stimuli=(names, changed))
            if is_noticed(reference, in_this_master(fmu, stimulated, reference.results[0])):
                idle.discard(name)
    assert idle == {"f_ext[3]", *(["Kn"] if control == "task" else [])}


def test_another_compiler_gives_results_within_the_tolerance(changed: Changed) -> None:
    """It is the control of the test above: the same procedure with a change that has no effect."""
    found = rows(changed("mechanism.c", "void effort_bounds(|{", NUMBER))
    assert {row.outcome for row in found.values()} == {"passed"}, found


@pytest.mark.parametrize("tool", TOOLS)
def test_another_tool_meets_them(tool: str, built: Path) -> None:
    for name in NEEDED.get(tool, ()):
        needs(name)
    found = rows(built, tool)
    assert [row.outcome for row in found.values()] == ["passed"] * 8 and f"reference push with {tool}" in found


def test_a_tool_that_is_missing_or_has_nothing_to_run_is_refused(
    built: Path, native_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("twodof.fmu.importers.find_spec", lambda name: None if name == "ecospy" else name)
    assert main(["check", str(built), "--with", "ecos"]) == 1
    assert "ecos is not installed: pip install ecospy" in capsys.readouterr().err
    assert main(["check", str(native_path), "--with", "fmpy"]) == 1
    assert "carries no references to run; build one with --reference" in capsys.readouterr().err
    with pytest.raises(InputError, match="did you mean 'fmpy'"):
        twodof.check(built, tools=["fmpi"])


@pytest.mark.parametrize(
    ("name", "old", "new", "text"),
    [
        ("push-ref.csv", b"0.01,", b"0.01,x", "could not convert"),
        ("push-ref.csv", b"\n0.01,", b"\n-0.01,", "it has results at -0.01 s, before its start"),
        ("references.exp", b'tolerance="1e-10"', b'tolerance="inf"', "its tolerance inf is not finite and >= 0"),
        ("references.exp", b'tolerance="1e-10"', b'tolerance="-1"', "its tolerance -1 is not finite and >= 0"),
        ("push-ref.csv", b"\n0.02,", b"\n0.02,1,", "cannot be read"),
        ("push.ssv", b"ssv:Real", b"ssv:Complex", "is of type Complex, which cannot be set"),
        ("references.exp", b'"push.ssv"', b'"none.ssv"', "none.ssv"),
        ("references.exp", b'"push.ssv"', b'"' + b"%2e" * 2000 + b'"', "6000 characters; at most 4096 are supported"),
        ("references.exp", b'"push.ssv"', b'"../../../../etc/passwd"', "etc/passwd"),
        ("references.exp", b"<Experiments", b"<!DOCTYPE x><Experiments", "declares entities"),
        ("references.exp", b'stepSize="0.01"', b'stepSize="0"', "must be a run of at most"),
        ("push-ref.csv", b"time,", b"x" * 200_000 + b",", "field larger than field limit"),
        ("references.exp", b'name="push"', b'name="move"', "have the same name"),
        ("references.exp", b'name="push"', b'name="' + b"p" * 1001 + b'"', "a name of more than 1000 characters"),
        ("push-in.csv", b"tau_ext[1]", b"tau_axt[1]", "there is no variable 'tau_axt[1]'"),
    ],
)
def test_damaged_references_fail_their_row(
    built: Path, tmp_path: Path, name: str, old: bytes, new: bytes, text: str
) -> None:
    files = members(built)
    assert old in files[FOLDER + name]
    files[FOLDER + name] = files[FOLDER + name].replace(old, new)
    found = rows(packed(files, tmp_path / "damaged.fmu"))
    assert any(row.outcome == "failed" and text in row.text for row in found.values()), found


@pytest.mark.parametrize(("control", "frame", "urdf"), [
    ("joint", "link7", "xarm_description/urdf/xarm7.urdf"),
    ("effort", "gripperMover", "z1_description/urdf/z1.urdf"),
])  # fmt: skip
def test_strong_friction_on_light_joints_has_a_reference(
    control: str, frame: str, urdf: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Their URDFs have no rotors, and friction that alone would decelerate a wrist by 10,000 rad/s²."""
    options = twodof.FmuOptions(
        robots_folder() / urdf, frame=frame, control=control, native=True, meshes=False, reference=True
    )
    path = twodof.build_fmu(tmp_path / "arm.fmu", options)
    assert not [record for record in caplog.records if record.levelno > logging.INFO]
    (rest,) = (reference for reference in references_of(load_any_fmu(path)) if reference.name == "rest")
    assert rest.tolerance == 1e-8
    assert {row.outcome for row in rows(path).values()} == {"passed"}


def test_a_sensitive_motion_with_impacts_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def differing(*_: object) -> None:
        raise BuildError("no references: solvers and closed form differ by 0.1 in q[1]")

    monkeypatch.setattr("twodof.export.references._narrowed", differing)
    fmu = twodof.build_fmu(tmp_path / "arm.fmu", twodof.FmuOptions(native=True, reference=True))
    assert [reference.name for reference in references_of(load_any_fmu(fmu))] == ["move", "push", "sample"]
    assert "no reference has friction and stops: solvers and closed form differ by 0.1 in q[1]" in caplog.messages


def test_the_units_of_an_fmu_are_read_once(built: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read = Mock(side_effect=units_of)
    monkeypatch.setattr("twodof.fmu.reference_runs.units_of", read)
    found = references_of(load_any_fmu(built))
    assert sum(len(reference.parameters) for reference in found) > 1 and read.call_count == 1


def test_the_number_of_readings_is_limited(built: Path, tmp_path: Path) -> None:
    files = members(built)
    files[FOLDER + "e"] = b"<E/>"
    again = b'<Related role="experiment" source="e"/>' * 5000
    tag = next(re.finditer(rb"<\S*Related\b", files[MANIFEST])).start()
    files[MANIFEST] = files[MANIFEST][:tag] + again + files[MANIFEST][tag:]
    with pytest.raises(FmuError, match="each as often as it is read, have more than"):
        references_of(load_any_fmu(packed(files, tmp_path / "again.fmu")))


def test_the_cells_of_all_tables_are_limited(built: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tables = [content for name, content in members(built).items() if name.startswith(FOLDER) and name.endswith(".csv")]
    cells = sum(1 + line.count(b",") for table in tables for line in table.splitlines()[1:])
    monkeypatch.setattr("twodof.fmu.reference_runs.MAX_CELLS", cells)
    assert len(references_of(load_any_fmu(built))) == 4
    monkeypatch.setattr("twodof.fmu.reference_runs.MAX_CELLS", cells - 1)
    with pytest.raises(FmuError, match=f"the tables have more than {cells - 1} cells"):
        references_of(load_any_fmu(built))


def test_an_experiment_may_have_any_name_and_needs_results(built: Path, tmp_path: Path) -> None:
    """A name may resemble a tool's row; results at the start alone do not count."""
    files = members(built)
    experiments, results = f"{FOLDER}references.exp", f"{FOLDER}move-ref.csv"
    files[experiments] = files[experiments].replace(b'name="push"', b'name="push with fmpy"')
    head = files[results].splitlines()[0]
    files[results] = head + b"\n0" + b",0" * head.count(b",")
    found = rows(packed(files, tmp_path / "named.fmu"))
    assert found["reference push with fmpy"].outcome == "passed"
    assert found["reference move"].text == "its results have no values after its start"


@pytest.mark.parametrize("name", ["references.exp", "push-ref.csv", "push.ssv"])
def test_a_file_with_another_checksum_than_stated_is_refused(built: Path, tmp_path: Path, name: str) -> None:
    files = members(built)
    with zipfile.ZipFile(tmp_path / "stale.fmu", "w") as archive:
        for member, content in files.items():
            archive.writestr(member, content + b"\n" * (member == FOLDER + name))
    (row,) = rows(tmp_path / "stale.fmu").values()
    assert row.outcome == "failed" and f"{name} is not the file whose checksum is in fmi-ls-manifest.xml" in row.text


def test_results_after_the_end_of_a_run_are_refused(built: Path, tmp_path: Path) -> None:
    files = members(built)
    results = f"{FOLDER}move-ref.csv"
    files[results] = files[results].rstrip() + b"\n0.51" + b",0" * files[results].splitlines()[0].count(b",")
    row = rows(packed(files, tmp_path / "long.fmu"))["reference move"]
    assert row[1:] == ("failed", "it has results at 0.51 s, after 0.5 s, the end of its run")


def with_references(fmu: bytes, files: dict[str, str], path: Path) -> Path:
    """Write an FMU with files of references, the first of which has the experiments."""
    related = "".join(
        f'<Related source="{name}" role="{"other" if k else "experiment"}" checksum=""/>'
        for k, name in enumerate(files)
    )
    path.write_bytes(fmu)
    texts = {**files, "fmi-ls-manifest.xml": f"<fmiReferences>{related}</fmiReferences>"}
    return packed({**members(path), **{FOLDER + name: text.encode() for name, text in texts.items()}}, path)


@pytest.mark.parametrize("tool", TOOLS)
def test_stimuli_and_results_may_be_truth_values_and_whole_numbers(tool: str, tmp_path: Path) -> None:
    """A controller is disabled by a Boolean, and by a number of steps, after 5 of 10 steps.

    PathSim has no such inputs, and fmuloader needs Model Exchange.
    """
    for name in NEEDED.get(tool, ()):
        needs(name)
    values = '<Parameter name="enabled"><Boolean value="1"/></Parameter>'
    stimuli = {"enabled": ("true", "false"), "seen": ("0", "30")}
    experiments = "".join(
        f'<Experiment name="{name}" startTime="0" stopTime="0.1" stepSize="0.01" tolerance="0">'
        f'<Parameters source="{name}.ssv"/><Stimuli source="{name}.csv"/><References source="results.csv"/>'
        "</Experiment>"
        for name in stimuli
    )
    results = "".join(f"{0.01 * (k + 1)!r},{10.0 if k < 5 else 0.0},{k + 1}\n" for k in range(10))
    files = {"e.exp": f"<Experiments>{experiments}</Experiments>"}
    for name, (first, last) in stimuli.items():
        own = "" if name == "enabled" else values
        files[f"{name}.ssv"] = f'<S><Parameter name="q_des[1]"><Real value="1"/></Parameter>{own}</S>'
        files[f"{name}.csv"] = f"time,{name}\n0,{first}\n0.04,{first}\n0.05,{last}\n"
    files["results.csv"] = "time,tau[1],steps\n" + results
    found = rows(with_references(pd_fmu(), files, tmp_path / "pd.fmu"), tool)
    others = tool in ("fmuloader", "pathsim")
    theirs = ("failed", "not run w") if others else ("passed", "20 values")
    assert [(row.outcome, row.text[:9]) for row in found.values()] == [("passed", "20 values"), theirs] * 2, found


def of_controller(files: dict[str, str], path: Path, times: str = "", fmu: bytes | None = None) -> Path:
    """Write the FMU of native/pd.c with one experiment e, of e.csv, results.csv and, if there, e.ssv."""
    times = times or 'startTime="0" stopTime="0.2" stepSize="0.01"'
    parameters = '<Parameters source="e.ssv"/>' if "e.ssv" in files else ""
    stimuli = '<Stimuli source="e.csv"/>' if "e.csv" in files else ""
    text = f'<Experiment name="e" {times} tolerance="1e-9">{parameters}{stimuli}<References source="results.csv"/>'
    return with_references(fmu or pd_fmu(), {"e.exp": f"<E>{text}</Experiment></E>", **files}, path)


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_a_continuous_stimulus_is_interpolated_and_a_discrete_one_is_held(kind: str, tmp_path: Path) -> None:
    """FMI 2.0.4, section 2.2.7: a discrete variable is constant between events. The effort is 10 q_des."""
    first = 'name="q_des[1]" valueReference="4" causality="input" variability="{}"'
    fmu = pd_fmu(replaced={first.format("continuous"): first.format(kind)})
    of_step = [min(1.0, k / 10) if kind == "continuous" else float(k >= 10) for k in range(20)]
    results = "".join(f"{0.01 * (k + 1)!r},{10.0 * value!r}\n" for k, value in enumerate(of_step))
    files = {"e.csv": "time,q_des[1]\n0,0\n0.1,1\n0.2,1\n", "results.csv": f"time,tau[1]\n{results}"}
    found = rows(of_controller(files, tmp_path / "pd.fmu", fmu=fmu), "fmpy")
    assert [row.outcome for row in found.values()] == ["passed"] * 2, found


@pytest.mark.parametrize("effort", [10.0, 5.0])
def test_values_at_the_start_are_compared(effort: float, tmp_path: Path) -> None:
    """The effort is 10 q_des before the first step, too."""
    files = {"e.csv": "time,q_des[1]\n0,1\n", "results.csv": f"time,tau[1]\n0,{effort}\n0.1,10\n"}
    for row in rows(of_controller(files, tmp_path / "pd.fmu"), "fmpy").values():
        assert row.outcome == ("passed" if effort == 10.0 else "failed"), row
        assert effort == 10.0 or row.text.startswith("tau[1] is 10 instead of 5 at 0 s"), row


@pytest.mark.parametrize("default", [True, False])
def test_an_experiment_without_a_step_has_that_of_the_fmu_or_of_its_results(default: bool, tmp_path: Path) -> None:
    """The third output counts the steps."""
    results = "".join(f"{0.05 * (k + 1)!r},{(k + 1) * (5 if default else 1)}\n" for k in range(4))
    step = {"<ModelVariables>": '<DefaultExperiment stepSize="0.01"/><ModelVariables>'} if default else {}
    files = {"results.csv": f"time,steps\n{results}"}
    times = 'startTime="0" stopTime="0.2"'
    (row,) = rows(of_controller(files, tmp_path / "pd.fmu", times, pd_fmu(replaced=step))).values()
    assert row.outcome == "passed", row


@pytest.mark.parametrize("jump", [35, 36])
def test_a_jump_of_a_stimulus_acts_at_its_communication_point(jump: int, tmp_path: Path) -> None:
    """1 + 36 * 0.01 is rounded to less than 1.36."""
    assert (1.0 + jump * 0.01 < float(f"1.{jump}")) == (jump == 36)
    results = "".join(f"{1.0 + 0.01 * (k + 1)!r},{10.0 * (k >= jump)}\n" for k in range(50))
    rise = f"1.{jump},0\n1.{jump},1"
    files = {"e.csv": f"time,q_des[1]\n1,0\n{rise}\n1.5,1\n", "results.csv": f"time,tau[1]\n{results}"}
    times = 'startTime="1" stopTime="1.5" stepSize="0.01"'
    (row,) = rows(of_controller(files, tmp_path / "pd.fmu", times)).values()
    assert row.outcome == "passed", row


def test_a_parameter_set_is_converted_to_the_units_of_the_fmu(tmp_path: Path) -> None:
    degree = '<ssc:Unit name="deg"><ssc:BaseUnit rad="1" factor="0.017453292519943295"/></ssc:Unit>'
    files = {
        "e.ssv": values("q_des[1] Real 90 deg", more=f"<ssv:Units>{degree}</ssv:Units>"),
        "results.csv": f"time,tau[1]\n0.1,{5.0 * np.pi!r}\n",
    }
    found = rows(of_controller(files, tmp_path / "pd.fmu"), "fmpy")
    assert [row.outcome for row in found.values()] == ["passed"] * 2, found


@pytest.mark.parametrize(
    "name, text, reason",
    [
        ("e.csv", "time,seen\n0,3.7\n", "e.csv: 'seen' has a value that is not a 32-bit integer"),
        ("e.csv", "time,seen\n0,4294967299\n", "e.csv: 'seen' has a value that is not a 32-bit integer"),
        ("e.ssv", values("seen Integer 4294967299"), "e.ssv: 'seen' has a value that is not a 32-bit integer"),
        ("e.csv", "time,mode\n0,1\n", "e.csv: 'mode' is of type Enumeration, which cannot be set"),
        ("e.csv", "time,seen\n0,1\n0.2,1\n0.1,1\n", "e.csv: its times do not ascend"),
    ],
)
def test_values_that_a_variable_cannot_have_are_refused(name: str, text: str, reason: str, tmp_path: Path) -> None:
    files = {name: text, "results.csv": "time,tau[1]\n0.1,0\n"}
    (row,) = rows(of_controller(files, tmp_path / "pd.fmu")).values()
    assert row.outcome == "failed" and reason in row.text


def test_the_steps_of_all_experiments_together_are_limited(built: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four experiments of 50 steps."""
    monkeypatch.setattr("twodof.fmu.reference_runs.MOST_STEPS", 201)
    assert len(references_of(load_any_fmu(built))) == 4
    monkeypatch.setattr("twodof.fmu.reference_runs.MOST_STEPS", 200)
    with pytest.raises(FmuError, match="'rest' must be a run of at most 200 whole steps, together with those before"):
        references_of(load_any_fmu(built))
