"""PPO in one file, in the style of CleanRL: a torch loop over a VectorAviary. A hover has the mean reward 0.5."""

import argparse
import time

import numpy as np
import torch
from torch import nn

from mujoco_drones_gym import VectorAviary

# starts in motion around the target, from the floor to 2 m
STARTS = {"initial": {"position": 0.9, "attitude": 0.5, "velocity": 1.0, "offset": [0.0, 0.0, 0.9]}}
HORIZON, GAMMA, LAMBDA, CLIP, EPOCHS, MINIBATCH, TARGET_KL, REWARD_SCALE = 32, 0.99, 0.95, 0.2, 4, 2048, 0.03, 0.05


class Agent(nn.Module):
    def __init__(self):
        super().__init__()
        self.actor = nn.Sequential(nn.Linear(12, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 4))
        self.critic = nn.Sequential(nn.Linear(12, 64), nn.ReLU(), nn.Linear(64, 64), nn.ReLU(), nn.Linear(64, 1))
        self.actor[-1].weight.data.mul_(0.01)  # the first actions are close to those of a hover
        self.log_std = nn.Parameter(torch.full((4,), -1.2))

    def policy(self, observations):
        return torch.distributions.Normal(self.actor(observations), self.log_std.exp())


@torch.no_grad()
def rollout(env, agent, observations):
    """Returns the next observations, the experience (a list of tensors), and the mean reward."""
    steps, mean_reward, advantage = [], 0.0, torch.zeros(env.num_envs)
    for _ in range(HORIZON):
        seen = torch.as_tensor(observations)
        action = agent.policy(seen).sample()
        observations, reward, terminated, truncated, infos = env.step(action.numpy())
        mean_reward += reward.mean() / HORIZON
        following = observations.copy()
        if infos:  # the last observations of the episodes that have ended
            following[infos["_final_obs"]] = np.stack(infos["final_obs"][infos["_final_obs"]])
        reward[terminated] = -100.0  # leaving the arena costs as much as a crash
        value, next_value = agent.critic(seen)[:, 0], agent.critic(torch.as_tensor(following))[:, 0]
        error = REWARD_SCALE * torch.as_tensor(reward) + GAMMA * torch.as_tensor(~terminated) * next_value - value
        live, log_prob = torch.as_tensor(~(terminated | truncated)), agent.policy(seen).log_prob(action).sum(-1)
        steps.append([seen, action, log_prob, value, error, live])
    for step in reversed(steps):  # generalized advantage estimation
        step[4] = advantage = step[4] + GAMMA * LAMBDA * step.pop() * advantage
    return observations, [torch.cat(column) for column in zip(*steps, strict=True)], mean_reward


def update(agent, optimizer, experience):
    for rows in (rows for _ in range(EPOCHS) for rows in torch.randperm(len(experience[0])).split(MINIBATCH)):
        seen, action, log_prob, value, advantage = (column[rows] for column in experience)
        log_ratio = agent.policy(seen).log_prob(action).sum(-1) - log_prob
        if (log_ratio.exp() - 1.0 - log_ratio).mean() > TARGET_KL:
            return
        scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        gain = torch.minimum(log_ratio.exp() * scaled, log_ratio.exp().clamp(1.0 - CLIP, 1.0 + CLIP) * scaled)
        optimizer.zero_grad()
        (nn.functional.mse_loss(agent.critic(seen)[:, 0], value + advantage) - gain.mean()).backward()
        optimizer.step()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_500_000, help="number of environment steps")
    parser.add_argument("--envs", type=int, default=512, help="number of environments")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    torch.set_num_threads(1)  # more do not help small networks
    env = VectorAviary("hover", args.envs, autoreset_mode="same_step", episode_seconds=3.5, randomization=STARTS)
    agent, (observations, _), start = Agent(), env.reset(seed=args.seed), time.perf_counter()
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-3)
    for step in range(args.envs * HORIZON, args.steps + 1, args.envs * HORIZON):
        observations, experience, reward = rollout(env, agent, observations)
        update(agent, optimizer, experience)
        print(f"{step:>9,} steps {time.perf_counter() - start:4.0f} s  mean reward {reward:6.2f}", flush=True)
