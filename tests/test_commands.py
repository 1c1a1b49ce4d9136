"""Commands of ROS 2 messages, which rosbags serialises."""

import logging
from collections.abc import Callable
from typing import Any

import pytest
from bags import STORE

import twodof
from twodof.bounds import MAX_COMMAND
from twodof.errors import InputError
from twodof.ros.commands import RAMP, CommandError, Commands, Watchdog
from twodof.ros.messages import JOINT_STATE, POINT

Build = Callable[..., twodof.Fmu]


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """The description of the default arm under a control, not compiled."""

    def build(control: str) -> twodof.Fmu:
        path = tmp_path_factory.mktemp(control) / "Arm.fmu"
        return twodof.load_fmu(twodof.build_fmu(path, twodof.FmuOptions(control=control)))

    return build


def joint_state(
    names: tuple[str, ...] = (),
    q: tuple[float, ...] = (),
    v: tuple[float, ...] = (),
    tau: tuple[float, ...] = (),
    stamp: tuple[int, int] = (0, 0),
) -> bytes:
    header = STORE.types["std_msgs/msg/Header"](stamp=STORE.types["builtin_interfaces/msg/Time"](*stamp), frame_id="")
    import numpy as np

    arrays = [np.array(part, float) for part in (q, v, tau)]
    return bytes(STORE.serialize_cdr(STORE.types[JOINT_STATE](header, [*names], *arrays), JOINT_STATE))


def test_joints_are_matched_by_name_in_any_order_and_number(arm):
    joint, effort = Commands(arm("joint")), Commands(arm("effort"))
    both = joint_state(("joint2", "joint1"), (0.2, 0.1), (2.0, 1.0), (20.0, 10.0), (3, 4))
    stamp, inputs, unknown_joints = joint.read(JOINT_STATE, both)
    assert stamp == 3_000_000_004 and unknown_joints == ()
    assert inputs == {"q_des[1]": 0.1, "q_des[2]": 0.2, "v_des[1]": 1.0, "v_des[2]": 2.0}
    assert effort.read(JOINT_STATE, both).inputs == {"tau_cmd[1]": 10.0, "tau_cmd[2]": 20.0}
    some = joint_state(("finger", "joint2"), (0.7, 0.2), (), (7.0, 20.0))
    assert joint.read(JOINT_STATE, some) == (0, {"q_des[2]": 0.2, "v_des[2]": 0.0}, ("finger",))
    assert effort.read(JOINT_STATE, some).inputs == {"tau_cmd[2]": 20.0}


NAMES = ("joint1", "joint2")


@pytest.mark.parametrize(
    ("control", "cdr", "kind", "text"),
    [
        ("joint", joint_state(("elbow",), (0.1,)), "names", "names no joint of this robot: 'elbow'"),
        ("joint", joint_state(), "names", "names no joint of this robot: ''"),
        ("joint", joint_state(NAMES, (0.1,)), "sizes", "has 1 positions for 2 joints"),
        ("joint", joint_state(NAMES, (), (1.0, 1.0)), "sizes", "has 0 positions for 2 joints"),
        ("joint", joint_state(NAMES, (0.1, 0.1), (1.0,)), "sizes", "has 1 velocities for 2"),
        ("effort", joint_state(NAMES, (0.1, 0.2)), "sizes", "has 0 efforts for 2 joints"),
        ("effort", joint_state(NAMES, tau=(0.1, float("nan"))), "finite", "is not finite"),
        ("joint", joint_state(NAMES, (0.1, float("inf"))), "finite", "is not finite"),
        ("joint", b"\0\1\0\0garbage", "bytes", "cannot be read"),
        ("joint", b"", "bytes", "cannot be read"),
        ("joint", bytes(MAX_COMMAND + 1), "bytes", f"it has {MAX_COMMAND + 1} bytes"),
    ],
)
def test_invalid_commands(arm, control, cdr, kind, text):
    with pytest.raises(CommandError, match=text) as caught:
        Commands(arm(control)).read(JOINT_STATE, cdr)
    assert caught.value.kind == kind


def test_each_control_follows_its_own_messages(arm, fmu_path):
    types = {c: Commands(arm(c)).types for c in ("joint", "effort")}
    assert types == {"joint": (JOINT_STATE,), "effort": (JOINT_STATE,)}
    assert Commands(twodof.load_fmu(fmu_path)).types == (POINT,)


def asked_each_tenth(dog: Watchdog, seconds: float) -> list[Any]:
    return [dog.asked(k / 10) for k in range(round(10 * seconds))]


def test_efforts_are_ramped_to_zero(arm, caplog):
    dog = Watchdog(arm("effort"), timeout=0.5)
    assert not any(asked_each_tenth(dog, 5))  # before the first command
    with caplog.at_level(logging.WARNING, "twodof"):
        dog.received(1.0, {"tau_cmd[2]": 8.0})
        assert dog.asked(1.4) == {}
        assert dog.asked(1.5) == {"tau_cmd[2]": 8.0}
        assert dog.asked(1.5 + RAMP / 4) == {"tau_cmd[2]": 6.0}
        assert dog.asked(1.5 + RAMP) == dog.asked(9.0) == {"tau_cmd[2]": 0.0}
        dog.received(9.0, {"tau_cmd[1]": 4.0})
        assert dog.asked(9.1) == {}
        assert dog.asked(20.0) == {"tau_cmd[1]": 0.0, "tau_cmd[2]": 0.0}
    (record,) = caplog.records
    assert "no command for 0.5 s: efforts go to 0" in record.message


def test_targets_are_held_without_their_velocity(arm):
    dog = Watchdog(arm("joint"), timeout=0.5)
    dog.received(1.0, {"q_des[1]": 0.3, "v_des[1]": 2.0})
    assert dog.asked(1.4) == {}
    assert dog.asked(1.6) == dog.asked(9.0) == {"v_des[1]": 0.0}
    held = Watchdog(arm("effort"), timeout=0.5, ramp=False)
    held.received(1.0, {"tau_cmd[1]": 4.0})
    assert held.asked(9.0) == {}
    with pytest.raises(InputError, match="on_timeout` 'ramp' is for control 'effort'"):
        Watchdog(arm("joint"), timeout=0.5, ramp=True)
