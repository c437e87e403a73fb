"""Domain randomization: ranges, samples, and their effect on flights."""

import math
import pickle

import gymnasium as gym
import numpy as np
import pytest

from mujoco_drones_gym import _native
from mujoco_drones_gym.wrappers import DomainRandomizationConfig, DomainRandomizationWrapper
from mujoco_drones_gym.wrappers.randomization import randomization_options

GROUPS = ["body", "aerodynamics", "actuators", "sensors", "environment", "initial"]
PAPER = _native.complete_options("randomization", {group: {} for group in GROUPS})
only = DomainRandomizationConfig.only


def test_the_default_has_the_papers_ranges():
    assert DomainRandomizationConfig()._to_options() == PAPER == randomization_options(True)
    config = DomainRandomizationConfig()
    assert config.mass_range == (0.8, 1.2) and config.kf_range == (0.85, 1.15)
    assert config.motor_time_constant_range == (0.005, 0.05) and config.pos_noise_std == 0.01
    assert config.rpy_noise_std == pytest.approx(math.radians(1.0)) and config.wind_speed_range == (0.0, 1.0)
    changed = DomainRandomizationConfig(mass_range=(0.5, 2.0))._to_options()
    assert changed["body"] == {**PAPER["body"], "mass": [0.5, 2.0]}
    assert {**changed, "body": None} == {**PAPER, "body": None}


def test_nominal_groups_are_missing():
    assert only(mass_range=(0.9, 1.1))._to_options() == {
        "body": {"mass": [0.9, 1.1], "inertia": [1.0, 1.0], "arm_length": [1.0, 1.0]}
    }
    assert only()._to_options() == {}
    assert "sensors" not in DomainRandomizationConfig(
        pos_noise_std=None, vel_noise_std=0.0, rpy_noise_std=None, ang_vel_noise_std=None, sensor_bias=None,
        sensor_latency_range=None,
    )._to_options()  # fmt: skip
    assert only(gyro_bias_std=0.1)._to_options()["sensors"]["gyro_bias"] == 0.1


def test_every_field_reaches_the_simulator():
    values = {
        "body": {"mass": [0.91, 1.11], "inertia": [0.92, 1.12], "arm_length": [0.93, 1.13]},
        "aerodynamics": {
            "thrust": [0.9, 1.01], "torque": [0.9, 1.02], "drag": [0.9, 1.03], "ground": [0.9, 1.04],
            "downwash": [0.9, 1.05],
        },
        "actuators": {"gain": [0.9, 1.06], "lag": [0.01, 0.02], "latency": [0.01, 0.03], "max_rpm": [0.9, 1.07]},
        "sensors": {
            "position": 0.1, "velocity": 0.2, "attitude": 0.3, "angular_velocity": 0.4, "bias": 0.5, "gyro_bias": 0.6,
            "latency": [0.01, 0.04],
        },
        "environment": {"gravity": [0.9, 1.08], "wind": [0.1, 0.2]},
        "initial": {"position": 0.1, "attitude": 0.2, "velocity": 0.3, "offset": [0.1, 0.2, 0.3]},
    }  # fmt: skip
    config = DomainRandomizationConfig(
        mass_range=(0.91, 1.11), inertia_range=(0.92, 1.12), arm_length_range=(0.93, 1.13), kf_range=(0.9, 1.01),
        km_range=(0.9, 1.02), drag_range=(0.9, 1.03), ground_effect_range=(0.9, 1.04), downwash_range=(0.9, 1.05),
        motor_gain_range=(0.9, 1.06), motor_time_constant_range=(0.01, 0.02), action_latency_range=(0.01, 0.03),
        motor_constant_range=(0.9, 1.07), pos_noise_std=0.1, vel_noise_std=0.2, rpy_noise_std=0.3,
        ang_vel_noise_std=0.4, sensor_bias=0.5, gyro_bias_std=0.6, sensor_latency_range=(0.01, 0.04),
        gravity_range=(0.9, 1.08), wind_speed_range=(0.1, 0.2), init_position=0.1, init_rpy=0.2, init_velocity=0.3,
        init_offset=(0.1, 0.2, 0.3),
    )  # fmt: skip
    assert config._to_options() == values
    assert randomization_options(values) == values
    assert pickle.loads(pickle.dumps(config)) == config


def test_names_of_the_paper_set_the_fields():
    config = only(motor_time_constant=0.02, action_delay_steps=2, init_pos_noise_std=0.1)
    options = config._to_options(ctrl_freq=100.0)
    assert options["actuators"]["lag"] == [0.02, 0.02] and options["actuators"]["latency"] == [0.02, 0.02]
    assert options["initial"]["position"] == pytest.approx(math.sqrt(3.0) * 0.1)
    assert config.motor_time_constant == 0.02 and config.init_pos_noise_std == pytest.approx(0.1)
    assert only(action_delay_range=(1, 3))._to_options(50.0)["actuators"]["latency"] == [0.02, 0.06]
    named = randomization_options({"mass_range": (2.0, 2.0), "action_delay_range": (0, 2)}, 100.0)
    assert named["body"]["mass"] == [2.0, 2.0] and named["actuators"]["latency"] == [0.0, 0.02]


def test_fixed_settings_of_the_paper_accept_the_value_that_they_have():
    assert DomainRandomizationConfig(randomize_every_episode=True, acc_bias_std=0.0) == DomainRandomizationConfig()
    with pytest.raises(ValueError, match="randomize_every_episode is False, expected True: the parameters are sampled"):
        DomainRandomizationConfig(randomize_every_episode=False)
    with pytest.raises(ValueError, match=r"acc_bias_std is 0\.05, expected 0\.0: observations have no accelerations"):
        only(acc_bias_std=0.05)


def test_dicts_of_groups_leave_missing_groups_off():
    options = randomization_options({"body": {"mass": (0.8, 1.2)}})
    assert options == {"body": {"mass": [0.8, 1.2], "inertia": [0.8, 1.2], "arm_length": [0.98, 1.02]}}
    assert randomization_options(False) is None and randomization_options(None) is None
    assert randomization_options({}) == {}


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"mass_range": (1.2, 0.8)}, "mass_range: the randomized body.mass is [1.2, 0.8], expected a range of factors"),
        ({"mass_range": 1.2}, "randomization.body.mass is 1.2, expected a list"),
        ({"mass_range": (0.8, 1.0, 1.2)}, "randomization.body.mass: 3 numbers, expected 2"),
        ({"motor_time_constant_range": (0.0, 20.0)}, "motor_time_constant_range: the randomized actuators.lag is"),
        ({"pos_noise_std": -0.1}, "pos_noise_std: the randomized sensors.position is -0.1, expected zero or"),
        ({"gyro_bias_std": math.nan}, "gyro_bias_std: the randomized sensors.gyro_bias is NaN"),
        ({"action_delay_range": 3}, "action_delay_range is 3, expected two numbers of control steps"),
        ({"kf_range": "wide"}, 'randomization.aerodynamics.thrust is "wide", expected a list'),
    ],
)
def test_bad_values_are_errors_of_one_line(settings, text):
    with pytest.raises(ValueError) as error:
        DomainRandomizationConfig(**settings)
    assert str(error.value).startswith(text), error.value
    assert "\n" not in str(error.value)


def test_other_errors():
    with pytest.raises(TypeError, match="weight_range"):
        DomainRandomizationConfig(weight_range=(1, 2))
    with pytest.raises(TypeError, match="weight_range"):
        only(weight_range=(1, 2))
    with pytest.raises(ValueError, match="randomization: unknown field `bdy`"):
        randomization_options({"bdy": {}})
    with pytest.raises(ValueError, match="body next to fields"):
        randomization_options({"body": {}, "mass_range": (1, 2)})
    with pytest.raises(ValueError, match="randomization is 3, expected True, False"):
        randomization_options(3)


# environments


def hover(**options):
    from mujoco_drones_gym.envs.hover_aviary import HoverAviary

    return HoverAviary(**options)


def flight(env, seed, level=0.0, steps=30):
    observation, info = env.reset(seed=seed)
    rows = [observation]
    for _ in range(steps):
        observation, _, terminated, truncated, _ = env.step(np.full(env.action_space.shape, level))
        rows.append(observation)
        if terminated or truncated:
            break
    return np.array(rows), info


def test_sampled_masses_are_in_their_range_and_repeat():
    env = DomainRandomizationWrapper(hover(), only(mass_range=(0.8, 1.2)))
    masses = [env.reset(seed=seed)[1]["domain_params"]["mass"] for seed in range(200)]
    factors = np.array(masses) / 0.027
    assert factors.min() >= 0.8 and factors.max() <= 1.2
    assert factors.min() < 0.82 and factors.max() > 1.18 and factors.mean() == pytest.approx(1.0, abs=0.03)
    assert [env.reset(seed=seed)[1]["domain_params"]["mass"] for seed in range(5)] == masses[:5]


def test_the_mass_of_the_environment_follows_the_sample():
    env = hover()
    wrapped = DomainRandomizationWrapper(env, DomainRandomizationConfig(mass_range=(2.0, 2.0)))
    for seed in range(5):
        _, info = wrapped.reset(seed=seed)
        assert pytest.approx(0.054) == env.M
        assert info["domain_params"]["mass"] == pytest.approx(0.054)
    fixed = DomainRandomizationWrapper(hover(), {"body": {"mass": (1.1, 1.1)}})
    assert fixed.reset(seed=1)[1]["domain_params"]["mass"] == pytest.approx(1.1 * 0.027)


def test_a_sampled_mass_changes_the_flight_as_it_should():
    """At hover speed the thrust is m·g of the nominal mass m, so that z̈ = g·(m/M − 1) for a mass M."""
    for factor in (0.9, 1.25):
        env = DomainRandomizationWrapper(hover(initial_xyzs=[[0.0, 0.0, 1.0]]), only(mass_range=(factor, factor)))
        rows, info = flight(env, 0, steps=24)
        assert info["domain_params"]["mass"] == pytest.approx(0.027 * factor)
        acceleration = 9.81 * (1.0 / factor - 1.0)
        assert rows[-1][8] == pytest.approx(acceleration * 24 / 48, rel=1e-5)
        assert rows[-1][2] - 1.0 == pytest.approx(0.5 * acceleration * 0.5**2, rel=1e-2)


def test_the_wrapper_and_the_option_give_the_same_flight():
    config = DomainRandomizationConfig()
    wrapped, option = DomainRandomizationWrapper(hover(), config), hover(randomization=config)
    for seed in (3, 4):
        assert np.array_equal(flight(wrapped, seed)[0], flight(option, seed)[0])
    assert not np.array_equal(flight(wrapped, 3)[0], flight(wrapped, 4)[0])
    assert np.array_equal(flight(DomainRandomizationWrapper(hover()), 3)[0], flight(hover(randomization=True), 3)[0])


def test_action_delays_are_whole_control_steps():
    config = only(action_delay_range=(2, 2))
    env = DomainRandomizationWrapper(hover(initial_xyzs=[[0.0, 0.0, 1.0]]), config)
    _, info = env.reset(seed=0)
    assert info["domain_params"]["action_delay"] == pytest.approx(2.0) and env._current_delay == 2
    plain = flight(hover(initial_xyzs=[[0.0, 0.0, 1.0]]), 0, 0.5, 10)[0]
    late = flight(env, 0, 0.5, 10)[0]
    assert late[2] == pytest.approx(late[0], abs=1e-6), "the motors turn at hover speed for two steps"
    assert late[4:][:, 8] == pytest.approx(plain[2:-2][:, 8], abs=1e-5)


def test_domain_params_have_the_samples_of_every_group():
    env = DomainRandomizationWrapper(hover())
    _, info = env.reset(seed=5)
    params = info["domain_params"]
    assert params == env.domain_params
    nominal = _native.airframe_constants("cf2x")[0]
    for name, key, (low, high) in [
        ("mass", "mass", (0.8, 1.2)),
        ("kf", "thrust_coefficient", (0.85, 1.15)),
        ("km", "torque_coefficient", (0.85, 1.15)),
        ("arm_length", "arm_length", (0.98, 1.02)),
    ]:
        assert low <= params[name] / nominal[key] <= high and params[name] != nominal[key], name
    assert 0.005 <= params["motor_tau"] <= 0.05 and 0.0 <= params["action_latency"] <= 0.05
    assert 0.98 <= params["gravity"] / 9.81 <= 1.02 and 0.0 <= params["sensor_latency"] <= 0.02
    assert len(params["motor_gains"]) == 4 and len(params["gyro_bias"]) == 3
    assert np.hypot(*params["wind"]["velocity"][:2]) <= 1.0


def test_wrappers_compose_and_pickle():
    inner = gym.wrappers.TimeLimit(DomainRandomizationWrapper(hover(), only(mass_range=(0.9, 1.1))), 10)
    outer = DomainRandomizationWrapper(gym.wrappers.TimeLimit(hover(), 10), only(mass_range=(0.9, 1.1)))
    assert np.array_equal(flight(inner, 2, steps=10)[0], flight(outer, 2, steps=10)[0])
    assert np.array_equal(flight(pickle.loads(pickle.dumps(outer)), 2, steps=10)[0], flight(outer, 2, steps=10)[0])
    with pytest.raises(TypeError, match="DomainRandomizationWrapper got CartPoleEnv"):
        DomainRandomizationWrapper(gym.make("CartPole-v1"))
