"""Options that have names. A value, such as "cf2x", is accepted wherever a member is."""

from __future__ import annotations

from enum import Enum

__all__ = ["ActionType", "DroneModel", "ImageType", "ObservationType", "Physics"]


class DroneModel(Enum):
    """Airframes of the paper. The identified Crazyflie 2.1 is `"cf21"`."""

    CF2X = "cf2x"
    """Bitcraze Crazyflie 2.x, motors on the diagonals."""
    CF2P = "cf2p"
    """Bitcraze Crazyflie 2.x, motors on the axes."""
    RACE = "race"
    """250 g racing quadcopter, motors on the diagonals."""


class Physics(Enum):
    """Physics modes."""

    MJC = "mjc"
    """MuJoCo without aerodynamic effects."""
    MJC_GND = "mjc_gnd"
    """MuJoCo with the ground effect."""
    MJC_DRAG = "mjc_drag"
    """MuJoCo with drag."""
    MJC_DW = "mjc_dw"
    """MuJoCo with downwash."""
    MJC_GND_DRAG_DW = "mjc_gnd_drag_dw"
    """MuJoCo with all three effects."""
    DYN = "dyn"
    """Explicit integration without contacts."""


class ActionType(Enum):
    """Meaning of the numbers of an action, per drone."""

    RPM = "rpm"
    """Four motor speeds: normalized to [-1, 1], where 0 hovers, in tasks; in rpm in `BaseAviary`."""
    ONE_D_RPM = "one_d_rpm"
    """One normalized motor speed for all four motors, in [-1, 1]."""
    VEL = "vel"
    """Velocity x, y, z in the heading frame, m/s, and yaw rate, rad/s."""
    PID = "pid"
    """Waypoint: position x, y, z in the world frame, m, and yaw, rad."""
    ATTITUDE = "attitude"
    """Collective thrust, roll, pitch and yaw rate, each in [-1, 1]."""
    CTBR = "ctbr"
    """Collective thrust and body rates x, y, z, each in [-1, 1]."""
    RAW_RPM = "raw_rpm"
    """Four motor speeds, rpm."""
    DUTY = "duty"
    """Four duties of the motors (normalized PWM), each in [0, 1], for an airframe with `speed_per_volt`."""


class ObservationType(Enum):
    """Parts of an observation."""

    KIN = "kin"
    """Numbers of the task, float32."""
    RGB = "rgb"
    """Colour images of the onboard cameras, uint8 (N, 48, 64, 4)."""
    KIN_RGB = "kin_rgb"
    """Both, as a dict with the keys "kin" and "rgb"."""
    DEPTH = "depth"
    """Depth images of the onboard cameras, m, float32 (N, 48, 64)."""
    SEGMENTATION = "segmentation"
    """Type and index of the object of every pixel, int32 (N, 48, 64, 2)."""
    KIN_ADJACENCY = "kin_adjacency"
    """Numbers of the task, followed by N numbers per drone: 1 for a drone within `neighbourhood_radius`, 0 for the
    others and for the drone itself."""
    KIN_OBSTACLE = "kin_obstacle"
    """Numbers of the task, followed by the distance of every drone from the nearest obstacle, m."""
    KIN_RANGES = "kin_ranges"
    """Numbers of the task, followed by ten rangefinder distances per drone, m: eight around the drone, up and down."""


class ImageType(Enum):
    """Channels of an image. The names of observations, "depth" and "segmentation", are accepted as well."""

    RGB = "rgb"
    """Colour."""
    DEP = "dep"
    """Depth, m."""
    SEG = "seg"
    """Index of the object."""

    @classmethod
    def _missing_(cls, value: object) -> ImageType | None:
        if not isinstance(value, str):
            return None
        return {"depth": cls.DEP, "segmentation": cls.SEG}.get(value)
