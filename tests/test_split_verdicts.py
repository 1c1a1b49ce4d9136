"""Verdicts of split robots, compared with those of the robot in one FMU, and of two robots in one system."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from systems import component, connection, pd_fmu

import twodof
from twodof.cli.main import main
from twodof.fmu.ssp_file import STRUCTURE

PERIOD = {"control_period": 0.01}
PASSED = 'suppressUnitConversion="true"'


@pytest.fixture(scope="module")
def arms(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The default arm in one FMU, and split."""
    folder = tmp_path_factory.mktemp("arms")
    whole = twodof.build_fmu(folder / "arm.fmu", twodof.FmuOptions(native=True, settings=PERIOD))
    return whole, twodof.build_fmu(folder / "arm.ssp", twodof.FmuOptions(part="split", settings=PERIOD))


def edited(ssp: Path, path: Path, changes: dict[str, str], **fmus: bytes) -> Path:
    """Write a system with another structure, and with more FMUs."""
    with zipfile.ZipFile(ssp) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            text = old.read(name)
            if name == STRUCTURE:
                for before, after in changes.items():
                    assert before.encode() in text
                    text = text.replace(before.encode(), after.encode(), 1)
            new.writestr(name, text)
        for name, fmu in fmus.items():
            new.writestr(f"resources/{name}.fmu", fmu)
    return path


@pytest.fixture(scope="module")
def two(arms: tuple[Path, Path]) -> Path:
    """Two split arms in one system; the second controller has the start values of its FMU."""
    parts = [component(name).replace(f'name="{name}"', f'name="{name}2"') for name in ("controller", "plant")]
    wires = "".join(
        connection(f"{start}[{i}]", f"{end}[{i}]")
        for i in (1, 2)
        for start, end in (
            ("plant2.q", "controller2.q"), ("plant2.v", "controller2.v"), ("controller2.tau_cmd", "plant2.tau_cmd"),
        )
    )  # fmt: skip
    changes = {
        "</ssd:Elements>": f"{''.join(parts)}</ssd:Elements>",
        "</ssd:Connections>": f"{wires}</ssd:Connections>",
    }
    return edited(arms[1], arms[1].with_name("two.ssp"), changes)


def of_the_whole(settings: dict[str, Any]) -> dict[str, Any]:
    """Return settings with the names of the robot in one FMU."""
    return {name.partition(".")[2] or name: value for name, value in settings.items()}


@pytest.mark.parametrize(
    "settings", [{"controller.rcond": 0.5}, {"controller.rcond": 0.9, "x_des": (0.25, 0.0)}, {"x_des": (0.25, 0.0)}]
)
def test_a_split_robot_near_a_singularity_has_the_verdict_of_the_whole(
    arms: tuple[Path, Path], settings: dict[str, Any]
) -> None:
    whole = twodof.simulate(arms[0], settings=of_the_whole(settings), stop_time=2.0).verdict
    assert twodof.simulate(arms[1], settings=settings, stop_time=2.0).verdict.lines == whole.lines
    assert ("near a singularity" in whole.lines[0]) == ("controller.rcond" in settings)


@pytest.mark.parametrize(
    ("settings", "rows"),
    [
        ({"plant.payload": 0.05}, []),
        ({"controller.payload_known": True, "controller.payload": 0.1}, []),
        ({"plant.gravity": (0.0, 0.0, 0.0)}, []),
        ({"controller.rcond": 0.5}, []),
        ({"controller.Kp": (0.0, 50.0)}, []),
        ({"controller.Kp": 5.0}, []),
        ({"controller.Kd": 1.0}, []),
        ({"controller.Kp": 342.0, "controller.Kd": 30.8, "controller.control_delay": 0.05}, []),
        ({"controller.xd_des": (0.1, 0.0)}, []),
        ({"plant.friction": (0.05, 0.05)}, []),
        ({}, [(0.2, {"controller.Kp[1]": 0.0, "controller.Kp[2]": 0.0})]),
        ({"controller.Kp": 0.0}, [(1.8, {"controller.Kp[1]": 50.0, "controller.Kp[2]": 50.0})]),
    ],
)
def test_one_of_two_robots_has_the_verdict_that_it_has_alone(
    arms: tuple[Path, Path], two: Path, settings: dict[str, Any], rows: Any, tmp_path: Path
) -> None:
    """Also in a bag without a stored verdict."""

    def second(values: dict[str, Any]) -> dict[str, Any]:
        return {name.replace(".", "2.", 1): value for name, value in values.items()}

    def judged(bag: Path) -> list[str]:
        read = twodof.read_bag(bag)
        lines = read._judged(read.setup, read.x, read.target).lines
        return [line.replace("controller2", "controller") for line in lines]

    bag = twodof.Bag(tmp_path / "alone")
    alone = twodof.simulate(arms[1], bag, settings=settings, changes=rows, stop_time=2.0).verdict
    assert alone.causes
    own = {**second(settings), "controller2.control_period": 0.01}
    for robot, each, changes in (
        ("plant", settings, rows),
        ("plant2", own, [(t, second(values)) for t, values in rows]),
    ):
        system, bag = twodof.load_fmu(two, robot), twodof.Bag(tmp_path / robot)
        made = twodof.simulate(system, bag, settings=each, changes=changes, stop_time=2.0).verdict
        assert [line.replace("controller2", "controller") for line in made.lines] == [*alone.lines]
        assert ("controller2." in str(made)) == (robot == "plant2" and "controller." in str(alone))
        assert judged(tmp_path / robot) == judged(tmp_path / "alone")


def test_the_controller_may_drive_the_robot_through_another_fmu(arms: tuple[Path, Path], tmp_path: Path) -> None:
    """Efforts pass an FMU without a change; a spare controller drives nothing."""
    through = pd_fmu(effort="c->value[Q_DES + i]", replaced={"q_des": "level"})
    spare = component("controller").replace('name="controller"', 'name="a_spare"')
    wires = [
        connection(*ends, more=PASSED)
        for i in (1, 2)
        for ends in ((f"controller.tau_cmd[{i}]", f"pd.level[{i}]"), (f"pd.tau[{i}]", f"plant.tau_cmd[{i}]"))
    ]
    with zipfile.ZipFile(arms[1]) as arm:
        text = arm.read(STRUCTURE).decode()
    begin, end = text.index("<ssd:Connections>"), text.index("</ssd:Connections>")
    read = "".join(connection(f"plant.{name}[{i}]", f"controller.{name}[{i}]") for name in ("q", "v") for i in (1, 2))
    changes = {text[begin:end]: f"<ssd:Connections>{read}{''.join(wires)}"}
    changes |= {"<ssd:Elements>": f"<ssd:Elements>{spare}{component('pd')}"}
    path = edited(arms[1], tmp_path / "through.ssp", changes, pd=through)
    line = twodof.simulate(path, settings={"plant.payload": 0.05}).verdict.lines[0]
    assert line.endswith("set controller.payload_known=true and controller.payload=0.05")


WIRED = re.compile(r"<ssd:Connection .*?(?:/>|</ssd:Connection>)", re.DOTALL)


def rewired(ssp: Path, path: Path, change: Callable[[str], str]) -> Path:
    """Write a system with another text of each connection."""
    with zipfile.ZipFile(ssp) as arm:
        wires = WIRED.findall(arm.read(STRUCTURE).decode())
    return edited(ssp, path, {wire: change(wire) for wire in wires})


@pytest.mark.parametrize("missing", ["controller.q", "controller.v", "plant.tau_cmd"])
def test_a_vector_without_a_connection_is_named(
    arms: tuple[Path, Path], missing: str, tmp_path: Path, caplog: pytest.LogCaptureFixture,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Unless a setting or an input over time gives it."""
    twodof.experiment(arms[1])
    assert not caplog.records
    element, _, group = missing.partition(".")
    ends = f'endElement="{element}" endConnector="{group}['
    path = rewired(arms[1], tmp_path / "part.ssp", lambda wire: "" if ends in wire else wire)
    twodof.experiment(path)
    line = f"the input {missing} is not connected, and keeps its value"
    assert [record.getMessage() for record in caplog.records] == [f"'{path}': {line}"]
    assert main(["info", str(path)]) == 0 and line in capsys.readouterr().out
    caplog.clear()
    twodof.experiment(path, settings={missing: (0.1, 0.0)})
    twodof.experiment(path, changes=[(0.5, {missing: (0.1, 0.0)})])
    assert not caplog.records


def test_info_prints_the_order_of_crossed_elements(
    arms: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def crossed(wire: str) -> str:
        swap = {"1": "2", "2": "1"}
        return re.sub(r'(endConnector="(?:q|tau_cmd)\[)(\d)', lambda found: found[1] + swap[found[2]], wire)

    path = tmp_path / "crossed.ssp"
    with zipfile.ZipFile(arms[1]) as arm:
        text = arm.read(STRUCTURE).decode()
    begin, end = text.index("<ssd:Connections>"), text.index("</ssd:Connections>")
    edited(arms[1], path, {text[begin:end]: crossed(text[begin:end])})
    found = []
    for each in (arms[1], path):
        assert main(["info", str(each)]) == 0
        found.append([line.split("  ")[-1].strip() for line in capsys.readouterr().out.splitlines() if "->" in line])
    straight, other = found
    assert straight == [
        "plant.q -> controller.q, 2 values",
        "plant.v -> controller.v, 2 values",
        "controller.tau_cmd -> plant.tau_cmd, 2 values",
    ]
    order = ": [1] -> [2], [2] -> [1]"
    assert other == [straight[0] + order, straight[1], straight[2] + order]


def test_a_payload_that_the_controller_knows_wrong_is_named(arms: tuple[Path, Path]) -> None:
    settings: dict[str, Any] = {"plant.payload": 0.1, "controller.payload": 0.2, "controller.payload_known": True}
    (cause, *_) = twodof.simulate(arms[1], settings=settings).verdict.causes
    assert cause.text.startswith("the controller assumes a payload of 0.2 kg, the plant has 0.1 kg")
    assert cause.text.endswith("; set controller.payload=0.1")
    assert cause.tried.startswith("with that of the plant: ") and cause.tried.endswith("reached")
    cured = twodof.simulate(arms[1], settings={**settings, "controller.payload": 0.1}).verdict
    assert cured.outcome == "reached" and not cured.causes


def test_layouts_of_a_system_need_no_step(
    arms: tuple[Path, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert len(twodof.layouts(arms[1], tmp_path)) == 3
    assert not caplog.records
