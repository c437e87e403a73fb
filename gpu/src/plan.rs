//! Description of the environments of a batch: what a kernel is built for, and the parameters that it reads.

use std::f64::consts::PI;
use std::fmt::Debug;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::ops::Deref;
use std::sync::Arc;

use aviary::action::{ActionDecoder, ActionType};
use aviary::drone::DroneParams;
use aviary::engine::{Engine, EngineKind};
use aviary::env::{Aviary, DroneEnv, EndReason, Env as _, Randomization};
use aviary::observation::ObservationType;
use aviary::physics::wind::{WindConfig, WindModel};
use aviary::state::wxyz;
use aviary::tasks::CrashConditions;
use aviary::vector::Autoreset;
use aviary::world::{Forcing, Integrator};
use flight::body::{FreeBody, Medium};
use flight::clearance::CollisionCylinder;
use flight::downwash::Wake;
use flight::ground_effect::GroundEffect;
use flight::math::V3;
use flight::rotor::RotorModel;
use flight::state::FlightState;
use flight::tasks::crash::CLEAR_OF_FLOOR;
use flight::wind::{WindParams, WindParts};

use crate::error::GpuError;
use crate::parameters::{Parameters, motion_of};
use crate::tasks::{GpuTask, KernelTask};

/// Largest number of control steps whose commands or states arrive later: a kernel visits each of them in every step,
/// in instructions of its own.
const MAX_LATE: usize = 64;

/// Largest number of drones of an environment: a kernel visits every other drone, in instructions of its own.
const MAX_DRONES: usize = 64;

/// Settings whose numbers are constants of a kernel. Two of them are equal if their texts are, which contain every
/// digit. Every launch compares them, so that their hash is computed once.
#[derive(Debug, Clone)]
pub(crate) struct Settings<T> {
    value: Arc<T>,
    text: Arc<str>,
    hash: u64,
}

impl<T: Debug> Settings<T> {
    pub fn new(value: T) -> Self {
        let text = format!("{value:?}");
        let mut hasher = DefaultHasher::new();
        text.hash(&mut hasher);
        Self { value: Arc::new(value), text: text.into(), hash: hasher.finish() }
    }
}

impl<T> Deref for Settings<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.value
    }
}

impl<T> PartialEq for Settings<T> {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.text, &other.text) || self.text == other.text
    }
}

impl<T> Eq for Settings<T> {}

impl<T> Hash for Settings<T> {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.hash.hash(state);
    }
}

/// Conversion of actions to motor speeds.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) enum Decoding {
    /// Normalized motor speeds of four motors, or of all motors together.
    Scaled { one: bool },
    /// Motor speeds, rpm.
    Raw,
    /// Control loops.
    Loops(Settings<ActionDecoder>),
}

/// Crash conditions of a kernel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Crash {
    /// True for the condition on the height of the centre.
    pub below_floor: bool,
    /// True if a contact of two drones is a crash.
    pub drones: bool,
    /// Cosine of the maximum tilt; `None` without a limit.
    pub upright: Option<f64>,
}

/// Settings of the wind of a kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct WindPlan {
    pub turbulence: bool,
    pub second_order: bool,
    pub gusts: bool,
    pub sinusoidal: bool,
}

impl WindPlan {
    fn new(params: &WindParams<f64>) -> Self {
        let WindParts { turbulence, second_order, gusts, sinusoidal } = params.parts();
        Self { turbulence, second_order, gusts, sinusoidal }
    }

    /// Returns the parts of the wind.
    pub fn parts(self) -> WindParts {
        let Self { turbulence, second_order, gusts, sinusoidal } = self;
        WindParts { turbulence, second_order, gusts, sinusoidal }
    }
}

/// Options that a kernel is built for. Equal plans share one kernel.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Plan {
    pub task: Settings<KernelTask>,
    pub crash: Settings<Crash>,
    /// Number of drones of an environment.
    pub drones: u32,
    /// Index of the random stream of the first environment.
    pub stream: u32,
    pub decoding: Decoding,
    /// Bounds of the action of a drone.
    pub action_bounds: Settings<Vec<[f64; 2]>>,
    /// Bounds of the observation of a drone.
    pub observation_bounds: Settings<Vec<[f64; 2]>>,
    /// Physics steps per control step.
    pub substeps: u32,
    /// Physics steps per second.
    pub sim_freq: u32,
    /// Control steps after which an episode is truncated.
    pub episode_steps: u32,
    pub autoreset: Autoreset,
    pub ground: bool,
    pub drag: bool,
    pub downwash: bool,
    /// True if the motors have lag.
    pub lag: bool,
    pub medium: bool,
    pub body_fixed: bool,
    pub wind: Option<WindPlan>,
    /// Ranges of the samples; all groups are off without randomization.
    pub ranges: Settings<Randomization>,
    /// Wind of a randomization with a speed of 1 m/s along x, per unit of drag area.
    pub sampled_wind: Option<Settings<WindConfig>>,
    /// True if a drone may start so close to the floor that its first contact is no crash.
    pub floor: bool,
    /// Number of control steps whose commands may still be on their way to the motors.
    pub late_commands: usize,
    /// Number of control steps whose states may still be observed.
    pub late_states: usize,
    /// Parameters that are drawn for every episode, in the order of [`Parameters::each`].
    pub drawn: Vec<bool>,
    /// True if rotor speeds are relative to the hover speed. In single precision the torque, a difference of squared
    /// rotor speeds, would otherwise keep few digits.
    pub relative: bool,
}

impl Plan {
    /// Returns the number of entries of the action of a drone.
    pub fn action_size(&self) -> usize {
        self.action_bounds.len()
    }

    /// Returns the number of entries of the observation of a drone.
    pub fn observation_size(&self) -> usize {
        self.observation_bounds.len()
    }

    /// Returns the length of a physics step, s.
    pub fn dt(&self) -> f64 {
        1.0 / f64::from(self.sim_freq)
    }

    /// Returns the length of a control step, s.
    pub fn control_period(&self) -> f64 {
        f64::from(self.substeps) * self.dt()
    }
}

/// Returns the number of a reason in the output of a kernel: 0 for none.
pub(crate) fn code_of(reason: EndReason) -> u32 {
    EndReason::ALL.iter().position(|other| *other == reason).map_or(0, |index| index as u32 + 1)
}

/// Returns the reason of its number.
pub(crate) fn reason_of(code: u32) -> Option<EndReason> {
    EndReason::ALL.get((code as usize).checked_sub(1)?).copied()
}

/// Returns an error for an option that the kernels do not have.
fn not_ported<T>(option: &'static str, got: impl ToString, expected: &'static str) -> Result<T, GpuError> {
    Err(GpuError::NotPorted { option, got: got.to_string(), expected })
}

/// Describes an environment for the kernels: a plan, and the nominal parameters of every drone. `relative` is
/// [`Plan::relative`].
///
/// # Errors
/// [`GpuError::NotPorted`] for an option that the kernels do not have.
pub(crate) fn describe<T: GpuTask>(
    env: &Aviary<T>,
    autoreset: Autoreset,
    relative: bool,
) -> Result<(Plan, Vec<Parameters>), GpuError> {
    // the parameters of a new environment are nominal
    let ranges = env.randomization().cloned().unwrap_or(Randomization::NONE);
    let (task, crash) = env.task().kernel(env.simulation().num_drones());
    let (simulation, action_type) = (env.simulation(), env.action_type());
    let (world, drones) = (simulation.world(), simulation.num_drones());
    if matches!(simulation.engine(), Engine::Explicit(_)) {
        return not_ported("engine", EngineKind::Explicit, "mujoco or hybrid");
    }
    if world.integrator != Integrator::Rk4 {
        return not_ported("integrator", "another integrator", "rk4");
    }
    if !simulation.obstacles().is_empty() {
        return not_ported("obstacles", simulation.obstacles().len(), "none");
    }
    let moving = env.task().moving_markers().len();
    if moving > 0 {
        return not_ported("moving_markers", moving, "none");
    }
    if env.observation_space().kind != ObservationType::KIN {
        return not_ported("observation_type", "another type", "kin");
    }
    if ranges.airframe.is_some() {
        return not_ported("randomization.airframe", "set", "no randomized airframes");
    }
    let medium = world.medium.map(|medium| Medium { density: medium.density, viscosity: medium.viscosity });
    if medium.is_some() && ranges.body.is_some() {
        return not_ported("medium", "set with a randomized body", "no medium, or no randomized body");
    }
    for drone in 0..drones {
        check_airframe(simulation.params(drone), relative)?;
    }
    check_crash(&crash)?;
    if drones > MAX_DRONES {
        return not_ported("num_drones", drones, "at most 64");
    }
    let Ok(episode_steps) = u32::try_from(env.episode_steps()) else {
        let got = format!("set to {} control steps", env.episode_steps());
        return not_ported("episode_seconds", got, "at most 4,294,967,295 control steps");
    };
    let Ok(stream) = u32::try_from(env.stream()) else {
        return not_ported("stream", env.stream(), "at most 4,294,967,295");
    };
    let own_wind = simulation.wind().filter(|wind| !wind.is_calm()).copied();
    let sampled_wind = ranges.draws_wind().then(|| unit_wind(env.wind_settings().copied()));
    let mut parameters = Vec::new();
    for drone in 0..drones {
        parameters.push(nominal(env, drone, medium, own_wind, sampled_wind));
    }
    check_starts(&task, &ranges, &parameters)?;
    let (dt, effects, substeps) = (world.timestep, simulation.effects(), simulation.substeps());
    let wind_params = match (&sampled_wind, own_wind) {
        (Some(wind), _) => Some(wind.params(dt)),
        (None, wind) => wind.map(|wind| wind.params(dt)),
    };
    let decoding = decoding(env, action_type)?;
    let history = |option, seconds: f64| match ((seconds / dt).round() as usize).div_ceil(substeps as usize) {
        steps @ 0..=MAX_LATE => Ok(steps),
        steps => not_ported(option, format!("up to {steps} control steps"), "at most 64 control steps"),
    };
    let nominal_latency = (0..drones).map(|drone| simulation.actuator_params(drone).latency).fold(0.0, f64::max);
    let late_commands = match ranges.actuators {
        Some(ranges) => history("randomization.actuators.latency", ranges.latency[1])?,
        None => history("latency", nominal_latency)?,
    };
    let late_states = match ranges.sensors {
        Some(ranges) => history("randomization.sensors.latency", ranges.latency[1])?,
        None => 0,
    };
    let bounds = |low: &[f64], high: &[f64]| -> Settings<Vec<[f64; 2]>> {
        let all = low.iter().zip(high).map(|(&low, &high)| [low, high]);
        Settings::new(all.take(low.len() / drones).collect())
    };
    let (actions, observations) = (env.action_space(), &env.observation_space().vector);
    let mut plan = Plan {
        task: Settings::new(task),
        crash: Settings::new(Crash {
            below_floor: crash.below_floor,
            drones: crash.drone_contact,
            upright: (crash.max_tilt < PI).then(|| crash.max_tilt.cos()),
        }),
        drones: drones as u32,
        stream,
        decoding,
        action_bounds: bounds(actions.low(), actions.high()),
        observation_bounds: bounds(observations.low(), observations.high()),
        substeps,
        sim_freq: simulation.sim_freq(),
        episode_steps,
        autoreset,
        ground: effects.ground,
        drag: effects.drag,
        downwash: effects.downwash && drones > 1,
        lag: ranges.actuators.is_some() || (0..drones).any(|drone| simulation.actuator_params(drone).lag > 0.0),
        medium: medium.is_some(),
        body_fixed: world.forcing == Forcing::BodyFixed,
        wind: wind_params.as_ref().map(WindPlan::new),
        floor: parameters.iter().any(|nominal| may_start_on_floor(&ranges, nominal)),
        late_commands,
        late_states,
        ranges: Settings::new(ranges),
        sampled_wind: sampled_wind.map(Settings::new),
        drawn: vec![false; Parameters::COUNT],
        relative,
    };
    plan.drawn = crate::environment::drawn_parameters(&plan, &parameters);
    Ok((plan, parameters))
}

/// Returns the nominal parameters of a drone.
///
/// Without a sample the wind is the environment's own one. A sampled wind keeps the drag of `sampled_wind` alone.
fn nominal<T: GpuTask>(
    env: &Aviary<T>,
    drone: usize,
    medium: Option<Medium>,
    own_wind: Option<WindConfig>,
    sampled_wind: Option<WindConfig>,
) -> Parameters {
    let simulation = env.simulation();
    let (params, actuators, dt) =
        (simulation.params(drone), simulation.actuator_params(drone), simulation.world().timestep);
    let state = &simulation.initial_states()[drone];
    let [w, x, y, z] = wxyz(&state.attitude);
    let (p, v, rate) = (&state.position, &state.velocity, &state.angular_velocity);
    let start = motion_of(&[p.x, p.y, p.z, w, x, y, z, v.x, v.y, v.z, rate.x, rate.y, rate.z]);
    let (hover, max) = (params.hover_rpm(), params.max_rpm());
    let allocation = params.allocation() * params.thrust_coefficient;
    let row = |row: usize| [0, 1, 2, 3].map(|rotor| allocation[(row, rotor)]);
    let quarter = params.propeller_radius / 4.0;
    let [drag_x, drag_y, drag_z] = params.drag_coefficients;
    let [c1, c2, c3] = params.downwash_coefficients;
    let of_area = |wind: WindConfig| {
        let air = wind.params(dt);
        WindParams { drag: air.drag * wind.area_of(params.drag_area()), ..air }
    };
    let wind = match (sampled_wind, own_wind) {
        (Some(wind), _) => WindParams { drag: of_area(wind).drag, ..WindParams::default() },
        (None, wind) => wind.map(of_area).unwrap_or_default(),
    };
    let lag = actuators.lag > 0.0;
    let (latency, saturated) = ((actuators.latency / dt).round(), max * actuators.saturation);
    Parameters {
        body: FreeBody::new(params.mass, params.inertia, simulation.gravity(), medium),
        rotors: RotorModel { thrust: allocation[(0, 0)], torque: [row(1), row(2), row(3)] },
        ground: GroundEffect {
            coefficient: params.ground_effect_coefficient * quarter * quarter,
            clip: params.ground_effect_clip(),
        },
        drag: V3::new(drag_x, drag_y, drag_z),
        wake: Wake { strength: c1 * quarter * quarter, spread: c2, offset: c3, cap: params.max_thrust() },
        lag_share: if lag { -(-dt / actuators.lag).exp_m1() } else { 1.0 },
        hover_rpm: hover,
        rpm_above_hover: max - hover,
        gains: actuators.gains,
        gain_errors: actuators.gains.map(|gain| gain - 1.0),
        max_change: saturated - hover,
        initial_change: if lag || latency > 0.0 { hover.min(saturated) - hover } else { -hover },
        motor_latency: latency,
        sensor_latency: 0.0,
        biases: [[0.0; 3]; 4],
        wind,
        cylinder: CollisionCylinder { radius: params.collision_radius, height: params.collision_height },
        start,
    }
}

/// Returns the settings of a sampled wind at a speed of 1 m/s along x. `own` is the environment's wind.
fn unit_wind(own: Option<WindConfig>) -> WindConfig {
    let WindConfig { filter, drag_area, still_air_drag, .. } = own.unwrap_or_default();
    WindConfig { filter, drag_area, still_air_drag, velocity: [1.0, 0.0, 0.0], ..WindConfig::new(WindModel::Combined) }
}

/// Returns the conversion of actions to motor speeds.
fn decoding<T: GpuTask>(env: &Aviary<T>, action_type: ActionType) -> Result<Decoding, GpuError> {
    Ok(match action_type {
        ActionType::Rpm => Decoding::Scaled { one: false },
        ActionType::OneDRpm => Decoding::Scaled { one: true },
        ActionType::RawRpm => Decoding::Raw,
        ActionType::Vel | ActionType::Pid | ActionType::Attitude | ActionType::Ctbr => {
            let loops = Settings::new(env.action_decoder(0).clone());
            for drone in 1..env.simulation().num_drones() {
                if Settings::new(env.action_decoder(drone).clone()) != loops {
                    return not_ported("drone", "several airframes with control loops", "one airframe");
                }
            }
            Decoding::Loops(loops)
        }
        other => return not_ported("action_type", other, "another action type than duty"),
    })
}

/// Checks that the kernels have all effects of an airframe.
fn check_airframe(params: &DroneParams, relative: bool) -> Result<(), GpuError> {
    if !params.motors.is_default() {
        return not_ported("drone.motors", "set", "an airframe without it");
    }
    if !params.air.is_default() {
        return not_ported("drone.air", "set", "an airframe without it");
    }
    if params.battery.is_some() {
        return not_ported("drone.battery", "set", "an airframe without it");
    }
    // at equal rotor speeds the torque of such an airframe is not zero
    if relative && params.center_of_mass != [0.0; 2] {
        return not_ported("drone.center_of_mass", "set", "[0, 0] in single precision");
    }
    Ok(())
}

/// Checks that a contact of a drone in flight ends the episode: the kernels detect such contacts, and do not compute
/// their forces.
fn check_crash(crash: &CrashConditions) -> Result<(), GpuError> {
    for (option, condition) in
        [("crash.floor_contact", crash.floor_contact), ("crash.drone_contact", crash.drone_contact)]
    {
        if !condition {
            return not_ported(option, false, "true");
        }
    }
    Ok(())
}

/// Returns the radius of the bounding ball of a collision cylinder, m.
fn ball(cylinder: &CollisionCylinder) -> f64 {
    cylinder.radius.hypot(0.5 * cylinder.height)
}

/// Returns the lowest position of the centre of a drone at the start of an episode, m, before the sampler lifts it out
/// of the floor.
fn lowest_start(ranges: &Randomization, nominal: &Parameters) -> f64 {
    let change = ranges.initial.map_or(0.0, |ranges| ranges.position - ranges.offset[2]);
    nominal.start.position.z - change
}

/// Returns true if a drone may start so close to the floor that it is not airborne.
fn may_start_on_floor(ranges: &Randomization, nominal: &Parameters) -> bool {
    let Parameters { cylinder, start, .. } = nominal;
    let tilts = ranges.initial.is_some_and(|ranges| ranges.attitude > 0.0);
    let up = start.attitude.up().z.clamp(-1.0, 1.0);
    let depth = if tilts { ball(cylinder) } else { cylinder.depth(up, (1.0 - up * up).sqrt()) };
    lowest_start(ranges, nominal) - depth <= CLEAR_OF_FLOOR
}

/// Checks that no start of an episode needs a second sample. On the CPU such starts overlap the floor or another drone.
pub(crate) fn check_starts(task: &KernelTask, ranges: &Randomization, drones: &[Parameters]) -> Result<(), GpuError> {
    if matches!(task, KernelTask::Stabilize { .. }) {
        let clearance = |nominal: &Parameters| lowest_start(ranges, nominal) - ball(&nominal.cylinder);
        let lowest = drones.iter().map(clearance).fold(f64::INFINITY, f64::min);
        if lowest <= CLEAR_OF_FLOOR {
            return not_ported("initial_positions", format!("{lowest} m above the floor"), "more than 0.01 m");
        }
    }
    let reach = ranges.initial.map_or(0.0, |ranges| 2.0 * 3_f64.sqrt() * ranges.position);
    if reach == 0.0 {
        // the builder has checked the starts
        return Ok(());
    }
    for (index, one) in drones.iter().enumerate() {
        for other in &drones[..index] {
            let FlightState { position, .. } = one.start;
            let apart = (position - other.start.position).norm() - ball(&one.cylinder) - ball(&other.cylinder);
            if apart <= reach {
                let got = format!("{apart:.3} m apart with a random change of up to {reach:.3} m");
                return not_ported("initial_positions", got, "drones whose random starts cannot meet");
            }
        }
    }
    Ok(())
}
