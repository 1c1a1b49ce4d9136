"""Plots in files, windows and notebooks, their legibility, and the command."""

import itertools
import json
import math
import os
import re
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import oracles
import pytest
from figures import assert_legible, only, panels
from harness import python
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image
from recordings import LINK, chain_urdf, long_run, third_party_bag, waves

import twodof
from twodof.cli.main import main
from twodof.errors import PlotError, TwoDofError
from twodof.plots.figure import Plot, draw_head, file_kind, save
from twodof.plots.panels import with_joints
from twodof.plots.runs import drawing, plot
from twodof.plots.track import read_tracks

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}


# --- what a reader sees ---


def test_long_texts_above_the_panels_are_cut():
    """Their number and length are those in an untrusted bag."""
    figure = Figure()
    draw_head(figure, "title", ["short", *["w " * 30_000] * 1000], (8.0, 4.0))
    (legend,) = figure.subfigs[0].legends
    first, *others = legend.get_title().get_text().splitlines()
    assert first == "short" and 10 < len(others) < 200
    assert others[9].endswith(" …") and max(map(len, others)) < 200
    assert figure.get_figheight() < 40


def test_figures_are_legible(gains, changing, foreign, ur5, tmp_path):
    (tmp_path / "ur5.urdf").write_text(ur5)
    (tmp_path / "chain.urdf").write_text(chain_urdf("zyX" * 5 + "z", 0.1, low=-3.07, high=2.35))
    names = [f"j{i + 1}" for i in range(16)]
    chain = third_party_bag(tmp_path / "chain", names, *waves(16))
    long = [f"left_front_{part}_of_the_gripper_joint" for part in ("upper", "lower", "middle")]
    for figure in (
        plot(*(recording.bag for recording in gains.values())),
        plot(changing.bag, gains[50].bag),
        plot(foreign, urdf=tmp_path / "ur5.urdf"),
        plot(chain, urdf=tmp_path / "chain.urdf"),
        plot(third_party_bag(tmp_path / "long", long, *waves(3))),
        plot(*[foreign] * 9),
        plot(*(third_party_bag(tmp_path / (c * 140), ["a"], *waves(1)) for c in "abc")),
        plot(third_party_bag(tmp_path / ("d" * 200), ["a"], *waves(1))),
    ):
        assert_legible(figure)


def test_names_are_drawn_as_they_are(tmp_path):
    """A dollar sign would begin a formula."""
    bag = third_party_bag(tmp_path / "a$b$_c^", ["$q$", "x_{1}"], *waves(2))
    figure = plot(bag)
    FigureCanvasAgg(figure).draw()
    named = [text for text in figure.findobj(Text) if "$" in text.get_text()]
    assert {text.get_text() for text in named} == {"a$b$_c^", "$q$"}
    assert not any(text.get_parse_math() for text in named)


def test_settings_of_the_user_do_not_change_it(default, tmp_path):
    expected = save(drawing(read_tracks([default.bag])), tmp_path / "a.svg").read_bytes()
    with matplotlib.rc_context({"lines.linewidth": 9.0, "axes.grid": False, "font.size": 30, "svg.fonttype": "none"}):
        found = save(drawing(read_tracks([default.bag])), tmp_path / "b.svg").read_bytes()
        assert matplotlib.rcParams["lines.linewidth"] == 9.0
        figure = plot(default.bag)
        FigureCanvasAgg(figure).draw()  # as windows and notebooks do
    assert found == expected
    assert max(text.get_fontsize() for text in figure.findobj(Text) if text.get_text()) == 11.0


def test_notebooks_show_it(default):
    figure = plot(twodof.read_bag(default.bag))
    assert isinstance(figure, Figure) and isinstance(figure, Plot)
    assert figure._repr_png_().startswith(b"\x89PNG")


@pytest.mark.parametrize("kind", ["png", "html"])
def test_numbers_too_large_for_an_axis_are_gaps(default, tmp_path, kind):
    q = np.linspace([0.0, 0.0], [1.0, 2.0], 100)
    q[40:42, 0] = 1.7e308, -1.7e308
    run = replace(long_run(default, q), provenance={})
    line = only(panels(plot(run)).q[0], "Kp50")
    assert np.isnan(line[40:42, 1]).all() and np.array_equal(
        np.delete(line[:, 1], [40, 41]), np.delete(q[:, 0], [40, 41])
    )
    assert save(drawing(read_tracks([run])), tmp_path / f"large.{kind}").stat().st_size


# --- long bags ---


def test_noise_in_a_long_bag_keeps_its_extremes(default, tmp_path):
    """They are kept in each of 500 pixels of width, and files stay small."""
    n = 120_000
    noise = np.random.default_rng(0).normal(scale=0.01, size=(n, 2))
    noise[41_152] = 0.3, -0.2  # a spike of one sample
    q = np.array([0.5, 0.35]) + noise
    run = long_run(default, q)
    run.v[[777, 778, 50_000], 1] = math.inf, 0.9, math.nan
    tracks = read_tracks([run])
    found = panels(plot(run))
    for axes, values in ((found.q[0], q[:, 0]), (found.v[1], run.v[:, 1])):
        line = only(axes, "Kp50")
        assert len(line) <= 4000
        at = np.rint(line[:, 0] * 1000).astype(int)
        np.testing.assert_array_equal(values[at], line[:, 1])  # nothing is made up
        for part in np.array_split(np.arange(n), 500):
            every = values[part][np.isfinite(values[part])]
            kept = line[(at >= part[0]) & (at <= part[-1]) & np.isfinite(line[:, 1]), 1]
            assert (kept.min(), kept.max()) == (every.min(), every.max())
    path = only(found.views[0], "path")
    exact = oracles.position(q)
    assert len(path) < 10_000
    np.testing.assert_allclose(np.ptp(path, axis=0), np.ptp(exact, axis=0), rtol=1e-12)
    for kind, most in (("svg", 1.5e6), ("png", 1.5e6)):
        assert save(drawing(tracks), tmp_path / f"long.{kind}").stat().st_size < most


def test_a_long_path_keeps_its_corners(default, tmp_path):
    """The path is a square in which the end effector rests long."""
    corners = np.array([(0.1, 0.1), (0.2, 0.1), (0.2, 0.15), (0.1, 0.15), (0.1, 0.1)])
    side = np.linspace(0.0, 1.0, 1250)[:, None]
    legs = [a + (b - a) * side for a, b in itertools.pairwise(corners)]
    rests = [np.repeat(corner[None], 17_000, axis=0) for corner in corners[1:]]
    x = np.concatenate(list(itertools.chain.from_iterable(zip(legs, rests, strict=True))))
    distance = np.hypot(*x.T)
    elbow = np.arccos(distance**2 / (2 * LINK**2) - 1.0)
    q = np.column_stack([np.arctan2(x[:, 1], x[:, 0]) - elbow / 2, elbow])
    run = long_run(default, q)
    path = only(panels(plot(run)).views[0], "path")
    for corner in corners:
        assert np.hypot(*(path - corner).T).min() < 1e-12
    svg = save(drawing(read_tracks([run])), tmp_path / "long.svg")
    assert svg.stat().st_size < 500_000


# --- files ---


def test_each_kind_of_file_opens(gains, tmp_path):
    tracks = read_tracks([recording.bag for recording in gains.values()])
    png, svg, pdf, page = (save(drawing(tracks), tmp_path / f"a.{k}") for k in ("PNG", "svg", "pdf", "html"))
    with Image.open(png) as image:
        image.load()
        assert image.format == "PNG"
        across = plot(gains[50].bag, gains[20].bag).get_size_inches()[0]
        assert image.size[0] == pytest.approx(200 * across, abs=1)
    root = ET.parse(svg).getroot()
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert pdf.read_bytes().startswith(b"%PDF-1.")
    assert pdf.read_bytes().rstrip().endswith(b"%%EOF")
    assert b"/Type3" not in pdf.read_bytes()  # which journals refuse
    text = page.read_text("utf-8")
    assert text.startswith("<!DOCTYPE html>")
    table = ET.fromstring(text[text.index('<table class="runs">') : text.rindex("</body>")])
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in table.findall("tr")}
    assert rows["bag"] == ["Kp20", "Kp50", "Kp400"]
    assert rows["Kp"] == ["20 s⁻²", "50 s⁻²", "400 s⁻²"]
    assert rows["x_des"] == ["(0.2, 0.05) m"] * 3
    assert rows["duration"] == ["1 s, 101 samples", "5 s, 501 samples", "1 s, 101 samples"]
    assert rows["at a limit"] == ["no joint"] * 3
    assert [float(re.sub(r".*reached: (\S+) m .*", r"\1", str(cell))) for cell in rows["verdict"]] == pytest.approx(
        [np.linalg.norm(r.x[-1] - (0.2, 0.05)) for r in gains.values()], rel=2e-3, abs=1e-14
    )


PLOT = """
import sys
from pathlib import Path
from twodof.plots.figure import save
from twodof.plots.runs import drawing
from twodof.plots.track import read_tracks
drawn = drawing(read_tracks([sys.argv[1]]))
for kind in ("png", "svg", "pdf", "html"):
    if kind == "html":
        print({*sys.modules} & {"matplotlib.pyplot", "pandas", "pinocchio", "plotly", "trimesh"})
    save(drawn, f"a.{kind}")
"""


def test_equal_bags_give_equal_files(gains, tmp_path):
    """Processes, hashes and times differ.

    Drawing imports nothing slow.
    """
    environment = {**ENVIRONMENT, "PYTHONHASHSEED": "1", "SOURCE_DATE_EPOCH": "1"}
    done = python("-c", PLOT, gains[20].bag, cwd=tmp_path, check=True, env=environment)
    assert done.stdout == "set()\n"
    drawn = drawing(read_tracks([gains[20].bag]))
    for kind in ("png", "svg", "pdf", "html"):
        here = save(drawn, tmp_path / f"b.{kind}")
        assert (tmp_path / f"a.{kind}").read_bytes() == here.read_bytes()


def test_without_a_name_the_plot_has_that_of_the_bag(gains, tmp_path, monkeypatch):
    """Only a plot of this package is replaced."""
    monkeypatch.chdir(tmp_path)
    tracks = read_tracks([gains[50].bag])
    assert save(drawing(tracks)) == Path("Kp50.png")
    first = Path("Kp50.png").read_bytes()
    Path("Kp50.png").write_bytes(first + b"older")
    assert save(drawing(tracks)) == Path("Kp50.png")
    assert Path("Kp50.png").read_bytes() == first
    Image.new("RGB", (9, 9)).save("Kp50.png")
    theirs = Path("Kp50.png").read_bytes()
    Path("Kp50-2.png").symlink_to("nowhere")
    assert save(drawing(tracks)) == Path("Kp50-3.png")
    assert Path("Kp50.png").read_bytes() == theirs
    assert Path("Kp50-2.png").is_symlink()
    assert save(drawing(read_tracks([gains[50].bag, gains[20].bag]))) == Path("Kp50-and-1-more.png")
    monkeypatch.chdir(gains[50].bag)
    assert read_tracks(["."])[0].name == "Kp50"


def test_a_file_is_written_whole_or_not_at_all(default, tmp_path, monkeypatch):
    (tmp_path / "a.png").write_bytes(b"before")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(PlotError, match=r"cannot write '.*a\.png': No space left on device"):
        save(drawing(read_tracks([default.bag])), tmp_path / "a.png")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    assert (tmp_path / "a.png").read_bytes() == b"before"


# --- windows ---


BACKEND = """
from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg

class Manager(FigureManagerBase):
    @classmethod
    def pyplot_show(cls, *, block=None):
        from matplotlib._pylab_helpers import Gcf
        for manager in Gcf.get_all_fig_managers():
            print("window", len(manager.canvas.figure.axes), "panels")

class FigureCanvas(FigureCanvasAgg):
    required_interactive_framework = {framework!r}
    manager_class = Manager
"""


SHOW = """
import json, os, sys
import matplotlib.cbook
from twodof.plots.figure import show
from twodof.plots.runs import drawing
from twodof.plots.track import read_tracks
drawn = drawing(read_tracks([sys.argv[1]]))
matplotlib.cbook._get_running_interactive_framework = lambda: None  # stands for a display
for environment, backend in json.loads(sys.argv[2]):
    if os.fork() == 0:
        os.environ.update(environment)
        matplotlib.use(f"module://{backend}")
        print(show(drawn), "matplotlib.pyplot" in sys.modules, flush=True)
        os._exit(0)
    os.wait()
"""


def test_a_window_opens_where_there_is_a_display(default, tmp_path):
    """The display is X or Wayland; backends for files, or missing ones, open none."""
    (tmp_path / "windows.py").write_text(BACKEND.format(framework="test"))
    (tmp_path / "files.py").write_text(BACKEND.format(framework=None))
    cases = [
        ({}, "windows", "False False"),
        ({"DISPLAY": ":7"}, "windows", "window 6 panels\nTrue True"),
        ({"WAYLAND_DISPLAY": "w"}, "windows", "window 6 panels\nTrue True"),
        ({"DISPLAY": ":7"}, "files", "False True"),
        ({"DISPLAY": ":7"}, "missing", "False True"),
    ]
    given = [(display, backend) for display, backend, _ in cases]
    environment = {k: v for k, v in ENVIRONMENT.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    environment["PYTHONPATH"] = os.pathsep.join([str(tmp_path), environment["PYTHONPATH"]])
    done = python("-c", SHOW, default.bag, json.dumps(given), env=environment)
    assert done.stdout == "".join(f"{said}\n" for *_, said in cases), done.stderr


# --- what is wrong ---


def test_further_faults_are_named(default, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    drawn = drawing(read_tracks([default.bag]))
    Path("folder.png").mkdir()
    Path("file").touch()
    for output, message in {
        "a.jpg": "'a.jpg': the name of a plot ends in .png, .svg, .pdf or .html",
        "a": "'a': the name of a plot ends in",
        ".png": "'.png': the name of a plot ends in",
        "gone/a.png": "cannot write 'gone/a.png': No such file or directory",
        "file/a.png": "cannot write 'file/a.png': Not a directory",
        "folder.png": "cannot write 'folder.png': Is a directory",
    }.items():
        with pytest.raises(PlotError, match=f"^{re.escape(message)}"):
            save(drawn, output)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.png"]
    with pytest.raises(PlotError, match=r"^there is no URDF 'gone\.urdf'"):
        plot(default.bag, urdf="gone.urdf")
    none = third_party_bag(tmp_path / "bag", ["a"], np.zeros(2), np.zeros((2, 0)), None)
    with pytest.raises(TwoDofError, match=r"'.*bag' has 0 positions for 1 joints"):
        plot(none)
    with pytest.raises(TwoDofError, match="gone"):
        plot("gone")
    assert file_kind("x/y.HTML") == "html"


def test_without_matplotlib_it_names_the_package_to_install():
    code = "import sys; sys.modules['matplotlib'] = None; import twodof.plots.runs"
    done = python("-c", code, env=ENVIRONMENT)
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("twodof.errors.PlotError: cannot plot: ")
    assert "install the extra 'view': " in last


# --- the command ---


def test_joints_are_chosen(default, tmp_path, capsys):
    (track,) = with_joints(read_tracks([default.bag]), ["joint2"])
    assert [joint.name for joint in track.joints] == ["joint2"]
    output = ["-o", str(tmp_path / "a.svg")]
    assert main(["plot", str(default.bag), "--joints", "joint2,elbow", *output]) == 1
    assert "no joint 'elbow'; there are: joint1, joint2" in capsys.readouterr().err
    assert main(["plot", str(default.bag), "--joints", "joint2,joint1", *output]) == 0


def test_the_command_prints_the_path_of_the_plot_and_the_verdict(gains, foreign, ur5, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ur5.urdf").write_text(ur5)
    options = ["--urdf", "ur5.urdf", "--frame", "forearm_link"]
    assert main(["plot", str(foreign), *options, "-o", "a.svg"]) == 0
    plotted, told = capsys.readouterr().out.splitlines()[:2]
    assert re.match(r"plot +a\.svg \(", plotted) and "  no target" in told
    assert main(["plot", str(gains[50].bag)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"plot  Kp50\.png \(\d+ KB\)", printed[0])
    assert re.fullmatch(r"Kp50  reached: 0\.000224 m from the target .*", printed[1])
    assert main(["plot", str(gains[20].bag), str(gains[50].bag), "-o", "both.html"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in printed] == ["plot", "Kp = 20 s⁻²", "Kp = 50 s⁻²"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["Kp50.png", "a.svg", "both.html", "ur5.urdf"]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda file: file.symlink_to("/dev/zero"), "Not a regular file"),
        (os.mkfifo, "Not a regular file"),
        (lambda file: file.write_bytes(b"\xff\xfe"), "it is not UTF-8 text"),
        (lambda file: os.truncate(os.open(file, os.O_CREAT | os.O_RDWR), 2**32), "File too large"),
    ],
)
def test_a_matplotlibrc_in_the_working_directory_that_cannot_be_read_is_refused(default, tmp_path, make, said):
    """Matplotlib would read it while it is imported."""
    make(tmp_path / "matplotlibrc")
    done = python("-m", "twodof", "plot", str(default.bag.absolute()), "-o", "a.png", cwd=tmp_path, env=ENVIRONMENT)
    assert done.returncode == 1
    assert done.stderr.startswith("twodof: error: cannot plot in this folder, move its file 'matplotlibrc': " + said)
