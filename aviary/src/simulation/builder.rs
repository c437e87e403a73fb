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

/// The options of a [`Simulation`]; what is not said is the paper's default.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::Physics;
/// use aviary::simulation::Simulation;
///
/// let builder = Simulation::builder(DroneModel::Race).num_drones(2).physics(Physics::MjcDrag);
/// let simulation = builder.clone().sim_freq(500).ctrl_freq(100).build()?;
/// assert_eq!((simulation.num_drones(), simulation.substeps()), (2, 5));
/// // what cannot be is an error that names it
/// let error = builder.ctrl_freq(7).build().unwrap_err();
/// assert!(error.to_string().contains("ctrl_freq 7 Hz"));
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone)]
pub struct SimulationBuilder {
    drones: Vec<DroneParams>,
    /// Number of drones that was asked for.
    asked: usize,
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
    markers: Vec<Marker>,
    integrator: Integrator,
    medium: Option<Medium>,
    wind: Option<WindConfig>,
    engine: Option<EngineKind>,
    /// The engine where none is asked for.
    default_engine: EngineKind,
}

impl SimulationBuilder {
    /// The defaults, for one drone of an airframe.
    pub fn new(drone: DroneParams) -> Self {
        Self {
            drones: vec![drone],
            asked: 1,
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
            markers: Vec::new(),
            integrator: Integrator::Rk4,
            medium: None,
            wind: None,
            engine: None,
            default_engine: EngineKind::default(),
        }
    }

    /// How many drones of the same airframe; 1 by default.
    #[must_use]
    pub fn num_drones(mut self, count: usize) -> Self {
        let first = self.drones.first().cloned();
        self.asked = count;
        // one more than there can be is enough for `build` to say so
        self.drones = first.into_iter().cycle().take(count.min(Simulation::MAX_DRONES + 1)).collect();
        self
    }

    /// Airframes of all drones, where they differ.
    #[must_use]
    pub fn drones(mut self, drones: impl IntoIterator<Item = DroneParams>) -> Self {
        self.drones = drones.into_iter().collect();
        self.asked = self.drones.len();
        self
    }

    /// Initial positions, world frame, m; by default in a row along x at z = 0.1 m, four times the largest arm or
    /// collision radius apart.
    #[must_use]
    pub fn initial_positions(mut self, positions: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.positions = Some(positions.into_iter().collect());
        self
    }

    /// Initial positions for callers that have their own idea of a default.
    pub(crate) fn initial_positions_or(mut self, positions: Vec<[f64; 3]>) -> Self {
        self.positions.get_or_insert(positions);
        self
    }

    /// Initial roll, pitch, yaw, rad; level and facing x by default.
    #[must_use]
    pub fn initial_rpys(mut self, rpys: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.rpys = Some(rpys.into_iter().collect());
        self
    }

    /// Initial velocities, world frame, m/s; at rest by default.
    #[must_use]
    pub fn initial_velocities(mut self, velocities: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.velocities = Some(velocities.into_iter().collect());
        self
    }

    /// Initial body rates, body frame, rad/s; none by default.
    #[must_use]
    pub fn initial_angular_velocities(mut self, rates: impl IntoIterator<Item = [f64; 3]>) -> Self {
        self.angular_velocities = Some(rates.into_iter().collect());
        self
    }

    /// The physics mode, the paper's shorthand for [`effects`](Self::effects) and [`engine`](Self::engine); MuJoCo without
    /// aerodynamic effects by default.
    #[must_use]
    pub fn physics(mut self, physics: Physics) -> Self {
        self.physics = Some(physics);
        self
    }

    /// Any subset of the aerodynamic effects; those of the physics mode by default. Next to a physics mode with other effects they
    /// are an error.
    #[must_use]
    pub fn effects(mut self, effects: Effects) -> Self {
        self.effects = Some(effects);
        self
    }

    /// The engine; by default the explicit engine in the physics mode `dyn`, and MuJoCo otherwise. The hybrid engine gives the same
    /// flights as MuJoCo, many times faster. An engine that the physics mode does not stand for is an error.
    #[must_use]
    pub fn engine(mut self, engine: EngineKind) -> Self {
        self.engine = Some(engine);
        self
    }

    /// The engine, for callers that have their own idea of a default.
    pub(crate) fn engine_or(mut self, engine: EngineKind) -> Self {
        self.default_engine = engine;
        self
    }

    /// How the rotors' wrench acts during a physics step; frozen by default.
    #[must_use]
    pub fn forcing(mut self, forcing: Forcing) -> Self {
        self.forcing = forcing;
        self
    }

    /// How the motors answer to commands; at once and exactly by default.
    #[must_use]
    pub fn actuators(mut self, actuators: ActuatorParams) -> Self {
        self.actuators = actuators;
        self
    }

    /// Things that stand in the way; none by default.
    #[must_use]
    pub fn obstacles(mut self, obstacles: impl IntoIterator<Item = Obstacle>) -> Self {
        self.obstacles = obstacles.into_iter().collect();
        self
    }

    /// Further things that stand in the way, after those that are there already.
    pub(crate) fn more_obstacles(mut self, obstacles: impl IntoIterator<Item = Obstacle>) -> Self {
        self.obstacles.extend(obstacles);
        self
    }

    /// Things that are seen and not touched, beside those that are there already.
    #[must_use]
    pub fn markers(mut self, markers: impl IntoIterator<Item = Marker>) -> Self {
        self.markers.extend(markers);
        self
    }

    /// Initial positions so far.
    pub(crate) fn starts(&self) -> &[[f64; 3]] {
        self.positions.as_deref().unwrap_or_default()
    }

    /// Returns whether there are obstacles so far.
    pub(crate) fn has_obstacles(&self) -> bool {
        !self.obstacles.is_empty()
    }

    /// The wind so far.
    pub(crate) fn wind_config(&self) -> Option<&WindConfig> {
        self.wind.as_ref()
    }

    /// Airframes so far, in order.
    pub(crate) fn airframes(&self) -> &[DroneParams] {
        &self.drones
    }

    /// Physics rate, Hz; 240 by default.
    #[must_use]
    pub fn sim_freq(mut self, hertz: u32) -> Self {
        self.sim_freq = hertz;
        self
    }

    /// Control rate, Hz, a divisor of the physics rate; 48 by default.
    #[must_use]
    pub fn ctrl_freq(mut self, hertz: u32) -> Self {
        self.ctrl_freq = hertz;
        self
    }

    /// MuJoCo's integrator; RK4 by default.
    #[must_use]
    pub fn integrator(mut self, integrator: Integrator) -> Self {
        self.integrator = integrator;
        self
    }

    /// MuJoCo's fluid forces; off by default.
    #[must_use]
    pub fn medium(mut self, medium: impl Into<Option<Medium>>) -> Self {
        self.medium = medium.into();
        self
    }

    /// The wind; still air by default.
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

    /// Compiles the world.
    ///
    /// # Errors
    /// [`SimulationError`] naming the option that is impossible.
    pub fn build(self) -> Result<Simulation, SimulationError> {
        let (sim_freq, ctrl_freq) = (self.sim_freq, self.ctrl_freq);
        if sim_freq == 0 || sim_freq > Simulation::MAX_SIM_FREQ || ctrl_freq == 0 || !sim_freq.is_multiple_of(ctrl_freq)
        {
            return Err(SimulationError::Rates { sim_freq, ctrl_freq });
        }
        let (effects, engine) = self.effects_and_engine()?;
        let count = self.drones.len();
        if !(1..=Simulation::MAX_DRONES).contains(&count) {
            return Err(SimulationError::NumDrones { got: self.asked.max(count) });
        }
        for (drone, params) in self.drones.iter().enumerate() {
            params.validate().map_err(|error| SimulationError::Drone { drone, error })?;
        }
        let positions = self.positions.unwrap_or_else(|| row(&self.drones));
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
            obstacles: self.obstacles,
            markers: self.markers,
            ..World::new(bodies)
        };
        let (actuators, fingerprint) = (self.actuators, Fingerprint::default());
        let model = SimModel { world, effects, engine, sim_freq, ctrl_freq, initial, actuators, fingerprint }
            .with_fingerprint();
        let workspace = model.workspace()?;
        // positions and attitudes that are out of range have been named by the scene
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

/// Drones side by side on a line along x, far enough apart that their bodies do not meet.
fn row(drones: &[DroneParams]) -> Vec<[f64; 3]> {
    let spacing = drones.iter().map(|params| 4.0 * params.arm_length.max(params.collision_radius)).fold(0.0, f64::max);
    (0..drones.len()).map(|index| [index as f64 * spacing, 0.0, 0.1]).collect()
}
