"""PPO of TorchRL over a VectorAviary. A hover has the mean reward 0.5."""

import argparse
import time

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from mujoco_drones_gym import VectorAviary

# starts in motion around the target, from the floor to 2 m
STARTS = {"initial": {"position": 0.9, "attitude": 0.5, "velocity": 1.0, "offset": [0.0, 0.0, 0.9]}}
HORIZON, EPOCHS, MINIBATCH, REWARD_SCALE = 32, 4, 2048, 0.05


def make_networks():
    """Returns an actor, whose standard deviation does not depend on the observation, and a critic."""
    options = {"num_cells": [64, 64], "activation_class": nn.ReLU}
    mean = MLP(12, 4, **options)
    mean[-1].weight.data.mul_(0.01)  # the first actions are close to those of a hover
    normal = AddStateIndependentNormalScale(4, scale_mapping="exp", scale_lb=1e-3)
    torch.nn.init.constant_(normal.state_independent_scale, -1.2)
    actor = ProbabilisticActor(
        TensorDictModule(nn.Sequential(mean, normal), ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    return actor, ValueOperator(MLP(12, 1, **options), in_keys=["observation"])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_500_000, help="number of environment steps")
    parser.add_argument("--envs", type=int, default=512, help="number of environments")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)  # more do not help small networks

    # TorchRL resets the environments whose episodes have ended, with a reset mask
    batch = VectorAviary("hover", args.envs, autoreset_mode="disabled", episode_seconds=3.5, randomization=STARTS)
    env = GymWrapper(batch)
    env.set_seed(args.seed)
    actor, critic = make_networks()
    gae, loss = GAE(gamma=0.99, lmbda=0.95, value_network=critic), ClipPPOLoss(actor, critic, entropy_coeff=0.0)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    collector = Collector(env, actor, frames_per_batch=HORIZON * args.envs, total_frames=args.steps)
    steps, start = 0, time.perf_counter()
    for data in collector:
        following = data["next"]
        reward = following["reward"].mean().item()
        # leaving the arena costs as much as a crash
        following["reward"] = REWARD_SCALE * following["reward"].masked_fill(following["terminated"], -100.0)
        with torch.no_grad():
            gae(data)
        data = data.reshape(-1)
        for _ in range(EPOCHS):
            for rows in torch.randperm(len(data)).split(MINIBATCH):
                losses = loss(data[rows])
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                optimizer.step()
        steps += len(data)
        print(f"{steps:>9,} steps {time.perf_counter() - start:4.0f} s  mean reward {reward:6.2f}", flush=True)
    collector.shutdown()


if __name__ == "__main__":
    main()
