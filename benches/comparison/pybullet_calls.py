#!/usr/bin/env python3
"""One control step of gym-pybullet-drones' HoverAviary (physics `PYB`), reproduced by its calls to PyBullet.

gym-pybullet-drones is not on PyPI. This script is not the package: it makes the same calls in the same order, with
arrays of the same shapes, as `BaseAviary.step`, `BaseRLAviary` and `HoverAviary` do at 240 Hz physics and 48 Hz
control. In each physics step: `applyExternalForce` on four rotor links, `applyExternalTorque` on the centre of mass,
`stepSimulation`. In each control step: `getBasePositionAndOrientation`, `getEulerFromQuaternion`, `getBaseVelocity`,
the state vector (once each for observation, reward, termination and truncation), and an observation of 12 states and
the actions of the last half second. Reward and ends are those of version 2.0. The visual mesh is left out, because
nothing is drawn.
"""

import collections
import pathlib
import tempfile

import numpy as np
import pybullet as p
import pybullet_data

from timing import SUBSTEPS, TARGET_HEIGHT, arguments, fly, report

MASS, ARM, THRUST, TORQUE = 0.027, 0.028, 3.16e-10, 7.94e-12
PAST_ACTIONS = 48 // 2  # half a second
HOVER_RPM = np.sqrt(9.8 * MASS / (4 * THRUST))


def urdf():
    """Returns a Crazyflie: a base with a cylinder, four rotor links and a link in the centre of mass, all fixed."""
    places = [(ARM, ARM), (-ARM, ARM), (-ARM, -ARM), (ARM, -ARM), (0, 0)]
    links = "".join(
        f'<link name="l{i}"><inertial><origin xyz="{x} {y} 0"/><mass value="0"/>'
        f'<inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial></link>'
        f'<joint name="j{i}" type="fixed"><parent link="base"/><child link="l{i}"/></joint>'
        for i, (x, y) in enumerate(places)
    )
    return (
        f'<robot name="crazyflie"><link name="base"><inertial><mass value="{MASS}"/>'
        '<inertia ixx="1.4e-5" ixy="0" ixz="0" iyy="1.4e-5" iyz="0" izz="2.17e-5"/></inertial>'
        '<collision><geometry><cylinder radius="0.06" length="0.025"/></geometry></collision></link>'
        f"{links}</robot>"
    )


class Hover:
    def __init__(self):
        self.client = p.connect(p.DIRECT)
        directory = tempfile.TemporaryDirectory()
        self.directory = directory
        self.file = pathlib.Path(directory.name) / "crazyflie.urdf"
        self.file.write_text(urdf())
        self.actions = collections.deque(maxlen=PAST_ACTIONS)

    def reset(self):
        client = self.client
        p.resetSimulation(physicsClientId=client)
        p.setGravity(0, 0, -9.8, physicsClientId=client)
        p.setRealTimeSimulation(0, physicsClientId=client)
        p.setTimeStep(1 / 240, physicsClientId=client)
        p.setAdditionalSearchPath(pybullet_data.getDataPath(), physicsClientId=client)
        p.loadURDF("plane.urdf", physicsClientId=client)
        self.drone = p.loadURDF(
            str(self.file), [0, 0, TARGET_HEIGHT - 0.1], flags=p.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
        )
        self.steps = 0
        for _ in range(PAST_ACTIONS):
            self.actions.append(np.zeros((1, 4)))
        self.last_rpm = np.zeros((1, 4))
        self.pos, self.rpy, self.vel, self.rates = (np.zeros((1, 3)) for _ in range(4))
        self.quat = np.zeros((1, 4))
        self.read()
        return self.observe()[0]

    def read(self):
        self.pos[0], self.quat[0] = p.getBasePositionAndOrientation(self.drone, physicsClientId=self.client)
        self.rpy[0] = p.getEulerFromQuaternion(self.quat[0])
        self.vel[0], self.rates[0] = p.getBaseVelocity(self.drone, physicsClientId=self.client)

    def state(self):
        parts = [self.pos[0], self.quat[0], self.rpy[0], self.vel[0], self.rates[0], self.last_rpm[0]]
        return np.hstack(parts).reshape(20)

    def observe(self):
        state = self.state()
        rows = np.zeros((1, 12))
        rows[0, :] = np.hstack([state[0:3], state[7:10], state[10:13], state[13:16]]).reshape(12)
        out = np.array([rows[0, :]]).astype("float32")
        for i in range(PAST_ACTIONS):
            out = np.hstack([out, np.array([self.actions[i][0, :]])])
        return out

    def apply(self, rpm):
        forces = np.array(rpm**2) * THRUST
        torques = np.array(rpm**2) * TORQUE
        about_z = -torques[0] + torques[1] - torques[2] + torques[3]
        for link in range(4):
            p.applyExternalForce(
                self.drone, link, forceObj=[0, 0, forces[link]], posObj=[0, 0, 0], flags=p.LINK_FRAME,
                physicsClientId=self.client,
            )
        p.applyExternalTorque(
            self.drone, 4, torqueObj=[0, 0, about_z], flags=p.LINK_FRAME, physicsClientId=self.client
        )

    def step(self, action):
        action = np.array(action).reshape(1, 4)
        self.actions.append(action)
        rpm = np.zeros((1, 4))
        rpm[0, :] = np.array(HOVER_RPM * (1 + 0.05 * action[0, :]))
        rpm = np.reshape(rpm, (1, 4))
        for _ in range(SUBSTEPS):
            self.apply(rpm[0, :])
            p.stepSimulation(physicsClientId=self.client)
            self.last_rpm = rpm
        self.read()
        observation = self.observe()
        target = np.array([0, 0, TARGET_HEIGHT])
        reward = max(0, 2 - np.linalg.norm(target - self.state()[0:3]) ** 4)
        terminated = bool(np.linalg.norm(target - self.state()[0:3]) < 0.0001)
        state = self.state()
        away = abs(state[0]) > 1.5 or abs(state[1]) > 1.5 or state[2] > 2.0
        truncated = bool(away or abs(state[7]) > 0.4 or abs(state[8]) > 0.4 or self.steps / 240 > 8)
        self.steps += SUBSTEPS
        return observation[0], reward, terminated, truncated, {"answer": 42}


def main():
    options = arguments(__doc__).parse_args()
    env = Hover()
    found = fly(env, options)
    report("gym-pybullet-drones' calls", found, envs=1, height=float(env.pos[0, 2]), pybullet=p.getAPIVersion())


if __name__ == "__main__":
    main()
