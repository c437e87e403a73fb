"""PPO on many machines with Ray: actors step batches of environments, and the driver learns (see ppo.py).

Every actor owns a VectorAviary. If an actor or its machine fails, Ray starts the actor again, on another machine if
necessary, and the training goes on. Without --address, Ray uses this machine only.
"""

import argparse
import os
import time
from pathlib import Path

import numpy as np
import ray
import torch
from ppo import HORIZON, STARTS, Agent, rollout, update

from mujoco_drones_gym import VectorAviary


@ray.remote(num_cpus=1, max_restarts=-1, max_task_retries=-1)
class Worker:
    """Steps a batch of environments with the weights of the learner."""

    def __init__(self, num_envs, seed):
        torch.set_num_threads(1)
        torch.manual_seed(seed)
        options = {"autoreset_mode": "same_step", "episode_seconds": 3.5, "randomization": STARTS}
        self.env, self.agent = VectorAviary("hover", num_envs, num_threads=1, **options), Agent()
        self.observations, _ = self.env.reset(seed=seed)

    def place(self):
        return os.getpid(), ray.get_runtime_context().get_node_id()[:8]

    def rollout(self, weights):
        self.agent.load_state_dict(weights)
        self.observations, experience, reward = rollout(self.env, self.agent, self.observations)
        return experience, reward, self.place()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--address", help="address of a Ray cluster, such as auto; default: a cluster of this machine")
    parser.add_argument("--workers", type=int, default=2, help="number of actors, each with one CPU")
    parser.add_argument("--envs", type=int, default=256, help="number of environments of each actor")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()

    # every machine needs this package, Ray and torch; Ray copies the files of this directory to the machines
    ray.init(address=args.address, runtime_env={"working_dir": str(Path(__file__).parent)}, log_to_driver=False)
    torch.manual_seed(args.seed)
    agent = Agent()
    optimizer = torch.optim.Adam(agent.parameters(), lr=1e-3)
    workers = [Worker.remote(args.envs, args.seed + index) for index in range(args.workers)]
    known, start = {}, None
    for iteration in range(1, args.iterations + 1):
        weights = ray.put(agent.state_dict())
        experiences, rewards, places = zip(
            *ray.get([worker.rollout.remote(weights) for worker in workers]), strict=True
        )
        for index, (pid, node) in enumerate(places):
            if known.get(index) != pid:
                print(f"worker {index} {'again' if index in known else 'starts'}: pid {pid} on node {node}", flush=True)
                known[index] = pid
        update(agent, optimizer, [torch.cat(column) for column in zip(*experiences, strict=True)])
        start = start or time.perf_counter()  # without the first iteration, in which the workers start
        steps, seconds = (iteration - 1) * args.workers * args.envs * HORIZON, time.perf_counter() - start
        print(f"iteration {iteration}: {steps:,} steps, {seconds:.1f} s, reward {np.mean(rewards):.2f}", flush=True)


if __name__ == "__main__":
    main()
