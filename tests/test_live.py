"""A live arm, driven and seen in a browser. Truth is the closed form, and other readers of bags."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import browser
import numpy as np
import oracles
import pytest
from bags import SECOND, assert_consistent, read_with_mcap
from browser import (
    LINKS,
    Served,
    chromium,
    colours,
    connect,
    direction,
    numbers,
    opened,
    picture,
    pixels,
    press,
    rows,
    served,
    type_into,
    until,
)
from harness import asked, children_of, lives, wait_until
from playwright.sync_api import Browser, Page

import twodof
from twodof.pages.live import live

Q_START = np.array([0.5, 0.35])
KP, KD = 50.0, 40.0  # those of the default FMU
ROUNDED = 6e-6  # m or rad, of what the page says


@pytest.fixture(scope="module")
def shown() -> Iterator[Browser]:
    with chromium() as program:
        yield program


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("live")


@pytest.fixture(scope="module")
def command(folder: Path, native_path: Path) -> Iterator[Served]:
    with served("live", native_path, "-o", "recorded", cwd=folder) as command:
        yield command


@pytest.fixture(scope="module")
def arm(shown: Browser, command: Served) -> Iterator[Page]:
    with opened(shown, command.url) as page:
        yield page


@pytest.fixture
def page(arm: Page) -> Page:
    """A page whose arm is at its start, paused."""
    if arm.get_by_role("button", name="Pause").count():
        pause(arm)
    press(arm, "Reset")
    until(arm, lambda found: found["time"] == "0.00 s")
    return arm


def pause(page: Page) -> None:
    press(page, "Pause")
    page.get_by_role("button", name="Play").wait_for()  # else the next click is on "Pause" again
    until(page, lambda found: found["real-time factor"] == "-")


def time_of(found: dict[str, str]) -> float:
    return numbers(found["time"])[0]


def watch(page: Page, until_time: float, *, least: int = 1) -> list[dict[str, str]]:
    """The readout at some moments, so many at least."""
    seen = [rows(page)]
    while time_of(seen[-1]) < until_time or len(seen) < least:
        page.wait_for_timeout(30)
        seen.append(rows(page))
    return seen


def play(page: Page, until_time: float) -> list[dict[str, str]]:
    """The readout at some moments of a run from the start, each after a step."""
    press(page, "Play")
    seen = [found for found in watch(page, until_time, least=20) if time_of(found) > 0.0]
    pause(page)
    return seen


def assert_follows(
    seen: list[dict[str, str]], target: Sequence[float], *, kp: float = KP, kd: float = KD,
    rounded: float = ROUNDED,
) -> None:  # fmt: skip
    """The arm goes from its start to the target as the closed form says."""
    t = np.array([time_of(found) for found in seen])
    x = np.array([numbers(found["end effector"]) for found in seen])
    e = oracles.task_error(oracles.position(Q_START) - target, kp, kd, t)
    assert x == pytest.approx(target + e, abs=rounded)
    q = np.array([numbers(found["joint1"] + found["joint2"]) for found in seen])
    assert x == pytest.approx(oracles.position(q), abs=2 * ROUNDED)


def test_arm_follows_the_target_as_the_closed_form_says(page: Page) -> None:
    target = np.array([0.12, 0.17])
    type_into(page, "x", target[0])
    type_into(page, "y", target[1])
    before = picture(page)
    seen = play(page, 3.0)
    assert_follows(seen, target)
    type_into(page, "y", -0.1)  # away from the arm
    after = picture(page)
    q = numbers(rows(page)["joint1"] + rows(page)["joint2"])
    found = [direction(pixels(after, colour)) for colour in LINKS]
    assert np.sin(found - np.cumsum(q)) == pytest.approx(0.0, abs=0.015)  # rad
    assert min(colours(before), colours(after)) > 100
    assert (before != after).any(axis=-1).mean() > 0.01


def test_readout_tells_how_well_time_is_kept(page: Page) -> None:
    seen = play(page, 1.0)
    counts = [numbers(found["deadlines missed"]) for found in seen]
    for found, (missed, steps, worst) in zip(seen, counts):
        assert steps - counts[0][1] == round(100 * (time_of(found) - time_of(seen[0])))
        assert 0 <= missed <= steps and worst >= 0.0
    press(page, "Play")
    until(page, lambda found: numbers(found["real-time factor"]) == pytest.approx([1.0], abs=0.1))
    pause(page)


def test_plots_are_those_of_what_was_shown(page: Page) -> None:
    """Up to the last step, and while it plays each fourth, back from some step."""
    type_into(page, "x", 0.2)
    type_into(page, "y", 0.05)
    press(page, "Play")
    seen = [found for found in watch(page, 1.0, least=20) if time_of(found) > 0.0]
    (_, moving), _ = page.evaluate(browser.PLOTS)
    pause(page)
    found = rows(page)
    count = round(100 * time_of(found)) + 1
    drawn = f"() => ({browser.PLOTS})().every(([_, [age]]) => age.length === {count})"
    page.wait_for_function(drawn)
    (title, (age, q1, q2)), (_, (_, error)) = page.evaluate(browser.PLOTS)
    assert title == "position, rad"
    assert np.diff(age) == pytest.approx(0.01) and age[-1] == 0.0
    for moment in (*seen, found):
        k = round(100 * time_of(moment))
        assert [q1[k], q2[k]] == pytest.approx(
            numbers(moment["joint1"] + moment["joint2"]), abs=ROUNDED
        )
        assert error[k] == pytest.approx(numbers(moment["error"])[0], rel=1e-3)
    back = range(0, -4 * len(moving[0]), -4)
    assert moving[0] == pytest.approx(0.01 * np.array(back[::-1]))
    ends = [k for k, value in enumerate(q1) if value == moving[1][-1]]
    assert [q2[k + offset] for k in ends for offset in back[::-1]] == moving[2]


def test_gains_are_those_of_the_sliders(page: Page) -> None:
    type_into(page, "x", 0.2)
    type_into(page, "y", 0.05)
    type_into(page, "Kp, s⁻²", 80.0)
    type_into(page, "Kd, s⁻¹", 12.0)
    seen = play(page, 1.0)
    type_into(page, "Kp, s⁻²", KP)
    type_into(page, "Kd, s⁻¹", KD)
    assert_follows(seen, np.array([0.2, 0.05]), kp=80.0, kd=12.0)


HANDLES = {  # how each is coloured, and what of a movement it follows
    "square": (lambda r, g, b: (b > 190) & (r < 90) & (b - g > 60), (1.0, 1.0)),
    "arrow along x": (lambda r, g, b: (r > 220) & (g < 120) & (b - g > 30), (1.0, 0.0)),
    "arrow along y": (lambda r, g, b: (g > 190) & (r < 170) & (g - r > 50), (0.0, 1.0)),
}


@pytest.mark.parametrize(("colour", "follows"), HANDLES.values(), ids=HANDLES)
def test_target_is_dragged_in_the_scene(
    page: Page, colour: Callable[..., np.ndarray], follows: tuple[float, float]
) -> None:
    """With the mouse, by each of the marker's handles, and the arm follows."""
    targets, shots = np.array([[0.1, 0.2], [0.2, 0.05]]), []
    for target in targets:
        type_into(page, "x", target[0])
        type_into(page, "y", target[1])
        press(page, "Single step")
        press(page, "Single step")  # what is asked holds from the next step on
        until(page, lambda found, at=target: numbers(found["target"]) == pytest.approx(at))
        shots.append(picture(page))
    squares = [pixels(shot, HANDLES["square"][0]).mean(axis=0) for shot in shots]
    metre = (squares[1] - squares[0]) / (targets[1] - targets[0])  # in pixels
    assert metre == pytest.approx(metre[0] * np.array([1, -1]), rel=0.02)
    press(page, "Reset")
    until(page, lambda found: found["time"] == "0.00 s")
    box = page.locator("canvas").first.bounding_box()
    x, y = np.add(pixels(shots[1], colour).mean(axis=0), (box["x"], box["y"]))
    page.mouse.move(x, y)
    page.wait_for_timeout(300)  # until the page knows what the mouse is on
    page.mouse.down()
    for i in range(1, 6):
        page.mouse.move(x - 12 * i, y + 6 * i)
        page.wait_for_timeout(60)
    page.mouse.up()
    dragged = targets[1] + np.array([-60, 30]) * follows / metre

    def values(page: Page) -> list[float]:
        return [float(browser.field_of(page, axis).input_value()) for axis in "xy"]

    until(page, lambda found: found == pytest.approx(dragged, abs=0.003), values)
    page.wait_for_timeout(150)
    fields = values(page)
    assert fields == pytest.approx(dragged, abs=0.003)
    seen = play(page, 1.0)
    target = np.array(numbers(seen[-1]["target"]))
    assert target == pytest.approx(fields, abs=6e-4)  # the fields have three digits
    assert_follows(seen, target, rounded=2 * ROUNDED)


def test_single_step_and_reset(page: Page) -> None:
    for k in range(1, 4):
        press(page, "Single step")
        until(page, lambda found, k=k: found["time"] == f"{0.01 * k:.2f} s")
    page.wait_for_timeout(200)
    assert rows(page)["time"] == "0.03 s"
    press(page, "Reset")
    found = until(page, lambda found: found["time"] == "0.00 s")
    assert numbers(found["joint1"] + found["joint2"]) == pytest.approx(Q_START, abs=ROUNDED)


def test_disturbance_pushes_the_arm_away(page: Page) -> None:
    """At rest J⁻ᵀ τ_ext is balanced by Kp: M (J⁻¹ Kp e) = τ_ext, with the textbook's M."""
    target, torque, gain = np.array([0.2, 0.05]), np.array([0.05, 0.0]), 80.0
    type_into(page, "Kp, s⁻²", gain)
    type_into(page, "Kd, s⁻¹", 16.0)
    type_into(page, "x", target[0])
    type_into(page, "y", target[1])
    type_into(page, "joint1, N·m", torque[0])
    press(page, "Play")
    found = until(page, lambda found: time_of(found) > 2.5)
    pause(page)
    press(page, "No disturbance")
    type_into(page, "Kp, s⁻²", KP)
    type_into(page, "Kd, s⁻¹", KD)
    q = np.array(numbers(found["joint1"] + found["joint2"]))
    plant = oracles.TwoLinkArm(Path(__file__).parents[1] / "urdf/2dof.urdf", 9.81)
    e = -oracles.jacobian(q) @ np.linalg.solve(plant.mass_matrix(q), torque) / gain
    assert target - numbers(found["end effector"]) == pytest.approx(e, abs=2e-5)
    assert np.linalg.norm(e) > 1e-3


def test_recording_is_what_was_shown(page: Page, folder: Path, native_path: Path) -> None:
    type_into(page, "x", 0.2)
    type_into(page, "y", 0.05)
    press(page, "Play")
    until(page, lambda found: time_of(found) > 0.3)
    before = time_of(rows(page))
    press(page, "Record")
    page.get_by_role("button", name=re.compile("^Stop recording")).wait_for()
    start = time_of(rows(page))
    seen = watch(page, start + 0.5, least=6)
    type_into(page, "x", 0.15)
    seen += watch(page, start + 1.5, least=6)
    press(page, "Stop recording")
    page.get_by_role("button", name="Record", exact=True).wait_for()
    pause(page)
    bag = folder / "recorded"
    assert_consistent(bag, "mcap")
    states = read_with_mcap(bag)
    made = json.loads((bag / "run.json").read_text())
    first = made["start_time"]
    assert before <= first <= start
    page.get_by_text(f"recorded, {len(states)} samples").wait_for()
    steps = np.diff([state.log_time for state in states])
    assert (steps == SECOND // 100).all()
    found = [found for found in seen if time_of(found) >= first]
    assert len(found) > 10
    for moment in found:
        state = states[round((time_of(moment) - first) / 0.01)]
        shown = numbers(moment["joint1"] + moment["joint2"])
        assert shown == pytest.approx(np.frombuffer(state.position), abs=ROUNDED)
    # the provenance is a run that starts there and does the same
    given = made["start_values"]
    ((moment_of_change, values),) = made["input_changes"]
    assert values == {"x_des[1]": 0.15}
    run = twodof.experiment(
        native_path,
        start_time=first, stop_time=first + (len(states) - 1) * 0.01, settings=given,
    )  # fmt: skip
    again = twodof.samples(run)
    sample = next(again)
    for k, state in enumerate(states):
        assert sample.q == pytest.approx(tuple(np.frombuffer(state.position)), abs=1e-9)
        if k < len(states) - 1:
            due = abs(sample.t - moment_of_change) < 1e-6
            sample = again.send(values if due else None)


def test_full_disk_ends_the_recording_alone(
    shown: Browser, native_path: Path, tmp_path: Path, disk: Callable[..., Path]
) -> None:
    """One note says so, and a second one that another recording cannot begin."""
    bag = disk(8192) / "bag"
    with served("live", native_path, "-o", bag, cwd=tmp_path) as command:
        with opened(shown, command.url) as page:
            press(page, "Record")
            page.get_by_role("button", name=re.compile("^Stop recording")).wait_for()
            watch(page, time_of(rows(page)) + 0.3)
            with (
                pytest.raises(OSError, match="No space left"),
                (bag.parent / "other").open("wb") as other,
            ):
                while True:
                    other.write(bytes(256))
                    other.flush()
            note = page.locator("[class*=Notification-root]", has_text="The recording has ended")
            note.wait_for()
            page.get_by_role("button", name="Record", exact=True).wait_for()
            said = note.inner_text()
            press(page, "Record")
            page.get_by_text("There is no recording").wait_for()
            watch(page, time_of(rows(page)) + 0.3)
            assert note.count() == 1
        status, output, errors = command.interrupt()
    assert (status, output, errors) == (130, "", "")
    assert_consistent(bag, "mcap")
    kept = len(read_with_mcap(bag))
    assert kept == len(twodof.read_bag(bag).t) > 20
    assert f"the disk is full; it is closed with its first {kept} samples" in said
    assert not bag.with_name("bag-2").exists()


SLIDER = """<robot name="slider">
  <link name="rail"/>
  <link name="carriage"><inertial><mass value="2"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="beam"><inertial><origin xyz="0.15 0 0"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <link name="tip"/>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="carriage"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="20" velocity="5"/></joint>
  <joint name="swing" type="revolute"><parent link="carriage"/><child link="beam"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="20" velocity="9"/></joint>
  <joint name="end" type="fixed"><parent link="beam"/><child link="tip"/>
    <origin xyz="0.3 0 0"/></joint>
</robot>"""


def test_joint_that_slides_has_its_own_units(shown: Browser, tmp_path: Path) -> None:
    """Pushed with a force, it rests where Kp balances it, as in the test of a disturbance."""
    (tmp_path / "slider.urdf").write_text(SLIDER)
    options = twodof.FmuOptions(
        urdf=tmp_path / "slider.urdf", frame="tip", axes="xy", q_start=(0.1, 0.6)
    )
    fmu = twodof.build_fmu(tmp_path / "Slider.fmu", options)
    with served("live", fmu, cwd=tmp_path) as command, opened(shown, command.url) as page:
        type_into(page, "Kp, s⁻²", 100.0)
        type_into(page, "Kd, s⁻¹", 20.0)
        type_into(page, "x", 0.4)
        type_into(page, "y", 0.1)
        type_into(page, "slide, N", 2.0)
        begin = time_of(rows(page))
        found = until(page, lambda found: time_of(found) > begin + 1.8)
        titles = [title for title, _ in page.evaluate(browser.PLOTS)]
        assert page.get_by_text("swing, N·m", exact=True).count() == 1
        status, _, errors = command.interrupt()
    assert (status, errors) == (130, "")
    assert titles[0] == "position, m or rad"
    assert (found["slide"][-2:], found["swing"][-4:]) == (" m", " rad")
    s, q = numbers(found["slide"] + found["swing"])
    x = np.array(numbers(found["end effector"]))
    assert x == pytest.approx([s + 0.3 * np.cos(q), 0.3 * np.sin(q)], abs=2 * ROUNDED)
    jacobian = np.array([[1.0, -0.3 * np.sin(q)], [0.0, 0.3 * np.cos(q)]])
    coupled = -0.15 * np.sin(q)
    mass = np.array([[3.0, coupled], [coupled, 0.01 + 0.15**2]])
    e = jacobian @ np.linalg.solve(mass, [2.0, 0.0]) / 100.0
    assert x - (0.4, 0.1) == pytest.approx(e, abs=2e-5)


def record_and_end(
    shown: Browser, fmu: Path, folder: Path, number: signal.Signals, closed_for: float
) -> tuple[float, float, int]:
    """The last time that was shown, that of the bag, and the exit status."""
    with served("live", fmu, cwd=folder) as command:
        with opened(shown, command.url) as page:
            press(page, "Record")
            page.get_by_role("button", name=re.compile("^Stop recording")).wait_for()
            last = time_of(watch(page, time_of(rows(page)) + 0.3)[-1])
            if not closed_for:
                status, output, errors = command.interrupt(number)
        if closed_for:
            time.sleep(closed_for)
            status, output, errors = command.interrupt(number)
    (bag,) = folder.glob("rosbag2_*")
    assert errors == ""
    assert f"bag   {bag.name}\n" in output
    assert_consistent(bag, "mcap")
    made = json.loads((bag / "run.json").read_text())
    return last, made["start_time"] + (len(read_with_mcap(bag)) - 1) * 0.01, status


def test_ctrl_c_while_recording_closes_the_bag(
    shown: Browser, fmu_path: Path, tmp_path: Path
) -> None:
    """In the Python flavour."""
    seen, recorded, status = record_and_end(shown, fmu_path, tmp_path, signal.SIGINT, 0.0)
    assert status == 130
    assert recorded >= seen - 1e-6


def test_closing_the_last_page_pauses(shown: Browser, native_path: Path, tmp_path: Path) -> None:
    """And another signal ends as Ctrl-C does."""
    seen, recorded, status = record_and_end(shown, native_path, tmp_path, signal.SIGTERM, 6.0)
    assert status == 130
    assert seen - 1e-6 <= recorded < seen + 4.0


def test_twenty_reconnects_leak_nothing(command: Served, page: Page) -> None:
    def count() -> tuple[int, int]:
        family = [command.process.pid, *command.children()]
        each = [(command.status("Threads", pid), command.status("VmRSS", pid)) for pid in family]
        return sum(threads for threads, _ in each), sum(memory for _, memory in each)

    for i in range(25):
        connect(command.url)
        if i == 4:
            threads, memory = count()
    after = count()
    assert after[0] <= threads + 2
    assert after[1] <= memory + 10_000  # KiB
    press(page, "Play")
    connect(command.url)
    left = time_of(rows(page))
    watch(page, left + 0.3)  # one that leaves is not the last


def test_seven_joints_without_a_mesh(shown: Browser, panda: str, tmp_path: Path) -> None:
    tree = ET.fromstring(panda)
    for link in tree.findall("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(part)
    urdf = tmp_path / "panda.urdf"
    urdf.write_text(ET.tostring(tree, encoding="unicode"))
    options = twodof.FmuOptions(
        urdf=urdf, frame="panda_hand", name="Panda", native=True,
        q_start=oracles.REST["panda"],
    )  # fmt: skip
    fmu = twodof.build_fmu(tmp_path / "Panda.fmu", options)
    with served("live", fmu, cwd=tmp_path) as command, opened(shown, command.url) as page:
        pause(page)
        place = numbers(rows(page)["end effector"])
        type_into(page, "z", round(place[2] - 0.1, 3))
        press(page, "Single step")
        press(page, "Single step")
        found = until(page, lambda found: numbers(found["error"])[0] > 0.09)
        assert sum(name.startswith("panda_joint") for name in found) == 7
        begin = time_of(found)
        press(page, "Play")
        found = until(page, lambda found: time_of(found) > begin + 1.0)
        assert numbers(found["error"])[0] < 0.05
        assert len(pixels(picture(page), LINKS[0])) > 200  # a joint's ball, as dark as link 1


def test_text_of_an_fmu_is_text(shown: Browser, tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_bytes(ET.tostring(browser.hostile_arm()))
    options = twodof.FmuOptions(
        urdf=tmp_path / "arm.urdf", frame=browser.HOSTILE + "EndEffector", axes="xy"
    )
    fmu = twodof.build_fmu(tmp_path / "Arm.fmu", options)
    bag = browser.HOSTILE.replace("/", "")
    with (
        served("live", fmu, "-o", bag, cwd=tmp_path) as command,
        opened(shown, command.url) as page,
    ):
        press(page, "Record")
        press(page, "Stop recording")
        page.get_by_text(f"{bag}, ").wait_for()  # the note
        browser.assert_shown_as_text(page, "joint1", "joint1, N·m")


def test_port_in_use(native_path: Path, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = subprocess.run(
            [*browser.COMMAND, "live", str(native_path), "--port", f"{port}"],
            cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(rf"twodof: error: port {port} of 127.0.0.1 is in use[^\n]*\n", done.stderr)


PROGRAM = """
import sys
from twodof.pages.live import live
def run():
    urls = []
    live(sys.argv[-1], lambda: bool(urls), urls.append, port=0)
    assert urls[0].startswith("http://127.0.0.1:")
run()
sys.path.append(sys.argv[-2])
from harness import lay_traps
lay_traps(".")  # only now: this process itself may import from here
run()
"""


@pytest.mark.parametrize("way", [["-c", PROGRAM], ["program.py"], ["-m", "program"]])
def test_the_page_imports_nothing_from_the_working_directory(
    way: list[str], native_path: Path, tmp_path: Path
) -> None:
    """Nor the program itself, which shields nothing by ``if __name__ == "__main__"``."""
    (tmp_path / "program.py").write_text(PROGRAM)
    done = subprocess.run(
        [sys.executable, *way, str(Path(__file__).parent), str(native_path)], cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": ":."}, capture_output=True, text=True, check=False,
        timeout=120,
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert (tmp_path / "numpy.py").exists() and not list(tmp_path.glob("*.sprung"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("raise ImportError('no such luck')", "a child process failed: ImportError: no such luck"),
        ("import os; os._exit(3)", "the process of the page has ended: exit status 3"),
    ],
)
def test_a_page_that_cannot_start_tells_why(
    text: str, said: str, native_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(twodof.TwoDofError, match=said):
        live(native_path, lambda: False)


def test_live_can_be_ended_while_its_page_starts(
    native_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text("import time; time.sleep(1e6)")
    monkeypatch.syspath_prepend(tmp_path)
    before, urls = children_of(os.getpid()), []
    assert live(native_path, asked(5), urls.append) == urls == []
    assert children_of(os.getpid()) == before


def test_the_page_ends_with_the_command(native_path: Path, tmp_path: Path) -> None:
    with served("live", native_path, cwd=tmp_path) as command:
        (page,) = command.children()
        command.process.kill()
        wait_until(lambda: not lives(page))
