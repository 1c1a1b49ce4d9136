"""The page of an FMU, in a browser without a network, against FMPy and other readers of bags."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import (
    EVEN_FRAMES,
    EVERY_OTHER_FRAME,
    HOSTILE,
    LINKS,
    READY,
    TIMEOUT,
    VIEWPORT,
    assert_shown_as_text,
    chromium,
    direction,
    hostile_arm,
    picture,
    pixels,
    press,
    samples,
    target_place,
    until,
)
from mcap_ros2.reader import read_ros2_messages
from native_models import robots_folder
from PIL import Image
from playwright.sync_api import Browser, Page, ViewportSize
from rosbags.rosbag2 import Reader
from tools import needs

import twodof
from twodof.cli.main import main
from twodof.errors import BagError, PageError
from twodof.fmu import instantiate
from twodof.plots.scripts import EXPORT, IMPORT
from twodof.plots.track import read_tracks
from twodof.simulation.input_values import resolve

ROOT = Path(__file__).parents[1]
ASSETS = ROOT / "fmu_src" / "page"

Script = dict[int, dict[str, Any]]
"""Settings before steps, by number."""


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as started:
        yield started


@contextmanager
def shown(browser: Browser, path: Path, begin: str = EVERY_OTHER_FRAME, **context: Any) -> Iterator[Page]:
    """A page from its file, without a network; it makes no requests and logs no errors."""
    with browser.new_context(viewport=VIEWPORT, offline=True, accept_downloads=True, **context) as opened:
        opened.set_default_timeout(1e3 * TIMEOUT)
        page = opened.new_page()
        page.add_init_script(begin)
        said: list[str] = []
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("console", lambda message: said.append(message.text))
        page.on("request", lambda request: said.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_selector(READY)
        yield page
        assert said == [path.as_uri()]


@pytest.fixture(scope="module")
def arm(native_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The default arm's page."""
    return twodof.page(native_path, tmp_path_factory.mktemp("page") / "arm.html")


@pytest.fixture(scope="module")
def alive(browser: Browser, arm: Path) -> Iterator[Page]:
    with shown(browser, arm) as page:
        yield page


@pytest.fixture
def page(alive: Page) -> Page:
    """The default arm's page, at its start and paused, with one slider for each gain."""
    alive.evaluate("() => { arm.play(false); arm.startAgain(true); arm.message = ''; }")
    for button in alive.locator("#arm-controls button[aria-expanded=true]").all():
        button.click()
    press(alive, "View")
    return alive


def built(folder: Path, name: str, **options: Any) -> Path:
    """A native FMU of a robot of the package example-robot-data."""
    urdf = next(robots_folder().rglob(f"{name}.urdf"))
    chosen = twodof.FmuOptions(urdf=urdf, mesh_dir=robots_folder().parent, native=True, **options)
    return twodof.build_fmu(folder / f"{name}.fmu", chosen)


@pytest.fixture(scope="module")
def panda(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("panda")
    return built(folder, "panda", frame="panda_hand_tcp", control="pose")


@pytest.fixture(scope="module")
def panda_page(panda: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return twodof.page(panda, tmp_path_factory.mktemp("panda") / "panda.html")


def stepped(path: Path, parameters: dict, script: Script, steps: int) -> np.ndarray:
    """Samples by FMPy, N × (q, v, x, tau); inputs are set before steps by number."""
    fmu = twodof.load_fmu(path)
    names = [name for group in ("q", "v", "x", "tau") for name in fmu.vector(group)]
    with instantiate(fmu) as instance:
        instance.initialise(0.0, inf, resolve(fmu, parameters))
        read = instance.reader(names)
        rows = [[*read()]]
        for k in range(steps):
            instance.set(resolve(fmu, script.get(k, {})))
            instance.step(k * 0.01, 0.01)
            rows.append([*read()])
    return np.array(rows)


def played(page: Page, parameters: dict, script: Script, steps: int) -> np.ndarray:
    """The same by the page."""
    if page.locator("#arm-play").text_content() == "Pause":
        press(page, "Pause")
    columns = page.evaluate(
        """([parameters, script, steps]) => {
            arm.startAgain(true);
            for (const [name, value] of Object.entries(parameters)) arm.set(name, value);
            for (let k = 0; k < steps; k++) {
                for (const [name, value] of Object.entries(script[k] ?? {})) arm.set(name, value);
                arm.step();
            }
            const groups = ["q", "v", "x", "tau"];
            return JSON.stringify(Array.from({length: arm.count},
                (_, k) => groups.flatMap(group => [...arm.at(group, k)])));
        }""",
        [parameters, {str(k): values for k, values in script.items()}, steps],
    )
    return np.array(json.loads(columns))


SESSION: Script = {
    0: {"x_des": [0.22, 0.02]},
    200: {"Kp": 90.0, "Kd": [25.0, 30.0]},
    350: {"f_ext": [2.0, -1.0, 0.0]},
    450: {"f_ext": 0.0, "x_des": [0.14, 0.16]},
    700: {"tau_ext": [0.3, -0.1], "x_des[1]": 0.17},
}


@pytest.mark.parametrize("fmi", [2, 3])
def test_a_session_has_the_numbers_of_the_fmu(browser, tmp_path, native_path, fmi) -> None:
    path = native_path
    if fmi == 3:
        path = twodof.build_fmu(tmp_path / "three.fmu", twodof.FmuOptions(native=True, fmi=3))
    parameters = {"payload": 0.7, "limit_effort": True}
    expected = stepped(path, parameters, SESSION, 800)
    with shown(browser, twodof.page(path, tmp_path / "arm.html")) as page:
        actual = played(page, parameters, SESSION, 800)
    assert actual.shape == expected.shape == (801, 8)
    assert np.ptp(expected[:, 0]) > 0.5  # it moved
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-12)


def test_a_panda_to_a_pose_has_its_numbers(browser, panda, panda_page) -> None:
    script: Script = {
        0: {"x_des": [0.45, 0.2, 0.4], "quat_des": [0.9, 0.1, 0.3, 0.2]},
        200: {"Kp_rot": 80.0, "f_ext": [0.0, 5.0, -20.0]},
    }
    assert panda_page.stat().st_size < 6e6
    expected = stepped(panda, {}, script, 400)
    changes = [(0.01 * k, values) for k, values in script.items()]
    summary = twodof.simulate(panda, stop_time=4.0, changes=changes)
    run_errors = summary.error, summary.turn_error
    with shown(browser, panda_page) as page:
        actual = played(page, {}, script, 400)
        joints, cut = page.evaluate(READOUT)
        error = page.locator("[data-value=error]")
        shown_error = f"{run_errors[0]:.3g}"[:4]  # the readout follows the last step by some frames
        until(page, lambda found: found.startswith(shown_error), lambda page: str(error.text_content()))
        curves = page.locator("#arm-curves canvas").evaluate_all("all => all.map(c => c.ariaLabel)")
        said = str(error.text_content())
        before = page.evaluate("arm.held('quat_des')")
        assert refused(page, "arm.set('quat_des', 0)") == NO_ORIENTATION
        assert page.evaluate("arm.held('quat_des')") == before
    np.testing.assert_allclose(actual, expected, rtol=0.0, atol=1e-12)
    distance, angle = (float(part.split()[0]) for part in said.split(", "))
    assert distance == pytest.approx(run_errors[0], rel=1e-3)
    assert angle == pytest.approx(run_errors[1], rel=1e-3)
    assert curves[-2:] == ["distance from the target, m", "angle from the target orientation, rad"]
    told = ("finger_joint1", "end effector", "target", "error")
    assert joints == [*(f"joint{i}" for i in range(1, 8)), *told]
    assert cut == 0


NO_ORIENTATION = "quat_des = 0, 0, 0, 0 is not an orientation; the identity is (0, 0, 0, 1)"


def refused(page: Page, code: str, *arguments: object) -> str:
    """Return the message about a refused value."""
    words = "{ try { %s; } catch (error) { return error.message; } }"
    return str(page.evaluate(f"([a, b]) => {words % code}", [*arguments, None, None][:2]))


def test_a_speed_that_rounds_to_zero_has_no_sign(page) -> None:
    page.evaluate("() => { arm.set('v_start', [-1e-6, -0.25]); arm.startAgain(); }")
    until(page, ["0.0000", "\u22120.2500"].__eq__, speeds)


def speeds(page: Page) -> list[str]:
    cells = page.locator("#arm-readout td").all_text_contents()
    return [cells[cells.index(joint) + 2] for joint in ("joint1", "joint2")]


READOUT = """() => {
    const cells = [...document.querySelectorAll("#arm-readout td")];
    return [cells.filter(cell => !cell.previousElementSibling).map(cell => cell.textContent),
        cells.filter(cell => cell.scrollWidth > cell.clientWidth).length];
}"""
"""Names in the readout, and how many of its cells do not show all that they hold."""


PHONE: ViewportSize = {"width": 390, "height": 844}
CUT = """() => [...document.querySelectorAll("#arm-readout td, .slider span")]
    .filter(name => name.checkVisibility() && name.scrollWidth > name.clientWidth)
    .map(name => name.textContent)"""
"""Names and numbers that are not shown whole."""


def test_all_is_seen_of_a_robot_and_its_names(browser, tmp_path) -> None:
    """Buttons hide no part, even of a bare plant that hangs down."""
    ur10 = built(tmp_path, "ur10_robot", frame="tool0", control="effort", meshes=False)
    with shown(browser, twodof.page(ur10, tmp_path / "ur10.html")) as page:
        for size in (VIEWPORT, PHONE):
            page.set_viewport_size(size)
            until(page, lambda found: found == [], lambda page: page.evaluate(CUT))
            scene, bar = (page.locator(f".view > {part}").bounding_box() for part in ("canvas", ".bar"))
            assert scene is not None and bar is not None
            assert scene["y"] + scene["height"] <= bar["y"] + 0.5
            assert bar["y"] + bar["height"] <= size["height"] and scene["height"] > 300
        names = page.locator("#arm-readout td:first-child").all_text_contents()
        titles = page.locator("#arm-readout td[title]").evaluate_all("all => all.map(e => e.title)")
    short = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
    assert names == [*short, "end effector"]
    assert titles == [f"{name}_joint" for name in short]


def test_the_arm_is_seen_in_the_dark(page) -> None:
    """The contrast is at least 3 to 1, as the Web Content Accessibility Guidelines require of graphics."""
    places = [pixels(picture(page), colour) for colour in LINKS]
    for scheme, least in (("dark", 3.0), ("light", 2.0)):
        page.emulate_media(color_scheme=scheme)
        now = picture(page)
        ground = luminance(now[5, 5])
        for place in places:
            light = luminance(np.median(now[place[:, 1], place[:, 0]], axis=0))
            contrast = (max(light, ground) + 0.05) / (min(light, ground) + 0.05)
            assert contrast > least, (scheme, contrast)
        assert (ground < 0.05) == (scheme == "dark")


def luminance(colour: np.ndarray) -> float:
    """Relative luminance of sRGB."""
    c = colour / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


PLAYED = """async () => {
    const next = requestAnimationFrame, clock = performance.now, begun = performance.now();
    const until = async (end) => { while (time < end) await new Promise((show) => next(show)); };
    let time = begun;
    window.requestAnimationFrame = (show) => next(() => show(time += 35));
    performance.now = () => time;
    await until(begun + 35);
    arm.play(true);
    const start = time, first = arm.k;
    await until(start + 700);
    const played = [arm.k - first, (time - start) / 10];
    [window.requestAnimationFrame, performance.now] = [next, clock];
    return played;
}"""
"""Steps of 10 ms in 20 frames of a clock that no slow machine delays, and how many the clock asks for."""


def test_the_arm_runs_in_real_time_and_is_seen_where_it_is(page, arm) -> None:
    assert arm.stat().st_size < 1.5e6
    steps, expected = page.evaluate(PLAYED)
    assert expected == pytest.approx(70.0) and abs(steps - expected) <= 1.0
    page.evaluate("() => { arm.play(false); arm.startAgain(true); arm.step(500); }")
    q1, q2 = page.evaluate("() => [...arm.at('q')]")
    links = [direction(pixels(picture(page), colour)) for colour in LINKS]
    for seen, angle in zip(links, (q1, q1 + q2)):
        assert abs(np.sin(seen - angle)) < 0.05


def test_the_buttons_and_keys_have_their_effects(page) -> None:
    page.locator("#arm-scene").click()
    page.keyboard.press(" ")
    until(page, lambda k: k > 0, lambda page: page.evaluate("arm.k"))
    page.keyboard.press(" ")
    assert page.locator("#arm-play").text_content() == "Play"
    k = page.evaluate("arm.k")
    press(page, "Step")
    assert page.evaluate("arm.k") == k + 1
    page.get_by_label("Kp, 1/s2").fill("77")
    page.keyboard.press("Enter")
    assert page.evaluate("arm.held('Kp')") == [77, 77]
    press(page, "Reset")
    assert page.evaluate("[arm.k, ...arm.held('Kp')]") == [0, 77, 77]
    press(page, "Defaults")
    assert page.evaluate("[arm.k, ...arm.held('Kp')]") == [0, 50, 50]
    page.evaluate("arm.set('x_des', [0.25, 0.8])")
    until(page, lambda text: "target out of reach" in text, said)
    until(page, lambda count: count > 5, ball)  # which is followed
    page.evaluate("arm.set('x_des', [0.2, 0.05]); arm.set('q_max[1]', 0.5)")
    until(page, lambda text: "not reached: joint 'joint1' is at its upper limit" in text, said)


HINT = "drag the ball: it is the target"
HELD = {"q_des": [0.5, 0.8], "q_max": [1.0, 0.6]}
SEEN = "decodeURI(location.hash.slice(1)) === arm.state"  # the page has shown what was set
SADDLED = {"payload": 9.0, "payload_known": True, "limit_effort": True, "gravity": [0.0, -9.81, 0.0]}


@pytest.mark.parametrize(
    ("control", "settings", "words"),
    [
        (
            "task",
            {"x_des": [0.5, 0.1]},
            "target out of reach by 0.2099 m; the nearest reachable point is (0.2942, 0.05883)",
        ),
        ("task", {"x_des": [200.0, 50.0]}, "in millimetres?"),
        ("joint", {"q_des": [90.0, 0.35]}, "q_des[1] is 90 rad; did you mean 90°, which is 1.5708 rad?"),
        ("joint", HELD, "the target 0.8 rad of joint 'joint2' is out of reach by 0.2 rad"),
        ("task", {"q_min": [0.2, -3.0]}, "joint 'joint1' is at its lower limit"),
        ("task", {"f_ext": [0.0, 3.0, 0.0]}, "not know f_ext = (0, 3, 0)"),
        ("task", {"payload": 3.0, "f_ext": [0.0, 1.0, 0.0]}, "the controller does not know the payload of 3 kg"),
        ("task", {"Kp": [50.0, 0.0]}, "Kp[2] (along y) = 0: the controller does not reduce"),
        ("task", {"Kd": 0.0, "Kp": 20.0}, "Kd = 0 s⁻¹ damps too little: critical is 8.944 s⁻¹"),
        ("joint", {"friction": [20.0, 0.0]}, "joint 'joint1' sticks: its friction of 20 N·m holds it"),
        ("joint", SADDLED, "the motor of joint 'joint1' is saturated for 9"),
        ("task", {"q_start": [0.0, 0.0], "x_des": [0.2, 0.0]}, "the arm is near a singularity"),
    ],
)
def test_the_verdict_names_the_cause(page, joint_page, control, settings, words) -> None:
    if control == "joint":
        page, settings = joint_page, {"q_des": [0.9, 0.7], **settings}
        page.evaluate("() => { arm.play(false); arm.startAgain(true); }")
    page.evaluate("settings => { for (const [k, v] of Object.entries(settings)) arm.set(k, v); }", settings)
    until(page, bool, lambda page: page.evaluate(SEEN))
    page.evaluate("arm.step(500)")
    until(page, lambda text: text.splitlines()[:1] and words in text.splitlines()[0], said)


def test_an_arm_that_never_moved_is_named(joint_page) -> None:
    for friction, expected in ((20.0, True), ([20.0, 0.0], False)):
        joint_page.evaluate("() => { arm.play(false); arm.startAgain(true); arm.set('q_des', [0.9, 0.7]); }")
        joint_page.evaluate("size => arm.set('friction', size)", friction)
        until(joint_page, bool, lambda page: page.evaluate(SEEN))
        joint_page.evaluate("arm.step(500)")
        until(joint_page, lambda text: "' sticks: its friction of 20 N·m" in text, said)
        assert ("no joint ever moved" in said(joint_page).splitlines()) == expected


@pytest.fixture(scope="module")
def joint_page(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """The default arm's page under joint control."""
    folder = tmp_path_factory.mktemp("joint")
    fmu = twodof.build_fmu(folder / "joint.fmu", twodof.FmuOptions(native=True, control="joint"))
    with shown(browser, twodof.page(fmu, folder / "joint.html")) as page:
        yield page


def test_a_joint_that_moves_no_target_is_no_cause(browser, panda_page) -> None:
    """A Panda's fingers are closed: only the arm's joint at its limit is named."""
    with shown(browser, panda_page) as page:
        page.evaluate("""() => { arm.play(false); arm.startAgain(true); arm.set("x_des", [0.5, 0.1, 0.4]);
            arm.set("q_start[7]", arm.values.get("q_max[7]")); }""")
        text = until(page, lambda text: "joint 'panda_joint7' is at its upper limit" in text, said)
        assert "finger" not in text


def test_a_run_that_reaches_its_target_has_no_cause(page) -> None:
    """At the target, on the way to it and after a drag to another, at each step."""
    until(page, lambda text: text in ("", HINT), said)
    for target in ([0.2, 0.05], [-0.1, 0.2], [-0.2, 0.1]):
        page.evaluate("x => arm.set('x_des', x)", target)
        for _ in range(8):
            page.evaluate("arm.step(40)")
            page.wait_for_timeout(150)
            assert said(page) in ("", HINT)


def test_friction_and_sampling_are_set_in_the_panel(page) -> None:
    for summary in page.locator("summary").all():
        if "joints" in str(summary.text_content()) or "sampling" in str(summary.text_content()):
            summary.click()
    typed = {"friction[1], N.m": 1e3, "control_period, s": 0.02, "control_delay, s": 0.01, "q_resolution[2], rad": 1e-3}
    for label, number in typed.items():
        page.get_by_label(label, exact=True).fill(str(number))
        page.keyboard.press("Enter")
        name = label.partition(",")[0].partition("[")[0]
        assert number in page.evaluate("name => arm.held(name)", name)
    page.get_by_label("v_from_q").check()
    until(page, lambda text: "joint1: held by friction" in text and "joint2" not in text, said)
    page.evaluate("arm.step(10)")
    assert page.evaluate("arm.at('v')[0] === 0 && arm.at('v')[1] !== 0 && arm.at('q')[0] === arm.held('q_start')[0]")
    page.get_by_label("control_period, s", exact=True).fill("0")
    page.keyboard.press("Enter")
    until(page, lambda text: "control_delay = 0.01 needs a control_period > 0" in text, said)
    assert page.evaluate("arm.held('control_period')") == [0.02]
    page.evaluate("arm.set('friction[1]', 0)")
    until(page, lambda text: "held by friction" not in text, said)


def ball(page: Page) -> int:
    """Pixels of the target at the upper edge, where nothing else is."""
    red, green, blue = np.moveaxis(picture(page)[:80].astype(int), -1, 0)
    return int(((red - blue > 100) & (green < 105) & (red < 225)).sum())


def said(page: Page) -> str:
    return str(page.locator("#arm-message").text_content())


def test_the_url_has_the_settings(browser, arm, page) -> None:
    page.evaluate("() => { arm.set('Kp', [80, 60]); arm.set('x_des[2]', -0.1); arm.set('limit_effort', true); }")
    expected = "#x_des=0.2,-0.1&Kp=80,60&limit_effort=true"
    until(page, lambda found: sorted(found[1:].split("&")) == sorted(expected[1:].split("&")), fragment)
    start = [50, 50, 0.2, 0.05, False]
    for part, said_of, held in (
        (expected, "", [80, 60, 0.2, -0.1, True]),
        ("#Kp=30", "", [30, 30, *start[2:]]),
        ("#Kp=1,2,3", "Kp has 2 elements", start),
        ("#Kq=1", "there is no variable 'Kq'", start),
    ):
        with browser.new_context(viewport=VIEWPORT, offline=True) as context:
            other = context.new_page()
            other.goto(arm.as_uri() + part)
            other.wait_for_selector(READY)
            values = other.evaluate("[...arm.held('Kp'), ...arm.held('x_des'), arm.values.get('limit_effort')]")
            assert values == held and said_of in said(other)
    page.evaluate("arm.startAgain(true)")
    until(page, lambda found: found == "", fragment)


def fragment(page: Page) -> str:
    return str(page.evaluate("decodeURI(location.hash)"))


def test_keys_move_the_view_of_a_flat_robot(page) -> None:
    before, ball_at = picture(page), target_place(page)
    page.locator("#arm-scene").focus()
    page.keyboard.press("ArrowRight")
    assert target_place(page)[0] == pytest.approx(ball_at[0] + 0.04 * before.shape[1], abs=2.0)


def test_gains_have_a_slider_for_each_axis_on_demand(browser, arm, page) -> None:
    every, own = "Kp, 1/s2", "Kp[2], 1/s2"
    button = page.get_by_role("button", name="each element of Kp", exact=True)
    assert not page.get_by_label(own).is_visible()
    button.click()
    page.get_by_label(own).fill("80")
    page.keyboard.press("Enter")
    assert page.evaluate("arm.held('Kp')") == [50, 80]
    until(page, "#Kp=50,80".__eq__, fragment)
    until(page, "".__eq__, lambda page: page.get_by_label(every).input_value())
    assert button.is_disabled()  # gains that differ stay visible
    with browser.new_context(viewport=VIEWPORT, offline=True) as context:
        other = context.new_page()
        other.goto(f"{arm.as_uri()}#Kp=50,80")
        other.wait_for_selector(READY)
        until(other, bool, lambda other: other.get_by_label(own).is_visible())
        assert other.get_by_label(own).input_value() == "80"
    page.get_by_label(every).fill("60")
    page.keyboard.press("Enter")
    assert page.evaluate("arm.held('Kp')") == [60, 60]
    until(page, bool, lambda page: button.is_enabled())
    button.click()
    assert not page.get_by_label(own).is_visible()


def test_the_axes_of_the_root_are_in_the_corner(page) -> None:
    """x to the right and y upwards; z points at the viewer."""
    for scheme in ("dark", "light"):
        page.emulate_media(color_scheme=scheme)
        red, green, blue = np.moveaxis(picture(page)[-100:, :100].astype(int), -1, 0)
        x, y = (red - green > 50), (green - red > 30) & (green - blue > 20)
        (height, width), (tall, narrow) = (np.ptp(np.argwhere(axis), axis=0) for axis in (x, y))
        assert width > 25 > height and tall > 25 > narrow
        assert not (blue - red > 60).any()


def test_the_hint_goes_with_the_first_drag(browser, arm) -> None:
    with shown(browser, arm) as page:
        page.evaluate("() => { arm.play(false); arm.startAgain(true); }")
        assert HINT in said(page)
        x, y = target_place(page)
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 30, y)
        page.mouse.up()
        until(page, lambda text: HINT not in text, said)


def test_the_picture_is_that_of_the_scene(page, tmp_path) -> None:
    with page.expect_download() as download:
        press(page, "Picture")
    assert download.value.suggested_filename == "TwoDof.png"
    download.value.save_as(tmp_path / "arm.png")
    shown_now, saved = picture(page), np.asarray(Image.open(tmp_path / "arm.png").convert("RGB"))
    small = np.asarray(Image.fromarray(saved).resize(shown_now.shape[1::-1]))
    assert np.abs(small.astype(int) - shown_now).mean() < 2.0


def test_units_stand_beside_the_sliders(page) -> None:
    units = page.locator("#arm-controls label:visible small").all_text_contents()
    assert units[:4] == ["m", "m", "s⁻²", "s⁻¹"]


def test_a_robot_in_space_stands_on_a_floor_with_its_shadow_and_keys_turn_it(browser, panda_page) -> None:
    """The shadow is drawn at the floor's point below the hand, and moves with it."""
    with shown(browser, panda_page, begin=EVEN_FRAMES) as page:
        page.evaluate("arm.play(false)")
        places = []
        for q1 in (0.0, 0.7):
            page.evaluate("q => arm.set('q_start[1]', q)", q1)
            seen = picture(page)
            shade = pixels(seen, lambda r, g, b: (r == 219) & (g == 224) & (b == 229))
            places.append(shade.mean(axis=0))
            assert len(shade) > 100
        assert np.hypot(*(places[1] - places[0])) > 10.0
        page.locator("#arm-scene").focus()
        for key in ("ArrowLeft", "ArrowUp", "+"):
            page.keyboard.press(key)
            turned = picture(page)
            assert (np.abs(turned.astype(int) - seen).max(axis=2) > 40).mean() > 0.01, key
            seen = turned


def test_a_browser_without_3d_shows_the_rest(browser, arm) -> None:
    with browser.new_context(viewport=VIEWPORT, offline=True) as context:
        context.set_default_timeout(1e3 * TIMEOUT)
        page = context.new_page()
        page.add_init_script(
            """const given = HTMLCanvasElement.prototype.getContext;
            HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
                return kind === "webgl2" ? null : given.call(this, kind, ...more);
            }"""
        )
        page.goto(arm.as_uri())
        page.wait_for_selector(READY)
        until(page, lambda text: "no 3D" in text, said)
        until(page, lambda k: k > 10, lambda page: page.evaluate("arm.k"))
        assert page.locator("#arm-readout td").nth(1).text_content() != ""


def test_the_target_is_dragged_in_the_plane(page) -> None:
    before = page.evaluate("arm.held('x_des')")
    box = page.locator("#arm-scene").bounding_box()
    target = target_place(page)
    page.mouse.move(*target)
    page.mouse.down()
    page.mouse.move(target[0] - 60, target[1] - 30, steps=3)
    page.mouse.up()
    x, y = np.array(page.evaluate("arm.held('x_des')")) - before
    assert x < -0.01 and abs(y / x + 0.5) < 0.02  # twice as far to the left as upwards
    off = np.hypot(*(np.add(before, (x, y)) - page.evaluate("[...arm.at('x')]")))
    until(page, lambda text: text == f"{off:.4g} m", error)  # before any step
    page.mouse.move(box["x"] + 40, box["y"] + 40)
    page.mouse.down()
    page.mouse.move(box["x"] + 90, box["y"] + 90, steps=3)  # beside it: the target stays
    page.mouse.up()
    assert page.evaluate("arm.held('x_des')") == [before[0] + x, before[1] + y]


def error(page: Page) -> str:
    return str(page.locator("[data-value=error]").text_content())


def download(page: Page, folder: Path) -> Path:
    with page.expect_download() as waiting:
        press(page, "Download")
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return path


def test_the_download_is_a_bag_of_the_samples(browser, panda, tmp_path, capsys) -> None:
    page_path = twodof.page(panda, tmp_path / "panda.html", settings={"Kd": 30.0})
    with shown(browser, page_path) as page:
        script: Script = {0: {"x_des": [0.45, 0.2, 0.4]}, 40: {"Kp": 70.0}}
        played(page, {"payload": 0.5}, script, 1700)
        rows = samples(page)
        path = download(page, tmp_path)
    n = 8
    bag = twodof.read_bag(path)
    assert bag.joints == twodof.load_fmu(panda).joints
    np.testing.assert_array_equal(bag.q, rows[:, :n])
    np.testing.assert_array_equal(bag.v, rows[:, n : 2 * n])
    assert np.diff(bag.stamps).tolist() == [10_000_000] * 1700
    messages = [m.ros_msg for m in read_ros2_messages(path, topics=["/joint_states"])]
    np.testing.assert_array_equal([m.effort for m in messages], bag.tau)
    np.testing.assert_array_equal([m.position for m in messages], bag.q)
    assert messages[0].name == list(bag.joints)
    with Reader(path) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
    streams = ("/joint_states", "/tf", "/end_effector", "/target")
    assert counts == {"/robot_description": 1, "/tf_static": 1, **dict.fromkeys(streams, 1701)}
    assert_scene_of_a_run(path, panda, script, tmp_path)
    told = bag.provenance
    assert told["fmu"]["guid"] == twodof.load_fmu(panda).guid
    assert told["start_values"]["payload"] == 0.5 and told["start_values"]["Kd[1]"] == 30.0
    assert [time for time, _ in told["input_changes"]] == [0, 0.4]
    np.testing.assert_array_equal(bag.target[1:], np.tile([0.45, 0.2, 0.4], (1700, 1)))
    poses = [m.ros_msg.pose for m in read_ros2_messages(path, topics=["/end_effector"])]
    places = [(p.position.x, p.position.y, p.position.z) for p in poses]
    np.testing.assert_allclose(places, rows[:, 2 * n : 2 * n + 3], rtol=0.0, atol=1e-12)
    assert read_tracks([path])[0].motion is not None
    assert main(["info", str(path)]) == 0
    out = capsys.readouterr().out
    assert "17 s, 1701 joint states, 100 Hz" in out
    assert re.search("^made by +a page in the browser$", out, re.M)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BagError, match="ends in the middle"):
        twodof.read_bag(path)


def assert_scene_of_a_run(path: Path, fmu: Path, script: Script, folder: Path) -> None:
    """Assert that a page's bag has the same scene as a run of the same inputs, stamps apart."""
    settings = {"payload": 0.5, "Kd": 30.0, **script[0]}
    changes = [(0.01 * k, values) for k, values in script.items() if k]
    bag = twodof.Bag(folder / "run", scene=True, effort=True)
    twodof.simulate(fmu, bag, stop_time=17.0, settings=settings, changes=changes)
    (run,) = (folder / "run").glob("*.mcap")
    topics = ["/robot_description", "/tf_static", "/tf", "/end_effector"]
    with Reader(folder / "run") as reader, Reader(path) as other:
        for topic in (*topics, "/joint_states", "/target"):
            theirs, ours = ([c for c in each.connections if c.topic == topic] for each in (reader, other))
            assert [(c.msgtype, c.msgdef, c.ext) for c in ours] == [(c.msgtype, c.msgdef, c.ext) for c in theirs]
    read, expected = ([*read_ros2_messages(each, topics=topics)] for each in (path, run))
    first = read[0].ros_msg, expected[0].ros_msg
    assert first[0].data == first[1].data and ET.fromstring(first[0].data).find(".//mesh") is None
    begin, since = read[0].log_time_ns, expected[0].log_time_ns
    assert [(m.channel.topic, m.log_time_ns - begin) for m in read] == [
        (m.channel.topic, m.log_time_ns - since) for m in expected
    ]
    for message, wanted in zip(read, expected):
        if message.channel.topic.startswith("/tf"):
            own, right = message.ros_msg.transforms, wanted.ros_msg.transforms
            assert [*map(frames, own)] == [*map(frames, right)]
            assert {stamped(each) for each in own} <= {message.log_time_ns}
            np.testing.assert_allclose([*map(pose, own)], [*map(pose, right)], rtol=0.0, atol=1e-9)


def frames(transform: Any) -> tuple[str, str]:
    return transform.header.frame_id, transform.child_frame_id


def stamped(message: Any) -> int:
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def pose(transform: Any) -> list[float]:
    p, q = transform.transform.translation, transform.transform.rotation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def test_hostile_names_are_shown_as_text(browser, tmp_path) -> None:
    robot = hostile_arm()
    robot.findall("joint")[0].set("name", "1 " + HOSTILE + "j" * (998 - len(HOSTILE)))
    (tmp_path / "hostile.urdf").write_text(ET.tostring(robot, encoding="unicode"))
    frame = robot.findall("link")[-1].get("name")
    options = twodof.FmuOptions(urdf=tmp_path / "hostile.urdf", frame=frame, control="joint", native=True)
    fmu = twodof.build_fmu(tmp_path / "hostile.fmu", options)
    with shown(browser, twodof.page(fmu, tmp_path / "hostile.html")) as page:
        assert_shown_as_text(page, "joint2")


def test_a_value_that_an_fmu_refuses_is_reported_and_changes_nothing(page) -> None:
    assert "rtol = 0 must be > 0" in refused(page, "arm.set('rtol', 0)")
    for seed, message in ((2**31, "must be in [0, 2147483647]"), (0.5, "seed = 0.5 must be a whole number")):
        assert message in refused(page, "arm.set('seed', a)", seed)
    assert page.evaluate("arm.held('rtol')") == [1e-3]
    for name, value, message in (
        ("nothing", 1, "there is no variable 'nothing'"),
        ("q[1]", 1, "output, cannot be set"),
        ("Kp", [1], "Kp has 2 elements"),
        ("Kp", True, "is not a number"),
    ):
        assert message in refused(page, "arm.set(a, b)", name, value)
    for count in (-1, 0, 1.5, "3"):
        told = refused(page, "arm.step(a)", count)
        assert told == f"step({count}): a number of steps is whole and at least 1"


def test_a_page_without_a_name_replaces_a_page_alone(
    native_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    own = Path(native_path.stem + ".html")
    for written in ([own], [own]):
        assert main(["page", str(native_path)]) == 0
        assert [*Path().iterdir()] == written
    own.write_text("of somebody")
    assert main(["page", str(native_path)]) == 0
    assert own.read_text() == "of somebody"
    assert "arm-scene" in Path(native_path.stem + "-2.html").read_text()


def test_the_policy_allows_its_own_script_alone(arm) -> None:
    text = arm.read_text()
    policy = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)[0]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "://" not in re.sub(r"<script.*?</script>", "", text, flags=re.S)


def test_the_documentation_of_an_fmu_fits_a_phone(browser, native_path, tmp_path) -> None:
    with zipfile.ZipFile(native_path) as archive:
        index = Path(archive.extract("documentation/index.html", tmp_path))
    with browser.new_context(viewport=PHONE, offline=True, is_mobile=True) as opened:
        page = opened.new_page()
        page.goto(index.as_uri())
        assert page.get_by_role("heading", name="Equations").is_visible()
        wide = page.evaluate("[innerWidth, document.documentElement.scrollWidth]")
        assert wide == [PHONE["width"]] * 2


def test_equal_fmus_make_equal_pages(native_path, arm, tmp_path) -> None:
    assert twodof.page(native_path, tmp_path / "again.html").read_bytes() == arm.read_bytes()


@pytest.mark.parametrize("module", sorted((ROOT / "fmu_src/page").glob("*.js")), ids=lambda module: module.stem)
def test_a_module_of_the_page_exports_what_others_import(module) -> None:
    """The bundler reads the first name of an export only; a missing name would show when it is called."""
    for names, path in IMPORT.findall(module.read_text()):
        assert {*names.split(", ")} <= {*EXPORT.findall((module.parent / path).read_text())}


def test_an_fmu_without_a_plant_in_c_is_refused(fmu_path, tmp_path) -> None:
    with pytest.raises(PageError, match="is not a native FMU of twodof"):
        twodof.page(fmu_path, tmp_path / "x.html")
    assert not (tmp_path / "x.html").exists()


def test_an_fmu_of_large_sources_is_refused(native_path, tmp_path) -> None:
    """Zeros of 129 MiB take 0.1 MB in an FMU."""
    fmu = Path(shutil.copy(native_path, tmp_path / "large.fmu"))
    with zipfile.ZipFile(fmu, "a", zipfile.ZIP_DEFLATED) as archive:
        for k in range(129):
            archive.writestr(f"sources/z{k}.h", bytes(2**20))
    with pytest.raises(PageError, match="its C sources have more than 128 MiB together"):
        twodof.page(fmu, tmp_path / "x.html")
    assert not (tmp_path / "x.html").exists()


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (rb'rgba="[^"]*"', b'rgba="1 nan 1 1"', "cannot be shown: link 'link1' cannot be drawn: rgba='1 nan"),
        (rb"\baccepts\b", b"takes", "its C sources are not those of this version of twodof, .*; build it again"),
    ],
)
def test_an_fmu_that_no_page_can_show_is_named(native_path, tmp_path, old, new, reason) -> None:
    fmu = tmp_path / "A.fmu"
    with zipfile.ZipFile(native_path) as archive, zipfile.ZipFile(fmu, "w") as other:
        for name in archive.namelist():
            content = archive.read(name)
            other.writestr(name, content if name.startswith("binaries") else re.sub(old, new, content))
    with pytest.raises(PageError, match=rf"A\.fmu': .*{reason}"):
        twodof.page(fmu, tmp_path / "x.html")


def test_the_scripts_are_typed_and_short() -> None:
    for path in ASSETS.glob("*.js"):
        name, text = path.name, path.read_text()
        late = re.search(r"\(\?<[=!]|\baria[A-Z]", text)  # browsers have it from 2023 on alone
        assert late is None, f"{name}: {late}"
        lines = text.splitlines()
        begin = 0
        for i, line in enumerate(lines):  # functions and methods begin and end at one indent
            if re.match(r"( {2})?(async )?(function\*? )?[\w$]+\(.*\) \{$", line):
                begin, indent = i, len(line) - len(line.lstrip())
            if begin and re.match(rf" {{{indent}}}}}$", line):
                assert i - begin < 60, f"{name}:{begin + 1}"
    done = subprocess.run([needs("tsc"), "-p", str(ROOT / "tests/tsconfig.json")], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_a_script_uses_only_its_declarations_and_imports() -> None:
    command = [needs("eslint"), "-c", "tests/eslint.config.js", "fmu_src/page", "twodof/plots"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
