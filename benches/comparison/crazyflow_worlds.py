#!/usr/bin/env python3
"""Control steps of crazyflow on the CPU, with the installed package.

`--model first_principles` is the model nearest to this project's: four rotor speeds in, a rigid body with thrust,
torque and drag out, without ground effect, downwash or contact forces. It runs at 240 Hz with five physics steps per
`Sim.step` call and no reward, termination or reset. `--integrator rk4` replaces its default, explicit Euler.
`--model env` is its Gymnasium environment `ReachPosEnv`: attitude commands, the fitted model `so_rpy` at 500 Hz, five
physics steps per control step, observation, reward, termination and automatic reset.
`--steps-per-call N` makes N control steps in one compiled call, under one command.

States are float32, JAX's default. Positions are copied to NumPy after every call.
"""

import time
from importlib.metadata import version

import numpy as np

from timing import SUBSTEPS, arguments, rates, report


def main():
    parser = arguments(__doc__)
    parser.add_argument("--worlds", type=int, default=1)
    parser.add_argument("--model", choices=["first_principles", "env"], default="first_principles")
    parser.add_argument("--integrator", choices=["euler", "rk4"], default="euler")
    parser.add_argument("--steps-per-call", type=int, default=1, metavar="N")
    options = parser.parse_args()

    import jax

    if options.model == "env":
        call, position, name = environment(options.worlds)
    else:
        call, position, name = simulation(options)
    found = rates(call, options.worlds * options.steps_per_call, options)
    report(
        name,
        found,
        envs=options.worlds,
        height=float(position()[0, 0, 2]),
        crazyflow=version("crazyflow"),
        jax=jax.__version__,
    )


def simulation(options):
    from crazyflow.control import Control
    from crazyflow.drones import Drone
    from crazyflow.dynamics import Dynamics, load_params
    from crazyflow.sim import Sim
    from crazyflow.sim.integration import Integrator

    drone = Drone.cf2x_L250
    sim = Sim(
        n_worlds=options.worlds,
        drone=drone,
        dynamics=Dynamics.first_principles,
        control=Control.rotor_vel,
        integrator=Integrator(options.integrator),
        freq=240,
    )
    sim.reset()
    # the thrust of each rotor is a quadratic polynomial of its speed
    params = load_params(Dynamics.first_principles, drone)
    a, b, c = (float(x) for x in params["rpm2thrust"])
    weight = float(params["mass"]) * 9.81
    speed = (-b + np.sqrt(b * b - 4 * c * (a - weight / 4))) / (2 * c)
    command = np.full((options.worlds, 1, 4), speed, dtype=np.float32)
    states = sim.data.states
    states = states.replace(pos=states.pos.at[..., 2].set(1.0), rotor_vel=states.rotor_vel.at[...].set(speed))
    sim.data = sim.data.replace(states=states)

    def call():
        begin = time.perf_counter()
        sim.rotor_vel_control(command)
        sim.step(SUBSTEPS * options.steps_per_call)
        np.asarray(sim.data.states.pos)
        return time.perf_counter() - begin

    many = f", {options.steps_per_call} steps per call" if options.steps_per_call > 1 else ""
    return call, lambda: sim.data.states.pos, f"crazyflow first_principles, {options.integrator}{many}"


def environment(worlds):
    from crazyflow.envs import ReachPosEnv

    env = ReachPosEnv(num_envs=worlds, freq=100)
    env.reset(seed=1)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    action[:, 3] = 0.0328 * 9.81

    def call():
        begin = time.perf_counter()
        observation, reward, terminated, truncated, _ = env.step(action)
        for array in (*observation.values(), reward, terminated, truncated):
            np.asarray(array)
        return time.perf_counter() - begin

    return call, lambda: env.sim.data.states.pos, "crazyflow ReachPosEnv, so_rpy"


if __name__ == "__main__":
    main()
