"""Domain randomization: ranges, samples, and their effect on flights."""

import math
import pickle

import gymnasium as gym
import numpy as np
import pytest

from mujoco_drones_gym import VectorAviary, _native
from mujoco_drones_gym.wrappers import (
    CurriculumConfig,
    CurriculumWrapper,
    DomainRandomizationConfig,
    DomainRandomizationWrapper,
    ObstacleConfig,
    WindConfig,
    WindWrapper,
)
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
            "downwash": [0.9, 1.05], "moment": [0.9, 1.08], "damping": [0.9, 1.09],
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
        velocity_moment_range=(0.9, 1.08), rotational_damping_range=(0.9, 1.09),
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
        ({"mass_range": (1.2, 0.8)}, "mass_range is [1.2, 0.8], expected a range of factors"),
        ({"mass_range": 1.2}, "mass_range is 1.2, expected a list"),
        ({"mass_range": (0.8, 1.0, 1.2)}, "mass_range: 3 numbers, expected 2"),
        ({"motor_time_constant_range": (0.0, 20.0)}, "motor_time_constant_range is [0, 20], expected"),
        ({"pos_noise_std": -0.1}, "pos_noise_std is -0.1, expected zero or"),
        ({"gyro_bias_std": math.nan}, "gyro_bias_std is NaN"),
        ({"init_pos_noise_std": -1}, "init_pos_noise_std is -1: init_position is -1.73"),
        ({"motor_time_constant": 20}, "motor_time_constant is 20: motor_time_constant_range is [20, 20], expected"),
        ({"action_delay_range": 3}, "action_delay_range is 3, expected two numbers of control steps"),
        ({"kf_range": "wide"}, 'kf_range is "wide", expected a list'),
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
    with pytest.raises(ValueError) as error:
        randomization_options({"body": {"mas": (1, 1)}})
    text = "unknown field `mas`, expected one of `mass`, `inertia`, `arm_length`; did you mean `mass`?"
    assert str(error.value) == f"randomization.body: {text}"
    with pytest.raises(ValueError) as error:
        randomization_options({"zzz": {}})
    assert all(f"`{group}`" in str(error.value) for group in GROUPS)
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


# an explicit wind next to the default range of the wind


WIND = WindConfig("constant", velocity=(2.0, 0.0, 0.0))


def stack(*makers, **options):
    env = hover(**options)
    for make in makers:
        env = make(env)
    return env


def wind(env):
    return WindWrapper(env, WIND)


def randomized(env):
    return DomainRandomizationWrapper(env)


def drift(env, seed=3):
    rows, info = flight(env, seed, level=0.0, steps=30)
    return rows, info


def test_wind_and_randomization_compose_in_any_order():
    rows, info = drift(stack(wind, randomized))
    assert 0.8 <= info["domain_params"]["mass"] / 0.027 <= 1.2 and info["domain_params"]["mass"] != 0.027
    assert info["domain_params"]["wind"] is None
    calm = drift(stack(lambda env: DomainRandomizationWrapper(env, DomainRandomizationConfig(wind_speed_range=None))))
    assert rows[-1][0] > calm[0][-1][0] + 0.005, "downwind"
    for other in (
        stack(randomized, wind),
        stack(randomized, wind=WIND),
        stack(wind, randomization=True),
        stack(wind=WIND, randomization=True),
        stack(wind=WIND, randomization={group: {} for group in GROUPS}),
        pickle.loads(pickle.dumps(stack(randomized, wind))),
    ):
        again, _ = drift(other)
        assert np.array_equal(again, rows)


def test_all_wrappers_form_a_stack():
    def harder(env, level):
        env.TARGET_HEIGHT = 1.0 + 0.1 * level

    def curriculum(env):
        return CurriculumWrapper(env, harder, CurriculumConfig(num_levels=3, start_level=1))

    forest = ObstacleConfig("forest", 6, seed=2)
    orders = [(wind, randomized, curriculum), (curriculum, randomized, wind), (randomized, curriculum, wind)]
    flights = []
    for order in orders:
        env = stack(*order, obstacles=forest)
        rows, info = drift(env)
        flights.append(rows)
        assert len(env.unwrapped._env.obstacles()) == 6 and env.unwrapped.TARGET_HEIGHT == pytest.approx(1.1)
        assert info["curriculum_level"] == 1 and info["wind_config"]["model"] == "constant"
        assert info["domain_params"]["mass"] == pytest.approx(env.unwrapped.M) != 0.027
    assert np.array_equal(flights[0], flights[1]) and np.array_equal(flights[0], flights[2])
    still = drift(stack(curriculum, lambda env: DomainRandomizationWrapper(env, only(mass_range=(0.8, 1.2)))))[0]
    windy = drift(stack(wind, lambda env: DomainRandomizationWrapper(env, only(mass_range=(0.8, 1.2)))))[0]
    assert windy[-1][0] > still[-1][0] + 0.01


def test_the_wind_can_change_between_episodes_of_a_randomization():
    env = hover(randomization=True)
    sampled, _ = drift(env)
    assert env.sampled_params()["wind"] is not None
    env.set_wind(WIND)
    windy, _ = drift(env)
    assert env.sampled_params().get("wind") is None
    assert np.array_equal(windy, drift(hover(wind=WIND, randomization=True))[0])
    env.set_wind(WindConfig("constant", velocity=(-2.0, 0.0, 0.0)))
    assert drift(env)[0][-1][0] < windy[-1][0] - 0.01, "upwind"
    env.set_wind(None)
    assert np.array_equal(drift(env)[0], sampled) and env.sampled_params()["wind"] is not None
    env.set_wind(WIND)
    env.set_randomization(None)
    assert np.array_equal(drift(env)[0], drift(hover(wind=WIND))[0])
    env.set_wind(None)
    env.set_randomization(True)
    assert np.array_equal(drift(env)[0], sampled)


@pytest.mark.parametrize("copy", [True, False])
def test_a_wind_of_a_member_of_a_batch_replaces_the_default_wind(copy):
    options = {"initial_xyzs": [[0, 0, 1]], "randomization": True}
    wind = {"model": "constant", "velocity": (3.0, 0.0, 0.0)}
    env = VectorAviary("hover", 3, copy=copy, **options)
    env.reset(seed=1)
    env.envs[1].set_wind(wind)
    obs, _ = env.reset(seed=1)
    alone = gym.make("mujoco_drones_gym/Hover-v0", stream=1, engine="hybrid", **options)
    alone.reset(seed=1)
    alone.unwrapped.set_wind(wind)
    expected, _ = alone.reset(seed=1)
    for _ in range(6):
        np.testing.assert_array_equal(obs[1], expected)
        obs, expected = env.step(np.zeros((3, 4)))[0], alone.step(np.zeros(4))[0]
    assert env.envs[1].vel[0, 0] > env.envs[2].vel[0, 0] + 0.005, "downwind"
    ranged = VectorAviary("hover", 2, randomization=DomainRandomizationConfig(wind_speed_range=(1.0, 3.0)))
    ranged.reset(seed=1)
    message = r"^wind_speed_range is \(1.0, 3.0\), expected \(0, 0\), because the environment has a wind \(constant\)$"
    with pytest.raises(ValueError, match=message):
        ranged.envs[0].set_wind(wind)
    ranged.envs[0].set_wind(None)


def test_a_range_of_the_user_next_to_a_wind_is_an_error():
    text = r"wind_speed_range is \(0\.0, 1\.0\), expected \(0, 0\), because the environment has a wind \(constant\)"
    explicit = DomainRandomizationConfig(wind_speed_range=(0.0, 1.0))
    named = pickle.loads(pickle.dumps(explicit))
    for make in (
        lambda: hover(wind=WIND, randomization=explicit),
        lambda: DomainRandomizationWrapper(wind(hover()), named),
        lambda: wind(DomainRandomizationWrapper(hover(), {"wind_speed_range": (0.0, 1.0)})),
    ):
        with pytest.raises(ValueError, match=text):
            make()
    with pytest.raises(ValueError, match=r"environment\.wind is \[0\.5, 2\], expected \(0, 0\)"):
        hover(wind=WIND, randomization={"environment": {"wind": [0.5, 2]}})
    assert hover(wind=WIND, randomization=DomainRandomizationConfig(wind_speed_range=None)) is not None
    assert pickle.loads(pickle.dumps(DomainRandomizationConfig())) == DomainRandomizationConfig()


def test_the_wind_can_change_after_a_state_with_a_sampled_wind():
    env = hover(randomization=True)
    env.reset(seed=1)
    state = env.get_state()
    env.set_wind(WIND)
    env.set_state(state)
    assert env.sampled_params()["wind"] is not None
    env.set_wind(WIND)
    assert np.array_equal(drift(env)[0], drift(hover(wind=WIND, randomization=True))[0])


def test_a_curriculum_can_set_the_wind_of_a_randomization():
    def harder(env, level):
        env.set_wind(WindConfig("constant", velocity=(2.0 * level, 0.0, 0.0)) if level else None)

    config = CurriculumConfig(metric="episode_length", num_levels=3, window_size=1, threshold_advance=1.0)
    env = CurriculumWrapper(DomainRandomizationWrapper(hover(episode_seconds=0.5)), harder, config)
    sampled, ends = [], []
    for level in range(3):
        rows, info = flight(env, 5, steps=60)
        assert info["curriculum_level"] == level
        sampled.append(info["domain_params"]["wind"] is not None)
        ends.append(rows[-1][0])
    assert sampled == [True, False, False] and ends[2] > ends[1] + 0.005
