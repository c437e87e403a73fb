#!/usr/bin/env python3
"""One control step of the HoverAviary of the paper's package (physics `MJC`), reproduced by its calls to MuJoCo.

The package of *MuJoCo-Drones-Gym* (Tayal) is not on PyPI. This script is not the package: it makes the same calls in
the same order, with arrays of the same shapes, as its `BaseAviary.step` and `HoverAviary` do at 240 Hz physics and
48 Hz control. In each physics step: `mj_name2id`, rotor forces and torques in NumPy, `xfrc_applied`, `mj_step` with
RK4. In each control step: `qpos`, `qvel`, roll, pitch and yaw, the state vector, observation and reward. Seven boxes
without contacts stand for its seven visual meshes.

`--mjx N` measures its vectorized back end instead, reproduced the same way: `jit(vmap(step))` over N environments,
each of which makes five `mjx.step` calls in `lax.scan`.

`--bare` measures `mj_step` alone in the same scene, called in a loop of C (`nstep`).
"""

import time

import mujoco
import numpy as np

from timing import SUBSTEPS, TARGET_HEIGHT, arguments, fly, rates, report

MASS, ARM, THRUST, TORQUE = 0.027, 0.0397, 3.16e-10, 7.94e-12
HOVER_RPM = np.sqrt(9.81 * MASS / (4 * THRUST))
MAX_RPM = np.sqrt(2.25) * HOVER_RPM

SENSORS = """<sensor><gyro site="centre"/><accelerometer site="centre"/>
<framequat objtype="site" objname="centre"/><framepos objtype="site" objname="centre"/>
<framelinvel objtype="site" objname="centre"/><frameangvel objtype="site" objname="centre"/></sensor>"""


def scene(lean):
    """Returns the scene: a floor and a Crazyflie with a cylinder; visual geoms, sites and sensors unless lean."""
    boxes = '<geom type="box" size="0.01 0.01 0.01" contype="0" conaffinity="0" group="2"/>' * 7
    offset = ARM / np.sqrt(2)
    sites = '<site name="centre"/>' + "".join(
        f'<site pos="{x * offset} {y * offset} 0"/>' for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    )
    medium = "" if lean else 'density="1.225" viscosity="1.8e-5"'
    return f"""<mujoco><option integrator="RK4" timestep="{1 / 240}" {medium}/>
<compiler inertiafromgeom="false" autolimits="true"/><worldbody>
<geom type="plane" size="10 10 0.05"/>
<body name="drone0" pos="0 0 {TARGET_HEIGHT - 0.1}"><freejoint name="drone0_joint"/>
<inertial pos="0 0 0" mass="{MASS}" diaginertia="1.4e-5 1.4e-5 2.17e-5"/>
<geom type="cylinder" size="0.06 0.015"/>{"" if lean else boxes + sites}</body></worldbody>
{"" if lean else SENSORS}</mujoco>"""


class Hover:
    def __init__(self):
        self.model = mujoco.MjModel.from_xml_string(scene(lean=False))
        self.data = mujoco.MjData(self.model)
        self.pos, self.rpy, self.vel, self.rates = (np.zeros((1, 3)) for _ in range(4))
        self.quat, self.last_rpm = np.zeros((1, 4)), np.zeros((1, 4))

    def reset(self):
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.steps = 0
        self.read()
        return self.observe()

    def read(self):
        joint = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, f"drone{0}_joint")
        q, v = self.model.jnt_qposadr[joint], self.model.jnt_dofadr[joint]
        self.pos[0] = self.data.qpos[q : q + 3]
        self.quat[0] = self.data.qpos[q + 3 : q + 7]
        self.vel[0] = self.data.qvel[v : v + 3]
        self.rates[0] = self.data.qvel[v + 3 : v + 6]
        w, x, y, z = self.quat[0]
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        self.rpy[0] = np.array([roll, pitch, yaw])
        self.data.xfrc_applied[:] = 0

    def state(self):
        parts = [self.pos[0], self.quat[0], self.rpy[0], self.vel[0], self.rates[0], self.last_rpm[0]]
        return np.hstack(parts).reshape(20)

    def observe(self):
        state = self.state()
        return np.hstack([state[0:3], state[7:10], state[10:13], state[13:16]]).astype(np.float32)

    def apply(self, rpm):
        forces = np.array(rpm**2) * THRUST
        torques = np.array(rpm**2) * TORQUE
        about_z = -torques[0] + torques[1] - torques[2] + torques[3]
        total = np.sum(forces)
        about_x = (forces[0] + forces[1] - forces[2] - forces[3]) * (ARM / np.sqrt(2))
        about_y = (-forces[0] + forces[1] + forces[2] - forces[3]) * (ARM / np.sqrt(2))
        body = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, f"drone{0}")
        rotation = np.array(self.data.xmat[body]).reshape(3, 3)
        self.data.xfrc_applied[body, :3] = rotation @ np.array([0, 0, total])
        self.data.xfrc_applied[body, 3:] = rotation @ np.array([about_x, about_y, about_z])

    def reward(self):
        state = self.state()
        pos, vel, rpy = state[0:3], state[10:13], state[7:10]
        height, aside = abs(pos[2] - TARGET_HEIGHT), np.linalg.norm(pos[0:2])
        reward = -height - 0.1 * aside
        reward -= 0.05 * np.linalg.norm(vel)
        reward -= 0.05 * (abs(rpy[0]) + abs(rpy[1]))
        if height < 0.05 and aside < 0.05:
            reward += 1.0
        if self.crashed():
            reward -= 100.0
        return float(reward)

    def crashed(self):
        state = self.state()
        pos, rpy = state[0:3], state[7:10]
        return bool(pos[2] < 0.0 or abs(rpy[0]) > np.pi / 2 or abs(rpy[1]) > np.pi / 2 or pos[2] > 3.0)

    def step(self, action):
        action = np.clip(np.array(action).flatten(), -1, 1)
        rpm = np.where(action <= 0, (action + 1) * HOVER_RPM, HOVER_RPM + (MAX_RPM - HOVER_RPM) * action)
        rpm = np.reshape(rpm.reshape(1, 4), (1, 4))
        for _ in range(SUBSTEPS):
            self.apply(rpm[0, :])
            mujoco.mj_step(self.model, self.data)
            self.last_rpm = rpm
        self.read()
        self.steps += SUBSTEPS
        observation, reward, terminated = self.observe(), self.reward(), self.crashed()
        truncated = self.steps / 240 >= 10
        info = {"position": self.pos[0].tolist(), "height_error": abs(self.pos[0, 2] - TARGET_HEIGHT)}
        return observation, reward, terminated, truncated, info


def bare(options):
    """Measures `mj_step` of a hovering drone in C, without and with the visual geoms, sites and sensors."""
    for name, lean in (("mj_step, lean scene", True), ("mj_step, the package's scene", False)):
        model = mujoco.MjModel.from_xml_string(scene(lean))
        data = mujoco.MjData(model)

        def call():
            mujoco.mj_resetData(model, data)
            # a small angular velocity, because MuJoCo is faster without rotation
            data.qvel[3:6] = [0.02, 0.01, 0.03]
            data.qpos[2] = 20
            data.xfrc_applied[1, 2] = 9.81 * MASS
            begin = time.perf_counter()
            mujoco.mj_step(model, data, nstep=1000)
            return time.perf_counter() - begin

        report(name, rates(call, 1000, options), mujoco=mujoco.__version__)


def vectorized(count, options):
    """Measures the reproduction of the vectorized back end."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    model = mujoco.MjModel.from_xml_string(scene(lean=True))
    device_model = mjx.put_model(model)
    max_rpm = 21714.0

    def step(data, action):
        forces = THRUST * ((jnp.clip(action, -1, 1) + 1) / 2 * max_rpm) ** 2
        rotation = data.xmat[1].reshape(3, 3)
        arm = ARM / jnp.sqrt(2.0)
        about_x = (forces[0] + forces[1] - forces[2] - forces[3]) * arm
        about_y = (-forces[0] + forces[1] + forces[2] - forces[3]) * arm
        about_z = (-forces[0] + forces[1] - forces[2] + forces[3]) * TORQUE / THRUST
        wrench = jnp.zeros_like(data.xfrc_applied)
        wrench = wrench.at[1, :3].set(rotation @ jnp.array([0.0, 0.0, 1.0]) * jnp.sum(forces))
        wrench = wrench.at[1, 3:].set(rotation @ jnp.array([about_x, about_y, about_z]))
        data = data.replace(xfrc_applied=wrench)
        data, _ = jax.lax.scan(lambda d, _: (mjx.step(device_model, d), None), data, None, length=SUBSTEPS)
        rotation = data.xmat[1].reshape(3, 3)
        rpy = jnp.array([
            jnp.arctan2(rotation[2, 1], rotation[2, 2]),
            jnp.arcsin(-jnp.clip(rotation[2, 0], -1, 1)),
            jnp.arctan2(rotation[1, 0], rotation[0, 0]),
        ])
        observation = jnp.concatenate([data.xpos[1], rpy, data.cvel[1, 3:], data.cvel[1, :3]])
        error = jnp.linalg.norm(data.xpos[1] - jnp.array([0.0, 0.0, TARGET_HEIGHT]))
        return data, observation, -error - 0.01 * jnp.sum(action**2)

    step = jax.jit(jax.vmap(step))
    one = mjx.put_data(model, mujoco.MjData(model))
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)).copy(), one)
    action = jnp.full((count, 4), 2 * HOVER_RPM / max_rpm - 1)
    state = {"data": batch}

    def call():
        begin = time.perf_counter()
        state["data"], observation, reward = step(state["data"], action)
        np.asarray(observation), np.asarray(reward)
        return time.perf_counter() - begin

    found = rates(call, count, options)
    height = float(state["data"].qpos[0, 2])
    report("the paper's MJX calls", found, envs=count, height=height, jax=jax.__version__, mujoco=mujoco.__version__)


def main():
    parser = arguments(__doc__)
    parser.add_argument("--bare", action="store_true", help="mj_step alone")
    parser.add_argument("--mjx", type=int, metavar="N", help="the vectorized back end with N environments")
    options = parser.parse_args()
    if options.bare:
        bare(options)
    elif options.mjx:
        vectorized(options.mjx, options)
    else:
        env = Hover()
        found = fly(env, options)
        report("the paper's calls", found, envs=1, height=float(env.pos[0, 2]), mujoco=mujoco.__version__)


if __name__ == "__main__":
    main()
