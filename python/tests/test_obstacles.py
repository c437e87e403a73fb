"""Obstacles: settings, layouts, and environments among them."""

import pickle

import numpy as np
import pytest

from mujoco_drones_gym import HoverAviary, _native
from mujoco_drones_gym.wrappers import Obstacle, ObstacleConfig, ObstacleType, generate_obstacles, obstacles_to_xml
from mujoco_drones_gym.wrappers.obstacles import obstacle_options

RANDOM = [ObstacleType.FOREST, ObstacleType.URBAN, ObstacleType.INDOOR, ObstacleType.RANDOM, ObstacleType.GATES]


def reach(obstacle):
    """Radius of the bounding sphere."""
    size = obstacle.size
    if obstacle.geom_type in ("box", "cylinder"):
        return np.linalg.norm(size)
    return size.sum()


def test_members_and_defaults():
    assert [kind.value for kind in RANDOM] == ["forest", "urban", "indoor", "random", "gates"]
    config = ObstacleConfig("gates")
    assert config.obstacle_type is ObstacleType.GATES and config.num_obstacles == 4
    assert ObstacleConfig().num_obstacles == 20
    file = _native.complete_options("obstacles", {})
    assert ObstacleConfig()._to_options() == {**file, "arena": [6.0, 6.0, 2.0]}


@pytest.mark.parametrize("name", ["kind", "obstacle_type"])
@pytest.mark.parametrize("value", [7, "forrest", [1, 2]])
def test_an_unknown_kind_is_an_error_that_lists_all_kinds(name, value):
    kinds = "none, forest, urban, indoor, random, gates, custom"
    option = "obstacle_type" if name == "obstacle_type" else "obstacles.kind"
    with pytest.raises(ValueError) as error:
        HoverAviary(obstacles={name: value})
    assert str(error.value) == f"{option} is {value!r}, expected one of {kinds}"


@pytest.mark.parametrize("kind", RANDOM)
def test_twenty_obstacles_of_any_kind_fit_into_the_default_arena(kind):
    for seed in range(20):
        obstacles = generate_obstacles(ObstacleConfig(kind, 20, seed=seed))
        assert len(obstacles) >= 20
        assert np.abs([obstacle.position[:2] for obstacle in obstacles]).max() <= 3.1


def test_the_arena_has_half_lengths_and_a_height():
    config = ObstacleConfig(ObstacleType.FOREST, 20, (3, 3, 2))
    assert config._to_options()["arena"] == [6.0, 6.0, 2.0]
    assert ObstacleConfig(arena=(6.0, 4.0, 2.0)).arena_size == (3.0, 2.0, 2.0)
    positions = np.array([obstacle.position for obstacle in generate_obstacles(config)])
    assert len(positions) == 20 and np.abs(positions[:, :2]).max() <= 3.0 and np.abs(positions[:, :2]).max() > 1.5


def test_keys_of_the_file_and_names_of_the_paper_are_equal():
    paper = ObstacleConfig(
        obstacle_type="urban", num_obstacles=5, arena_size=(2, 2, 3), min_spacing=0.4, safe_zone_radius=0.5, seed=3
    )
    keys = ObstacleConfig(kind="urban", count=5, arena=(4, 4, 3), spacing=0.4, safe_zone=0.5, seed=3)
    assert paper == keys and (paper.count, paper.kind) == (5, ObstacleType.URBAN)
    file = {"kind": "urban", "count": 5, "arena": (4, 4, 3), "spacing": 0.4, "safe_zone": 0.5, "seed": 3}
    names = {"obstacle_type": ObstacleType.URBAN, "num_obstacles": 5, "arena_size": (2, 2, 3), "min_spacing": 0.4}
    assert obstacle_options(file) == paper._to_options()
    assert obstacle_options({**names, "safe_zone_radius": 0.5, "seed": 3}) == paper._to_options()
    assert pickle.loads(pickle.dumps(paper)) == paper


@pytest.mark.parametrize("kind", RANDOM)
def test_layouts_repeat_with_the_seed_and_leave_the_safe_zones_free(kind):
    center = (0.9, -0.8, 0.5)
    met, small = False, (1.5, 1.5, 2.0)
    for seed in range(10):
        free = ObstacleConfig(kind, 3, small, safe_zone_radius=0.5, safe_zone_centers=[center], seed=seed)
        obstacles = generate_obstacles(free)
        assert obstacles == generate_obstacles(free)
        assert obstacles != generate_obstacles(ObstacleConfig(kind, 3, small, seed=seed + 1))
        for obstacle in obstacles:
            assert np.linalg.norm(obstacle.position - center) + reach(obstacle) >= 0.5
            if obstacle.geom_type == "sphere":
                assert np.linalg.norm(obstacle.position - center) - obstacle.size[0] >= 0.5
        anywhere = generate_obstacles(ObstacleConfig(kind, 3, small, safe_zone_radius=0.5, seed=seed))
        met |= anywhere != obstacles
    assert met, "no layout needed the zone"


def test_kinds_have_their_shapes():
    shapes = {kind: {obstacle.geom_type for obstacle in generate_obstacles(ObstacleConfig(kind))} for kind in RANDOM}
    assert shapes[ObstacleType.FOREST] == {"cylinder"} and shapes[ObstacleType.URBAN] == {"box"}
    assert shapes[ObstacleType.RANDOM] == {"box", "sphere", "cylinder", "capsule"}
    assert len(generate_obstacles(ObstacleConfig("gates"))) == 16, "four bars each"
    trunk = generate_obstacles(ObstacleConfig("forest"))[0]
    assert trunk.position[2] == pytest.approx(trunk.size[1]), "it stands on the floor"
    assert trunk.rgba.shape == (4,) and trunk.euler.shape == (3,)


def test_no_obstacles_and_lists_of_obstacles():
    assert generate_obstacles(ObstacleConfig(ObstacleType.NONE)) == []
    assert obstacle_options(ObstacleConfig("none")) is None
    assert obstacle_options(False) is None and obstacle_options(None) is None
    assert obstacle_options(True) == obstacle_options(ObstacleConfig()) == obstacle_options("forest")
    box = Obstacle("box", [1, 0, 0.5], [0.1, 0.2, 0.5], euler=[0, 0, 0.3])
    ball = Obstacle("sphere", np.array([0, 1, 1]), 0.2, rgba=(1, 0, 0, 1))
    custom = ObstacleConfig(ObstacleType.CUSTOM, custom_obstacles=[box, ball])
    assert generate_obstacles(custom) == [box, ball]
    assert obstacle_options([box, ball])["custom"] == custom._to_options()["custom"]


def test_mjcf_bodies_have_the_pose_of_the_obstacle():
    box = Obstacle("box", [1, 0, 0.5], [0.1, 0.2, 0.5], euler=[0, 0, np.pi / 2])
    text = obstacles_to_xml([box, Obstacle("sphere", [0, 0, 1], [0.25])])
    lines = text.splitlines()
    assert len(lines) == 2 and lines[0].startswith(
        '<body name="obstacle_0" pos="1 0 0.5"><geom type="box" size="0.1 0.2'
    )
    quat = [float(x) for x in lines[0].split('quat="')[1].split('"')[0].split()]
    assert quat == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    assert obstacles_to_xml([]) == ""


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (
            {"obstacle_type": "wood"},
            "obstacle_type is 'wood', expected one of none, forest, urban, indoor, random, gates, custom",
        ),
        ({"num_obstacles": -1}, "num_obstacles is -1, expected a whole number, zero or positive"),
        ({"num_obstacles": 3000}, "num_obstacles is 3000, expected 0 to 2000"),
        (
            {"arena_size": (0.1, 3, 2)},
            "arena_size is (0.1, 3, 2): a whole side is 0.2 m, expected sides of 0.5 to 1000 m",
        ),
        ({"obstacle_type": 5}, "obstacle_type is 5, expected one of none, forest, urban, indoor"),
        ({"custom_obstacles": 5}, "custom_obstacles is 5, expected a list of Obstacle"),
        ({"safe_zone_centers": "here"}, "safe_zone_centers is 'here', expected points (n, 3)"),
        ({"arena_size": "abc"}, "arena_size is 'abc', expected three lengths in m"),
        ({"arena_size": 3}, "arena_size is 3, expected three lengths in m"),
        ({"safe_zone_radius": -0.5}, "safe_zone_radius is -0.5, expected 0 to 1000 m"),
        ({"safe_zone_centers": [(0, 0)]}, "safe_zone_centers"),
        ({"min_spacing": "far"}, 'min_spacing is "far", expected a number'),
        ({"seed": -3}, "seed is -3, expected a whole number"),
        ({"custom_obstacles": [Obstacle("sphere", [0, 0, 0], [1])]}, "obstacle_type is forest"),
    ],
)
def test_bad_values_are_errors_of_one_line(settings, text):
    with pytest.raises(ValueError) as error:
        ObstacleConfig(**settings)
    assert str(error.value).startswith(text) and "\n" not in str(error.value)


def test_other_errors():
    with pytest.raises(TypeError, match="trees"):
        ObstacleConfig(trees=3)
    with pytest.raises(ValueError, match=r"obstacles: unknown field `cuont`.*did you mean `count`"):
        obstacle_options({"cuont": 3})
    with pytest.raises(ValueError, match="of 300 obstacles fit into"):
        generate_obstacles(ObstacleConfig(num_obstacles=300, arena_size=(0.5, 0.5, 1)))
    with pytest.raises(ValueError, match="obstacles is 7, expected True, False, an ObstacleConfig"):
        obstacle_options(7)
    with pytest.raises(ValueError, match="position of an obstacle has 2 numbers, expected 3"):
        Obstacle("box", [0, 0], [1, 1, 1])
    with pytest.raises(ValueError, match="size has 1 number, expected 3 for a box"):
        Obstacle("box", [0, 0, 0], [1])
    shapes = "geom_type: unknown variant `cone`, expected one of `box`, `sphere`, `cylinder`, `capsule`"
    with pytest.raises(ValueError, match=shapes):
        Obstacle("cone", [0, 0, 0], [1])
    with pytest.raises(ValueError, match="geom_type: unknown variant `3`, expected one of `box`"):
        Obstacle(3, [0, 0, 0], [1])
    with pytest.raises(ValueError, match="size of an obstacle is 'big', expected numbers"):
        Obstacle("box", [0, 0, 0], "big")
    with pytest.raises(ValueError, match="obstacles is 5, expected True, False, an ObstacleConfig"):
        generate_obstacles(5)
    with pytest.raises(ValueError, match="num_obstacles is -1, expected a whole number"):
        obstacle_options({"num_obstacles": -1})


def test_the_list_of_custom_obstacles_wins_over_the_number():
    ball = Obstacle("sphere", [0, 1, 1], 0.2)
    config = ObstacleConfig(ObstacleType.CUSTOM, num_obstacles=5, custom_obstacles=[ball])
    assert generate_obstacles(config) == [ball] and config.num_obstacles == 1
    assert generate_obstacles({"kind": "custom", "count": 5, "custom": [ball]}) == [ball]


# environments


def hover(**options):
    from mujoco_drones_gym.envs.hover_aviary import HoverAviary

    return HoverAviary(**options)


def test_drones_collide_with_obstacles():
    roof = Obstacle("box", [0, 0, 0.6], [0.5, 0.5, 0.05])
    ends = {}
    for name, obstacles in [("free", False), ("roof", [roof]), ("far", [Obstacle("sphere", [3, 3, 1], 0.2)])]:
        env = hover(obstacles=obstacles)
        env.reset(seed=0)
        for _ in range(480):
            *_, terminated, truncated, info = env.step(np.full(env.action_space.shape, 0.3))
            if terminated or truncated:
                break
        ends[name] = (info["end"], round(info["time"], 3))
    assert ends["roof"][0] == "obstacle_contact" and ends["free"][0] != "obstacle_contact"
    assert ends["far"] == ends["free"] and ends["roof"][1] < ends["free"][1]


def test_environments_accept_every_form():
    for obstacles in (True, "gates", ObstacleConfig("random", 5, seed=2), {"kind": "urban", "count": 3}):
        env = hover(obstacles=obstacles)
        observation, _ = env.reset(seed=1)
        assert env.observation_space.contains(observation)
