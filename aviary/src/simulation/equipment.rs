use super::SimulationError;
use crate::drone::{DroneError, DroneParams};
use crate::engine::flight::{Airframe, Envelope, FreeBody};
use crate::engine::{Bodies, Body};
use crate::physics::Effects;
use crate::physics::actuators::{ActuatorParams, Actuators};
use crate::physics::downwash::Wake;
use crate::physics::ground_effect::GroundEffect;
use crate::physics::rotor::RotorModel;
use crate::physics::wind::WindField;
use crate::state::DroneState;
use crate::world::{Obstacle, World};

/// What an episode may have for itself besides the drones' states: airframes, motors, wind, memory. A batch keeps one for
/// every environment that has one of its own.
#[derive(Debug, Clone)]
pub(crate) struct Equipment {
    pub(super) drones: Vec<Drone>,
    pub(super) actuators: Vec<Actuators>,
    pub(super) wakes: Vec<Wake>,
    pub(super) bodies: Bodies,
    pub(super) wind: Option<WindField>,
    /// Seed that the wind was started from.
    pub(super) wind_seed: u64,
    pub(super) memory: Memory,
    /// Motor speeds commanded during the last control step, rpm.
    pub(super) motor_speeds: Vec<[f64; 4]>,
    /// Whether something changed on which the bodies hang.
    pub(super) changed: bool,
    /// In place of the world's, where a batch keeps those of an environment; otherwise empty.
    pub(super) obstacles: Vec<Obstacle>,
}

/// One drone's constants in the form the step wants them.
#[derive(Debug, Clone)]
pub(super) struct Drone {
    pub params: DroneParams,
    pub rotors: RotorModel,
    pub ground: GroundEffect,
    /// Of the motors that it was built with, rpm.
    pub max_rpm: f64,
    pub actuators: ActuatorParams,
}

/// States of earlier physics steps, a ring of one list after the other.
#[derive(Debug, Clone, Default)]
pub(super) struct Memory {
    pub states: Vec<DroneState>,
    /// The oldest of them, by number of list.
    pub oldest: usize,
}

impl Equipment {
    pub(super) fn new(world: &World, actuators: &ActuatorParams, timestep: f64) -> Self {
        let drone = |params: &DroneParams| Drone {
            rotors: RotorModel::new(params),
            ground: GroundEffect::new(params),
            max_rpm: params.max_rpm(),
            actuators: *actuators,
            params: params.clone(),
        };
        let count = world.drones.len();
        Self {
            drones: world.drones.iter().map(|body| drone(&body.params)).collect(),
            actuators: world.drones.iter().map(|body| Actuators::new(&body.params, actuators, timestep)).collect(),
            wakes: world.drones.iter().map(|body| Wake::new(&body.params)).collect(),
            bodies: Bodies { drones: Vec::with_capacity(count), gravity: world.gravity, obstacle_drift: 0.0 },
            wind: None,
            wind_seed: 0,
            memory: Memory::default(),
            motor_speeds: vec![[0.0; 4]; count],
            changed: true,
            obstacles: Vec::new(),
        }
    }

    /// Brings the bodies up to date, and how far they can come.
    pub(super) fn refresh(&mut self, world: &World, effects: Effects) {
        if !std::mem::take(&mut self.changed) {
            return;
        }
        let wakes: f64 = self.wakes.iter().map(|wake| wake.cap).sum();
        let gravity = self.bodies.gravity;
        let body = |(drone, motors): (&Drone, &Actuators)| {
            let (params, inertia) = (&drone.params, drone.params.inertia_vector());
            let free = FreeBody::new(params.mass, &inertia, gravity, world.medium);
            let (rpm, rotors) = (motors.max_rpm(), &drone.rotors);
            let most = [rpm; 4];
            let mut force = rotors.wrench(&most).thrust;
            let slowing = if effects.drag {
                let least = params.drag_coefficients.into_iter().fold(0.0, f64::max);
                least * 4.0 * rpm * (std::f64::consts::TAU / 60.0) / params.mass
            } else {
                0.0
            };
            if effects.ground && drone.ground.coefficient > 0.0 {
                force += force * drone.ground.coefficient / (drone.ground.clip * drone.ground.clip);
            }
            if effects.downwash {
                force += wakes;
            }
            if self.wind.is_some() {
                // gusts have no bound that is worth anything
                force = f64::INFINITY;
            }
            let torque = rotors.torque.iter().map(|row| row.iter().map(|x| x.abs()).sum::<f64>() * rpm * rpm);
            let torque = torque.map(|x| x * x).sum::<f64>().sqrt();
            Body {
                mass: params.mass,
                inertia,
                free,
                envelope: Envelope::new(&free, 0.0, force / params.mass, torque, slowing),
            }
        };
        self.bodies.drones.clear();
        self.bodies.drones.extend(self.drones.iter().zip(&self.actuators).map(body));
        for (body, drone) in self.bodies.drones.iter_mut().zip(&world.drones) {
            // the size that it collides with is always that of the scene
            let reach = drone.params.collision_radius.hypot(0.5 * drone.params.collision_height);
            body.envelope = body.envelope.reaching(reach);
        }
    }

    /// Changes a drone's airframe. What is not one is an error, and there all the same.
    pub(super) fn change(&mut self, drone: usize, change: impl FnOnce(&mut DroneParams)) -> Result<(), DroneError> {
        let own = &mut self.drones[drone];
        change(&mut own.params);
        let params = &mut own.params;
        // one that can no longer hover is still a body
        let ratio = params.thrust_to_weight;
        params.thrust_to_weight = ratio.max(1.0);
        let sound = params.validate();
        params.thrust_to_weight = ratio;
        (own.rotors, own.ground) = (RotorModel::new(&own.params), GroundEffect::new(&own.params));
        self.wakes[drone] = Wake::new(&own.params);
        if let Some(wind) = &mut self.wind {
            wind.set_area(drone, own.params.drag_area());
        }
        self.changed = true;
        sound
    }

    /// Makes room for motors that are so many physics steps late and for so many states to be remembered.
    pub(super) fn reserve(&mut self, motors: usize, states: usize) {
        self.actuators.iter_mut().for_each(|actuators| actuators.reserve(motors));
        self.memory.states.reserve(states.saturating_sub(self.memory.states.len()));
    }

    /// Whether its drones can be advanced as lanes, without looking at them between physics steps.
    pub(crate) fn is_plain(&self) -> bool {
        self.wind.is_none() && self.memory.states.is_empty() && self.actuators.iter().all(Actuators::is_prompt)
    }

    /// Whether all environments may have the same: nothing of it changes while it flies, and motors do what they are told.
    pub(crate) fn is_common(&self) -> bool {
        self.is_plain() && self.drones.iter().all(|drone| drone.actuators == ActuatorParams::default())
    }

    /// Whether an environment with the other one flies as with this one.
    pub(crate) fn is_like(&self, other: &Self) -> bool {
        let drones = self.drones.iter().zip(&other.drones);
        self.is_common()
            && other.is_common()
            && self.bodies == other.bodies
            && self.obstacles == other.obstacles
            && drones.clone().all(|(a, b)| a.params == b.params)
    }

    /// Keeps obstacles of its own.
    pub(crate) fn keep_obstacles(&mut self, obstacles: &[Obstacle]) {
        self.obstacles = obstacles.to_vec();
    }

    /// Takes over what was commanded to a drone (rpm), clipped, and says to what speeds its rotors go.
    #[inline]
    pub(crate) fn command(&mut self, drone: usize, command: &[f64; 4]) -> [f64; 4] {
        let speeds = command.map(|rpm| rpm.clamp(0.0, self.drones[drone].max_rpm));
        self.motor_speeds[drone] = speeds;
        self.actuators[drone].target(&speeds)
    }

    /// Speeds that a drone's rotors go to, rpm.
    pub(crate) fn target(&self, drone: usize) -> [f64; 4] {
        self.actuators[drone].target(&self.motor_speeds[drone])
    }

    /// What was commanded to a drone, rpm.
    #[inline]
    pub(crate) fn commanded(&self, drone: usize) -> &[f64; 4] {
        &self.motor_speeds[drone]
    }

    /// Speeds of a drone's rotors, rpm.
    #[inline]
    pub(crate) fn rpm(&self, drone: usize) -> &[f64; 4] {
        self.actuators[drone].rpm()
    }

    /// Whether some rotors are slow.
    pub(crate) fn has_lag(&self) -> bool {
        self.actuators.iter().any(|motors| motors.share() < 1.0)
    }

    /// Bytes that it takes.
    pub(crate) fn bytes(&self) -> usize {
        let Self { drones, actuators, wakes, bodies, wind, memory, motor_speeds, obstacles, .. } = self;
        let texts: usize = drones.iter().map(|drone| drone.params.name.len() + drone.params.provenance.len()).sum();
        size_of::<Self>()
            + texts
            + size_of_val(&drones[..])
            + size_of_val(&actuators[..])
            + size_of_val(&wakes[..])
            + size_of_val(&bodies.drones[..])
            + wind.as_ref().map_or(0, WindField::bytes)
            + size_of_val(&memory.states[..])
            + size_of_val(&motor_speeds[..])
            + size_of_val(&obstacles[..])
    }

    /// Whether it has obstacles of its own.
    pub(crate) fn has_obstacles(&self) -> bool {
        !self.obstacles.is_empty()
    }

    /// The bodies, once they are up to date.
    pub(crate) fn bodies(&self) -> &Bodies {
        &self.bodies
    }

    /// Obstacles of its own.
    pub(crate) fn obstacles(&self) -> &[Obstacle] {
        &self.obstacles
    }

    /// A drone for the flight kernel's lanes.
    pub(crate) fn airframe(&self, drone: usize, effects: Effects) -> Airframe {
        let Drone { params, rotors, ground, .. } = &self.drones[drone];
        Airframe {
            body: self.bodies.drones[drone].free,
            rotors: *rotors,
            ground: if effects.ground { *ground } else { GroundEffect::default() },
            drag: if effects.drag { params.drag_coefficients.into() } else { nalgebra::Vector3::zeros() },
            wake: if effects.downwash { self.wakes[drone] } else { Wake::default() },
            share: self.actuators[drone].share(),
            envelope: self.bodies.drones[drone].envelope,
        }
    }

    /// Takes motor commands over, clipped, if all of them are numbers.
    pub(super) fn accept(&mut self, commands: &[[f64; 4]], time: f64) -> Result<(), SimulationError> {
        let expected = self.drones.len();
        if commands.len() != expected {
            return Err(SimulationError::Length { what: "the list of motor commands", got: commands.len(), expected });
        }
        for (drone, speeds) in commands.iter().enumerate() {
            if let Some((motor, &got)) = speeds.iter().enumerate().find(|(_, rpm)| !rpm.is_finite()) {
                return Err(SimulationError::Command { drone, motor, got, time });
            }
        }
        for ((drone, speeds), command) in self.drones.iter().zip(&mut self.motor_speeds).zip(commands) {
            *speeds = command.map(|rpm| rpm.clamp(0.0, drone.max_rpm));
        }
        Ok(())
    }
}

impl Memory {
    /// As if the drones had always been where they are.
    pub fn forget(&mut self, states: &[DroneState]) {
        self.oldest = 0;
        for list in self.states.chunks_exact_mut(states.len()) {
            list.copy_from_slice(states);
        }
    }

    /// Keeps the states of a physics step.
    pub fn note(&mut self, states: &[DroneState]) {
        if !self.states.is_empty() {
            let count = states.len();
            self.states[self.oldest * count..][..count].copy_from_slice(states);
            self.oldest = (self.oldest + 1) % (self.states.len() / count);
        }
    }
}
