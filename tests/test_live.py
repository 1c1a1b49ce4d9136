"""A live arm, controlled and observed in a browser, against the closed form and other readers of bags."""

import json
import re
import signal
import socket
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from pathlib import Path
from threading import Event, Thread
from typing import Any
from urllib.parse import urlsplit

import browser
import numpy as np
import oracles
import pytest
from bags import SECOND, assert_consistent, read_with_mcap
from browser import (
    LINKS,
    Served,
    area,
    at_rest,
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
    target_place,
    type_into,
    until,
)
from harness import wait_until
from playwright.sync_api import Page
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect as open_socket

import twodof

Q_START = np.array([0.5, 0.35])
KP, KD = 50.0, 40.0  # those of the default FMU
ROUNDED = 6e-5  # m or rad, of what the page says


@pytest.fixture(scope="module")
def shown():
    with chromium() as program:
        yield program


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("live")


@pytest.fixture(scope="module")
def command(folder, native_path):
    with served("live", native_path, "-o", "recorded", cwd=folder) as command:
        yield command


@pytest.fixture(scope="module")
def arm(shown, command):
    with opened(shown, command.url) as page:
        yield page


@pytest.fixture
def page(arm):
    """A page whose arm is at its start, paused, with the inputs of the FMU and the first view."""
    if arm.evaluate("arm.playing"):
        pause(arm)
    begin_anew(arm, "Defaults")
    until(arm, bool, lambda arm: arm.evaluate(AS_AT_FIRST))
    assert at_rest(arm)["time"] == "0.000 s"
    press(arm, "View")
    return arm


AS_AT_FIRST = "() => [...arm.defaults()].every(([name, start]) => arm.values.get(name) === start)"


def begin_anew(page: Page, name: str) -> None:
    """Press a button that restarts the run, and wait until it has restarted."""
    run = page.evaluate("arm.run")
    press(page, name)
    until(page, lambda now: now > run, lambda page: page.evaluate("arm.run"))


def pause(page: Page) -> None:
    press(page, "Pause")
    at_rest(page)


def joints(found: dict[str, str]) -> list[float]:
    return numbers(f"{found['joint1']} {found['joint2']}")


def time_of(found: dict[str, str]) -> float:
    return numbers(found["time"])[0]


def watch(page: Page, until_time: float, *, least: int = 1) -> list[dict[str, str]]:
    """The readout at some moments, at least so many."""
    seen, end = [rows(page)], time.monotonic() + browser.TIMEOUT
    while time_of(seen[-1]) < until_time or len(seen) < least:
        assert time.monotonic() < end, seen[-1]
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
    seen: list[dict[str, str]],
    target: Sequence[float] | np.ndarray,
    *,
    kp: float = KP,
    kd: float = KD,
    rounded: float = ROUNDED,
) -> None:
    """Assert that the arm moves from its start to the target by the closed form."""
    t = np.array([time_of(found) for found in seen])
    x = np.array([numbers(found["end effector"])[:2] for found in seen])
    e = oracles.task_error(oracles.position(Q_START) - target, kp, kd, t)
    assert x == pytest.approx(target + e, abs=rounded)
    q = np.array([joints(found) for found in seen])
    assert x == pytest.approx(oracles.position(q), abs=2 * ROUNDED)


def test_target_is_dragged_and_followed_as_the_closed_form_says(command, page):
    """Sliders set gains; time is real, and the curves have the shown samples."""
    noted = page.evaluate("arm.noted")
    latest(command, lambda news: news["noted"] == noted + 1, ["change", {browser.HOSTILE: 0}])
    until(page, lambda text: "there is no variable" in text, told)  # a message that covers the ball
    (x, y), start = target_place(page), (0.2, 0.05)
    y -= 10  # pixels: in the message, and on the ball's upper edge
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 60, y + 30, steps=5)
    page.mouse.up()
    moved = until(
        page, lambda moved: moved[0] < -0.01, lambda page: np.subtract(page.evaluate("arm.held('x_des')"), start)
    )
    assert moved[1] / moved[0] == pytest.approx(0.5, abs=0.02)
    target = np.array([0.12, 0.17])
    for i in (1, 2):
        type_into(page, f"x_des[{i}], m", target[i - 1])
    type_into(page, "Kp, 1/s2", 80.0)
    type_into(page, "Kd, 1/s", 12.0)
    before = picture(page)
    seen = play(page, 1.5)
    assert_follows(seen, target, kp=80.0, kd=12.0)
    counts = [numbers(found["deadlines missed"]) for found in seen]
    for found, (missed, steps, worst) in zip(seen, counts):
        assert steps - counts[0][1] == round(100 * (time_of(found) - time_of(seen[0])))
        assert 0 <= missed <= steps and worst >= 0.0
    samples = browser.samples(page)
    assert len(samples) == round(100 * time_of(rows(page))) + 1
    assert samples[:, 0] == pytest.approx(0.01 * np.arange(len(samples)))
    for moment in [*seen, rows(page)]:
        q = samples[round(100 * time_of(moment)), 1:3]
        assert q == pytest.approx(joints(moment), abs=ROUNDED)
        assert numbers(moment["target"])[:2] == pytest.approx(target, abs=ROUNDED)
        error = np.linalg.norm(oracles.position(q) - target)
        assert error == pytest.approx(numbers(moment["error"])[0], rel=1e-3, abs=1e-9)
    type_into(page, "x_des[2], m", -0.1)  # away from the arm
    after, angles = picture(page), joints(rows(page))
    links = [direction(area(after, colour)) for colour in LINKS]
    assert np.sin(links - np.cumsum(angles)) == pytest.approx(0.0, abs=0.015)  # rad
    assert min(colours(before), colours(after)) > 100
    assert (before != after).any(axis=-1).mean() > 0.01
    press(page, "Play")
    until(page, lambda found: numbers(found["real-time factor"]) == pytest.approx([1.0], abs=0.1))
    pause(page)


def test_two_viewers_see_and_steer_the_same(command, page):
    """The second is a websocket."""
    with open_socket(socket_of(command)) as other:

        def sees(condition: Callable[[dict[str, Any]], bool]) -> None:
            while not condition(json.loads(other.recv(timeout=browser.TIMEOUT))):
                pass

        other.send('["change", {"x_des[1]": 0.11}]')
        until(page, lambda value: value == 0.11, lambda page: page.evaluate("arm.held('x_des')[0]"))
        type_into(page, "Kp, 1/s2", 70.0)
        sees(lambda news: news["values"]["Kp[2]"] == 70.0)
        other.send('["step", null]')
        until(page, lambda found: found["time"] == "0.010 s")
        press(page, "Play")
        sees(lambda news: news["playing"] and news["t"] > 0.05)
        other.send('["play", false]')
        page.get_by_role("button", name="Play").wait_for()
        other.send('["change", {"Kp": 60.0}]')
        kp = page.get_by_label("Kp, 1/s2", exact=True)
        until(page, lambda value: value == "60", lambda page: kp.input_value())
    assert page.title() == "2dof - twodof"


def test_a_parameter_restarts_the_run(page):
    press(page, "Step")
    until(page, lambda found: found["time"] == "0.010 s")
    type_into(page, "payload, kg", 0.5)
    until(page, lambda found: found["time"] == "0.000 s")
    heavy = page.evaluate("arm.at('tau')[0]")
    page.evaluate("arm.set('rtol', 0)")
    page.get_by_text("rtol = 0 must be > 0").wait_for()
    until(page, lambda value: value == 1e-3, lambda page: page.evaluate("arm.values.get('rtol')"))
    assert page.evaluate("arm.values.get('payload')") == 0.5
    begin_anew(page, "Reset")  # inputs and parameters stay
    assert page.evaluate("[arm.values.get('payload'), arm.at('tau')[0]]") == [0.5, heavy]
    press(page, "Defaults")
    until(page, lambda value: value == 0, lambda page: page.evaluate("arm.values.get('payload')"))


ORDERS = (["no order"], ["[]"], ['["leave", 1]'], ['["change", 3]'], ['["change"]'], ["{}"], [b"\xff"], ["x" * 100_000])


def test_a_client_that_sends_invalid_orders_is_disconnected(command, page):
    for orders in ORDERS:
        with open_socket(socket_of(command)) as connection:
            for order in orders:
                connection.send(order)
            with pytest.raises(ConnectionClosed):
                while True:
                    connection.recv(timeout=browser.TIMEOUT)
    press(page, "Step")
    until(page, lambda found: found["time"] == "0.010 s")


def test_a_flood_of_requests_does_not_delay_updates(command, page):
    """Other pages' requests are executed too, and so is its own last one."""
    with open_socket(socket_of(command)) as flood, open_socket(socket_of(command)) as other:
        other.send('["play", true]')
        stopped = Event()

        def send() -> None:
            while not stopped.is_set():
                for order in ('["play", true]', '["step", null]', '["change", {"Kp": 55.0}]'):
                    for _ in range(1000):
                        flood.send(order)
            flood.send('["change", {"Kp": 56.0}]')

        sending = Thread(target=send)
        sending.start()
        try:
            for k in range(30):
                target = 0.1 + k / 1000
                other.send(json.dumps(["change", {"x_des[1]": target}]))
                while json.loads(other.recv(timeout=browser.TIMEOUT))["values"]["x_des[1]"] != target:
                    pass
        finally:
            stopped.set()
            while True:  # what has come of news, which nobody else reads
                try:
                    flood.recv(timeout=0.1)
                except TimeoutError:
                    if not sending.is_alive():
                        break
            sending.join()
        while json.loads(other.recv(timeout=browser.TIMEOUT))["values"]["Kp[1]"] != 56.0:
            pass
        other.send('["play", false]')
        while json.loads(other.recv(timeout=browser.TIMEOUT))["playing"]:
            pass


def test_an_invalid_setting_is_reported_as_text(command, page):
    def ask(name: str, value: object, number: int) -> None:
        latest(command, lambda news: news["noted"] == number, ["change", {name: value}])
        until(page, lambda said: name.split("[")[0][:50] in said, told)

    asked, noted = (("q[1]", 1.0), ("Kp", "much"), (browser.HOSTILE, 0)), page.evaluate("arm.noted")
    for number, (name, value) in enumerate(asked, noted + 1):
        ask(name, value, number)
    browser.assert_shown_as_text(page)
    latest(command, lambda news: news["values"]["Kp[1]"] == 60.0, ["change", {"Kp": 60.0}])
    until(page, lambda value: value == 60.0, lambda page: page.evaluate("arm.held('Kp')[0]"))


def test_a_slow_page_or_ctrl_c_does_not_damage_a_recording(shown, fmu_path, tmp_path):
    """In the Python flavour; the recording does not wait for a page that reads too slowly."""
    with served("live", fmu_path, cwd=tmp_path) as command:
        place = urlsplit(socket_of(command))
        deaf = socket.create_connection((str(place.hostname), place.port or 0))
        head = "".join(f"{name}: {value}\r\n" for name, value in browser.UPGRADE)
        path = f"/socket?{place.query}"
        deaf.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n{head}\r\n".encode())
        with opened(shown, command.url) as page:
            press(page, "Record")
            page.get_by_role("button", name=re.compile("^Stop recording")).wait_for()
            seen = time_of(watch(page, time_of(rows(page)) + 1.0)[-1])
        assert end(command, tmp_path, signal.SIGINT) >= seen - 1e-6
        deaf.close()


def test_closing_the_last_page_pauses(native_path, tmp_path):
    """Another signal has the effect of Ctrl-C."""
    with served("live", native_path, cwd=tmp_path) as command:

        def stands() -> bool:
            """Return True if time stands still."""
            left = latest(command, lambda news: True)["t"]
            time.sleep(0.7)
            return bool(latest(command, lambda news: True)["t"] < left + 0.3)

        seen = latest(command, lambda news: news["recorded"] > 20, ["record", True])["t"]
        wait_until(stands)
        assert end(command, tmp_path, signal.SIGTERM) >= seen - 1e-6


def latest(command: Served, condition: Callable[[dict[str, Any]], bool], *orders: list[Any]) -> dict[str, Any]:
    """Updates that meet a condition, as sent to a page that makes requests and then closes."""
    with open_socket(socket_of(command)) as connection:
        for order in orders:
            connection.send(json.dumps(order))
        while not condition(news := json.loads(connection.recv(timeout=browser.TIMEOUT))):
            pass
    return dict(news)


def end(command: Served, folder: Path, number: signal.Signals) -> float:
    """The last time in the bag of a command that a signal ends."""
    status, output, errors = command.interrupt(number)
    (bag,) = folder.glob("rosbag2_*")
    assert (status, errors) == (130, "")
    assert f"bag   {bag.name}\n" in output
    assert_consistent(bag, "mcap")
    made = json.loads((bag / "run.json").read_text())
    return float(made["start_time"] + (len(read_with_mcap(bag)) - 1) * 0.01)


def socket_of(command: Served) -> str:
    return browser.socket_of(command.url)


def test_a_request_without_the_token_is_refused(command):
    """Another user of this machine can reach the port."""
    token = urlsplit(command.url).query.removeprefix("token=")
    assert len(token) == 43
    for query in ("", "?token=", f"?token={token[:-1]}", f"?token={token}x", f"?{token}"):
        for path, headers in (("/", ()), ("/socket", browser.UPGRADE)):
            own = ("Host", "localhost"), *headers
            assert browser.answer(command.url, *own, path=path + query) == 403


def test_the_socket_is_guarded_as_the_page(command):
    for headers, status in (
        ((("Host", "localhost"), ("Origin", "http://localhost")), 101),
        ((("Host", "localhost"), ("Origin", "http://evil.example")), 403),
        ((("Host", "evil.example"), ("Origin", "http://evil.example")), 403),
    ):
        query = urlsplit(command.url).query
        path = f"/socket?{query}"
        assert browser.answer(command.url, *headers, *browser.UPGRADE, path=path) == status
        page = 200 if status == 101 else 403
        assert browser.answer(command.url, *headers, path=f"/?{query}") == page


def test_the_page_talks_to_its_server_alone(shown, command):
    """Its policy forbids all other requests."""
    with socket.create_server(("127.0.0.1", 0)) as other, shown.new_context() as context:
        context.set_default_timeout(1e3 * browser.TIMEOUT)
        page, port = context.new_page(), other.getsockname()[1]
        page.goto(command.url)
        page.wait_for_selector(browser.READY)
        for code in (
            f"new WebSocket('ws://127.0.0.1:{port}')",
            f"fetch('http://127.0.0.1:{port}')",
            f"new Image().src = 'http://127.0.0.1:{port}'",
            "document.body.append(Object.assign(document.createElement('script'), {text: 'document.title = 1'}))",
        ):
            page.evaluate(f"() => {{ try {{ {code}; }} catch {{}} }}")
        page.wait_for_timeout(500)
        assert page.title() == "2dof - twodof"
        other.setblocking(False)
        with pytest.raises(BlockingIOError):
            other.accept()


def test_recording_equals_the_shown_motion(page, folder, native_path):
    type_into(page, "x_des[1], m", 0.2)
    type_into(page, "x_des[2], m", 0.05)
    press(page, "Play")
    until(page, lambda found: time_of(found) > 0.3)
    before = time_of(rows(page))
    press(page, "Record")
    page.get_by_role("button", name=re.compile("^Stop recording")).wait_for()
    start = time_of(rows(page))
    seen = watch(page, start + 0.5, least=6)
    type_into(page, "x_des[1], m", 0.15)
    seen += watch(page, start + 1.5, least=6)
    press(page, "Stop recording")
    note = until(page, lambda said: "Recorded: recorded, " in said, told)
    page.get_by_role("button", name="Record", exact=True).wait_for()
    pause(page)
    bag = folder / "recorded"
    assert_consistent(bag, "mcap")
    states = read_with_mcap(bag)
    made = json.loads((bag / "run.json").read_text())
    first = made["start_time"]
    assert before <= first <= start
    assert f"recorded, {len(states)} samples" in note
    steps = np.diff([state.log_time for state in states])
    assert (steps == SECOND // 100).all()
    found = [found for found in seen if time_of(found) >= first]
    assert len(found) > 10
    for moment in found:
        state = states[round((time_of(moment) - first) / 0.01)]
        shown = joints(moment)
        assert shown == pytest.approx(np.frombuffer(state.position), abs=ROUNDED)
    # the provenance is a run that starts there and does the same
    given = made["start_values"]
    ((moment_of_change, values),) = made["input_changes"]
    assert values == {"x_des[1]": 0.15}
    run = twodof.experiment(native_path, start_time=first, stop_time=first + (len(states) - 1) * 0.01, settings=given)
    again = twodof.samples(run)
    sample = next(again)
    for k, state in enumerate(states):
        assert sample.q == pytest.approx(tuple(np.frombuffer(state.position)), abs=1e-9)
        if k < len(states) - 1:
            due = abs(sample.t - moment_of_change) < 1e-6
            sample = again.send(values if due else None)


def told(page: Page) -> str:
    return page.inner_text("#arm-message")


SLIDER = """<robot name="slider">
  <link name="rail"/>
  <link name="carriage"><inertial><mass value="2"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="beam"><inertial><origin xyz="0.15 0 0"/><mass value="1"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>
  <link name="tip"/>
  <joint name="_slide" type="prismatic"><parent link="rail"/><child link="carriage"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="20" velocity="5"/></joint>
  <joint name="swing" type="revolute"><parent link="carriage"/><child link="beam"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="20" velocity="9"/></joint>
  <joint name="end" type="fixed"><parent link="beam"/><child link="tip"/>
    <origin xyz="0.3 0 0"/></joint>
</robot>"""


def test_twenty_reconnects_leak_nothing(command, page):
    for i in range(20):
        connect(command.url)
        if i == 4:
            threads, memory = command.status("Threads"), command.status("VmRSS")
    assert command.children() == []
    assert command.status("Threads") <= threads + 2
    assert command.status("VmRSS") <= memory + 10_000  # KiB
    press(page, "Play")
    connect(command.url)
    left = time_of(rows(page))
    watch(page, left + 0.3)  # one that leaves is not the last


def test_seven_joints_without_a_mesh_to_a_pose(shown, panda, tmp_path):
    """In the Python flavour; a target orientation of zeros is refused and does not end the run."""
    tree = ET.fromstring(panda)
    for link in tree.findall("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(part)
    urdf = tmp_path / "panda.urdf"
    urdf.write_text(ET.tostring(tree, encoding="unicode"))
    options = twodof.FmuOptions(urdf=urdf, frame="panda_hand", control="pose", q_start=oracles.REST["panda"])
    fmu = twodof.build_fmu(tmp_path / "Panda.fmu", options)
    with served("live", fmu, cwd=tmp_path) as command, opened(shown, command.url) as page:
        pause(page)
        place = numbers(rows(page)["end effector"])
        type_into(page, "x_des[3], m", round(place[2] - 0.1, 3))
        press(page, "Step")
        press(page, "Step")
        found = until(page, lambda found: numbers(found["error"])[0] > 0.09)
        assert sum(name.startswith("panda_joint") for name in found) == 7
        quat = page.evaluate("arm.held('quat_des')")
        for i in range(4):
            type_into(page, f"quat_des[{i + 1}], number", 0.0)
        until(page, lambda said: "quat_des = 0, 0, 0, 0 is not an orientation" in said, told)
        left = page.evaluate("arm.held('quat_des')")
        assert left == [0.0, 0.0, 0.0, quat[3]]  # without the last
        latest(command, lambda news: news["noted"] == 1, ["change", {"quat_des": 0}])
        page.evaluate("(quat) => arm.set('quat_des', quat)", quat)
        begin = time_of(found)
        press(page, "Play")
        found = until(page, lambda found: time_of(found) > begin + 1.0)
        assert numbers(found["error"])[0] < 0.05
        assert len(pixels(picture(page), LINKS[0])) > 200  # a joint's ball, as dark as link 1


def test_a_page_whose_server_ends_goes_on_with_the_next(shown, native_path, tmp_path, monkeypatch):
    """The next server steps another robot, whose joints have units of their own.

    At rest J⁻ᵀ τ_ext is balanced by Kp: M (J⁻¹ Kp e) = τ_ext, with the textbook's M.
    """
    monkeypatch.setenv("TMPDIR", str(tmp_path))  # the server that is killed leaves a folder
    (tmp_path / "slider.urdf").write_text(SLIDER)
    options = twodof.FmuOptions(urdf=tmp_path / "slider.urdf", frame="tip", axes="xy", q_start=(0.1, 0.6))
    slider = twodof.build_fmu(tmp_path / "Slider.fmu", options)
    with served("live", native_path, cwd=tmp_path) as command:
        port = urlsplit(command.url).port or 0
        with opened(shown, command.url) as page:
            until(page, lambda found: time_of(found) > 0.1)
            command.interrupt(signal.SIGKILL)
            until(page, lambda said: "this page waits for it" in said, told)
            press(page, "Play")
            page.wait_for_timeout(1500)  # it looks for one more than once
            assert "this page waits for it" in told(page)
            with served("live", slider, "--set", "Kp=100", cwd=tmp_path, port=port) as following:
                page.wait_for_function("() => globalThis.arm?.facts?.robot === 'slider'")
                assert page.evaluate("arm.held('Kp')") == [100, 100]
                names = page.locator("#arm-readout td:first-child").all_text_contents()
                assert names[:2] == ["_slide", "swing"]
                assert told(page) == "drag the ball: it is the target"
                type_into(page, "Kd, 1/s", 20.0)
                type_into(page, "x_des[1], m", 0.4)
                type_into(page, "x_des[2], m", 0.1)
                type_into(page, "tau_ext[1], N", 2.0)
                begin = time_of(rows(page))
                until(page, lambda found: time_of(found) > begin + 1.8)
                assert page.get_by_label("position, rad or m").count() == 1
                s, q, *x = page.evaluate("[...arm.at('q'), ...arm.at('x')]")  # of one sample
                status, _, errors = following.interrupt()
    assert (status, errors) == (130, "")
    assert x == pytest.approx([s + 0.3 * np.cos(q), 0.3 * np.sin(q)], abs=1e-9)
    jacobian = np.array([[1.0, -0.3 * np.sin(q)], [0.0, 0.3 * np.cos(q)]])
    coupled = -0.15 * np.sin(q)
    mass = np.array([[3.0, coupled], [coupled, 0.01 + 0.15**2]])
    e = jacobian @ np.linalg.solve(mass, [2.0, 0.0]) / 100.0
    assert np.subtract(x, (0.4, 0.1)) == pytest.approx(e, abs=2e-5)
