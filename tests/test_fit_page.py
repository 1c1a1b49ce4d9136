"""The page of a fit in a browser, its progress, and interrupts."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import browser
import numpy as np
import pytest
from motions import bag_of, noisy
from test_fit import ARM, FREE, GRAVITY, JOINTS, arm_motion

import twodof
from twodof.cli.main import main

CURVES = """() => [...document.querySelectorAll("#plots .plot")].map(plot => plot._fullData.map(
    trace => ({meta: trace.meta, x: [...trace.x], y: [...trace.y]})))"""
VERDICT, TABLES = ".verdict", "details table"


@pytest.fixture(scope="module")
def motion() -> Any:
    return arm_motion()


@pytest.fixture(scope="module")
def result(motion: Any, tmp_path_factory: pytest.TempPathFactory) -> twodof.Fit:
    """A fit with a coordinate of the payload's position that a planar arm does not determine."""
    bag = bag_of(tmp_path_factory.mktemp("page") / "monday", JOINTS, *noisy(motion))
    return twodof.fit(ARM, bag, (*FREE, "payload_com"), gravity=GRAVITY)


def test_a_page_has_the_verdict_the_parameters_and_the_curves(result: twodof.Fit, motion: Any, tmp_path: Path) -> None:
    file = result.save(tmp_path / "fitted") / "fit.html"
    errors: list[str] = []
    with browser.chromium() as chromium:
        for scheme, width in (("light", 1400), ("dark", 390)):
            with chromium.new_context(color_scheme=scheme, offline=True) as context:  # type: ignore[arg-type]
                page = context.new_page()
                page.on("pageerror", lambda error: errors.append(str(error)))
                page.set_viewport_size({"width": width, "height": 844})
                page.goto(file.as_uri())
                page.wait_for_selector("#plots[data-ready]", timeout=1e3 * browser.TIMEOUT)
                verdict = page.locator(VERDICT)
                told = verdict.inner_text()
                box = verdict.bounding_box()
                assert box is not None and box["y"] + box["height"] < 844
                assert page.evaluate("document.documentElement.scrollWidth") == width and not errors
                ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
                assert (ground == "rgb(20, 20, 20)") == (scheme == "dark")
                tables = [each.inner_text() for each in page.locator(TABLES).all()]
                figures = page.evaluate(CURVES)
                key, plots = page.get_by_text("Thin: measured; thick: model").bounding_box(), page.locator("#plots")
                assert key is not None and key["y"] < plots.bounding_box()["y"]  # type: ignore[index]
    assert told.startswith("The model explains these data") and "do not determine payload_com[3]\n" in told
    known = [row for row in result.rows if row[3] != "not determined"]
    assert [row.split("\t") for row in tables[0].splitlines()] == [[*row] for row in known]
    assert len(known) == len(result.rows) - 1 and "payload_com[3]\t0\t" in tables[1]

    q, _, clean = motion
    t = 0.01 * np.arange(len(q))
    curves = {tuple(curve["meta"]): curve for figure in figures for curve in figure}
    for i, joint in enumerate(JOINTS):
        for which, kind, truth in ((0, "tau", clean), (2, "tau", clean), (0, "q", q)):
            x, y = (np.array(curves[which, joint, kind][axis], dtype=float) for axis in "xy")
            seen = np.isfinite(x) & np.isfinite(y)
            off = y[seen] - np.interp(x[seen], t, truth[:, i])
            size = {"q": 2e-4, "tau": 0.03 * np.sqrt(np.mean(clean[:, i] ** 2))}[kind]
            assert seen.sum() > 500 and np.sqrt(np.mean(off**2)) < size, (joint, which, kind)
        x = np.array(curves[2, joint, "q"]["x"], dtype=float)
        assert np.nanmin(x) == pytest.approx(0.8 * t[-1], abs=0.02)  # only the held-out fifth
        measured, after, rest = (
            np.array(curves[key]["y"], dtype=float)
            for key in ((0, joint, "tau"), (2, joint, "tau"), (2, joint, "residual"))
        )
        np.testing.assert_allclose(rest, measured - after, atol=1e-12)


@pytest.mark.parametrize(
    ("after", "deviation", "row"),
    [
        (0.149999726, 1.4e-6, ("0.1499997", "0.1499970 … 0.1500025")),
        (1.742e-12, 2e-5, ("0.000000", "0.000000 … 0.000039")),
        (2.0, 0.0104, ("2.000", "1.980 … 2.020")),
        (1234.5, 210.0, ("1234", "822.9 … 1646")),
    ],
)
def test_values_have_the_digits_that_their_intervals_have(
    after: float, deviation: float, row: tuple[str, str], result: twodof.Fit
) -> None:
    low, high = max(0.0, after - 1.96 * deviation), after + 1.96 * deviation
    own = result.parameters[0]._replace(after=after, deviation=deviation, low=low, high=high)
    assert replace(result, parameters=(own,)).rows[1][2:4] == row


def test_the_verdict_on_a_hidden_spring_names_the_joint(tmp_path: Path) -> None:
    q, effort = noisy(arm_motion(stiffness=[0.0, 0.1]))
    page = twodof.fit(ARM, bag_of(tmp_path / "bag", JOINTS, q, effort), FREE, gravity=GRAVITY).page().decode()
    verdict = page.partition('<p class="verdict"><b>')[2]
    assert verdict.startswith("The model does not explain these data, worst at joint &#x27;joint2&#x27;")
    assert page.count(" % of the effort, not noise</td>") == 1


def test_names_are_text_on_the_page(result: twodof.Fit, tmp_path: Path) -> None:
    hostile = browser.HOSTILE
    named = [parameter._replace(name=hostile) for parameter in result.parameters]
    other = replace(result, urdf=hostile, bags=(hostile,), joints=(hostile, "b"), parameters=(*named,))
    other.save(tmp_path / "fitted")
    with browser.chromium() as chromium:
        page = chromium.new_page()
        page.goto((tmp_path / "fitted" / "fit.html").as_uri())
        page.wait_for_selector("#plots[data-ready]", timeout=1e3 * browser.TIMEOUT)
        assert page.title() == f"Fit of {hostile}"
        assert page.locator("iframe, img, a[href^=javascript]").count() == 0


def test_without_plotly_the_folder_has_no_page_and_the_command_reports_it(
    result: twodof.Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    (bag,) = result.bags
    assert main(["fit", str(ARM), bag, "--free", "payload", "-o", str(tmp_path / "fitted")]) == 0
    assert {file.name for file in (tmp_path / "fitted").iterdir()} == {"robot.urdf", "fit.json"}
    assert "no page: install the extra 'view'" in capsys.readouterr().out


def test_progress_counts_every_step_once(result: twodof.Fit) -> None:
    seen: list[tuple[int, int]] = []
    twodof.fit(ARM, result.bags, "payload", gravity=GRAVITY, progress=lambda *step: seen.append(step))
    total = seen[-1][1]
    assert total > 5 and seen == [(done, total) for done in range(total + 1)]


INTERRUPTED = """
import os, signal, sys
from pathlib import Path
from twodof.__main__ import main
{imports}
def interrupted(*given, own={place}, **named):
    os.kill(os.getpid(), signal.SIGINT)
    return own(*given, **named)
{place} = interrupted
sys.exit(main())
"""


@pytest.mark.parametrize(
    ("place", "imports"),
    [
        ("estimate._solve", "from twodof.identification import estimate"),
        ("fit_page.html_of", "from twodof.identification import fit_page"),
        ("Path.write_bytes", ""),
    ],
)
def test_an_interrupt_leaves_nothing(place: str, imports: str, result: twodof.Fit, tmp_path: Path) -> None:
    script = INTERRUPTED.format(place=place, imports=imports)
    command = [sys.executable, "-c", script, "fit", str(ARM), *result.bags, "--free", "payload", "-o", "fitted"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "twodof: error: interrupted\n" and not [*tmp_path.iterdir()]
