use std::sync::Arc;

use super::{SimModel, Simulation, SimulationError, out_of_range};
use crate::drone::DroneParams;
use crate::engine::EngineKind;
use crate::physics::actuators::ActuatorParams;
use crate::physics::wind::WindConfig;
use crate::physics::{Effects, Physics};
use crate::serial::Fingerprint;
use crate::state::DroneState;
use crate::world::{DroneBody, Forcing, Integrator, Marker, Medium, Obstacle, World};

/// Options of a [`Simulation`]. The defaults are the paper's.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::Physics;
/// use aviary::simulation::Simulation;
///
/// let builder = Simulation::builder(DroneModel::Race).num_drones(2).physics(Physics::MjcDrag);
/// let simulation = builder.clone().sim_freq(500).ctrl_freq(100).build()?;
/// assert_eq!((simulation.num_drones(), simulation.substeps()), (2, 5));
/// // an invalid option is an error that names it
/// let error = builder.ctrl_freq(7).build().unwrap_err();
/// assert!(error.to_string().contains("ctrl_freq 7 Hz"));
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone)]
pub struct SimulationBuilder {
    drones: Vec<DroneParams>,
    /// Number of drones before it was limited for allocation.
    requested: usize,
    positions: Option<Vec<[f64; 3]>>,
    rpys: Option<Vec<[f64; 3]>>,
    sim_freq: u32,
    ctrl_freq: u32,
    velocities: Option<Vec<[f64; 3]>>,
    angular_velocities: Option<Vec<[f64; 3]>>,
    physics: Option<Physics>,
    effects: Option<Effects>,
    forcing: Forcing,
    actuators: ActuatorParams,
    obstacles: Vec<Obstacle>,
    moving_obstacles: Vec<Obstacle>,
    markers: Vec<Marker>,
    integrator: Integrator,
    medium: Option<Medium>,
    wind: Option<WindConfig>,
    engine: Option<EngineKind>,
    /// Engine without a call of `engine` or a physics mode that implies one.
    default_engine: EngineKind,
}

impl SimulationBuilder {
    /// Creates the default options for one drone of an airframe.
    pub fn new(drone: DroneParams) -> Self {
        Self {
            drones: vec![drone],
            requested: 1,
            positions: None,
            rpys: None,
            sim_freq: 240,
            ctrl_freq: 48,
            velocities: None,
            angular_velocities: None,
            physics: None,
            effects: None,
            forcing: Forcing::default(),
            actuators: ActuatorParams::default(),
            obstacles: Vec::new(),
            moving_obstacles: Vec::new(),
            markers: Vec::new(),
            integrator: Integrator::Rk4,
            medium: None,
            wind: None,
            engine: None,
            default_engine: EngineKind::default(),
        }
    }

    /// Sets the number of drones of the same airframe; default 1.
    #[must_use]
    pub fn num_drones(mut self, count: usize) -> Self {
        let first = self.drones.first().cloned();
        self.requested = count;
        // one more than the maximum is enough for `build` to return its error
        self.drones = first.into_iter().cycle().take(count.min(Simulation::MAX_DRONES + 1)).collect();
        self
    }

    /// Sets the airframe of each drone.
    #[must_use]
    pub fn drones(mut self, drones: impl IntoIterator<Item = DroneParams>) -> Self {
        self.drones = drones.into_iter().collect();
        self.requested = self.drones.len();
        self
    }

    /// Sets the initial positions, world frame, m. By default, drones stand in a row along x at z = 0.1 m, four
    /// times the largest arm or collision radius apart.
    #[must_use]
    pub fn initial_positions(mut self, positions: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.positions = Some(positions.into_iter().collect());
        self
    }

    /// Sets the initial positions if they are not set yet.
    pub(crate) fn initial_positions_or(mut self, positions: Vec<[f64; 3]>) -> Self {
        self.positions.get_or_insert(positions);
        self
    }

    /// Sets the initial roll, pitch and yaw, rad; default zero (level, facing x).
    #[must_use]
    pub fn initial_rpys(mut self, rpys: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.rpys = Some(rpys.into_iter().collect());
        self
    }

    /// Sets the initial velocities, world frame, m/s; default zero.
    #[must_use]
    pub fn initial_velocities(mut self, velocities: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.velocities = Some(velocities.into_iter().collect());
        self
    }

    /// Sets the initial angular velocities, body frame, rad/s; default zero.
    #[must_use]
    pub fn initial_angular_velocities(mut self, rates: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.angular_velocities = Some(rates.into_iter().collect());
        self
    }

    /// Sets the paper's physics mode, a shorthand for [`effects`](Self::effects) and [`engine`](Self::engine);
    /// default MuJoCo without aerodynamic effects.
    #[must_use]
    pub fn physics(mut self, physics: Physics) -> Self {
        self.physics = Some(physics);
        self
    }

    /// Sets the aerodynamic effects; default those of the physics mode. [`build`](Self::build) returns an error if
    /// they differ from those of a physics mode that is also set.
    #[must_use]
    pub fn effects(mut self, effects: Effects) -> Self {
        self.effects = Some(effects);
        self
    }

    /// Sets the engine; default the explicit engine for the physics mode `dyn`, otherwise MuJoCo. The hybrid engine
    /// computes the same trajectories as MuJoCo, many times faster. [`build`](Self::build) returns an error if the
    /// engine contradicts the physics mode.
    #[must_use]
    pub fn engine(mut self, engine: EngineKind) -> Self {
        self.engine = Some(engine);
        self
    }

    /// Sets the default of [`engine`](Self::engine).
    pub(crate) fn engine_or(mut self, engine: EngineKind) -> Self {
        self.default_engine = engine;
        self
    }

    /// Sets how the rotors' wrench acts during a physics step; default frozen.
    #[must_use]
    pub fn forcing(mut self, forcing: Forcing) -> Self {
        self.forcing = forcing;
        self
    }

    /// Sets the motor parameters; default immediate and exact.
    #[must_use]
    pub fn actuators(mut self, actuators: ActuatorParams) -> Self {
        self.actuators = actuators;
        self
    }

    /// Sets the obstacles; default none.
    #[must_use]
    pub fn obstacles(mut self, obstacles: impl IntoIterator<Item = Obstacle>) -> Self {
        self.obstacles = obstacles.into_iter().collect();
        self
    }

    /// Adds obstacles after those already set.
    pub(crate) fn more_obstacles(mut self, obstacles: impl IntoIterator<Item = Obstacle>) -> Self {
        self.obstacles.extend(obstacles);
        self
    }

    /// Adds obstacles that [move](Simulation::move_obstacles) between control steps, after all others. A later call of
    /// [`obstacles`](Self::obstacles) keeps them.
    #[must_use]
    pub fn moving_obstacles(mut self, obstacles: impl IntoIterator<Item = Obstacle>) -> Self {
        self.moving_obstacles.extend(obstacles);
        self
    }

    /// Adds markers, which are visible and do not collide.
    #[must_use]
    pub fn markers(mut self, markers: impl IntoIterator<Item = Marker>) -> Self {
        self.markers.extend(markers);
        self
    }

    /// Returns the initial positions set so far.
    pub(crate) fn starts(&self) -> &[[f64; 3]] {
        self.positions.as_deref().unwrap_or_default()
    }

    /// Returns true if obstacles are set.
    pub(crate) fn has_obstacles(&self) -> bool {
        !self.obstacles.is_empty()
    }

    /// Returns the wind set so far.
    pub(crate) fn wind_config(&self) -> Option<&WindConfig> {
        self.wind.as_ref()
    }

    /// Returns the airframes set so far, in order.
    pub(crate) fn airframes(&self) -> &[DroneParams] {
        &self.drones
    }

    /// Sets the physics rate, Hz; default 240.
    #[must_use]
    pub fn sim_freq(mut self, hertz: u32) -> Self {
        self.sim_freq = hertz;
        self
    }

    /// Sets the control rate, Hz, a divisor of the physics rate; default 48.
    #[must_use]
    pub fn ctrl_freq(mut self, hertz: u32) -> Self {
        self.ctrl_freq = hertz;
        self
    }

    /// Sets MuJoCo's integrator; default RK4.
    #[must_use]
    pub fn integrator(mut self, integrator: Integrator) -> Self {
        self.integrator = integrator;
        self
    }

    /// Sets the medium of MuJoCo's fluid forces; default none.
    #[must_use]
    pub fn medium(mut self, medium: impl Into<Option<Medium>>) -> Self {
        self.medium = medium.into();
        self
    }

    /// Sets the wind; default still air.
    #[must_use]
    pub fn wind(mut self, wind: impl Into<Option<WindConfig>>) -> Self {
        self.wind = wind.into();
        self
    }

    /// Resolves the physics mode, the effects and the engine.
    fn effects_and_engine(&self) -> Result<(Effects, EngineKind), SimulationError> {
        let Some(physics) = self.physics else {
            return Ok((self.effects.unwrap_or_default(), self.engine.unwrap_or(self.default_engine)));
        };
        if let Some(effects) = self.effects.filter(|effects| *effects != physics.effects()) {
            return Err(SimulationError::EffectsOfPhysics { effects, physics });
        }
        let default = if physics.is_explicit() { EngineKind::Explicit } else { self.default_engine };
        let engine = self.engine.unwrap_or(default);
        if physics.is_explicit() != (engine == EngineKind::Explicit) {
            return Err(SimulationError::EngineOfPhysics { engine, physics });
        }
        Ok((physics.effects(), engine))
    }

    /// Compiles the scene and creates the simulation.
    ///
    /// # Errors
    /// [`SimulationError`] naming the invalid option.
    pub fn build(self) -> Result<Simulation, SimulationError> {
        let (sim_freq, ctrl_freq) = (self.sim_freq, self.ctrl_freq);
        if sim_freq == 0 || sim_freq > Simulation::MAX_SIM_FREQ || ctrl_freq == 0 || !sim_freq.is_multiple_of(ctrl_freq)
        {
            return Err(SimulationError::Rates { sim_freq, ctrl_freq });
        }
        let (effects, engine) = self.effects_and_engine()?;
        let count = self.drones.len();
        if !(1..=Simulation::MAX_DRONES).contains(&count) {
            return Err(SimulationError::NumDrones { got: self.requested.max(count) });
        }
        for (drone, params) in self.drones.iter().enumerate() {
            params.validate().map_err(|error| SimulationError::Drone { drone, error })?;
        }
        let positions = self.positions.unwrap_or_else(|| default_positions(&self.drones));
        let zeros = || vec![[0.0; 3]; count];
        let rpys = self.rpys.unwrap_or_else(zeros);
        let velocities = self.velocities.unwrap_or_else(zeros);
        let rates = self.angular_velocities.unwrap_or_else(zeros);
        for (what, got) in [
            ("initial_positions", positions.len()),
            ("initial_rpys", rpys.len()),
            ("initial_velocities", velocities.len()),
            ("initial_angular_velocities", rates.len()),
        ] {
            if got != count {
                return Err(SimulationError::Length { what, got, expected: count, of: "drone" });
            }
        }
        self.actuators.validate()?;

        let bodies: Vec<_> = (self.drones.iter().zip(&positions).zip(&rpys))
            .map(|((params, &position), &rpy)| DroneBody {
                params: params.clone(),
                position: position.into(),
                rpy: rpy.into(),
            })
            .collect();
        let initial: Vec<_> = (bodies.iter().zip(velocities).zip(rates))
            .map(|((body, velocity), rate)| DroneState {
                velocity: velocity.into(),
                angular_velocity: rate.into(),
                ..DroneState::at_rest(body.position, body.rpy)
            })
            .collect();
        let world = World {
            timestep: 1.0 / f64::from(sim_freq),
            integrator: self.integrator,
            medium: self.medium,
            forcing: self.forcing,
            moving_obstacles: self.moving_obstacles.len(),
            obstacles: [self.obstacles, self.moving_obstacles].concat(),
            markers: self.markers,
            ..World::new(bodies)
        };
        let (actuators, fingerprint) = (self.actuators, Fingerprint::default());
        let model = SimModel { world, effects, engine, sim_freq, ctrl_freq, initial, actuators, fingerprint }
            .with_fingerprint();
        let workspace = model.workspace()?;
        // compiling the scene has already rejected positions and attitudes out of range
        if let Some(drone) = model.initial.iter().position(|state| out_of_range(state).is_some()) {
            return Err(SimulationError::State { drone });
        }
        let mut data = model.data();
        data.contacts.reserve(workspace.engine().mujoco_engine().max_contacts());
        data.set_wind(self.wind, 0)?;
        let mut simulation = Simulation { model: Arc::new(model), data, workspace };
        simulation.workspace.load(&simulation.model, &simulation.data)?;
        Ok(simulation)
    }
}

/// Returns positions in a row along x, far enough apart that the drones do not touch.
pub(crate) fn default_positions(drones: &[DroneParams]) -> Vec<[f64; 3]> {
    let spacing = drones.iter().map(|params| 4.0 * params.arm_length.max(params.collision_radius)).fold(0.0, f64::max);
    (0..drones.len()).map(|index| [index as f64 * spacing, 0.0, 0.1]).collect()
}
