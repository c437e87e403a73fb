//! Conversion of scenarios to simulations.

use super::{ReplayError, Scenario};
use crate::drone::{DroneModel, DroneParams};
use crate::engine::EngineKind;
use crate::physics::Physics;
use crate::simulation::{Simulation, SimulationBuilder, SimulationError};
use crate::state::{DroneState, attitude_from_rpy, attitude_from_wxyz};
use crate::world::{Obstacle, ObstacleKind, World};

impl Scenario {
    /// Returns the parameters of the airframe. Paths of files are relative to the current directory.
    ///
    /// # Errors
    /// [`ReplayError::Field`] if the airframe does not exist or is invalid.
    pub fn drone(&self) -> Result<DroneParams, ReplayError> {
        if let Some(params) = &self.airframe {
            if params.name != self.drone_model {
                let (name, found) = (&params.name, &self.drone_model);
                return Err(self.wrong("drone_model", format!("`{found}`, expected `{name}`, the name in [airframe]")));
            }
            return Ok(params.clone());
        }
        if self.drone_model.ends_with(".toml") {
            return DroneParams::from_file(&self.drone_model).map_err(|error| self.wrong("drone_model", error));
        }
        let model = self.drone_model.parse::<DroneModel>().map_err(|error| self.wrong("drone_model", error))?;
        Ok(model.params())
    }

    /// Creates the simulation at the start of the flight.
    ///
    /// # Errors
    /// [`ReplayError::Field`] with the invalid field.
    pub fn simulation(&self) -> Result<Simulation, ReplayError> {
        let (quaternions, bodies) = (self.initial_quaternions.as_ref(), self.bodies.as_ref());
        let lengths = [("initial_quaternions", quaternions.map(Vec::len)), ("bodies", bodies.map(Vec::len))];
        let vectors = [
            ("initial_xyzs", Some(&self.initial_xyzs), World::MAX_COORDINATE),
            ("initial_rpys", Some(&self.initial_rpys), World::MAX_ANGLE),
            ("scene_rpys", self.scene_rpys.as_ref(), World::MAX_ANGLE),
            // MuJoCo diverges at higher speeds
            ("initial_velocities", self.initial_velocities.as_ref(), 1e9),
            ("initial_angular_velocities", self.initial_angular_velocities.as_ref(), 1e9),
        ];
        let vector_lengths = vectors.map(|(field, list, _)| (field, list.map(Vec::len)));
        for (field, length) in vector_lengths.into_iter().chain(lengths) {
            if let Some(length) = length.filter(|&length| length != self.num_drones) {
                let (found, drones) = (crate::count(length, "entry"), crate::count(self.num_drones, "drone"));
                return Err(self.wrong(field, format!("{found}, expected one for each of {drones}")));
            }
        }
        for (field, list, max) in vectors {
            let Some(list) = list else { continue };
            if let Some(got) = list.iter().flatten().find(|x| !(-max..=max).contains(*x)) {
                let got = crate::number(*got);
                return Err(self.wrong(field, format!("{got}, expected finite numbers within ±{max:e}")));
            }
        }
        if self.scene_rpys.is_some() && quaternions.is_none() {
            return Err(
                self.wrong("scene_rpys", "no initial_quaternions, expected both, or initial_rpys without scene_rpys")
            );
        }
        let level = vec![[0.0; 3]; self.num_drones];
        let scene = match quaternions {
            Some(_) => self.scene_rpys.as_ref().unwrap_or(&level),
            None => &self.initial_rpys,
        };
        if let Some(medium) = self.medium {
            for (what, got) in [("density", medium.density), ("viscosity", medium.viscosity)] {
                if !(0.0..=1e5).contains(&got) {
                    let got = crate::number(got);
                    return Err(self.wrong("medium", format!("{what} is {got}, expected 0 to 1e5")));
                }
            }
        }
        let mut obstacles = self.obstacles()?;
        let Some(fixed) = obstacles.len().checked_sub(self.moving_obstacles) else {
            let (got, all) = (self.moving_obstacles, crate::count(obstacles.len(), "obstacle"));
            return Err(self.wrong("moving_obstacles", format!("{got} of {all}, expected at most all of them")));
        };
        let moving = obstacles.split_off(fixed);
        let mut builder: SimulationBuilder = Simulation::builder(self.drone()?)
            .num_drones(self.num_drones)
            .obstacles(obstacles)
            .moving_obstacles(moving)
            .sim_freq(self.sim_freq)
            .ctrl_freq(self.ctrl_freq)
            .initial_positions(self.initial_xyzs.iter().copied())
            .initial_rpys(scene.iter().copied())
            .medium(self.medium)
            .forcing(self.forcing)
            .integrator(self.integrator);
        if let Some(physics) = self.physics {
            builder = builder.physics(physics);
        }
        if let Some(effects) = self.effects {
            builder = builder.effects(effects);
        }
        // scenarios of earlier versions name the engine `mujoco` for the physics mode `dyn`, which the explicit
        // engine integrates
        let is_early = self.physics == Some(Physics::Dyn) && self.engine == Some(EngineKind::Mujoco);
        if let Some(engine) = self.engine.filter(|_| !is_early) {
            builder = builder.engine(engine);
        }
        if let Some(velocities) = &self.initial_velocities {
            builder = builder.initial_velocities(velocities.iter().copied());
        }
        if let Some(rates) = &self.initial_angular_velocities {
            builder = builder.initial_angular_velocities(rates.iter().copied());
        }
        let mut simulation = builder.build().map_err(|error| {
            let field = match &error {
                SimulationError::Rates { .. } => "sim_freq",
                SimulationError::NumDrones { .. } => "num_drones",
                SimulationError::EngineOfPhysics { .. } => "engine",
                SimulationError::EffectsOfPhysics { .. } => "effects",
                _ => "drone_model",
            };
            self.wrong(field, error)
        })?;
        for (drone, body) in bodies.into_iter().flatten().enumerate() {
            simulation
                .set_airframe(drone, body.airframe.clone())
                .and_then(|()| simulation.set_actuators(drone, &body.actuators))
                .map_err(|error| self.wrong("bodies", error))?;
        }
        if let Some(gravity) = self.gravity {
            simulation.set_gravity(gravity).map_err(|error| self.wrong("gravity", error))?;
        }
        if let Some(quaternions) = quaternions {
            let states = self.states_with(quaternions, simulation.states())?;
            simulation.reset_to(&states).map_err(|error| self.wrong("initial_quaternions", error))?;
        } else if bodies.is_some() || self.gravity.is_some() {
            simulation.reset().map_err(|error| self.wrong("bodies", error))?;
        }
        if self.wind.is_none() && self.wind_seed.is_some() {
            return Err(self.wrong("wind_seed", "a seed without a section [wind], expected both or neither"));
        }
        let seed = self.wind_seed.unwrap_or_default();
        simulation.set_wind(self.wind, seed).map_err(|error| self.wrong("wind", error))?;
        Ok(simulation)
    }

    /// Returns the obstacles.
    fn obstacles(&self) -> Result<Vec<Obstacle>, ReplayError> {
        let Some(config) = &self.obstacles else { return Ok(Vec::new()) };
        if config.kind != ObstacleKind::Custom {
            let kind = config.kind.name();
            return Err(
                self.wrong("obstacles", format!("kind is {kind}, expected custom: a scenario lists its obstacles"))
            );
        }
        config.validate().map_err(|error| self.wrong("obstacles", error))?;
        Ok(config.custom.clone())
    }

    /// Returns states with the attitudes of quaternions, which must match `initial_rpys`.
    fn states_with(&self, quaternions: &[[f64; 4]], states: &[DroneState]) -> Result<Vec<DroneState>, ReplayError> {
        let with = |((state, &q), &rpy): ((&DroneState, &[f64; 4]), &[f64; 3])| {
            let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            if !(1.0 - 1e-9..=1.0 + 1e-9).contains(&length) {
                let length = crate::number(length);
                return Err(self.wrong("initial_quaternions", format!("{q:?} has length {length}, expected 1")));
            }
            let attitude = attitude_from_wxyz(q);
            if attitude.angle_to(&attitude_from_rpy(rpy.into())) > 1e-6 {
                let message = format!("{q:?} differs from the attitude of initial_rpys, expected the same attitude");
                return Err(self.wrong("initial_quaternions", message));
            }
            Ok(DroneState { attitude, ..*state })
        };
        states.iter().zip(quaternions).zip(&self.initial_rpys).map(with).collect()
    }
}
