"""A live arm, driven and seen in a browser. Truth is the closed form, and other readers of bags."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import browser
import numpy as np
import oracles
import pytest
from bags import SECOND, assert_consistent, read_with_mcap
from browser import (
    Served,
    chromium,
    colours,
    connect,
    numbers,
    opened,
    picture,
    press,
    rows,
    served,
    type_into,
    until,
)
from playwright.sync_api import Browser, Page

import twodof

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
        press(arm, "Pause")
        until(arm, lambda found: found["real-time factor"] == "-")
    press(arm, "Reset")
    until(arm, lambda found: found["time"] == "0.00 s")
    return arm


def time_of(found: dict[str, str]) -> float:
    return numbers(found["time"])[0]


def watch(page: Page, until_time: float) -> list[dict[str, str]]:
    """The readout at some moments."""
    seen = [rows(page)]
    while time_of(seen[-1]) < until_time:
        page.wait_for_timeout(30)
        seen.append(rows(page))
    return seen


def test_arm_follows_the_target_as_the_closed_form_says(page: Page) -> None:
    target = np.array([0.12, 0.17])
    type_into(page, "x", target[0])
    type_into(page, "y", target[1])
    page.wait_for_timeout(600)
    before = picture(page)
    press(page, "Play")
    seen = [found for found in watch(page, 3.0) if time_of(found) > 0.0]
    press(page, "Pause")
    assert len(seen) > 10
    t = np.array([time_of(found) for found in seen])
    x = np.array([numbers(found["end effector"]) for found in seen])
    e = oracles.task_error(oracles.position(Q_START) - target, KP, KD, t)
    assert x == pytest.approx(target + e, abs=ROUNDED)
    q = np.array([numbers(found["joint1"] + found["joint2"]) for found in seen])
    assert x == pytest.approx(oracles.position(q), abs=2 * ROUNDED)
    page.wait_for_timeout(600)
    after = picture(page)
    assert min(colours(before), colours(after)) > 100
    assert (before != after).any(axis=-1).mean() > 0.01


def test_gains_are_those_of_the_sliders(page: Page) -> None:
    type_into(page, "x", 0.2)
    type_into(page, "y", 0.05)
    type_into(page, "Kp, s⁻²", 80.0)
    type_into(page, "Kd, s⁻¹", 12.0)
    press(page, "Play")
    seen = [found for found in watch(page, 1.0) if time_of(found) > 0.0]
    press(page, "Pause")
    t = np.array([time_of(found) for found in seen])
    x = np.array([numbers(found["end effector"]) for found in seen])
    e = oracles.task_error(oracles.position(Q_START) - (0.2, 0.05), 80.0, 12.0, t)
    assert x == pytest.approx(np.add((0.2, 0.05), e), abs=ROUNDED)
    type_into(page, "Kp, s⁻²", KP)
    type_into(page, "Kd, s⁻¹", KD)


def test_target_is_dragged_in_the_scene(page: Page) -> None:
    """By the marker's square between its arrows, which moves it in the plane."""
    type_into(page, "x", 0.2)
    type_into(page, "y", 0.05)
    page.wait_for_timeout(800)
    shot = picture(page).astype(int)
    blue = (shot[..., 2] > 190) & (shot[..., 0] < 90) & (shot[..., 2] - shot[..., 1] > 60)
    box = page.locator("canvas").first.bounding_box()
    y, x = np.add(np.argwhere(blue).mean(axis=0), (box["y"], box["x"]))
    page.mouse.move(x, y)
    page.wait_for_timeout(500)
    page.mouse.down()
    for i in range(1, 6):
        page.mouse.move(x - 12 * i, y + 6 * i)
        page.wait_for_timeout(150)
    page.mouse.up()
    press(page, "Single step")  # what is asked holds from the next step on
    press(page, "Single step")
    found = until(page, lambda found: time_of(found) >= 0.02)
    target = numbers(found["target"])
    assert target[0] < 0.17 and target[1] < 0.04
    assert (0.2 - target[0]) / (0.05 - target[1]) == pytest.approx(2.0, rel=0.1)
    assert float(browser.field_of(page, "x").input_value()) == pytest.approx(target[0], abs=6e-4)


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
    press(page, "Pause")
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
    seen = watch(page, start + 0.5)
    type_into(page, "x", 0.15)
    seen += watch(page, start + 1.5)
    press(page, "Stop recording")
    page.get_by_role("button", name="Record", exact=True).wait_for()
    press(page, "Pause")
    bag = folder / "recorded"
    assert_consistent(bag, "mcap")
    states = read_with_mcap(bag)
    made = json.loads((bag / "run.json").read_text())
    first = made["start_time"]
    assert before <= first <= start
    assert made["steps"] == len(states) - 1
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
        start_time=first, stop_time=first + made["steps"] * 0.01, settings=given,
    )  # fmt: skip
    again = twodof.samples(run)
    sample = next(again)
    for k, state in enumerate(states):
        assert sample.q == pytest.approx(tuple(np.frombuffer(state.position)), abs=1e-9)
        if k < len(states) - 1:
            due = abs(sample.t - moment_of_change) < 1e-6
            sample = again.send(values if due else None)


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
    seen, recorded, status = record_and_end(shown, native_path, tmp_path, signal.SIGTERM, 3.0)
    assert status == 130
    assert seen - 1e-6 <= recorded < seen + 1.5


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
    press(page, "Single step")
    until(page, lambda found: found["time"] == "0.01 s")


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
        press(page, "Pause")
        until(page, lambda found: found["real-time factor"] == "-")
        place = numbers(rows(page)["end effector"])
        type_into(page, "z", round(place[2] - 0.1, 3))
        press(page, "Single step")
        press(page, "Single step")
        found = until(page, lambda found: numbers(found["error"])[0] > 90.0)
        assert sum(name.startswith("panda_joint") for name in found) == 7
        begin = time_of(found)
        press(page, "Play")
        found = until(page, lambda found: time_of(found) > begin + 1.0)
        assert numbers(found["error"])[0] < 50.0
        assert colours(picture(page)) > 100


def test_port_in_use(native_path: Path, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = subprocess.run(
            [*browser.COMMAND, "live", str(native_path), "--port", f"{port}"],
            cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(rf"twodof: error: port {port} of 127.0.0.1 is in use[^\n]*\n", done.stderr)
