"""Timing and output that the measuring scripts share."""

import argparse
import json
import statistics
import time

TARGET_HEIGHT = 1.0
# control steps of 48 Hz over physics steps of 240 Hz
SUBSTEPS = 5


def arguments(description):
    """Returns a parser with the options of every script."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--seconds", type=float, default=4.0, help="measured time")
    parser.add_argument("--chunk", type=float, default=0.1, help="time of one measurement, s")
    return parser


def rates(call, env_steps, options):
    """Measures environment steps per second in chunks. `call` returns the seconds that count."""
    call()
    found = []
    end = time.perf_counter() + options.seconds
    while time.perf_counter() < end or not found:
        spent, calls = 0.0, 0
        while spent < options.chunk:
            spent += call()
            calls += 1
        found.append(calls * env_steps / spent)
    return found


def report(name, found, **more):
    """Prints one measurement as a line of JSON: the median and the best chunk."""
    row = {"name": name, "median": statistics.median(found), "best": max(found), "chunks": len(found), **more}
    print(json.dumps(row), flush=True)


def fly(env, options):
    """Measures `env.step` under a feedback law that hovers; the law and resets do not count."""
    state = {"observation": env.reset()}

    def call():
        action = hover_action(state["observation"])
        begin = time.perf_counter()
        state["observation"], _, terminated, truncated, _ = env.step(action)
        spent = time.perf_counter() - begin
        if terminated or truncated:
            state["observation"] = env.reset()
        return spent

    return rates(call, 1, options)


def hover_action(observation):
    """Returns four normalized motor commands of a linear law (observation: position, rpy, velocity, body rates)."""
    o = [float(x) for x in observation[:12]]
    lift = 0.5 * (TARGET_HEIGHT - o[2]) - 0.4 * o[8]
    about_x = 0.12 * (0.2 * o[1] + 0.2 * o[7] - o[3]) - 0.03 * o[9]
    about_y = 0.12 * (-0.2 * o[0] - 0.2 * o[6] - o[4]) - 0.03 * o[10]
    about_z = -0.05 * (o[5] + o[11])
    return [
        max(-1.0, min(1.0, lift + x * about_x + y * about_y + z * about_z))
        for x, y, z in ((1, -1, -1), (1, 1, 1), (-1, 1, -1), (-1, -1, 1))
    ]
