"""Duties and batteries: action type, readings, errors, sampled charges."""

import numpy as np
import pytest
from airframes import AIRFRAME_WITH_BATTERY, AIRFRAME_WITH_DUTY

import mujoco_drones_gym as mdg
from mujoco_drones_gym import VectorAviary
from mujoco_drones_gym.utils.enums import ActionType


def test_duties_follow_from_the_speed_and_the_voltage():
    env = mdg.MultiHoverAviary(
        drone_model=AIRFRAME_WITH_BATTERY, act_type=ActionType.DUTY, initial_xyzs=[[0, 0, 2], [1, 0, 2]]
    )
    env.reset(seed=1)
    rpm = np.array([[14_200.0, 14_201.0, 14_199.0, 14_200.0], [14_500.0] * 4])
    duties = []
    for _ in range(60):
        voltage = env.battery[:, 1]
        action = env._env.action_of_rpm(rpm)
        expected = (rpm - 1500.0) / (5800.0 * voltage[:, None])
        np.testing.assert_allclose(action.reshape(2, 4), expected, rtol=1e-12)
        env.step(action)
        np.testing.assert_allclose(env.last_clipped_action, rpm, rtol=1e-12)
        duties.append(action)
    charge, voltage, current = env.battery.T
    assert ((0.5 < charge) & (charge < 0.9)).all() and (voltage < 4.0).all() and (current > 1.0).all()
    # the faster drone draws more
    assert charge[1] < charge[0] and current[1] > current[0]
    # the same speed takes more duty as the batteries empty
    assert (duties[-1] > duties[5] + 0.01).all()
    metrics = env.metrics()
    assert (metrics["battery_charge"], metrics["battery_voltage"]) == (charge[1], voltage[1])


def test_a_battery_in_a_batch_is_that_of_single_environments():
    options = {
        "drone_model": AIRFRAME_WITH_BATTERY,
        "act_type": "duty",
        "randomization": {"battery": {"charge": [0.3, 1.0]}},
    }
    batch = VectorAviary("hover", 9, num_threads=2, **options)
    alone = [mdg.HoverAviary(stream=index, engine="hybrid", **options) for index in range(9)]
    batch.reset(seed=4)
    for env in alone:
        env.reset(seed=4)
    rng = np.random.default_rng(1)
    for _ in range(12):
        actions = rng.uniform(0.55, 0.7, (9, 4))
        batch.step(actions)
        for env, action in zip(alone, actions, strict=True):
            env.step(action)
        rows = batch.batteries()
        assert rows.shape == (9, 1, 3)
        np.testing.assert_array_equal(rows, [env.battery for env in alone])
        np.testing.assert_array_equal(batch.envs[3].battery, rows[3])
    assert np.ptp(rows[:, 0, 0]) > 0.2
    sampled = alone[0]._env.sampled_params()["drones"][0]["charge"]
    assert rows[0, 0, 0] < sampled <= 1.0


def test_without_a_battery_the_readings_are_nan():
    for env in (mdg.HoverAviary(), mdg.HoverAviary(drone_model=AIRFRAME_WITH_DUTY)):
        env.reset(seed=1)
        assert env.battery.shape == (1, 3) and np.isnan(env.battery).all()
        assert "battery_charge" not in env.metrics()
    batch = VectorAviary("hover", 3)
    batch.reset(seed=1)
    assert np.isnan(batch.batteries()).all()


def test_agents_have_batteries():
    pytest.importorskip("pettingzoo")
    env = mdg.MultiAgentAviary(2, drone_model=AIRFRAME_WITH_BATTERY, act_type="duty")
    env.reset(seed=1)
    env.step({agent: np.full(4, 0.6) for agent in env.agents})
    assert env.battery.shape == (2, 3) and (env.battery[:, 0] < 1.0).all()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"act_type": "duty"}, "act_type is duty for the airframe cf2x, which has no law from duty to motor speed"),
        ({"randomization": {"battery": {"charge": [0.5, 1.0]}}}, "battery is set for cf2x, which has none"),
        (
            {"drone_model": AIRFRAME_WITH_BATTERY, "randomization": {"battery": {"charge": [0.5, 2.0]}}},
            "battery.charge is",
        ),
        (
            {"drone_model": {**AIRFRAME_WITH_BATTERY, "motors": {}}},
            "motors.speed_per_volt is 0, expected a positive number of rpm/V",
        ),
    ],
)
def test_errors_name_the_option(options, expected):
    with pytest.raises(ValueError, match=expected) as error:
        mdg.HoverAviary(**options)
    assert "\n" not in str(error.value) and "expected" in str(error.value)
