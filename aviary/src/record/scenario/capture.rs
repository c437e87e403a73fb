//! Conversion of simulations to scenarios.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::{ReplayError, Scenario, ScenarioBody};
use crate::drone::{DroneModel, GRAVITY};
use crate::physics::actuators::ActuatorParams;
use crate::record::table::written;
use crate::simulation::Simulation;
use crate::state::{DroneState, attitude_from_rpy, wxyz};
use crate::world::{ObstacleConfig, ObstacleKind};

impl Scenario {
    /// Creates the scenario of a flight from a simulation at its start, after the reset of the environment.
    ///
    /// # Errors
    /// [`ReplayError::Field`] for a simulation that a scenario cannot describe: one that has been stepped, or one
    /// whose drones have different airframes.
    pub fn of(simulation: &Simulation) -> Result<Self, ReplayError> {
        let wrong = |field, message: &str| Err(ReplayError::Field { field, line: None, message: message.into() });
        let (world, states) = (&simulation.scene(), simulation.states());
        let nominal = &world.drones[0].params;
        if simulation.control_steps() > 0 {
            return wrong("initial_xyzs", "the simulation has been stepped, expected one at its start");
        }
        if world.drones.iter().any(|drone| drone.params != *nominal) {
            return wrong("drone_model", "the drones have different airframes, expected one for all");
        }
        if (0..simulation.num_drones()).any(|drone| simulation.external_force(drone) != Vector3::zeros()) {
            return wrong("external_force", "a drone has an external force, expected none");
        }
        let physics = simulation.physics();
        let built_in = nominal.name.parse::<DroneModel>().is_ok_and(|model| model.params() == *nominal);
        let count = states.len();
        let all = |vector: fn(&DroneState) -> Vector3<f64>| -> Vec<[f64; 3]> {
            states.iter().map(|state| vector(state).into()).collect()
        };
        let nonzero = |list: Vec<[f64; 3]>| list.iter().flatten().any(|&x| x != 0.0).then_some(list);
        // the rounding of MuJoCo's inertia depends on the attitudes of the compiled scene
        let scene: Vec<[f64; 3]> = world.drones.iter().map(|drone| drone.rpy.into()).collect();
        let quaternions: Vec<_> = states.iter().map(|state| wxyz(&state.attitude)).collect();
        let bits = |q: [f64; 4]| q.map(f64::to_bits);
        let of_scene = scene.iter().map(|&rpy| bits(wxyz(&attitude_from_rpy(rpy.into()))));
        let exact = of_scene.eq(quaternions.iter().copied().map(bits));
        let (rpys, scene) = if exact {
            (scene, None)
        } else {
            (all(DroneState::rpy).into_iter().map(|rpy| rpy.map(written)).collect(), nonzero(scene))
        };
        let motors =
            |drone| ActuatorParams { gains: *simulation.motor_gains(drone), ..*simulation.actuator_params(drone) };
        let body = |drone| ScenarioBody { airframe: simulation.params(drone).clone(), actuators: motors(drone) };
        let plain = |drone| simulation.params(drone) == nominal && motors(drone) == ActuatorParams::default();
        let obstacles = ObstacleConfig { custom: world.obstacles.clone(), ..ObstacleConfig::new(ObstacleKind::Custom) };
        Ok(Self {
            drone_model: nominal.name.clone(),
            physics,
            effects: physics.is_none().then(|| simulation.effects()),
            num_drones: count,
            sim_freq: simulation.sim_freq(),
            ctrl_freq: simulation.ctrl_freq(),
            initial_xyzs: all(|state| state.position),
            initial_rpys: rpys,
            initial_quaternions: (!exact).then_some(quaternions),
            scene_rpys: scene,
            initial_velocities: nonzero(all(|state| state.velocity)),
            initial_angular_velocities: nonzero(all(|state| state.angular_velocity)),
            forcing: world.forcing,
            integrator: world.integrator,
            engine: Some(simulation.model().engine_kind()),
            gravity: Some(simulation.gravity()).filter(|&gravity| gravity != GRAVITY),
            wind_seed: simulation.wind().map(|_| simulation.wind_seed()),
            medium: world.medium,
            wind: simulation.wind().copied(),
            obstacles: (!world.obstacles.is_empty()).then_some(obstacles),
            moving_obstacles: world.moving_obstacles,
            airframe: (!built_in).then(|| nominal.clone()),
            bodies: (!(0..count).all(plain)).then(|| (0..count).map(body).collect()),
            lines: BTreeMap::new(),
        })
    }
}
