"""The loop of a live page, without the page: requests, updates, and ends of a recording."""

import sys
from pathlib import Path
from threading import Event, Thread

import numpy as np
import pytest
from bags import assert_consistent, read_with_mcap
from harness import wait_until

import twodof
from twodof.errors import InputError
from twodof.pages.loop import Loop
from twodof.simulation.experiments import experiment


def loop_of(fmu: Path) -> Loop:
    return Loop(experiment(fmu, stop_time=np.inf))


def test_the_end_does_not_wait_for_orders(native_path):
    """Some of the requests take long."""
    loop, asked = loop_of(native_path), iter([False, True])
    for _ in range(5):
        loop.tell("reset")
    loop.play(lambda: next(asked, True))
    assert loop.news()["run"] < 5


@pytest.mark.parametrize("everything", [False, True])
def test_orders_are_carried_out_in_turn(native_path, everything):
    """Values set before a step apply to it, and values set after a reset are not reset."""
    loop = loop_of(native_path)
    for order, value in (
        ("change", {"x_des[1]": 0.11}),
        ("step", None),
        ("change", {"x_des[1]": 0.12}),
        ("step", None),
        ("reset", everything),
        ("change", {"x_des[2]": 0.07}),
        ("step", None),
    ):
        loop.tell(order, value)
    loop.play(lambda: loop.news()["run"] > 1 and loop.news()["t"] == 0.01)
    news = loop.news()
    target = [0.2 if everything else 0.12, 0.07]
    assert [news["values"][f"x_des[{i}]"] for i in (1, 2)] == target
    assert news["rows"][-1][-2:] == target


def test_a_run_without_samples_gives_no_updates(native_path):
    """A page requests updates all the time."""
    loop, ended, counts = loop_of(native_path), Event(), set()

    def ask() -> None:
        while not ended.is_set():
            counts.add(len(loop.news()["rows"]))

    asking, interval = Thread(target=ask), sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        asking.start()
        for _ in range(30):
            loop.tell("reset")
            loop.tell("step")  # resets that follow each other are one
        loop.play(lambda: loop.news()["run"] > 30)
    finally:
        sys.setswitchinterval(interval)
        ended.set()
        asking.join()
    assert counts <= {1, 2}


def test_orders_of_one_kind_become_one(native_path):
    """The newest value applies if no other request is between them."""
    loop = loop_of(native_path)
    for k in range(10_000):
        loop.tell("change", {"x_des[1]": k / 1e5, f"Kd[{1 + k % 2}]": float(k)})
        assert not loop.behind
    loop.tell("reset", True)
    for everything in (False, True, False):
        loop.tell("reset", everything)
    for _ in range(3):
        loop.tell("step")
    loop.play(lambda: loop.news()["t"] == 0.03)
    assert loop.news()["run"] == 2
    assert loop.news()["values"]["x_des[1]"] == 0.2


def test_orders_of_several_kinds_are_all_done(native_path):
    """Further requests have to wait."""
    loop = loop_of(native_path)
    for k in range(100):
        loop.tell("change" if k % 2 else "step", {"x_des[1]": k / 1e3} if k % 2 else None)
    assert loop.behind
    loop.play(lambda: not loop._orders)
    assert (loop.news()["t"], loop.news()["values"]["x_des[1]"]) == (0.5, 0.099)


def test_a_parameter_that_is_refused_leaves_inputs_as_they_are(native_path):
    loop, told = loop_of(native_path), [{"payload": 0.3}, {"x_des[1]": 0.11}, None, {"rtol": 0.0}]

    def stop() -> bool:
        if told:
            values = told.pop(0)
            loop.tell("change" if values else "step", values)
        return bool(loop.news()["noted"])

    loop.play(stop)
    news = loop.news()
    assert news["notes"] == ["rtol = 0 must be > 0"] and news["t"] == 0.0
    values = [news["values"][name] for name in ("x_des[1]", "payload", "rtol")]
    assert values == [0.11, 0.3, 1e-3]


def test_full_disk_ends_the_recording_alone(native_path, disk):
    """One note reports it, and a second one that another recording cannot start."""
    bag = disk(8192) / "bag"
    loop, ended = Loop(experiment(native_path, stop_time=np.inf), bag=str(bag)), Event()
    loop.viewers = 1
    playing = Thread(target=loop.play, args=(ended.is_set,))
    playing.start()
    try:
        loop.tell("record", True)
        wait_until(lambda: loop.news()["recorded"] > 20)
        with pytest.raises(OSError, match="No space left"), (bag.parent / "other").open("wb") as other:
            while True:
                other.write(bytes(256))
                other.flush()
        wait_until(lambda: loop.news()["noted"] == 1)
        assert loop.news()["recorded"] == 0
        loop.tell("record", True)
        wait_until(lambda: loop.news()["noted"] == 2)
        steps = loop.steps
        wait_until(lambda: loop.steps > steps + 30)
    finally:
        ended.set()
        playing.join()
    said, again = loop.news()["notes"]
    assert again.startswith("There is no recording")
    assert_consistent(bag, "mcap")
    kept = len(read_with_mcap(bag))
    assert kept == len(twodof.read_bag(bag).t) > 20
    assert said.startswith("The recording has ended")
    assert f"the disk is full; it is closed with its first {kept} samples" in said
    assert not bag.with_name("bag-2").exists()


def test_a_gain_below_0_is_refused_before_it_ends_the_run(native_path):
    loop = loop_of(native_path)
    with pytest.raises(InputError, match=r"Kp\[1\] = -5 is less than 0"):
        loop.tell("change", {"Kp": -5.0})
    assert loop.news()["values"]["Kp[1]"] == 50.0
