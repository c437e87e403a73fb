"""Options of the constructors: enums, strings, dicts and config objects, and the errors of wrong ones."""

import math
import subprocess
import sys

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
    images = {"RGB", "KIN_RGB", "DEPTH", "SEGMENTATION"}
    assert {m.name for m in ObservationType} - images == {"KIN", "KIN_ADJACENCY", "KIN_OBSTACLE", "KIN_RANGES"}
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
    flights = read_flight(folder, episode=1)
    assert len(flights) == 2
    for drone, flight in enumerate(flights):
        assert flight["t"][-1] == 0.5 and len(flight["t"]) == 25
        np.testing.assert_array_equal(flight["state"][-1], env._getDroneStateVector(drone))
        (alone,) = read_flight(folder / f"episode_0001_drone{drone}.csv")
        assert all(np.array_equal(alone[name], flight[name], equal_nan=True) for name in flight)
    for episode, expected in [(None, "one from 0 to 1"), (2, "one from 0 to 1"), ("1", "one from 0 to 1")]:
        with pytest.raises(ValueError, match=f"^episode is {episode!r}, expected {expected}"):
            read_flight(folder, episode)
    with pytest.raises(ValueError, match=r"^episode is 0, expected None for a file"):
        read_flight(folder / names[0], 0)
    (tmp_path / "file").write_text("")
    with pytest.raises((ValueError, OSError), match="output_folder"):
        mdg.HoverAviary(output_folder=tmp_path / "file")


LIMITED = """
import resource
import sys
import numpy as np
import mujoco_drones_gym as mdg

env = mdg.HoverAviary(output_folder=sys.argv[1], episode_seconds=100.0)
env.reset(seed=1)
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 17, resource.RLIM_INFINITY))
try:
    while True:
        env.step(np.zeros(4))
except OSError as error:
    print(type(error).__name__, error)
resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
env.reset(seed=1)
env.step(np.zeros(4))
"""


def test_a_log_that_cannot_be_written_is_an_os_error(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, tmp_path / "flights"], capture_output=True, text=True, check=True
    )
    (line,) = done.stdout.splitlines()
    assert line.startswith("OSError output_folder: ") and "episode_0000_drone0.csv" in line
    env = mdg.HoverAviary(output_folder=tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with pytest.raises(FileNotFoundError, match=r"^output_folder: .*gone/episode_0000_drone0\.csv: ") as error:
        env.reset(seed=1)
    assert "\n" not in str(error.value)


def test_close_ends_the_files_of_an_unfinished_episode(tmp_path):
    from mujoco_drones_gym.utils.logger import read_flight

    env = mdg.HoverAviary(output_folder=tmp_path)
    env.reset(seed=1)
    for _ in range(3):
        env.step(np.zeros(4))
    path = tmp_path / "episode_0000_drone0.csv"
    assert path.read_text().endswith("\n\n"), "empty lines until the file ends"
    env.close()
    assert len(path.read_text().splitlines()) == 5
    assert len(read_flight(tmp_path, 0)[0]["t"]) == 4
    env.step(np.zeros(4))
    env.reset()
    env.close()
    assert len(read_flight(tmp_path, 0)[0]["t"]) == 4 and len(read_flight(tmp_path, 1)[0]["t"]) == 1


def test_files_that_cannot_be_read_are_os_errors():
    from mujoco_drones_gym.wrappers import WindField

    for make in (
        lambda: mdg.HoverAviary(drone_model="nothing.toml"),
        lambda: mdg.VectorAviary("hover", 2, drone_model="nothing.toml"),
        lambda: mdg.MultiAgentAviary(drone_model="nothing.toml"),
        lambda: mdg.PIDControl("nothing.toml"),
        lambda: WindField(env="nothing.toml"),
    ):
        with pytest.raises(FileNotFoundError, match=r"^drone_model: nothing\.toml: No such file"):
            make()
    with pytest.raises(FileNotFoundError, match=r"^track: nowhere\.toml: No such file"):
        mdg.RaceAviary(track="nowhere.toml")


def test_adjacency_and_ranges_follow_the_numbers_of_the_task():
    plain = mdg.MultiHoverAviary(num_drones=3)
    obs, _ = plain.reset(seed=1)
    options = {"num_drones": 3, "neighbourhood_radius": 1.5}
    wall = [mdg.wrappers.Obstacle("box", [-2.0, 0, 0.5], [0.1, 5, 5])]
    adjacent = mdg.MultiHoverAviary(obs_type=mdg.ObservationType.KIN_ADJACENCY, **options)
    seen, _ = adjacent.reset(seed=1)
    np.testing.assert_array_equal(seen, [*obs, *(adjacent._getAdjacencyMatrix() - np.identity(3)).reshape(-1)])
    assert seen[len(obs) :].sum() == 4 and adjacent.observation_space.contains(seen)
    near = mdg.MultiHoverAviary(obs_type=mdg.ObservationType.KIN_OBSTACLE, obstacles=wall, **options)
    seen, _ = near.reset(seed=1)
    np.testing.assert_allclose(seen[len(obs) :], near.pos[:, 0] + 1.9, atol=1e-6)
    ranging = mdg.MultiHoverAviary(obs_type="kin_ranges", obstacles=wall, **options)
    seen, _ = ranging.reset(seed=1)
    ranges = seen[len(obs) :].reshape(3, 10)
    assert ranging.OBS_TYPE is mdg.ObservationType.KIN_RANGES
    # drones stand at x = 0, 1 and 2, and the wall is behind them
    np.testing.assert_allclose(ranges[0].min(), ranging.pos[0, 2], atol=1e-6)
    assert np.isclose(ranges[0], 1.9, atol=1e-6).any()
    batch = mdg.VectorAviary("multi_hover", 2, obs_type="kin_ranges", obstacles=wall, **options)
    np.testing.assert_array_equal(batch.reset(seed=1)[0][0], seen)


def test_gates_are_those_of_the_moment():
    env = mdg.RaceAviary()
    assert env.gates.shape == (6, 4) and env.gates.dtype == np.float64
    np.testing.assert_array_equal(env.gates[:, :3], env.GATES)
    # from the last gate to the second one
    np.testing.assert_allclose(env.gates[0, 3], np.arctan2(1.0, 2.0))
    track = {
        "laps": 1,
        "solid": True,
        "gates": [{"position": [1.0, 0.0, 1.0], "yaw": 0.0}, {"position": [3.0, 1.0, 1.2], "yaw": 0.5}],
        "randomization": {"position": 0.2, "yaw": 0.1},
        "motion": {"amplitude": 0.1, "period": 2.0},
    }
    env = mdg.RaceAviary(track=track)
    env.reset(seed=1)
    first = env.gates
    np.testing.assert_allclose(first[0, :3], env._computeObs()[12:15], atol=1e-6)
    assert (np.abs(first[:, :3] - env.GATES) <= 0.3).all() and (first[:, :3] != env.GATES).any()
    for _ in range(12):
        env.step(np.full(4, 0.1))
    later = env.gates
    assert (later[:, :2] != first[:, :2]).any() and (later[:, 3] == first[:, 3]).all()
    env.reset(seed=2)
    assert (env.gates[:, 3] != first[:, 3]).all()
    assert len(env.obstacles) == 8, "four bars per gate"


def test_obstacles_are_those_of_the_moment():
    wall = Obstacle("box", [2.0, 0.0, 0.5], [0.1, 1.0, 0.5], euler=[0.0, 0.0, 0.5])
    env = mdg.HoverAviary(obstacles=[wall])
    assert env.obstacles == [wall] and mdg.HoverAviary().obstacles == []
    env = mdg.HoverAviary(obstacles=ObstacleConfig(num_obstacles=5, new_layout=True))
    layouts = []
    for seed in (1, 2):
        env.reset(seed=seed)
        layouts.append(env.obstacles)
        assert len(layouts[-1]) == 5 and all(isinstance(obstacle, Obstacle) for obstacle in layouts[-1])
    assert layouts[0] != layouts[1]
    again = mdg.HoverAviary(obstacles=layouts[1])
    again.reset(seed=5)
    assert again.obstacles == layouts[1]


def test_track():
    env = mdg.RaceAviary(track="oval")
    observation, _ = env.reset(seed=1)
    # 21 numbers, and the normals of two gates
    assert observation.shape == env.observation_space.shape == (27,)
    assert mdg.VectorAviary("race", 2, track="stacked").single_observation_space.shape == (27,)
    assert mdg.RaceAviary().observation_space.shape == (21,)
    with pytest.raises(ValueError, match="did you mean `oval`"):
        mdg.RaceAviary(track="ovale")
    with pytest.raises(ValueError, match=r"track is 3, expected the name of a track, a TOML file, or a dict"):
        mdg.RaceAviary(track=3)


class Within:
    """An object whose value is one of its own kind, without an end."""

    @property
    def value(self):
        return Within()

    def __repr__(self):
        return "within"


def test_values_that_contain_themselves():
    from mujoco_drones_gym import _native

    own = {}
    own["a"] = own
    endless = []
    endless.append(endless)
    for name in ("drone_model", "track"):
        for value in (own, {"a": endless}, {"a": Within()}):
            with pytest.raises(ValueError, match=f"^{name} has more than 16 levels of lists and dicts"):
                _native.Env("race", {name: value})
    with pytest.raises(ValueError, match=r"^drone_model .*16 levels"):
        mdg.HoverAviary(drone_model=own)
    with pytest.raises(ValueError, match=r"^drone_model .*16 levels"):
        mdg.PIDControl(drone_model=own)
    with pytest.raises(ValueError, match=r"^wind .*16 levels"):
        _native.complete_options("wind", {"model": "constant", "velocity": endless})
