"""Obstacles and their generator."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from mujoco_drones_gym import _native
from mujoco_drones_gym._config import Alias, accept_aliases, complete, short, translated

__all__ = ["Obstacle", "ObstacleConfig", "ObstacleType", "generate_obstacles", "obstacles_to_xml"]


class ObstacleType(Enum):
    """Kinds of generated obstacles."""

    NONE = "none"
    """No obstacles."""
    FOREST = "forest"
    """Tree trunks."""
    URBAN = "urban"
    """Buildings of different heights."""
    INDOOR = "indoor"
    """Room with walls around the arena, furniture, and partitions with doorways."""
    RANDOM = "random"
    """Boxes, spheres, cylinders and capsules in the air."""
    GATES = "gates"
    """Square gates of four bars each."""
    CUSTOM = "custom"
    """List of the user's obstacles."""


_OBSTACLE_NAMES = {"obstacles.custom.shape": "geom_type"}


def _array(values: Any, name: str, counts: Sequence[int]) -> np.ndarray:
    try:
        array = np.array(values, dtype=np.float64).reshape(-1)
    except (TypeError, ValueError):
        raise ValueError(f"{name} of an obstacle is {short(values)}, expected numbers") from None
    if array.size not in counts:
        expected = " or ".join(str(count) for count in counts)
        raise ValueError(f"{name} of an obstacle has {array.size} numbers, expected {expected}")
    return array


_PLAIN = {"shape": "sphere", "size": [1.0], "position": [0.0, 0.0, 0.0]}
_RGBA = _native.complete_options("obstacles", {"kind": "custom", "custom": [_PLAIN]})["custom"][0]["rgba"]


@dataclass(eq=False)
class Obstacle:
    """Static object with which drones collide.

    Raises:
        ValueError: for an unknown shape or a wrong number of values.
    """

    geom_type: str
    """Shape: `box`, `sphere`, `cylinder` or `capsule`."""
    position: np.ndarray
    """Centre, world frame, m, shape (3,)."""
    size: np.ndarray
    """Half sizes of a box (3,), radius of a sphere (1,), or radius and half height (2,), m."""
    rgba: np.ndarray = field(default_factory=lambda: np.array(_RGBA))
    """Red, green, blue and alpha, 0 to 1, shape (4,)."""
    euler: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """Roll, pitch and yaw, rad, shape (3,)."""

    def __post_init__(self):
        self.geom_type = getattr(self.geom_type, "value", self.geom_type)
        self.position = _array(self.position, "position", [3])
        self.size = _array(self.size, "size", [1, 2, 3])
        self.rgba = _array(self.rgba, "rgba", [4])
        self.euler = _array(self.euler, "euler", [3])
        complete("obstacles", {"kind": "custom", "custom": [self._to_options()]}, _OBSTACLE_NAMES)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Obstacle):
            return NotImplemented
        return self._to_options() == other._to_options()

    __hash__ = None

    def _to_options(self) -> dict[str, Any]:
        """Returns the obstacle as an entry of `[[obstacles.custom]]`."""
        return {
            "shape": self.geom_type,
            "size": self.size.tolist(),
            "position": self.position.tolist(),
            "euler": self.euler.tolist(),
            "rgba": self.rgba.tolist(),
        }

    @classmethod
    def _from_options(cls, options: dict[str, Any]) -> Obstacle:
        return cls(options["shape"], options["position"], options["size"], options["rgba"], options["euler"])


def _halves(arena: Sequence[float]) -> tuple[float, ...]:
    length, width, height = arena
    return (length / 2, width / 2, height)


def _lengths(arena_size: Sequence[float]) -> list[float]:
    length, width, height = map(float, arena_size)
    return [2 * length, 2 * width, height]


ALIASES = {
    "kind": Alias("obstacle_type"),
    "count": Alias("num_obstacles"),
    "arena": Alias("arena_size", _halves, _lengths),
    "spacing": Alias("min_spacing"),
    "safe_zone": Alias("safe_zone_radius"),
    "custom": Alias("custom_obstacles"),
}

# names of the options in configuration files
_NAMES = {
    "obstacles.kind": "obstacle_type",
    "obstacles.count": "num_obstacles",
    "obstacles.arena": "arena_size",
    "obstacles.spacing": "min_spacing",
    "obstacles.safe_zone": "safe_zone_radius",
    "obstacles.safe_zone_centers": "safe_zone_centers",
    "obstacles.custom": "custom_obstacles",
    "obstacles.seed": "seed",
}
_DEFAULTS = _native.complete_options("obstacles", {})


@accept_aliases(ALIASES)
@dataclass
class ObstacleConfig:
    """Settings of obstacles that are placed at random around the origin.

    The keys of the section `[obstacles]` of a configuration file are accepted as well: `kind`, `count`, `arena` (whole
    lengths), `spacing`, `safe_zone`, `custom`.

    Raises:
        ValueError: for a setting out of range.
    """

    obstacle_type: ObstacleType = ObstacleType.FOREST
    """Kind of obstacles, or its name."""
    num_obstacles: int | None = None
    """Number of trees, buildings, pieces of furniture, floating objects or gates; None for 20 trees, 4 gates and 8 of
    the other kinds. Of the kind `CUSTOM`, it is the length of the list."""
    arena_size: tuple[float, float, float] = (3.0, 3.0, 2.0)
    """Half lengths along x and y, and height of the arena, m. It is centred on the origin and stands on the floor. The
    default is the paper's, four times as large as that of a configuration file."""
    safe_zone_radius: float = _DEFAULTS["safe_zone"]
    """Smallest distance from the centre of every drone at its start to the surface of an obstacle, m."""
    safe_zone_centers: Sequence[Sequence[float]] | np.ndarray | None = None
    """Centres of further spheres that stay free of obstacles, world frame, m, shape (n, 3)."""
    seed: int | None = None
    """Seed of the layout; None for 0."""
    min_spacing: float = _DEFAULTS["spacing"]
    """Smallest distance between two obstacles, m."""
    new_layout: bool = _DEFAULTS["new_layout"]
    """True to generate a new layout for every episode."""
    custom_obstacles: list[Obstacle] = field(default_factory=list)
    """Obstacles of the kind `CUSTOM`."""

    def __post_init__(self):
        options = self._to_options()
        self.obstacle_type = ObstacleType.NONE if options is None else ObstacleType(options["kind"])
        if options is not None and (self.num_obstacles is None or self.obstacle_type is ObstacleType.CUSTOM):
            is_custom = self.obstacle_type is ObstacleType.CUSTOM
            self.num_obstacles = len(options["custom"]) if is_custom else options["count"]
        self.arena_size = tuple(float(side) for side in self.arena_size)

    def _to_options(self) -> dict[str, Any] | None:
        """Returns the settings as the keys of the section `[obstacles]`; None for no obstacles."""
        kind = _kind("obstacle_type", self.obstacle_type)
        if kind == "none":
            return None
        try:
            arena = _lengths(self.arena_size)
        except (TypeError, ValueError):
            raise ValueError(f"arena_size is {self.arena_size!r}, expected three lengths in m") from None
        options = {
            "kind": kind,
            "count": self.num_obstacles,
            "arena": arena,
            "spacing": self.min_spacing,
            "safe_zone": self.safe_zone_radius,
            "safe_zone_centers": _centers(self.safe_zone_centers),
            "new_layout": self.new_layout,
            "seed": self.seed,
            "custom": _entries(self.custom_obstacles),
        }
        try:
            return complete("obstacles", _counted(options), _NAMES)
        except ValueError as error:
            # the simulator has whole lengths
            side, found, expected = str(error).partition(", expected sides")
            if not found:
                raise
            side = side.removeprefix("arena_size is ")
            message = f"arena_size is {short(self.arena_size)}: a whole side is {side} m, expected sides{expected}"
            raise ValueError(message) from None


def _kind(option: str, value: Any) -> str | None:
    """Returns the name of a kind of obstacles; None for None."""
    kind = getattr(value, "value", value)
    kinds = [member.value for member in ObstacleType]
    if kind is not None and kind not in kinds:
        raise ValueError(f"{option} is {short(kind)}, expected one of {', '.join(kinds)}")
    return kind


def _centers(centers: Any) -> list[Any]:
    try:
        return [] if centers is None else np.asarray(centers, np.float64).tolist()
    except (TypeError, ValueError):
        raise ValueError(f"safe_zone_centers is {short(centers)}, expected points (n, 3)") from None


def _counted(options: dict[str, Any]) -> dict[str, Any]:
    """Returns options without the number of obstacles if they have a list of obstacles."""
    is_custom = getattr(options.get("kind"), "value", options.get("kind")) == "custom"
    return {name: value for name, value in options.items() if name != "count" or not is_custom}


def _entries(obstacles: Any) -> list[Any]:
    if isinstance(obstacles, (list, tuple)):
        return [_entry(obstacle) for obstacle in obstacles]
    raise ValueError(f"custom_obstacles is {short(obstacles)}, expected a list of Obstacle")


def _entry(obstacle: Any) -> Any:
    return obstacle._to_options() if isinstance(obstacle, Obstacle) else obstacle


# keys of a dict, to those of a configuration file
_KEYS = {
    "obstacle_type": Alias("kind"),
    "num_obstacles": Alias("count"),
    "arena_size": Alias("arena", _lengths, _halves),
    "min_spacing": Alias("spacing"),
    "safe_zone_radius": Alias("safe_zone"),
    "custom_obstacles": Alias("custom"),
}


def dict_options(obstacles: Mapping[str, Any]) -> dict[str, Any] | None:
    """Returns the options of a dict with the keys of a configuration file or the fields of an `ObstacleConfig`."""
    options = translated("obstacles", obstacles, _KEYS)
    if _kind("obstacle_type" if "obstacle_type" in obstacles else "obstacles.kind", options.get("kind")) == "none":
        return None
    if "custom" in options:
        options["custom"] = _entries(options["custom"])
    names = {f"obstacles.{alias.field}": name for name, alias in _KEYS.items() if name in obstacles}
    return complete("obstacles", _counted(options), names)


def list_options(obstacles: Iterable[Obstacle]) -> dict[str, Any]:
    """Returns the options of a list of obstacles."""
    return complete("obstacles", {"kind": "custom", "custom": [_entry(obstacle) for obstacle in obstacles]})


def obstacle_options(obstacles: Any) -> dict[str, Any] | None:
    """Returns the section `[obstacles]` of True, False, an `ObstacleConfig`, a kind or its name, a dict of settings, or
    a list of `Obstacle`."""
    if obstacles is None or obstacles is False:
        return None
    if obstacles is True:
        return ObstacleConfig()._to_options()
    if isinstance(obstacles, ObstacleConfig):
        return obstacles._to_options()
    if isinstance(obstacles, (str, ObstacleType)):
        return ObstacleConfig(obstacles)._to_options()
    if isinstance(obstacles, Mapping):
        return dict_options(obstacles)
    if isinstance(obstacles, (list, tuple)):
        return list_options(obstacles)
    expected = "True, False, an ObstacleConfig, a dict of its settings or a list of Obstacle"
    raise ValueError(f"obstacles is {short(obstacles)}, expected {expected}")


def generate_obstacles(config: ObstacleConfig | Mapping[str, Any]) -> list[Obstacle]:
    """Generates the layout of a seed.

    The spheres around `safe_zone_centers` stay free. An environment also keeps the starts of its drones free.

    Args:
        config: Settings, or a dict of them.

    Returns:
        Obstacles; the bars of a gate and the walls of a room are obstacles of their own.

    Raises:
        ValueError: if a setting is out of range, or if the arena has too little room.
    """
    options = obstacle_options(config)
    if options is None:
        return []
    return [Obstacle._from_options(entry) for entry in _native.generate_obstacles(options, np.empty((0, 3)))]


def obstacles_to_xml(obstacles: Iterable[Obstacle]) -> str:
    """Returns obstacles as MJCF bodies with one geom each, for a scene of your own."""

    def text(values: np.ndarray) -> str:
        return " ".join(f"{value:.9g}" for value in values)

    return "\n".join(
        f'<body name="obstacle_{index}" pos="{text(obstacle.position)}">'
        f'<geom type="{obstacle.geom_type}" size="{text(obstacle.size)}" rgba="{text(obstacle.rgba)}"'
        f' quat="{text(_native.quaternion_of_rpy(obstacle.euler))}"/></body>'
        for index, obstacle in enumerate(obstacles)
    )
