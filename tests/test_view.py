"""The replay of a bag in a browser, compared with the bag in MCAP's own reader."""

import json
import logging
import os
import re
import shutil
import socket
import time as clock
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import browser
import numpy as np
import oracles
import pytest
from browser import (
    LINKS,
    answer,
    area,
    at_rest,
    chromium,
    colours,
    direction,
    numbers,
    opened,
    picture,
    pixels,
    press,
    rows,
    served,
    until,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from playwright.sync_api import Page

import twodof
from twodof.cli.main import main
from twodof.files import data_file

CHANGE = 2.0  # s
TARGETS = ((0.2, 0.05), (0.1, 0.2))


@pytest.fixture(scope="module")
def shown():
    with chromium() as program:
        yield program


@pytest.fixture(scope="module")
def folder(native_path, tmp_path_factory):
    """A folder with an FMU and the bag of a run whose target changes."""
    folder = tmp_path_factory.mktemp("view")
    fmu = folder / native_path.name
    fmu.write_bytes(native_path.read_bytes())
    inputs = folder / "inputs.csv"
    inputs.write_text("time,x_des[1],x_des[2]\n0,0.2,0.05\n2,0.1,0.2\n")
    run = twodof.experiment(fmu, stop_time=4, input_file=inputs)
    twodof.simulate(run, twodof.Bag(folder / "bag"))
    return folder


@pytest.fixture(scope="module")
def command(folder):
    with served("view", "bag", cwd=folder) as command:
        yield command


@pytest.fixture(scope="module")
def page(shown, command):
    with opened(shown, command.url) as page:
        yield page


@pytest.fixture(scope="module")
def truth(folder):
    """Time and joint positions of each sample, by another reader."""
    with (folder / "bag/bag.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = [
            (message.log_time, *state.position)
            for _, _, message, state in reader.iter_decoded_messages(topics=["/joint_states"])
        ]
    table = np.array(found, dtype=object)
    return np.column_stack([(table[:, 0] - table[0, 0]) / 1e9, table[:, 1:]]).astype(float)


def pause(page: Page) -> None:
    """Press the button if it exists; search and press are one call, because the replay may end between."""
    page.evaluate(
        "() => [...document.querySelectorAll('button')]"
        ".find((button) => button.textContent.trim() === 'Pause')?.click()"
    )
    at_rest(page)


def scrub(page: Page, time: float) -> dict[str, str]:
    """Return the page's text after moving its slider."""
    page.get_by_label("time, s").evaluate(
        "(slider, t) => { slider.value = t; slider.dispatchEvent(new Event('input')); }", f"{time}"
    )
    return until(page, lambda found: found["time"] == f"{time:.3f} s")


def test_page_plays_and_scrubbing_lands_on_the_right_sample(page, truth):
    until(page, lambda found: numbers(found["time"])[0] > 0.0)
    pictures = []
    for time in (1.23, 0.05, 3.99):
        found = scrub(page, time)
        k = round(time / 0.01)
        q = truth[k, 1:]
        assert truth[k, 0] == pytest.approx(time, abs=1e-9)
        assert found["sample"] == f"{k} of 400"
        assert numbers(found["joint1"] + " " + found["joint2"]) == pytest.approx(q, abs=6e-5)
        place = numbers(found["end effector"])
        assert place == pytest.approx([*oracles.position(q), 0.0], abs=6e-5)
        target = TARGETS[time > CHANGE]
        assert numbers(found["target"])[:2] == pytest.approx(target)
        error = np.linalg.norm(oracles.position(q) - target)
        assert numbers(found["error"])[0] == pytest.approx(error, rel=1e-3)
        pictures.append(picture(page))
    assert all(colours(shot) > 100 for shot in pictures)
    assert (pictures[0] != pictures[1]).any() and (pictures[1] != pictures[2]).any()
    scrub(page, 0.5)
    press(page, "Play")
    until(page, lambda found: numbers(found["time"])[0] > 0.8)
    slider = page.get_by_label("time, s")
    slider.press("Home")
    held = until(page, lambda found: found["time"] == "0.000 s")
    assert at_rest(page) == held  # scrubbing has stopped the replay
    assert float(slider.input_value()) == 0.0
    slider.press(" ")  # plays, wherever the focus is
    until(page, lambda found: numbers(found["time"])[0] > 0.4)
    page.keyboard.press(" ")
    paused = pytest.approx(numbers(at_rest(page)["time"])[0], abs=0.006)
    assert float(slider.input_value()) == paused
    press(page, "Step")
    assert until(page, lambda found: numbers(found["time"])[0] == pytest.approx(paused.expected + 0.01))


def test_the_end_is_the_end_or_the_beginning(page):
    scrub(page, 3.8)
    press(page, "Play")
    until(page, lambda found: found["sample"] == "400 of 400")
    page.get_by_role("button", name="Play").wait_for()
    page.get_by_label("speed").select_option("0.25")  # or a busy machine might not see the start
    press(page, "Play")  # from the start
    until(page, lambda found: 0.0 < numbers(found["time"])[0] < 3.0)
    page.get_by_label("speed").select_option("1")
    page.get_by_label("loop").check()
    scrub(page, 3.8)
    press(page, "Play")
    until(page, lambda found: 0.2 < numbers(found["time"])[0] < 3.0)
    page.get_by_role("button", name="Pause").wait_for()
    page.get_by_label("loop").uncheck()


def test_the_view_is_brought_back(page):
    scrub(page, 1.0)
    page.locator("#arm-scene").focus()
    page.keyboard.press("Home")
    before = picture(page).astype(int)

    def change(shot: np.ndarray) -> float:
        return float(np.abs(shot - before).mean())

    page.locator("#arm-scene").hover()
    page.mouse.wheel(0, -400)
    zoomed = change(until(page, lambda shot: change(shot) > 1.0, picture))
    page.keyboard.press("Home")
    # A page whose frames have become slow smooths edges no more: the view is the same, some pixels are not.
    until(page, lambda shot: change(shot) < 0.1 * zoomed, picture)


def test_speed_is_that_of_the_wall_clock(page, speed=0.25):
    """It is distinguished from half and twice that speed, once a busy machine shows the page in time."""
    page.get_by_label("speed").select_option(f"{speed:g}")
    shown: list[float] = []
    while not shown or not 0.7 < shown[-1] < 1.4:
        assert len(shown) < 10, shown
        shown.append(slope(page) / speed)
    page.get_by_label("speed").select_option("1")


def slope(page: Page) -> float:
    """Return the speed of time on the page, s per s."""
    scrub(page, 0.5)
    press(page, "Play")
    until(page, lambda found: numbers(found["time"])[0] > 0.5)
    seen: list[tuple[float, ...]] = []
    while not seen or seen[-1][0] < seen[0][0] + 1.0:
        page.wait_for_timeout(30)
        seen.append((clock.monotonic(), *numbers(rows(page)["time"])))
    pause(page)
    passed, told = np.transpose(seen)
    return float(np.polyfit(passed, told, 1)[0])


def test_curves_are_the_bag_with_a_mark_at_the_time(page, truth):
    np.testing.assert_array_equal(browser.samples(page)[:, :3], truth)
    marks = []
    for time in (0.6, 1.7, 3.4):  # where no line of the grid is
        scrub(page, time)
        at_rest(page)
        mark, width = page.get_by_label("position, rad").evaluate(MARK)
        marks.append(mark)
    assert np.diff(marks) == pytest.approx(np.diff([0.6, 1.7, 3.4]) * width / 4, abs=1.0)
    assert width > 200


MARK = """(canvas) => {
    const context = canvas.getContext("2d"), {width, height} = canvas, dark = [];
    const {data} = context.getImageData(0, 0, width, height);
    for (let x = 0; x < width; x++) {
        let count = 0;
        for (let y = 0; y < height; y++) {
            const [r, g, b, a] = data.subarray(4 * (y * width + x), 4 * (y * width + x) + 4);
            count += Number(a > 60 && r < 60 && g < 60 && b < 70);
        }
        if (count > 0.6 * height) dark.push(x);
    }
    return [dark.reduce((sum, x) => sum + x, 0) / dark.length, width - 58 - 8];
}"""
"""Places of a dark line in a canvas that goes from top to bottom, and the width of its axes, pixels."""


@given(st.lists(st.floats(-1, 5), min_size=1, max_size=50))
@settings(max_examples=20, deadline=None)
def test_nearest_is_nearest(page, truth, times):
    nearest = page.evaluate("(times) => times.map((t) => arm.nearest(t))", times)
    least = np.abs(truth[:, [0]] - times).min(axis=0)
    assert np.abs(truth[nearest, 0] - times) == pytest.approx(least, abs=1e-12)


def test_twenty_visits_leak_nothing(command, page):
    """Threads and memory equal those after the first visits."""
    for i in range(25):
        assert answer(command.url, ("Host", "localhost")) == 200
        if i == 4:
            threads, memory = command.status("Threads"), command.status("VmRSS")
    assert command.status("Threads") <= threads + 2
    assert command.status("VmRSS") <= memory + 10_000  # KiB


def test_exported_file_replays_offline(shown, folder, truth, run_view):
    """Each picture shows the arm at its time in the bag; the file is the whole page."""
    done = run_view("bag", "--export", "replay.html", cwd=folder)
    assert (done.returncode, done.stderr) == (0, "")
    file = folder / "replay.html"
    with shown.new_context(viewport={"width": 450, "height": 640}, offline=True) as context:
        context.set_default_timeout(1e3 * browser.TIMEOUT)
        page = context.new_page()
        said: list[str] = []
        page.on("request", lambda request: said.append(request.url))
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("console", lambda message: said.append(message.text))
        page.goto(file.as_uri())
        page.wait_for_selector(browser.READY)
        until(page, lambda found: numbers(found["time"])[0] > 0.2)  # plays by itself
        system, middles = [], []
        for time in (0.1, 0.3, 2.15, 2.4):  # the target's marker is before neither link
            found = scrub(page, time)
            q = truth[round(time / 0.01), 1:]
            assert numbers(found["joint1"] + " " + found["joint2"]) == pytest.approx(q, abs=6e-5)
            links = [area(picture(page), colour) for colour in LINKS]
            along = np.cumsum(q)
            seen = [direction(link) for link in links]
            assert np.sin(seen - along) == pytest.approx(0.0, abs=0.015)
            for k, lengths in enumerate((np.cos(along), -np.sin(along))):  # y is downwards
                system.append([k == 0, k == 1, *lengths])
                middles.append(links[1][:, k].mean())
        assert_on_one_arm(np.array(system, float), np.array(middles))
        assert page.title() == "2dof - bag - twodof"
        assert said == [file.as_uri()]
    text = file.read_text()
    policy = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)[0]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules.pop("default-src") == "'none'"
    assert re.fullmatch(r"'sha256-[\w+/=]+'", rules.pop("script-src"))
    assert rules == {"style-src": "'unsafe-inline'", "img-src": "data:"}
    assert "://" not in re.sub(r"<script.*?</script>", "", text, flags=re.S)
    assert file.stat().st_size < 1e6


def assert_on_one_arm(system: np.ndarray, middles: np.ndarray) -> None:
    """Assert that the middle of the second link is where the first one leads, and not its mirror image.

    Position and scale of the root in the picture, and the position of the middle on the link, are constant and fitted.
    """
    fitted, *_ = np.linalg.lstsq(system, middles, rcond=None)
    assert min(fitted[2:]) > 0.0 and np.abs(system @ fitted - middles).max() < 1.5  # pixels


def test_a_third_party_bag_is_drawn_as_far_as_it_is_known(shown, folder, tmp_path):
    bag = tmp_path / "foreign"
    bag.mkdir()
    for file in (folder / "bag").iterdir():
        if file.name != "run.json":
            (bag / file.name).write_bytes(file.read_bytes())
    with served("view", "foreign", cwd=tmp_path) as command, opened(shown, command.url) as page:
        assert set(rows(page)) == {"time", "sample", "joint1", "joint2"}
        status, _, errors = command.interrupt()
    assert status == 0
    assert errors == "WARNING: 'foreign' contains no robot; give one with --urdf\n"


class Done(NamedTuple):
    """The end of a command, and its output."""

    returncode: int
    stdout: str
    stderr: str


View = Callable[..., Done]


@pytest.fixture
def run_view(monkeypatch, capsys):
    """Run ``twodof view`` in a folder."""

    def run(*arguments: str | Path, cwd: Path) -> Done:
        monkeypatch.chdir(cwd)
        monkeypatch.setattr(logging.root, "handlers", [])  # as in a process of its own
        capsys.readouterr()
        return Done(main(["view", *map(str, arguments), "--no-browser"]), *capsys.readouterr())

    return run


@pytest.fixture(scope="module")
def painted(folder):
    """A folder with the bag of a robot whose magenta meshes are elsewhere."""
    root = Path(__file__).parents[1]
    shutil.copytree(root / "meshes", folder / "packages/painted")
    urdf = (root / "urdf/2dof.urdf").read_text().replace("package://meshes/", "package://painted/")
    urdf = urdf.replace("0.95 0.49 0.09 1", "1 0 1 1")
    (folder / "painted.urdf").write_text(urdf)
    options = twodof.FmuOptions(urdf=folder / "painted.urdf", mesh_dir=folder / "packages")
    (folder / "made").mkdir()
    run = twodof.experiment(twodof.build_fmu(folder / "made/painted.fmu", options), stop_time=0.1)
    bag = folder / "elsewhere/bag"
    bag.parent.mkdir()
    twodof.simulate(run, twodof.Bag(bag))
    return bag.parent


@pytest.mark.parametrize(
    "options", [["--fmu", "made/painted.fmu"], ["--urdf", "painted.urdf", "--mesh-dir", "packages"]]
)
def test_meshes_are_found_by_their_options(shown, folder, painted, run_view, options):
    done = run_view(painted / "bag", *options, "--export", "painted.html", cwd=folder)
    assert (done.returncode, done.stderr) == (0, "")
    with opened(shown, (folder / "painted.html").as_uri()) as page:
        assert len(pixels(picture(page), magenta)) > 3000


def magenta(r: np.ndarray, g: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (r > 150) & (g < 60) & (b > 150)


def test_without_its_meshes_a_robot_is_drawn_as_sticks(painted, run_view):
    done = run_view("bag", "--export", "sticks.html", cwd=painted)
    assert done.returncode == 0
    assert re.fullmatch(
        "WARNING: without the meshes meshes/link1.stl, .*; give them with --fmu or --urdf\n", done.stderr
    )
    shutil.copy(data_file("urdf", "2dof.urdf"), painted / "far.urdf")
    far = "--urdf", "far.urdf", "--mesh-dir", "bag", "--export", "far.html"
    done = run_view("bag", *far, cwd=painted)
    assert done.returncode == 0
    assert re.fullmatch(
        "WARNING: meshes are left out, .* with --mesh-dir: package://meshes/link1.stl, .*\n", done.stderr
    )


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """A bag with hostile texts only."""
    folder, robot = tmp_path_factory.mktemp("hostile"), browser.hostile_arm()
    (folder / "arm.urdf").write_bytes(ET.tostring(robot))
    frame = browser.HOSTILE + "EndEffector"
    options = twodof.FmuOptions(urdf=folder / "arm.urdf", frame=frame, axes="xy")
    run = twodof.experiment(twodof.build_fmu(folder / "Arm.fmu", options), stop_time=0.1)
    bag = folder / browser.HOSTILE.replace("/", "")
    twodof.simulate(run, twodof.Bag(bag))
    made = json.loads((bag / "run.json").read_text())
    for sphere in robot.iter("sphere"):
        sphere.tag = "mesh"
        sphere.set("filename", f"package://meshes/{browser.HOSTILE}mesh")
    made["urdf"] = ET.tostring(robot, encoding="unicode")
    made["fmu"] = dict.fromkeys(made["fmu"], browser.HOSTILE)
    made |= dict.fromkeys(("robot", "root", "command_line"), browser.HOSTILE)
    (bag / "run.json").write_text(json.dumps(made))
    return bag


def test_text_of_a_bag_is_text(shown, hostile, run_view):
    done = run_view(hostile.name, "--export", "hostile.html", cwd=hostile.parent)
    assert done.returncode == 0
    with opened(shown, (hostile.parent / "hostile.html").as_uri()) as page:
        browser.assert_shown_as_text(page, "joint1", "joint2", "mesh")
        assert page.title() == f"{browser.HOSTILE}2dof - {hostile.name} - twodof"


def test_bag_whose_name_is_no_text_is_shown(folder, tmp_path, run_view):
    name = os.fsdecode(b"bag\xff")
    shutil.copytree(folder / "bag", tmp_path / name)
    assert run_view(name, "--export", "bag.html", cwd=tmp_path).returncode == 0
    assert "bag\\xff - twodof</title>" in (tmp_path / "bag.html").read_text("utf-8")


@pytest.mark.parametrize(
    "shape",
    [
        '<geometry><sphere radius="wide"/></geometry>',
        '<geometry><sphere radius=""/></geometry>',
        '<geometry><cylinder radius="1" length="nan"/></geometry>',
        '<geometry><box size="1 1 inf"/></geometry>',
        '<geometry><box/></geometry><material name="red"><color rgba="1 nan 1 1"/></material>',
        '<geometry><box size="1 1 x"/></geometry>',
        '<geometry><mesh filename="package://meshes/link1.stl" scale="a"/></geometry>',
        '<geometry><box/></geometry><origin rpy="0"/>',
        '<geometry><box/></geometry><material name="red"><color rgba="1"/></material>',
    ],
)
def test_shape_without_numbers_gets_one_line(shape, folder, tmp_path, run_view):
    shutil.copytree(folder / "bag", tmp_path / "bag")
    made = json.loads((tmp_path / "bag/run.json").read_text())
    made["urdf"] = made["urdf"].replace("<visual>", f"<visual>{shape}</visual><visual>", 1)
    (tmp_path / "bag/run.json").write_text(json.dumps(made))
    done = run_view("bag", "--export", "bag.html", cwd=tmp_path)
    assert done.returncode == 1
    assert re.fullmatch(r"twodof: error: [^\n]*link 'link1'[^\n]+\n", done.stderr)


def test_port_in_use(folder, run_view):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        done = run_view("bag", "--port", f"{port}", cwd=folder)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1
    assert f"port {port} of 127.0.0.1 is in use" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere"], "'nowhere'"),
        (["bag", "--urdf", "other.urdf"], "no joint 'shoulder'"),
        (["bag", "--fmu", "none.fmu"], "no FMU 'none.fmu'"),
        (["bag", "--mesh-dir", "."], "give that with --urdf"),
        (["bag", "--urdf", "other.urdf", "--fmu", "none.fmu"], "leave it out with --urdf"),
        (["bag", "--host", "192.0.2.1"], "cannot listen on 192.0.2.1"),
        (["bag", "--host", "a" * 64], f"cannot listen on {'a' * 64}:0: "),
        (["bag", "--host", ""], "--host is empty; 0.0.0.0 is all addresses of this machine"),
        (["bag", "--export", "no/where.html"], "cannot write 'no/where.html'"),
    ],
)
def test_bad_input_gets_one_line(arguments, said, folder, run_view):
    urdf = (Path(__file__).parents[1] / "urdf/2dof.urdf").read_text()
    (folder / "other.urdf").write_text(urdf.replace('"joint1"', '"shoulder"'))
    port = () if "--export" in arguments else ("--port", "0")
    done = run_view(*arguments, *port, cwd=folder)
    assert (done.returncode, done.stdout) == (1, "")
    assert re.fullmatch(r"twodof: error: [^\n]+\n", done.stderr)
    assert said in done.stderr
