"""Camera observations of a batch: four drones fly through forests, and a PNG file shows the images of their cameras."""

import argparse

import numpy as np
from PIL import Image

from mujoco_drones_gym import VectorAviary

FOREST = {"kind": "forest", "count": 15, "new_layout": True}
ENVS, COLUMNS, SCALE = 4, 6, 3


def fly(observations):
    """Returns velocities towards the next waypoints, m/s in the heading frame, and yaw rates, rad/s."""
    offset = observations["kin"][:, 15:18]  # the next waypoint relative to the drone, body frame, m
    velocity = 0.7 * offset / np.maximum(1.0, np.linalg.norm(offset, axis=1, keepdims=True))
    return np.column_stack([velocity, np.arctan2(offset[:, 1], offset[:, 0])])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=240, help="control steps (48 per second)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", default="vision.png", help="image file: a row per drone, a column per moment")
    args = parser.parse_args()

    # "kin" has the numbers of the task, "rgb" the RGBA images of the onboard cameras: uint8 (envs, drones, 48, 64, 4)
    env = VectorAviary("fly_through", ENVS, obs_type="kin_rgb", act_type="vel", obstacles=FOREST)
    observations, _ = env.reset(seed=args.seed)
    print({name: (part.shape, str(part.dtype)) for name, part in observations.items()})
    columns, moments = [], np.linspace(0, args.steps - 1, COLUMNS).astype(int)
    for step in range(args.steps):
        if step in moments:
            columns.append(np.concatenate(observations["rgb"][:, 0, :, :, :3]))
        observations, *_ = env.step(fly(observations))
    image = Image.fromarray(np.concatenate(columns, axis=1))
    image.resize((SCALE * image.width, SCALE * image.height), Image.Resampling.NEAREST).save(args.out)
    env.close()


if __name__ == "__main__":
    main()
