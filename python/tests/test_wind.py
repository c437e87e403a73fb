"""Wind: settings, forces, and the wrapper around environments."""

import copy
import math
import pickle

import gymnasium as gym
import numpy as np
import pytest

from mujoco_drones_gym import _native
from mujoco_drones_gym.wrappers import WindConfig, WindField, WindModel, WindWrapper
from mujoco_drones_gym.wrappers.wind import wind_options

DT = 1 / 240
ZERO = np.zeros(3)
HIGH = np.array([0.0, 0.0, 1.0])


def test_members_and_names_are_equal():
    assert [model.value for model in WindModel] == ["none", "constant", "gust", "dryden", "sinusoidal", "combined"]
    assert WindConfig("dryden") == WindConfig(WindModel.DRYDEN)
    assert WindConfig("dryden").model is WindModel.DRYDEN


def test_defaults_are_those_of_the_simulator():
    assert WindConfig()._to_options() == _native.complete_options("wind", {})
    assert WindConfig().velocity == (0.0, 0.9, 0.0) and WindConfig().drag_area is None


def test_names_of_the_paper_set_the_fields():
    config = WindConfig(
        model="combined",
        constant_wind=np.array([1.0, 2.0, 3.0]),
        gust_intensity=0.04,
        gust_probability=0.01,
        gust_duration_steps=120,
        turbulence_intensity=1.5,
        sinusoidal_amplitude=0.03,
        sinusoidal_period=2.0,
        drag_coefficient=0.005,
    )
    expected = WindConfig(
        "combined", (1.0, 2.0, 3.0), 0.04, 1.5, 0.03, math.pi, gust_duration=0.5, gust_rate=2.4, drag_area=0.005
    )
    assert config == expected
    assert config.constant_wind.tolist() == [1.0, 2.0, 3.0] and config.turbulence_intensity == 1.5
    assert config.sinusoidal_period == pytest.approx(2.0) and config.gust_probability == pytest.approx(0.01)
    config.sinusoidal_amplitude = 0.5
    assert config.sinusoidal_force == 0.5
    assert WindConfig("constant", constant_wind=None).velocity == (0.0, 0.0, 0.0)
    assert pickle.loads(pickle.dumps(config)) == config


def test_the_turbulence_follows_the_drone():
    assert WindConfig("dryden", altitude=None, airspeed=None) == WindConfig("dryden")
    with pytest.raises(ValueError, match=r"altitude is 1\.0, expected None: the turbulence depends on the height"):
        WindConfig("dryden", altitude=1.0)


def test_dicts_have_the_keys_of_the_file_or_the_names_of_the_paper():
    config = WindConfig("gust", gust_force=0.1)
    assert wind_options({"model": "gust", "gust_force": 0.1}) == config._to_options()
    assert wind_options({"model": WindModel.GUST, "gust_intensity": np.float32(0.5)})["gust_force"] == 0.5
    assert wind_options("gust") == wind_options(WindModel.GUST) == WindConfig("gust")._to_options()
    assert wind_options(None) is None


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"model": "storm"}, "wind.model: unknown variant `storm`, expected one of `none`, `constant`"),
        ({"gust_force": -1.0}, "wind.gust_force is -1, expected 0 to 1000"),
        ({"velocity": (1.0, 2.0)}, "wind.velocity"),
        ({"velocity": (1.0, 2.0, math.nan)}, "wind.velocity is NaN, expected finite numbers up to 1000 m/s"),
        ({"gust_force": "strong"}, 'wind.gust_force is "strong", expected a number'),
        ({"turbulence": None, "gust_duration": 0}, "wind.gust_duration is 0, expected 1 ms to 1000 s"),
        ({"drag_area": -1}, "wind.drag_area is -1, expected 0 to 1000 m²"),
        ({"turbulence_intensity": [1]}, "turbulence_intensity is [1], expected a number"),
        ({"gust_intensity": -1.0}, "gust_intensity is -1, expected 0 to 1000"),
        ({"gust_probability": 10}, "gust_probability is 10: wind.gust_rate is 2400, expected 0 to 1000"),
        ({"sinusoidal_period": "long"}, "sinusoidal_period is 'long', expected a positive period in s"),
        ({"sinusoidal_period": 0}, "sinusoidal_period is 0, expected a positive period in s"),
        ({"filter": 1}, "wind.filter: unknown variant `1`, expected `first_order` or `mil_f_8785c`"),
    ],
)
def test_bad_values_are_errors_of_one_line(settings, text):
    for call in (lambda: WindConfig(**settings), lambda: wind_options(settings)):
        with pytest.raises(ValueError) as error:
            call()
        assert str(error.value).startswith(text) and "\n" not in str(error.value)


def test_errors_list_every_name_that_is_possible():
    models = ", ".join(f"`{model.value}`" for model in WindModel)
    for wrong in (5, "foo", 1.5, [1]):
        with pytest.raises(ValueError) as error:
            WindConfig(model=wrong)
        assert str(error.value) == f"wind.model: unknown variant `{wrong}`, expected one of {models}"
    with pytest.raises(ValueError) as error:
        wind_options({"gust_forse": 1.0})
    keys = [f"`{key}`" for key in _native.complete_options("wind", {})]
    assert all(key in str(error.value) for key in keys) and str(error.value).endswith("did you mean `gust_force`?")


def test_a_dict_needs_a_model_unless_it_acts_in_still_air():
    text = "wind has no model, expected one of none, constant, gust, dryden, sinusoidal, combined"
    for settings in ({"velocity": (3.0, 0.0, 0.0)}, {"turbulence_intensity": 3.0}, {"model": None, "gust_force": 1.0}):
        for call in (wind_options, WindField, lambda wind: hover(wind=wind)):
            with pytest.raises(ValueError) as error:
                call(settings)
            assert str(error.value) == text
    assert wind_options({"still_air_drag": True, "air_density": 1.0, "drag_area": 0.1})["model"] == "none"
    assert wind_options({}) == wind_options({"model": "none", "turbulence": None}) == WindConfig()._to_options()


def test_a_frequency_of_zero_has_an_infinite_period():
    config = WindConfig("sinusoidal", sinusoidal_frequency=0.0)
    assert config.sinusoidal_period == math.inf
    config.sinusoidal_period = 4.0
    assert config.sinusoidal_frequency == pytest.approx(math.pi / 2)
    with pytest.raises(ValueError, match="sinusoidal_period is 0, expected a positive period in s"):
        config.sinusoidal_period = 0


def test_unknown_settings_are_errors():
    with pytest.raises(TypeError, match="speed"):
        WindConfig(speed=3.0)
    with pytest.raises(TypeError, match="WindConfig got gust_intensity and another name of gust_force"):
        WindConfig(gust_intensity=1.0, gust_force=1.0)
    with pytest.raises(ValueError, match=r"wind: unknown field `gust_forse`.*did you mean `gust_force`"):
        wind_options({"gust_forse": 1.0})
    with pytest.raises(ValueError, match="wind is 3, expected a WindConfig, a dict of its settings or None"):
        wind_options(3)


def test_constant_wind_follows_the_drag_law():
    field = WindField(WindConfig("constant", constant_wind=[2.0, 0.0, 0.0], drag_coefficient=0.01))
    field.reset(seed=0)
    force = field.get_force(DT, HIGH, ZERO)
    assert force == pytest.approx([0.5 * 1.225 * 0.01 * 4.0, 0.0, 0.0], abs=1e-15)
    relative = np.array([2.0, 0.0, 0.0]) - [1.0, -2.0, 0.5]
    force = field.get_force(dt=DT, position=HIGH, velocity=np.array([1.0, -2.0, 0.5]))
    assert force == pytest.approx(0.5 * 1.225 * 0.01 * np.linalg.norm(relative) * relative, rel=1e-12)
    assert field.get_force(DT, HIGH, [2.0, 0.0, 0.0]) == pytest.approx(ZERO), "a drone that moves with the air"


def test_the_drag_area_is_that_of_the_airframe():
    config = WindConfig("constant", velocity=(3.0, 0.0, 0.0))
    for model in ("cf2x", "race"):
        area = _native.airframe_constants(model)[1]["drag_area"]
        force = WindField(config, env=model).get_force(DT, HIGH, ZERO)
        assert force[0] == pytest.approx(0.5 * 1.225 * area * 9.0, rel=1e-12)


def test_sinusoidal_wind_follows_the_papers_formula():
    field = WindField(WindConfig("sinusoidal", sinusoidal_force=0.01, sinusoidal_frequency=3.0), seed=1)
    forces = np.array([field.get_force(DT, HIGH, ZERO) for _ in range(480)])
    best = min(
        np.abs(forces - 0.01 * np.stack([np.sin(3 * t), np.cos(3 * t), 0.3 * np.sin(6 * t)], axis=1)).max()
        for t in (DT * np.arange(480), DT * (np.arange(480) + 1))
    )
    assert best < 1e-12


def test_still_air_has_no_force():
    for config in (None, WindConfig(), WindConfig("constant", velocity=(0, 0, 0))):
        assert not WindField(config, seed=0).get_force(DT, HIGH, np.array([1.0, 2.0, 3.0])).any()


@pytest.mark.parametrize("model", ["gust", "dryden", "combined"])
def test_seeds_repeat_and_differ(model):
    field = WindField(WindConfig(model, gust_rate=5.0))

    def forces(seed):
        field.reset(seed=seed)
        return np.array([field.get_force(DT, HIGH, ZERO) for _ in range(480)])

    first, again, other = forces(3), forces(3), forces(4)
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    assert first.std() > 0
    field.reset(5)
    following = [forces(None) for _ in range(2)]
    assert not np.array_equal(*following), "without a seed the random numbers go on"
    assert np.array_equal(WindField(WindConfig(model, gust_rate=5.0), seed=3).get_force(DT, HIGH, ZERO), first[0])


def test_gusts_have_their_amplitude_and_duration():
    config = WindConfig("gust", gust_force=0.1, gust_duration=0.25, gust_rate=1.0)
    field = WindField(config, seed=1)
    sizes = np.array([np.linalg.norm(field.get_force(DT, HIGH, ZERO)) for _ in range(240 * 120)])
    assert 0.05 < sizes.max() <= 0.1
    # per gust one second of calm and a quarter of a second of wind on average
    assert np.mean(sizes > 0) == pytest.approx(0.2, abs=0.06)


def test_turbulence_has_the_standard_deviation_of_the_specification():
    # the drag law F = k·|v|·v in turbulence without a mean wind: |F| = k·|v|²
    config = WindConfig("dryden", velocity=(0, 0, 0), turbulence=5.0, drag_area=0.01)
    field = WindField(config)
    squares = []
    for seed in range(4000):
        field.reset(seed)
        squares.append(np.linalg.norm(field.get_force(DT, np.array([0, 0, 3.0]), ZERO)) / (0.5 * 1.225 * 0.01))
    # at 10 feet: σ_w = 0.1·W20 and σ_u = σ_v = σ_w/(0.177 + 0.000823·10)^0.4
    vertical = 0.5
    level = vertical / (0.177 + 0.00823) ** 0.4
    assert np.mean(squares) == pytest.approx(2 * level**2 + vertical**2, rel=0.05)


def test_errors_of_the_field():
    field = WindField(WindConfig("constant"))
    for arguments, text in [
        ((-1.0, HIGH, ZERO), "dt is -1, expected 0 to 1 s"),
        (("a", HIGH, ZERO), "dt is 'a', expected a number"),
        ((None, HIGH, ZERO), "dt is None, expected a number"),
        ((DT, [0, 0], ZERO), "position has the shape (2,), expected (3,)"),
        ((DT, "high", ZERO), "position is 'high', expected 3 numbers"),
        ((DT, HIGH, None), "velocity"),
        ((DT, HIGH, [0, 0, 1e300]), "velocity[2] is 1e+300, expected a number from -1e+09 to 1e+09"),
        ((DT, HIGH, [0, math.nan, 0]), "velocity[1] is NaN"),
    ]:
        with pytest.raises(ValueError) as error:
            field.get_force(*arguments)
        assert str(error.value).startswith(text) and "\n" not in str(error.value)
    for seed in (-1, "a", 1.5, True, 2**64):
        with pytest.raises(ValueError) as error:
            field.reset(seed)
        assert str(error.value) == f"seed is {seed!r}, expected an integer from 0 to 2^64 - 1"
    for config, text in [
        (5, "wind is 5, expected a WindConfig, a dict"),
        ("x", "wind.model: unknown variant `x`, expected one of `none`"),
    ]:
        with pytest.raises(ValueError) as error:
            WindField(config)
        assert str(error.value).startswith(text) and "\n" not in str(error.value)
    with pytest.raises(TypeError):
        WindField(WindConfig(), wind=3)


def test_fields_accept_every_form_of_a_wind():
    forms = [WindConfig("gust", gust_rate=50.0), {"model": WindModel.GUST, "gust_rate": 50.0}]
    forms = [WindField(form, seed=4) for form in forms]
    rows = [[field.get_force(DT, HIGH, ZERO) for _ in range(100)] for field in forms]
    assert np.array_equal(*rows) and np.any(rows)
    assert WindField("gust").config == WindField(WindModel.GUST).config == WindConfig("gust")


@pytest.mark.parametrize("model", ["gust", "dryden", "combined"])
def test_copies_of_a_field_continue_with_its_forces(model):
    field = WindField(WindConfig(model, gust_rate=20.0), env="race", seed=7)
    for _ in range(100):
        field.get_force(DT, HIGH, ZERO)
    clones = [pickle.loads(pickle.dumps(field)), copy.deepcopy(field)]
    rows = [field.get_force(DT, HIGH, ZERO) for _ in range(200)]
    field.reset()
    rows.append(field.get_force(DT, HIGH, ZERO))
    for clone in clones:
        own = [clone.get_force(DT, HIGH, ZERO) for _ in range(200)]
        clone.reset()
        own.append(clone.get_force(DT, HIGH, ZERO))
        assert np.array_equal(own, rows) and np.any(rows)


# environments


def hover(**options):
    from mujoco_drones_gym.envs.hover_aviary import HoverAviary

    return HoverAviary(**options)


def flight(env, seed, steps=60):
    observation, _ = env.reset(seed=seed)
    rows = [observation]
    action = np.full(env.action_space.shape, 0.02)
    for _ in range(steps):
        observation, _, terminated, truncated, _ = env.step(action)
        rows.append(observation)
        if terminated or truncated:
            break
    return np.array(rows)


STRONG = {"gust_force": 0.03, "gust_rate": 3.0, "velocity": (1.5, -2.0, 0.4), "turbulence": 8.0}


@pytest.mark.parametrize("model", [model for model in WindModel if model is not WindModel.NONE])
def test_the_wrapper_and_the_option_give_the_same_flight(model):
    config = WindConfig(model, **STRONG)
    wrapped, option = WindWrapper(hover(), config), hover(wind=config)
    calm = flight(hover(), 3)
    for seed in (3, 4):
        assert np.array_equal(flight(wrapped, seed), flight(option, seed))
    assert np.array_equal(flight(wrapped, 3), flight(WindWrapper(hover(), wind_config=config._to_options()), 3))
    assert not np.array_equal(flight(wrapped, 3), calm)


def test_the_wrapper_composes_with_wrappers_of_gymnasium():
    config = WindConfig("combined", **STRONG)
    plain = flight(WindWrapper(hover(), config), 5, 20)
    inner = gym.wrappers.TimeLimit(WindWrapper(hover(), config), 20)
    outer = WindWrapper(gym.wrappers.RecordEpisodeStatistics(gym.wrappers.TimeLimit(hover(), 20)), config)
    stacked = gym.wrappers.FrameStackObservation(WindWrapper(hover(), config), 2)
    for env in (inner, outer):
        assert np.array_equal(flight(env, 5, 20), plain)
    assert np.array_equal(flight(stacked, 5, 20)[:, -1], plain)


def test_wrappers_pass_the_checker_of_gymnasium_and_their_specs_rebuild_them():
    from gymnasium.utils.env_checker import check_env

    import mujoco_drones_gym  # noqa: F401
    from mujoco_drones_gym.wrappers import CurriculumWrapper, DomainRandomizationWrapper

    for wrapper in (WindWrapper, DomainRandomizationWrapper, CurriculumWrapper):
        with pytest.warns(UserWarning):
            check_env(wrapper(hover()), skip_render_check=True)
        env = wrapper(gym.make("mujoco_drones_gym/Hover-v0"))
        assert isinstance(gym.make(env.spec), wrapper)
    config = WindConfig("combined", **STRONG)
    again = gym.make(WindWrapper(gym.make("mujoco_drones_gym/Hover-v0"), config).spec)
    assert np.array_equal(flight(again, 5, 20), flight(WindWrapper(hover(), config), 5, 20))


def test_every_environment_of_a_vector_environment_has_its_own_wind():
    def make():
        return WindWrapper(hover(), WindConfig("combined", **STRONG))

    env = gym.vector.SyncVectorEnv([make] * 2)
    rows = [env.reset(seed=[3, 4])[0]]
    rows += [env.step(np.full(env.action_space.shape, 0.02))[0] for _ in range(20)]
    for index in range(2):
        assert np.array_equal(np.array(rows)[:, index], flight(make(), 3 + index, 20))


def test_set_wind_changes_the_wind_of_the_next_episodes():
    env = hover()
    calm = flight(env, 1)
    wrapped = WindWrapper(env, WindConfig("constant", velocity=(2.0, 0.0, 0.0)))
    assert flight(wrapped, 1)[-1][0] > calm[-1][0] + 0.01, "downwind"
    env.set_wind(None)
    assert np.array_equal(flight(env, 1), calm)


def test_the_info_of_a_reset_has_the_settings():
    _, info = WindWrapper(hover(), WindConfig("constant")).reset(seed=0)
    assert info["wind_config"]["model"] == "constant" and "time" in info
    _, info = WindWrapper(hover()).reset(seed=0)
    assert info["wind_config"]["model"] == "dryden"


def test_wrapped_environments_keep_their_wind_when_pickled():
    env = WindWrapper(hover(), WindConfig("combined", **STRONG))
    assert np.array_equal(flight(pickle.loads(pickle.dumps(env)), 2), flight(env, 2))


def test_errors_of_the_wrapper():
    with pytest.raises(TypeError, match="WindWrapper got CartPoleEnv, expected an environment of mujoco_drones_gym"):
        WindWrapper(gym.make("CartPole-v1"), WindConfig("gust"))
    with pytest.raises(ValueError, match="wind: unknown field"):
        WindWrapper(hover(), {"speed": 1})
    with pytest.raises(TypeError, match="config and wind_config"):
        WindWrapper(hover(), WindConfig(), wind_config=WindConfig())
