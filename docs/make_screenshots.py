"""Make docs/view.png, live.png, panda.png, page.png, fit.png and panda.webp, pictures of the pages.

    python docs/make_screenshots.py

The first is the replay of a real run of the default arm, whose target changes; the second a live arm, whose target
has just been dragged; the third the Panda on its way to a pose, and the fourth in a page of its own. The last one
moves: the Panda in its page follows three targets. The page of a fit has a recording by MuJoCo. Needs chromium and
the packages 'mujoco', 'websockets', 'playwright' and 'example-robot-data'.
"""

from __future__ import annotations

import io
import sys
import tempfile
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import browser  # noqa: E402
from motions import bag_of, noisy  # noqa: E402
from native_models import robots_folder  # noqa: E402
from PIL import Image  # noqa: E402
from playwright.sync_api import Browser, Page  # noqa: E402
from test_fit import ARM, FREE, GRAVITY, JOINTS, arm_motion  # noqa: E402

import twodof  # noqa: E402

SIZE = {"width": 1280, "height": 800}
shown_by = partial(browser.opened, begin=browser.EVEN_FRAMES)  # a slow machine would leave shadows out
FRAMES, FRAME = 72, 0.08  # number; s of one
TARGETS = [[0.5, 0.2, 0.45], [0.35, -0.3, 0.3], [0.55, 0.0, 0.6]]
INPUTS = "time,x_des[1],x_des[2]\n0,0.2,0.05\n2,0.1,0.2\n4,0.22,-0.08\n"


def main() -> None:
    """Make all screenshots."""
    browser.VIEWPORT.update(SIZE)
    with tempfile.TemporaryDirectory() as name, browser.chromium() as chromium:
        folder = Path(name)
        fmu = twodof.build_fmu(folder / "TwoDof-native.fmu", twodof.FmuOptions(native=True))
        (folder / "targets.csv").write_text(INPUTS)
        run = twodof.experiment(fmu, stop_time=6, input_file=folder / "targets.csv")
        twodof.simulate(run, twodof.Bag(folder / "my_bag", effort=True))
        view(chromium, folder)
        live(chromium, folder, fmu)
        panda(chromium, folder)
        page(chromium, folder)
        fit(chromium, folder)
        moving(chromium, folder)


def panda_page(folder: Path) -> str:
    """Return the URL of a Panda's page."""
    options = twodof.FmuOptions(
        urdf=robots_folder() / "panda_description/urdf/panda.urdf",
        mesh_dir=robots_folder().parent,
        frame="panda_hand_tcp",
        control="pose",
        native=True,
        name="Panda",
    )
    fmu = twodof.build_fmu(folder / "Panda.fmu", options)
    return twodof.page(fmu, folder / "panda.html").as_uri()


def moving(chromium: Browser, folder: Path) -> None:
    """Make docs/panda.webp: a Panda in its page follows three targets, in real time."""
    frames = []
    with shown_by(chromium, panda_page(folder)) as shown:
        shown.locator("#arm-play").click()
        shown.evaluate("() => { arm.startAgain(); arm.set('quat_des', [1, 0, 0, 0]); }")
        for target in TARGETS:
            shown.evaluate("target => arm.set('x_des', target)", target)
            for _ in range(FRAMES // len(TARGETS)):
                shown.evaluate("steps => arm.step(steps)", round(FRAME / 0.01))
                draw(shown)
                frames.append(Image.open(io.BytesIO(shown.screenshot())).convert("RGB").resize((720, 450)))
    frames[0].save(
        ROOT / "docs/panda.webp",
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 * FRAME),
        loop=0,
        quality=60,
        method=6,
    )


def page(chromium: Browser, folder: Path) -> None:
    """Make docs/page.png: a Panda in a page of its own."""
    with shown_by(chromium, panda_page(folder), scale=2) as shown:
        shown.locator("#arm-play").click()
        shown.evaluate(
            "() => { arm.startAgain(); arm.set('x_des', [0.5, 0.1, 0.4]);"
            " arm.set('quat_des', [1, 0, 0.3, 0.2]); arm.step(40); }"
        )
        shoot(shown, "page.png")


def fit(chromium: Browser, folder: Path) -> None:
    """Make the picture of the page of a fit to a recording by MuJoCo."""
    bag = bag_of(folder / "monday", JOINTS, *noisy(arm_motion()))
    result = twodof.fit(ARM, bag, (*FREE, "payload_com"), gravity=GRAVITY, output=folder / "fitted")
    assert result.explains
    shown = chromium.new_page(viewport=SIZE)
    shown.goto((folder / "fitted" / "fit.html").as_uri())
    shown.wait_for_selector("#plots[data-ready]")
    shown.locator("table.runs").evaluate("table => table.remove()")  # it has the path of the bag
    picture = Image.open(io.BytesIO(shown.screenshot(full_page=True)))
    picture.quantize(64).save(ROOT / "docs" / "fit.png", optimize=True)
    shown.close()


def view(chromium: Browser, folder: Path) -> None:
    """Make the picture of a replay, 0.6 s after the target has changed."""
    with browser.served("view", "my_bag", cwd=folder) as command, shown_by(chromium, command.url, scale=2) as page:
        page.evaluate("arm.seek(4.6)")
        shoot(page, "view.png")


def live(chromium: Browser, folder: Path, fmu: Path) -> None:
    """Make the picture of the live arm, paused on its way to a target that was moved."""
    with browser.served("live", fmu, cwd=folder) as command, shown_by(chromium, command.url, scale=2) as page:
        page.wait_for_function("() => arm.error() < 0.01")
        page.evaluate("arm.set('x_des', [0.14, 0.19])")
        page.wait_for_function("() => arm.error() > 0.08")
        page.wait_for_function("() => arm.error() < 0.06")
        browser.press(page, "Pause")
        shoot(page, "live.png")


def panda(chromium: Browser, folder: Path) -> None:
    """Make the picture of the scene alone, of the run in docs/tutorial.md after a second."""
    urdf = robots_folder() / "panda_description/urdf/panda.urdf"
    bent = (0.0, -0.6, 0.0, -2.2, 0.0, 1.6, 0.8, 0.03)
    options = twodof.FmuOptions(
        urdf=urdf, mesh_dir=robots_folder().parent, frame="panda_hand_tcp", control="pose", native=True, q_start=bent
    )
    fmu = twodof.build_fmu(folder / "bent.fmu", options)
    goal = {"x_des": (0.45, 0.2, 0.4), "quat_des": (0.9, 0.1, 0.3, 0.2)}
    twodof.simulate(fmu, twodof.Bag(folder / "panda"), stop_time=1, settings=goal)
    with browser.served("view", "panda", cwd=folder) as command, shown_by(chromium, command.url) as page:
        page.evaluate("arm.seek(1)")
        draw(page)
        picture = Image.fromarray(browser.still(page).astype("uint8"))
        picture.save(ROOT / "docs" / "panda.png", optimize=True)


def draw(page: Page) -> None:
    """Wait until a page has drawn its scene and its panel, which takes turns with it."""
    for _ in range(3):
        page.evaluate(browser.DRAWN)


def shoot(page: Page, name: str) -> None:
    """Save a screenshot with smoothed edges."""
    draw(page)
    picture = Image.open(io.BytesIO(page.screenshot()))
    picture.resize((SIZE["width"], SIZE["height"])).save(ROOT / "docs" / name, optimize=True)


if __name__ == "__main__":
    main()
