"""Films of bags, read by FFmpeg and Pillow: the arm is at the position in the bag."""

import sys
from pathlib import Path

import av
import numpy as np
import pytest
from browser import pixels
from PIL import Image

import twodof
from twodof.cli.main import main
from twodof.errors import PlotError
from twodof.plots.film import film

GREY = (91, 101, 112)
STOP, TARGETS = 3.0, ((-0.2, 0.05), (0.1, 0.2))


@pytest.fixture(scope="module")
def bag(native_path, tmp_path_factory):
    bag = tmp_path_factory.mktemp("film") / "bag"
    changes = [(1.0, {"x_des": TARGETS[1]})]
    settings = {"x_des": TARGETS[0], "Kp": 100.0}
    twodof.run(native_path, twodof.Bag(bag), stop_time=STOP, settings=settings, changes=changes)
    return bag


def frames(path: Path) -> list[np.ndarray]:
    """Height × width × 3."""
    if path.suffix == ".mp4":
        with av.open(str(path)) as container:
            return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    with Image.open(path) as image:
        found = []
        for k in range(getattr(image, "n_frames", 1)):
            image.seek(k)
            found.append(np.asarray(image.convert("RGB")))
        return found


def arm_box(picture: np.ndarray) -> np.ndarray:
    """Smallest and largest x and y of the arm's pixels, y upwards."""
    near = lambda *rgb: np.all([abs(a - b) < 25 for a, b in zip(rgb, GREY)], axis=0)  # noqa: E731
    place = pixels(picture[150:], near) * (1, -1)
    return np.array([place.min(axis=0), place.max(axis=0)])


def pose_box(q: np.ndarray) -> np.ndarray:
    """The same of the default arm's joints, m."""
    angles = np.cumsum(q)
    points = np.cumsum([[0.0, 0.0], *(0.15 * np.array([np.cos(a), np.sin(a)]) for a in angles)], axis=0)
    return np.array([points.min(axis=0), points.max(axis=0)])


@pytest.mark.parametrize(("kind", "rate"), [("mp4", 30), ("webp", 30), ("gif", 25)])
def test_a_film_has_the_runs_time_and_the_arm_where_it_was(bag, tmp_path, kind, rate):
    path = tmp_path / f"run.{kind}"
    assert main(["view", str(bag), "--export", str(path)]) == 0
    found = frames(path)
    assert len(found) == round(STOP * rate) + 1
    assert {frame.shape for frame in found} == {(720, 1280, 3)}
    if kind == "mp4":
        with av.open(str(path)) as container:
            assert float(container.duration) / av.time_base == pytest.approx(len(found) / rate, abs=0.5 / rate)
    else:
        with Image.open(path) as image:
            shown = [(image.seek(k), image.load(), image.info["duration"])[-1] for k in range(len(found))]
            assert sum(shown) == pytest.approx(1e3 * len(found) / rate, abs=1e3 / rate)
            assert image.info["loop"] == 0
    recording = twodof.read_bag(bag)
    poses = [np.array([np.interp(k / rate, recording.t, q) for q in recording.q.T]) for k in range(len(found))]
    (W, H), (X, Y) = (np.diff(box(of), axis=0)[0] for box, of in ((arm_box, found[0]), (pose_box, poses[0])))
    scale = (W - H) / (X - Y)  # in which the line's width cancels
    edge = 0.5 * (W - scale * X)
    offset = arm_box(found[0]).mean(axis=0) - scale * pose_box(poses[0]).mean(axis=0)
    assert np.ptp(poses, axis=0).max() > 0.5
    for picture, q in zip(found[::9], poses[::9]):
        expected = offset + scale * pose_box(q) + edge * np.array([[-1, -1], [1, 1]])
        np.testing.assert_allclose(arm_box(picture), expected, atol=8.0)  # pixels of 900 in a metre


def test_a_picture_is_the_end_of_the_run(bag, tmp_path):
    for kind in ("png", "mp4"):
        assert main(["view", str(bag), "--export", str(tmp_path / f"run.{kind}")]) == 0
    (picture,), moving = frames(tmp_path / "run.png"), frames(tmp_path / "run.mp4")
    assert picture.shape == (720, 1280, 3)
    off = [np.abs(picture.astype(int) - frame).mean() for frame in (moving[0], moving[-1])]
    assert off[1] < 0.5 < off[0]


def test_reasons_against_a_film_are_reported(bag, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    for name, more, words in (
        (".png", [], "the name of an export ends in .html, .mp4, .webp, .gif, .png"),
        ("run.avi", [], "the name of an export ends in .html, .mp4, .webp, .gif, .png"),
        ("run.mp4", ["--fmu", "a.fmu"], "a film shows the arm as lines, without meshes; leave out --fmu"),
        ("run.mp4", [], "cannot write"),
    ):
        assert main(["view", str(bag), "--export", str(tmp_path / name), *more]) == 1
        said = capsys.readouterr().err
        assert words in said and said.count("\n") == 1
    assert "install the extra 'video'" in said
    assert not [*tmp_path.iterdir()]


def test_a_film_that_ffmpeg_does_not_end_is_not_written(bag, tmp_path, monkeypatch):
    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", lambda: "/bin/false")
    with pytest.raises(PlotError, match="FFmpeg failed, exit status 1; is there room in"):
        film(bag, tmp_path / "a.gif")
    assert not [*tmp_path.iterdir()]


def test_films_of_centuries_are_refused(bag, tmp_path, monkeypatch):
    monkeypatch.setattr("twodof.plots.film.MAX_FRAMES", 10)
    with pytest.raises(PlotError, match=r"a film has at most 0\.4 s"):
        film(bag, tmp_path / "a.gif")
