"""Downsampling of a long bag for drawing keeps everything that a picture shows."""

from pathlib import Path

import numpy as np
import pytest

import twodof
from twodof.bag.downsampling import extremes
from twodof.bag.reader import read_bag, read_downsampled
from twodof.bag.recording import Array, Recording
from twodof.plots.track import Track, read_tracks

MOST = 2000


@pytest.fixture(scope="module")
def bag(native_path, tmp_path_factory):
    """A run of 20,000 steps whose target, also on a topic, jumps often, once for a single step."""
    folder = tmp_path_factory.mktemp("long")
    table = folder / "targets.csv"
    random = np.random.default_rng(2)
    times = np.sort(np.r_[0.0, random.integers(1, 19_000, 300) / 100, 195.0, 195.01])
    rows = [f"{t},{x},{y}" for t, (x, y) in zip(times, random.uniform(-0.2, 0.2, (len(times), 2)))]
    rows[-2:] = ["195.0,50.0,0.0", "195.01,0.1,0.1"]
    table.write_text("\n".join(['time,"x_des[1]","x_des[2]"', *rows]))
    path = folder / "bag"
    twodof.simulate(
        native_path, twodof.Bag(path, storage="sqlite3", scene=True), stop_time=200.0, step=0.01, input_file=table
    )
    return path


def track_of(bag: Path, most: int) -> Track:
    (track,) = read_tracks([bag], most=most)
    return track


def lines_of(track: Track) -> list[Array]:
    assert track.motion is not None and track.task is not None and track.task.off is not None
    joints = [line for joint in track.joints for line in (joint.q, joint.v)]
    return [*joints, *track.motion.path.T, track.task.error, track.task.off]


def test_every_line_keeps_its_extremes_wherever_it_is_looked_at(bag):
    """This holds in each twentieth of the time, up to the spans at its ends."""
    whole, few = track_of(bag, 10**6), track_of(bag, MOST)
    assert len(whole.t) == whole.recording.count == few.recording.count == 20_001
    assert MOST / 16 < len(few.t) <= MOST / 4
    k = np.searchsorted(whole.t, few.t)
    for every, some in zip(lines_of(whole), lines_of(few), strict=True):
        np.testing.assert_allclose(some, every[k], rtol=0.0, atol=1e-14)
        assert (some.min(), some.max()) == (every.min(), every.max())
        for n in range(4):
            low, high = np.searchsorted(whole.t, (50.0 * n, 50.0 * (n + 1)))
            here = (k >= low) & (k < high)
            assert some[here].max() >= np.sort(every[low:high])[-len(every) // 50]


def test_facts_about_a_long_bag_use_all_its_samples(bag):
    whole, few = track_of(bag, 10**6), track_of(bag, MOST)
    assert whole.task is not None and few.task is not None
    assert few.task.off is not None and whole.task.off is not None
    assert few.task.off.max() == pytest.approx(whole.task.off.max(), rel=1e-9)
    assert few.task.error[-1] == whole.task.error[-1]
    assert few.task.error.max() == whole.task.error.max() > 49.0  # for one step
    assert [j.at_limit for j in few.joints] == [j.at_limit for j in whole.joints]
    assert few.settings == whole.settings


def test_a_target_on_a_topic_is_that_of_its_time(bag, tmp_path):
    """The bag has no provenance; repeated points are dropped."""
    (bag / "run.json").rename(tmp_path / "run.json")
    try:
        whole, few = read_bag(bag), read_downsampled(bag, MOST, lambda part: [*part.target.T])
    finally:
        (tmp_path / "run.json").rename(bag / "run.json")
    assert whole.target.shape == (20_001, 3) and len(few.t) <= MOST / 4
    k = np.searchsorted(whole.stamps, few.stamps)
    np.testing.assert_array_equal(few.target, whole.target[k])
    assert few.target[:, 0].max() == 50.0


def test_a_bag_that_is_not_long_is_read_whole(bag):
    def none(part: Recording) -> list[Array]:
        raise AssertionError

    read = read_downsampled(bag, 20_001, none)
    np.testing.assert_array_equal(read.q, read_bag(bag).q)


def test_extremes_are_those_of_each_part():
    random = np.random.default_rng(0)
    parts = np.sort(random.integers(0, 50, 1000)) * 3
    lines = list(random.normal(size=(3, 1000)))
    lines[1][parts == 3] = np.nan
    lines[2][random.random(1000) < 0.3] = np.nan
    expected = set()
    for part in np.unique(parts):
        (here,) = np.nonzero(parts == part)
        expected |= {here[0], here[-1]}
        for line in lines:
            if not np.isnan(line[here]).all():
                expected |= {here[np.nanargmin(line[here])], here[np.nanargmax(line[here])]}
    np.testing.assert_array_equal(extremes(parts, lines), sorted(expected))
