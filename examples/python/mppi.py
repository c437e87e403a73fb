"""Model-predictive path integral control (Williams et al. 2017, Information-theoretic model predictive control).

In every control step the planner samples flights of one second from a snapshot of the environment, and weights their
actions by the rewards of the task. The drone takes off and hovers, or follows a point that moves on a circle.
"""

import argparse
import time

import numpy as np

from mujoco_drones_gym import HoverAviary, TrackAviary

HORIZON = 48  # control steps of the prediction: 1 s
TEMPERATURE = 0.02  # of the weights, in units of the mean reward of a flight
SPREAD = np.array([0.25, 0.35, 0.35, 0.05])  # standard deviations of thrust, roll, pitch and yaw rate


def mean_reward(env, state, actions):
    """Returns the mean reward of a flight from a snapshot."""
    env.set_state(state)
    total = 0.0
    for action in actions:
        _, reward, terminated, truncated, _ = env.step(action)
        total += reward
        if terminated or truncated:
            break
    return total / len(actions)


def improve(env, plan, samples, rng):
    """Returns the plan that the sampled flights suggest."""
    state = env.get_state()
    # the noise is constant over four control steps
    noise = np.repeat(rng.normal(0.0, SPREAD, (samples, HORIZON // 4, 4)), 4, axis=1)
    noise[0] = 0.0
    flights = np.clip(plan + noise, -1.0, 1.0)
    rewards = np.array([mean_reward(env, state, actions) for actions in flights])
    env.set_state(state)
    weights = np.exp((rewards - rewards.max()) / TEMPERATURE)
    return np.einsum("s,sha->ha", weights / weights.sum(), flights)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=["hover", "track"], default="track")
    parser.add_argument("--steps", type=int, default=240, help="control steps (48 per second)")
    parser.add_argument("--samples", type=int, default=64, help="sampled flights per control step")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()

    make = {"hover": HoverAviary, "track": TrackAviary}[args.task]
    env = make(act_type="attitude", engine="hybrid", episode_seconds=args.steps / 48 + 2.0)
    env.reset(seed=args.seed)
    rng, plan, errors = np.random.default_rng(args.seed), np.zeros((HORIZON, 4)), []
    start = time.perf_counter()
    for step in range(args.steps):
        plan = improve(env, plan, args.samples, rng)
        _, _, terminated, truncated, info = env.step(plan[0])
        if terminated or truncated:
            print(f"the flight ends after {info['time']:.2f} s: {info['end']}")
            break
        plan = np.vstack([plan[1:], plan[-1]])
        errors.append(info["position_error"])
        if step % 48 == 47:
            print(f"{info['time']:5.2f} s  {errors[-1]:.3f} m from the target")
    sampled = len(errors) * args.samples * HORIZON / (time.perf_counter() - start)
    print(f"mean of the last second {np.mean(errors[-48:]):.3f} m; {sampled:,.0f} sampled steps per second")


if __name__ == "__main__":
    main()
