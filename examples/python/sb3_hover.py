"""Trains a hovering policy with PPO of Stable-Baselines3, and prints the time until it hovers.

The policy commands motor speeds. It hovers if at least 95 % of the evaluation episodes last their 10 s and end within
5 cm of the target.
"""

import argparse
import time

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize

from mujoco_drones_gym import VectorAviary
from mujoco_drones_gym.sb3 import SB3VecEnv

# starts in motion around the target, from the floor to 2 m
STARTS = {"initial": {"position": 0.9, "attitude": 0.5, "velocity": 1.0, "offset": [0.0, 0.0, 0.9]}}


class PenalizeEnds(VecEnvWrapper):
    """Every end but the time limit costs as much as a crash. Otherwise, leaving the arena ends all costs."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones):
            rewards[i] = rewards[i] if infos[i]["TimeLimit.truncated"] else -100.0
        return observations, rewards, dones, infos


def success_rate(model, episodes=64):
    """Returns the fraction of episodes from the start of the task that end in a hover."""
    env = VectorAviary("hover", episodes, randomization={"initial": {"position": 0.05}})
    observations, _ = env.reset(seed=1)
    live, success = np.ones(episodes, bool), np.zeros(episodes, bool)
    while live.any():
        observations, _, terminations, truncations, infos = env.step(model.predict(observations, deterministic=True)[0])
        success |= live & truncations & infos["success"] if infos else False
        live &= ~(terminations | truncations)
    return success.mean()


class StopAtHover(BaseCallback):
    """Evaluates the policy after every tenth rollout, and stops the training once it hovers."""

    rollouts, rate, start = 0, 0.0, 0.0

    def _on_rollout_start(self):
        self.start = self.start or time.perf_counter()
        if self.rollouts % 10 == 0:
            self.rate, seconds = success_rate(self.model), time.perf_counter() - self.start
            print(f"{self.num_timesteps:>9,} steps  {seconds:4.0f} s  success {self.rate:4.0%}", flush=True)
        self.rollouts += 1

    def _on_step(self):
        return self.rate < 0.95


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--steps", type=int, default=5_000_000, help="largest number of environment steps")
parser.add_argument("--envs", type=int, default=512, help="number of environments")
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--save", help="file for the trained model, such as hover.zip")
args = parser.parse_args()

torch.set_num_threads(1)  # more do not help small networks
env = PenalizeEnds(SB3VecEnv("hover", args.envs, episode_seconds=3.5, randomization=STARTS))
env = VecNormalize(env, norm_obs=False, gamma=0.99)  # rewards only: the policy reads plain observations
network = {"net_arch": [64, 64], "activation_fn": torch.nn.ReLU, "log_std_init": -1.2}
options = {"n_steps": 32, "batch_size": 2048, "n_epochs": 4, "learning_rate": 1e-3, "target_kl": 0.03}
model = PPO("MlpPolicy", env, policy_kwargs=network, seed=args.seed, device="cpu", **options)
model.learn(args.steps, callback=StopAtHover())
if args.save:
    model.save(args.save)
