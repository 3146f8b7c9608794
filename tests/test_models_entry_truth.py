"""The truth of landing flights: forces in wind against a flight seen from the moving air, servo against its limits, sensors."""

import casadi as ca
import numpy as np
import pytest

import models
import ocp
from models.core import ModelError, evaluate
from models.entry import Planet
from models.entry_cartesian import entry_cartesian, to_cartesian
from models.entry_truth import Servo, entry_onboard, entry_truth
from models.units import DEG, G0, OMEGA_EARTH

VEHICLE = models.from_ratios("N2", ballistic_coefficient=450.0, lift_to_drag=0.3)
STATE = to_cartesian([45e3, 1.9, 0.4, 4000.0, -0.05, 0.3])


def test_onboard_model_without_wind_is_the_cartesian_one():
    onboard, calm = entry_onboard(VEHICLE), entry_cartesian(VEHICLE)
    assert onboard.xdot(STATE, [0.7]) == pytest.approx(calm.xdot(STATE, [0.7]), rel=1e-12)


def test_wind_enters_the_air_velocity_only():
    """Against vectors written out: drag along the velocity through the air, lift across it, no other change of the acceleration."""
    onboard = entry_onboard(VEHICLE)
    r, v = STATE[:3], STATE[3:]
    up = r / np.linalg.norm(r)
    east = np.cross([0, 0, 1.0], up)
    east /= np.linalg.norm(east)
    wind = 30.0 * east - 12.0 * np.cross(up, east)
    bank, rho = 0.9, 1.225 * np.exp(-45e3 / 7110)

    def aerodynamic(through):
        e = through / np.linalg.norm(through)
        n = up - (up @ e) * e
        n /= np.linalg.norm(n)
        drag = 0.5 * rho * (through @ through) / 450.0
        return -drag * e + 0.3 * drag * (np.cos(bank) * n + np.sin(bank) * np.cross(e, n))

    still = onboard.xdot(STATE, [bank])
    blown = onboard.xdot(STATE, [bank], {"wind_east": 30.0, "wind_north": -12.0})
    assert blown[3:] - still[3:] == pytest.approx(aerodynamic(v - wind) - aerodynamic(v), abs=1e-9)
    assert blown[:3] == pytest.approx(v, rel=1e-15)
    assert np.linalg.norm(blown[3:] - still[3:]) > 0.05


def test_force_and_heating_of_the_model_on_board():
    onboard = entry_onboard(VEHICLE)
    y = onboard.y(STATE, [0.4], {"nose_radius": 2.0})
    force = y[onboard.index("force_x") : onboard.index("force_x") + 3]
    assert np.linalg.norm(force) / G0 == pytest.approx(y[onboard.index("load")], rel=1e-9)
    assert y[onboard.index("heat")] == pytest.approx(1.7415e-4 * np.sqrt(1.225 * np.exp(-45e3 / 7110) / 2.0) * 4000.0**3, rel=1e-9)


def fly_servo(servo, command, seconds=30.0, step=0.002):
    """Bank angle, rate and greatest acceleration of a response from rest, by small Euler steps."""
    x = ca.SX.sym("x", 2)
    one = ca.Function("one", [x], [ca.vertcat(x[0] + step * x[1], x[1] + step * servo.bank_acceleration(x[0], x[1], ca.SX(command)))])
    path = np.asarray(one.mapaccum(int(seconds / step))(ca.DM([0.0, 0.0])).full())
    return path[0], path[1], np.abs(np.diff(path[1])).max() / step


def test_servo_keeps_its_limits_and_does_not_overshoot():
    servo = Servo()
    for command in (2.0, -0.3, 0.01):
        bank, rate, acceleration = fly_servo(servo, command)
        assert bank[-1] == pytest.approx(command, abs=1e-4)
        assert np.abs(bank).max() < abs(command) * 1.01
        assert np.abs(rate).max() <= servo.rate * (1 + 1e-9)
        assert acceleration <= servo.acceleration * (1 + 1e-6)
    assert np.abs(fly_servo(servo, 2.0)[1]).max() > 0.99 * servo.rate  # the limit of rate is met


@pytest.mark.parametrize("name", ["rate", "acceleration", "stiffness", "damping"])
def test_servo_refuses(name):
    with pytest.raises(ModelError, match=name):
        Servo(**{name: 0.0})


def test_truth_without_errors_follows_the_cartesian_model():
    truth, calm = entry_truth(VEHICLE), entry_cartesian(VEHICLE)
    x = np.concatenate([STATE, [0.7, 0.0, 0.0, 0.0]])
    assert truth.xdot(x, [0.7])[:6] == pytest.approx(calm.xdot(STATE, [0.7]), rel=1e-12)
    y = truth.y(x, [0.7])
    assert y[truth.index("nav_x") : truth.index("nav_x") + 6] == pytest.approx(STATE)


def test_zonal_wind_of_the_truth():
    """sin(pi h/24 km) below 24 km, none above; flown against the model on board with that wind."""
    truth, onboard = entry_truth(VEHICLE), entry_onboard(VEHICLE)
    for h in (8e3, 18e3, 30e3):
        state = to_cartesian([h, 1.9, 0.4, 300.0, -0.9, 0.3])
        east = 25.0 * np.sin(np.pi * min(h / 24e3, 1.0))
        x = np.concatenate([state, [0.7, 0.0, 0.0, 0.0]])
        found = truth.xdot(x, [0.7], {"wind_speed": 25.0})[:6]
        assert found == pytest.approx(onboard.xdot(state, [0.7], {"wind_east": east}), rel=1e-9, abs=1e-9)


def test_sensors_tell_state_and_force_with_their_errors():
    truth = entry_truth(VEHICLE)
    x = np.concatenate([STATE, [0.7, 0.0, 0.0, 0.0]])
    first = truth.index("force_x")
    force = truth.y(x, [0.7])[first : first + 3]
    gravity_and_rest = truth.xdot(x, [0.7])[3:6] - force  # what is left has no air in it
    without = truth.xdot(x, [0.7], {"rho_factor": 0.05})[3:6] - truth.y(x, [0.7], {"rho_factor": 0.05})[first : first + 3]
    assert gravity_and_rest == pytest.approx(without, rel=1e-9)
    biased = truth.y(x, [0.7], {"force_bias_y": 0.02, "nav_w_error": 1.5})
    assert biased[first + 1] - force[1] == pytest.approx(0.02)
    assert biased[truth.index("nav_w")] == pytest.approx(STATE[5] + 1.5)


def test_noise_has_the_deviation_asked_for_and_no_mean():
    truth = entry_truth(VEHICLE)
    steps = np.arange(4000)[:, None] * np.array([500.0, 900.0, -700.0, 0, 0, 0])
    x = np.hstack([STATE + steps, np.tile([0.7, 0, 0, 0], (4000, 1))])
    x[:, :3] *= (np.linalg.norm(STATE[:3]) / np.linalg.norm(x[:, :3], axis=1))[:, None]  # at one altitude
    first = truth.index("force_x")
    quiet, noisy = (
        evaluate(truth.out, x, np.array([0.7]), truth.parameters({"force_noise": s}))[0][:, first : first + 3] for s in (0.0, 0.3)
    )
    assert np.abs((noisy - quiet).std(axis=0) - 0.3).max() < 0.03
    assert np.abs((noisy - quiet).mean(axis=0)).max() < 0.03


def test_peak_and_travel_are_those_of_the_flight():
    truth = entry_truth(VEHICLE, planet=Planet(rotation=OMEGA_EARTH))
    x0 = np.concatenate([to_cartesian([100e3, 1.885, 0.297, 7650.0, -1.6 * DEG, 8 * DEG]), [45 * DEG, 0.0, 0.0, 0.0]])
    law = ocp.profile([0, 245, 275], bank_command=np.array([45.0, 45.0, -45.0]) * DEG)
    flown = ocp.simulate(truth, law, x0=x0, until=ocp.falls_below("h", 10e3), method=ocp.RK4(step=0.25))
    assert flown["peak"][-1] == pytest.approx(flown["load"].max(), rel=2e-4)
    assert flown["travel"][-1] == pytest.approx(90 * DEG, rel=1e-3)
