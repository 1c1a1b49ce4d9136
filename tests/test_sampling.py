"""A sampled controller: closed forms, time events that no communication step moves, sensors and their noise."""

import numpy as np
import pytest
import scipy.linalg

from twodof.plant.plant import Plant
from twodof.plant.robot import load_robot
from twodof.plant.variables import variable_table

SLIDER = """<robot name="slider">
  <link name="rail"/>
  <link name="cart"><inertial><mass value="2.5"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit lower="-100" upper="100" effort="1000" velocity="100"/></joint>
</robot>"""
EXACT = dict(rtol=1e-10, atol=1e-12)


def slider(control="joint", **values):
    robot = load_robot(SLIDER, "cart", "x")
    starts = {"q_start": (0.3,), "v_start": (-0.2,), "gravity": (0.0, 0.0, 0.0)}
    plant = Plant(robot, variable_table(robot, starts, control), control)
    for name, value in {**EXACT, **values}.items():
        setattr(plant, name, value)
    plant.initialise()
    return plant


def closed_form(T, D, Kp, Kd, samples, target=0.0):
    """q and v of a double integrator at t_k, its acceleration held from t_k + D to t_(k+1) + D."""
    whole, part = divmod(D, T)
    whole, part = (whole + 1, 0.0) if T - part < 1e-9 * T else (whole, part)
    y, commands, states = np.array([0.3, -0.2]), [0.0] * (int(whole) + 1), []

    def moved(y, a, h):
        A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, a], [0.0, 0.0, 0.0]])
        return (scipy.linalg.expm(A * h) @ [*y, 1.0])[:2]

    for _ in range(samples):
        states.append(y)
        commands.append(Kp * (target - y[0]) - Kd * y[1])
        before, after = commands[-2 - int(whole)], commands[-1 - int(whole)]
        y = moved(moved(y, before, part), after, T - part)
    return np.array(states)


@pytest.mark.parametrize("delay", [0.0, 0.002, 0.003, 0.01, 0.1])
def test_a_sampled_joint_follows_its_discrete_time_closed_form(delay):
    T, Kp, Kd = 0.01, 60.0, 9.0
    plant = slider(control_period=T, control_delay=delay, Kp=[Kp], Kd=[Kd], q_des=[0.0])
    expected = closed_form(T, delay, Kp, Kd, 200)
    for q, v in expected:
        assert abs(plant.q[0] - q) <= 1e-10 * max(1.0, np.abs(expected).max())
        assert abs(plant.v[0] - v) <= 1e-10 * max(1.0, np.abs(expected).max())
        plant.step(T)
