"""Compares environment steps per second of SubprocVecEnv and of SB3VecEnv, alone and in PPO of Stable-Baselines3."""

import argparse
import time

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import SubprocVecEnv

from mujoco_drones_gym import HoverAviary
from mujoco_drones_gym.sb3 import SB3VecEnv


def steps_per_second(function, steps):
    start = time.perf_counter()
    function(steps)
    return steps / (time.perf_counter() - start)


def measure(name, env, steps):
    """Prints the steps per second of a VecEnv with constant actions, and those of PPO with this VecEnv."""
    actions = np.zeros((env.num_envs, 4), np.float32)

    def fly(steps):
        for _ in range(steps // env.num_envs):
            env.step(actions)

    env.reset()
    alone = steps_per_second(fly, max(steps, 200 * env.num_envs))
    n_steps = max(2, min(4096, steps) // env.num_envs)
    batch_size = min(1024, n_steps * env.num_envs)
    model = PPO("MlpPolicy", env, n_steps=n_steps, batch_size=batch_size, n_epochs=4, device="cpu")
    learning = steps_per_second(model.learn, steps)
    print(f"{name:28} {alone:>11,.0f} alone {learning:>9,.0f} in PPO", flush=True)
    env.close()


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000, help="environment steps of each measurement")
    parser.add_argument("--envs", type=int, default=512, help="number of environments of the large batch")
    args = parser.parse_args()
    torch.set_num_threads(1)  # more do not help small networks
    measure("SubprocVecEnv, 4 processes", SubprocVecEnv([HoverAviary] * 4), args.steps)
    measure("SB3VecEnv, 4 environments", SB3VecEnv("hover", 4), args.steps)
    measure(f"SB3VecEnv, {args.envs} environments", SB3VecEnv("hover", args.envs), args.steps)


if __name__ == "__main__":  # SubprocVecEnv imports this file in its processes
    main()
