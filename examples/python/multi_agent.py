"""Flies a swarm in PettingZoo's parallel API: every drone is an agent with its own observation, action and reward."""

import argparse

import numpy as np

from mujoco_drones_gym import parallel_env


def act(observation):
    """Returns the motor speeds of an agent, normalized to [-1, 1], that lift the drone to its own height."""
    height, climb, target = observation[2], observation[8], observation[12]
    return np.full(4, 0.5 * (target - height) - 0.4 * climb, np.float32)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drones", type=int, default=4, help="number of drones")
    parser.add_argument("--steps", type=int, default=480, help="largest number of control steps (48 per second)")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()

    env = parallel_env("multi_agent", num_drones=args.drones)
    observations, infos = env.reset(seed=args.seed)
    returns = dict.fromkeys(env.possible_agents, 0.0)
    for _ in range(args.steps):
        actions = {agent: act(observations[agent]) for agent in env.agents}
        observations, rewards, terminations, truncations, infos = env.step(actions)
        for agent, reward in rewards.items():
            returns[agent] += reward
            if terminations[agent] or truncations[agent]:
                print(f"{agent} ends after {infos[agent]['time']:.2f} s: {infos[agent]['end']}")
        if not env.agents:  # an agent leaves when its episode ends
            break
    for agent, total in returns.items():
        info = infos.get(agent, {})
        print(f"{agent}: return {total:8.2f}, {info.get('position_error', np.nan):.3f} m from its target")
    env.close()


if __name__ == "__main__":
    main()
