"""Options of the constructors: enums, strings, dicts and config objects, and the errors of wrong ones."""

import math

import numpy as np
import pytest
from airframes import AIRFRAME_WITH_DUTY

import mujoco_drones_gym as mdg
from mujoco_drones_gym.utils.enums import ActionType, DroneModel, ImageType, ObservationType, Physics
from mujoco_drones_gym.wrappers.obstacles import Obstacle, ObstacleConfig, ObstacleType
from mujoco_drones_gym.wrappers.randomization import DomainRandomizationConfig
from mujoco_drones_gym.wrappers.wind import WindConfig, WindModel


def flown(env, steps=24):
    """Returns the states after a fixed flight."""
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    low, high = env.action_space.low.astype(float), env.action_space.high.astype(float)
    middle = (low + high) / 2
    for _ in range(steps):
        if env.step(middle + 0.05 * (high - low) * rng.uniform(-1, 1, middle.shape))[2]:
            break
    return env._env.states()


def test_enums_have_the_names_and_values_of_the_paper():
    assert [m.name for m in DroneModel] == ["CF2X", "CF2P", "RACE"]
    assert [m.name for m in Physics] == ["MJC", "MJC_GND", "MJC_DRAG", "MJC_DW", "MJC_GND_DRAG_DW", "DYN"]
    assert {m.name for m in ActionType} == {"RPM", "ONE_D_RPM", "VEL", "PID", "ATTITUDE", "CTBR", "RAW_RPM", "DUTY"}
    assert {m.name for m in ObservationType} == {"KIN", "RGB", "KIN_RGB", "DEPTH", "SEGMENTATION"}
    assert [m.name for m in ImageType] == ["RGB", "DEP", "SEG"]
    for enum in (DroneModel, Physics, ActionType, ObservationType):
        assert all(member.value == member.name.lower() for member in enum)


@pytest.mark.parametrize(
    ("option", "enum"), [("drone_model", DroneModel), ("physics", Physics), ("act_type", ActionType)]
)
def test_a_value_does_wherever_a_member_does(option, enum):
    others = {"drone_model": AIRFRAME_WITH_DUTY} if enum is ActionType else {}
    for member in enum:
        states = [flown(mdg.HoverAviary(**{option: value}, **others)) for value in (member, member.value)]
        assert (states[0] == states[1]).all()


def test_every_option_has_an_effect():
    start = [[0, 0, 0.5]]
    plain = flown(mdg.HoverAviary(initial_xyzs=start))
    assert (flown(mdg.HoverAviary(initial_xyzs=np.array(start))) == plain).all()
    for options in (
        {"drone_model": "race"},
        {"initial_rpys": [[0, 0, 1]]},
        {"physics": "mjc_drag"},
        {"sim_freq": 480},
        {"ctrl_freq": 24},
        {"wind": {"model": "constant", "velocity": [1, 0, 0]}},
        {"randomization": {"body": {"mass": (0.8, 0.9)}}},
        {"act_type": "ctbr"},
    ):
        assert (flown(mdg.HoverAviary(initial_xyzs=start, **options)) != plain).any(), options
    env = mdg.HoverAviary(episode_seconds=0.5, ctrl_freq=120)
    assert (env.EPISODE_LEN_SEC, env.CTRL_FREQ, env.SIM_FREQ, env.CTRL_TIMESTEP) == (0.5, 120, 240, 1 / 120)
    assert env.metadata["render_fps"] == 120


def test_airframes(tmp_path):
    from mujoco_drones_gym import _native

    airframe, _ = _native.airframe_constants("cf2x")
    heavy = {**airframe, "mass": 0.033}
    env = mdg.HoverAviary(drone_model=heavy)
    assert env.M == 0.033 and env.drone_params(0)["mass"] == 0.033
    path = tmp_path / "heavy.toml"
    lines = [
        f"{key} = {str(value).lower() if isinstance(value, bool) else repr(value)}" for key, value in heavy.items()
    ]
    path.write_text("\n".join(lines))
    assert mdg.HoverAviary(drone_model=path).M == 0.033
    assert mdg.HoverAviary(drone_model=str(path)).M == 0.033


def test_options_of_tasks():
    assert mdg.HoverAviary(target_height=1.5).TARGET_HEIGHT == 1.5
    assert mdg.HoverAviary().TARGET_HEIGHT == 1.0
    env = mdg.MultiHoverAviary(num_drones=3, target_heights=np.array([0.5, 0.6, 0.7]))
    assert env.TARGET_HEIGHTS.tolist() == [0.5, 0.6, 0.7]
    assert mdg.MultiHoverAviary().TARGET_HEIGHTS.tolist() == [0.7, 1.2]
    points = np.array([[0, 0, 1.0], [1, 0, 1.0], [1, 1, 1.0]])
    env = mdg.FlyThroughAviary(waypoints=points)
    assert (points == env.WAYPOINTS).all()
    assert env.reset(seed=1)[0][12:15].tolist() == [0, 0, 1]
    env = mdg.RaceAviary(gates=points, laps=1)
    assert (points == env.GATES).all() and env.NUM_LAPS == 1


def test_target_heights_change_during_an_episode():
    env = mdg.HoverAviary()
    env.reset(seed=1)
    far = env.step(np.zeros(4))[1]
    env.TARGET_HEIGHT = 0.1
    near = env.step(np.zeros(4))[1]
    assert near > 0.4 > far
    for height in (-1.0, math.nan, 5.0, "high", None):
        with pytest.raises(ValueError, match="target_height"):
            env.TARGET_HEIGHT = height
    assert env.TARGET_HEIGHT == 0.1
    assert env.step(np.zeros(4))[1] == near
    env.reset()
    assert env.step(np.zeros(4))[1] > 0.4
    pair = mdg.MultiHoverAviary()
    pair.TARGET_HEIGHTS = [0.5, 1.5]
    assert pair.reset(seed=1)[0][[12, 25]].tolist() == [0.5, 1.5]


def test_starts_change_from_the_next_reset_on():
    env = mdg.HoverAviary(wind={"model": "constant"})
    env.reset(seed=1)
    env.step(np.zeros(4))
    before = env.pos
    env.INIT_XYZS = [[0.2, 0.1, 0.7]]
    assert (env.pos == before).all()
    env.step(np.zeros(4))
    obs, _ = env.reset(seed=1)
    assert obs[:3] == pytest.approx([0.2, 0.1, 0.7])
    assert (env.INIT_XYZS == [[0.2, 0.1, 0.7]]).all()
    same = mdg.HoverAviary(initial_xyzs=[[0.2, 0.1, 0.7]], wind={"model": "constant"})
    same.reset(seed=1)
    assert (env.step(np.zeros(4))[0] == same.step(np.zeros(4))[0]).all()
    env.INIT_XYZS[0][2] = 0.8
    assert env.reset(seed=1)[0][2] == pytest.approx(0.8)
    state = env._env.states()
    for wrong in ([[0, 0, -1]], [[0, 0]], [[0, 0, 1], [0]], "here", [[0, 0, math.nan]]):
        env.INIT_XYZS = wrong
        with pytest.raises(ValueError, match="initial_xyzs"):
            env.reset(seed=1)
        assert (env._env.states() == state).all()
    env.INIT_XYZS = np.array([[0, 0, 1]])
    env.INIT_RPYS = [[0, 0, 1]]
    assert env.reset(seed=1)[0][5] == pytest.approx(1.0)


@pytest.mark.parametrize("obstacles", [True, ObstacleConfig(ObstacleType.FOREST), {"kind": "forest"}, "forest"])
def test_kinds_of_obstacles(obstacles):
    env = mdg.HoverAviary(obstacles=obstacles)
    assert len(env._env.obstacles()) == 20
    assert not mdg.HoverAviary(obstacles=False)._env.obstacles()


def test_a_list_of_obstacles():
    wall = Obstacle("box", [0.5, 0, 0.5], [0.1, 1, 0.5])
    env = mdg.HoverAviary(obstacles=[wall], initial_xyzs=[[0.2, 0, 0.5]], act_type="vel")
    env.reset(seed=1)
    terminated = False
    while not terminated:
        _, _, terminated, _, info = env.step([1, 0, 0, 0])
    assert info["end"] == "obstacle_contact"


@pytest.mark.parametrize(
    "wind", [WindConfig(WindModel.CONSTANT, (1, 0, 0)), {"model": "constant", "velocity": (1, 0, 0)}]
)
def test_wind(wind):
    env, later = mdg.HoverAviary(wind=wind), mdg.HoverAviary()
    later.set_wind(wind)
    assert (flown(env) == flown(later)).all()
    later.set_wind(None)
    assert (flown(later) == flown(mdg.HoverAviary())).all()


def test_randomization():
    assert mdg.HoverAviary().sampled_params() is None
    masses = set()
    for value in (True, DomainRandomizationConfig(), {"body": {"mass": (0.8, 1.2)}}):
        env = mdg.HoverAviary(randomization=value)
        for _ in range(5):
            env.reset(seed=None)
            masses.add(env.M)
            assert 0.8 * 0.027 <= env.M <= 1.2 * 0.027
            # a drawn mass is that of the simulation, not of the constants
            assert env.HOVER_RPM == mdg.HoverAviary().HOVER_RPM
    assert len(masses) > 5
    env.set_randomization(None)
    env.reset()
    assert env.M == 0.027


def test_num_drones_of_hover():
    assert mdg.HoverAviary(num_drones=1).NUM_DRONES == 1
    with pytest.raises(ValueError, match="num_drones is 2, expected 1"):
        mdg.HoverAviary(num_drones=2)


WRONG = [
    ("drone_model", "cf3x", "cf2x"),
    ("drone_model", 3, "drone_model"),
    ("num_drones", 0, "1"),
    ("num_drones", -1, "whole"),
    ("num_drones", 1.5, "whole"),
    ("num_drones", True, "whole"),
    ("num_drones", 1000, "256"),
    ("physics", "mjc_grnd", "mjc_gnd"),
    ("physics", None, None),
    ("sim_freq", 0, "sim_freq"),
    ("sim_freq", 241, "ctrl_freq"),
    ("ctrl_freq", 7, "multiple"),
    ("ctrl_freq", -1, "whole"),
    ("initial_xyzs", [[0, 0]], "(n, 3)"),
    ("initial_xyzs", [[0, 0, math.nan]], "finite"),
    ("initial_xyzs", [[0, 0, 1], [1, 0, 1]], "1"),
    ("initial_xyzs", "here", "numbers"),
    ("initial_xyzs", [[0, 0, -1]], "above the floor"),
    ("initial_rpys", [[0, 0]], "(n, 3)"),
    ("obs_type", "kinematic", "kin"),
    ("obs_type", 3, "kin"),
    ("act_type", 3, "rpm"),
    ("drone_model", "nothing.toml", "No such file"),
    ("obstacles", {"kind": "forest", "count": 1000}, "fit"),
    ("act_type", "thrust", "rpm"),
    ("obstacles", 3, "ObstacleConfig"),
    ("obstacles", {"kind": "desert"}, "forest"),
    ("obstacles", {"number": 3}, "count"),
    ("neighbourhood_radius", -1.0, "positive"),
    ("neighbourhood_radius", "far", "number"),
    ("episode_seconds", 0, "positive"),
    ("episode_seconds", math.inf, "positive"),
    ("wind", {"model": "storm"}, "gust"),
    ("wind", {"model": "constant", "velocity": [1, 2]}, "3"),
    ("wind", 3, "WindConfig"),
    ("randomization", {"body": {"mass": (1.2, 0.8)}}, "mass"),
    ("randomization", {"bodies": {}}, "body"),
    ("randomization", 3, "DomainRandomizationConfig"),
    ("engine", "bullet", "hybrid"),
    ("stream", -1, "whole"),
    ("render_mode", "hologram", "rgb_array"),
    ("width", 0, "pixels"),
    ("height", 1.5, "pixels"),
    ("output_folder", 3, "path"),
    ("target_height", -1.0, "above the floor"),
    ("target_height", "high", "number"),
]


@pytest.mark.parametrize(("option", "value", "possible"), WRONG)
def test_a_wrong_value_is_one_line_with_the_option_and_what_is_possible(option, value, possible):
    if possible is None:
        mdg.HoverAviary(**{option: value})
        return
    with pytest.raises(ValueError) as error:
        mdg.HoverAviary(**{option: value})
    message = str(error.value)
    assert "\n" not in message and len(message) < 300
    assert option.removesuffix("s").removesuffix("ation") in message, message
    assert possible in message, message


@pytest.mark.parametrize("option", ["target_heights", "drones", "gates", "freq", "record"])
def test_an_unknown_option_is_a_type_error(option):
    with pytest.raises(TypeError, match=option):
        mdg.HoverAviary(**{option: 1})


def test_native_options_refuse_unknown_options_and_options_of_other_tasks():
    from mujoco_drones_gym import _native

    with pytest.raises(TypeError, match=r"no option `sim_freqs`.*did you mean `sim_freq`"):
        _native.Env("hover", {"sim_freqs": 3})
    with pytest.raises(TypeError, match="the task `hover` has no option `laps`, expected target_height"):
        _native.Env("hover", {"laps": 3})
    with pytest.raises(ValueError, match="no task `hovr`"):
        _native.Env("hovr", {})


def test_options_of_an_environment_of_one_agent_are_refused_by_others(tmp_path):
    for options in ({"gui": True}, {"vision_attributes": True}, {"output_folder": tmp_path}):
        with pytest.raises(ValueError, match=next(iter(options))):
            mdg.VectorAviary("hover", 2, **options)
    mdg.VectorAviary("hover", 2, gui=False, vision_attributes=False, output_folder=None).close()


def test_output_folder(tmp_path):
    from mujoco_drones_gym.utils.logger import read_flight

    folder = tmp_path / "flights"
    env = mdg.MultiHoverAviary(output_folder=folder, episode_seconds=0.5)
    for _ in range(2):
        env.reset(seed=1)
        while not env.step(np.zeros(8))[3]:
            pass
    names = sorted(path.name for path in folder.iterdir())
    assert names == [f"episode_{episode:04}_drone{drone}.csv" for episode in range(2) for drone in range(2)]
    lines = (folder / names[1]).read_text().splitlines()
    last = [line for line in lines if line][-1].split(",")
    assert float(last[0]) == 0.5 and float(last[1]) == env.pos[1, 0]
    assert read_flight is not None
    (tmp_path / "file").write_text("")
    with pytest.raises((ValueError, OSError), match="output_folder"):
        mdg.HoverAviary(output_folder=tmp_path / "file")


def test_track():
    env = mdg.RaceAviary(track="oval")
    observation, _ = env.reset(seed=1)
    # 21 numbers, and the normals of two gates
    assert observation.shape == env.observation_space.shape == (27,)
    assert mdg.VectorAviary("race", 2, track="stacked").single_observation_space.shape == (27,)
    assert mdg.RaceAviary().observation_space.shape == (21,)
    with pytest.raises(ValueError, match="did you mean `oval`"):
        mdg.RaceAviary(track="ovale")
    with pytest.raises(ValueError, match=r"nowhere\.toml"):
        mdg.RaceAviary(track="nowhere.toml")
    with pytest.raises(ValueError, match=r"track is 3, expected the name of a track, a TOML file, or a dict"):
        mdg.RaceAviary(track=3)
