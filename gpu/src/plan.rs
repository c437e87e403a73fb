//! Description of the environments of a batch: what a kernel is built for, and the parameters that it reads.

use aviary::action::ActionType;
use aviary::drone::DroneParams;
use aviary::engine::{Engine, EngineKind};
use aviary::env::{Aviary, DroneEnv, EndReason, Env as _, Task};
use aviary::observation::ObservationType;
use aviary::state::wxyz;
use aviary::tasks::{CrashConditions, Hover, Stabilize};
use aviary::vector::Autoreset;
use aviary::world::{Forcing, Integrator};
use flight::body::{Fluid, FreeBody, Medium};
use flight::clearance::CollisionCylinder;
use flight::ground_effect::GroundEffect;
use flight::math::{Real, Turn, V3};
use flight::rotor::RotorModel;
use flight::state::FlightState;
use flight::tasks::crash::CLEAR_OF_FLOOR;

use crate::error::GpuError;

/// Task of a kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum TaskKind {
    Hover,
    Stabilize,
}

/// Options that a kernel is built for. Equal plans share one kernel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Plan {
    pub task: TaskKind,
    /// True if one action commands all four motors.
    pub one_action: bool,
    /// Physics steps per control step.
    pub substeps: u32,
    /// Physics steps per second.
    pub sim_freq: u32,
    /// Control steps after which an episode is truncated.
    pub episode_steps: u32,
    pub autoreset: Autoreset,
    pub ground: bool,
    pub drag: bool,
    /// True if the motors have lag.
    pub lag: bool,
    pub medium: bool,
    pub body_fixed: bool,
    /// True if rotor speeds are relative to the hover speed. In single precision the torque, a difference of squared
    /// rotor speeds, would otherwise keep few digits.
    pub relative: bool,
}

impl Plan {
    /// Returns the number of entries of an action.
    pub fn action_size(&self) -> usize {
        if self.one_action { 1 } else { 4 }
    }
}

/// Parameters of an environment, in the units of the fields of `flight`.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Parameters<R = f64> {
    pub body: FreeBody<R>,
    pub rotors: RotorModel<R>,
    pub ground: GroundEffect<R>,
    /// Coefficients of the blade drag, body frame, N/(m/s)/(rad/s).
    pub drag: V3<R>,
    /// Share of the remaining speed difference that a rotor closes in one physics step.
    pub lag_share: R,
    /// Hover speed of the nominal airframe, rpm.
    pub hover_rpm: R,
    /// Full speed minus hover speed of the nominal airframe, rpm.
    pub rpm_above_hover: R,
    /// Factors on the commanded speeds.
    pub gains: [R; 4],
    /// The factors minus 1. In single precision their difference would keep few digits.
    pub gain_errors: [R; 4],
    /// Speed at which the rotors saturate, minus the hover speed, rpm.
    pub max_change: R,
    pub cylinder: CollisionCylinder<R>,
    /// Cosine of the maximum tilt; below −1 without a limit.
    pub min_up: R,
    /// Options of the task: Hover has target and maximum height (m). Stabilize has the maxima of the initial speed
    /// (m/s), roll and pitch (rad) and body rate (rad/s) along each axis.
    pub task: [R; 3],
    /// State at the start of an episode, before the draws of the task.
    pub start: FlightState<R>,
}

impl Parameters {
    /// Number of parameters.
    pub const COUNT: usize = 67;

    /// Returns the parameters as a list, in the order of [`Parameters::read`].
    pub fn numbers(&self) -> Vec<f64> {
        let Self { body, rotors, ground, drag, start, .. } = self;
        let mut list = vec![body.inverse_mass, body.gravity];
        list.extend(body.inverse_inertia);
        list.extend(body.gyration);
        list.push(body.fluid.viscous);
        list.extend(body.fluid.quadratic);
        list.extend(body.fluid.viscous_rate);
        list.extend(body.fluid.quadratic_rate);
        list.push(rotors.thrust);
        list.extend(rotors.torque.as_flattened());
        list.extend([ground.coefficient, ground.clip, drag.x, drag.y, drag.z]);
        list.extend([self.lag_share, self.hover_rpm, self.rpm_above_hover]);
        list.extend(self.gains);
        list.extend(self.gain_errors);
        list.push(self.max_change);
        list.extend([self.cylinder.radius, self.cylinder.height]);
        list.push(self.min_up);
        list.extend(self.task);
        list.extend(motion_numbers(start));
        debug_assert_eq!(list.len(), Self::COUNT);
        list
    }
}

impl<R: Real> Parameters<R> {
    /// Reads the parameters from a list. `next` returns its numbers in order.
    pub fn read(mut next: impl FnMut() -> R) -> Self {
        fn several<R, const N: usize>(next: &mut impl FnMut() -> R) -> [R; N] {
            std::array::from_fn(|_| next())
        }
        let next = &mut next;
        let (inverse_mass, gravity) = (next(), next());
        let (inverse_inertia, gyration) = (several(next), several(next));
        let fluid = Fluid {
            viscous: next(),
            quadratic: several(next),
            viscous_rate: several(next),
            quadratic_rate: several(next),
        };
        let body = FreeBody { inverse_mass, gravity, inverse_inertia, gyration, fluid };
        let rotors = RotorModel { thrust: next(), torque: [several(next), several(next), several(next)] };
        let ground = GroundEffect { coefficient: next(), clip: next() };
        let drag = V3 { x: next(), y: next(), z: next() };
        Self {
            body,
            rotors,
            ground,
            drag,
            lag_share: next(),
            hover_rpm: next(),
            rpm_above_hover: next(),
            gains: several(next),
            gain_errors: several(next),
            max_change: next(),
            cylinder: CollisionCylinder { radius: next(), height: next() },
            min_up: next(),
            task: several(next),
            start: motion_of(&several(next)),
        }
    }
}

/// Number of numbers of a state: position 3, attitude 4, velocity 3, body rate 3.
pub(crate) const MOTION: usize = 13;

/// Returns a state as numbers.
pub(crate) fn motion_numbers<R: Copy>(motion: &FlightState<R>) -> [R; MOTION] {
    let FlightState { position: p, attitude: q, velocity: v, rate: w } = motion;
    [p.x, p.y, p.z, q.w, q.v.x, q.v.y, q.v.z, v.x, v.y, v.z, w.x, w.y, w.z]
}

/// Returns the state of its numbers.
pub(crate) fn motion_of<R: Copy>(&[x, y, z, w, qx, qy, qz, vx, vy, vz, p, q, r]: &[R; MOTION]) -> FlightState<R> {
    FlightState {
        position: V3 { x, y, z },
        attitude: Turn { w, v: V3 { x: qx, y: qy, z: qz } },
        velocity: V3 { x: vx, y: vy, z: vz },
        rate: V3 { x: p, y: q, z: r },
    }
}

/// Task of this library that runs on a GPU.
pub trait GpuTask: Task + Clone + Send + Sync + private::Sealed {
    #[doc(hidden)]
    fn kernel(&self) -> private::KernelTask;
}

pub(crate) mod private {
    /// Tasks have kernels of this crate.
    pub trait Sealed {}

    impl Sealed for super::Hover {}
    impl Sealed for super::Stabilize {}

    /// Task of a kernel with its options.
    #[derive(Debug)]
    pub struct KernelTask {
        pub(crate) kind: super::TaskKind,
        pub(crate) options: [f64; 3],
        pub(crate) crash: super::CrashConditions,
    }
}

impl GpuTask for Hover {
    fn kernel(&self) -> private::KernelTask {
        let options = [self.target_height, self.max_height, 0.0];
        private::KernelTask { kind: TaskKind::Hover, options, crash: self.crash.clone() }
    }
}

impl GpuTask for Stabilize {
    fn kernel(&self) -> private::KernelTask {
        let options = [self.max_speed, self.max_lean, self.max_rate];
        private::KernelTask { kind: TaskKind::Stabilize, options, crash: self.crash.clone() }
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

/// Describes an environment for the kernels. `relative` is [`Plan::relative`].
///
/// # Errors
/// [`GpuError::NotPorted`] for an option that the kernels do not have, and the errors of the first reset.
pub(crate) fn describe<T: GpuTask>(
    env: &mut Aviary<T>,
    autoreset: Autoreset,
    relative: bool,
) -> Result<(Plan, Parameters), GpuError> {
    // samples exist from the first episode on
    env.reset(Some(0))?;
    if env.sampled_params().is_some() {
        return not_ported("randomization", "set", "none");
    }
    let private::KernelTask { kind, options, crash } = env.task().kernel();
    let (simulation, action_type) = (env.simulation(), env.action_type());
    let (world, params) = (simulation.world(), simulation.params(0));
    if simulation.num_drones() != 1 {
        return not_ported("num_drones", simulation.num_drones(), "1");
    }
    if !matches!(action_type, ActionType::Rpm | ActionType::OneDRpm) {
        return not_ported("action_type", action_type, "rpm or one_d_rpm");
    }
    if matches!(simulation.engine(), Engine::Explicit(_)) {
        return not_ported("engine", EngineKind::Explicit, "mujoco or hybrid");
    }
    if world.integrator != Integrator::Rk4 {
        return not_ported("integrator", "another integrator", "rk4");
    }
    if simulation.wind().is_some() {
        return not_ported("wind", "set", "none");
    }
    if !simulation.obstacles().is_empty() {
        return not_ported("obstacles", simulation.obstacles().len(), "none");
    }
    if env.observation_space().kind != ObservationType::KIN {
        return not_ported("observation_type", "another type", "kin");
    }
    check_airframe(params, relative)?;
    check_crash(&crash)?;
    let actuators = simulation.actuator_params(0);
    if actuators.latency > 0.0 {
        return not_ported("actuators.latency", format!("{} s", actuators.latency), "0 s");
    }
    let Ok(episode_steps) = u32::try_from(env.episode_steps()) else {
        return not_ported("episode_seconds", env.episode_steps(), "an episode of at most 4,294,967,295 control steps");
    };
    let state = &simulation.initial_states()[0];
    let [w, x, y, z] = wxyz(&state.attitude);
    let (p, v, rate) = (&state.position, &state.velocity, &state.angular_velocity);
    let start = motion_of(&[p.x, p.y, p.z, w, x, y, z, v.x, v.y, v.z, rate.x, rate.y, rate.z]);
    let cylinder = CollisionCylinder { radius: params.collision_radius, height: params.collision_height };
    let clearance = cylinder.floor_clearance(start.position.z, start.attitude.up().z);
    if clearance <= CLEAR_OF_FLOOR {
        return not_ported("initial_positions", format!("{} m above the floor", clearance), "more than 0.01 m");
    }
    let (dt, effects) = (world.timestep, simulation.effects());
    let (hover, max) = (params.hover_rpm(), params.max_rpm());
    let allocation = params.allocation() * params.thrust_coefficient;
    let row = |row: usize| [0, 1, 2, 3].map(|rotor| allocation[(row, rotor)]);
    let quarter = params.propeller_radius / 4.0;
    let medium = world.medium.map(|medium| Medium { density: medium.density, viscosity: medium.viscosity });
    let [drag_x, drag_y, drag_z] = params.drag_coefficients;
    let parameters = Parameters {
        body: FreeBody::new(params.mass, params.inertia, simulation.gravity(), medium),
        rotors: RotorModel { thrust: allocation[(0, 0)], torque: [row(1), row(2), row(3)] },
        ground: GroundEffect {
            coefficient: params.ground_effect_coefficient * quarter * quarter,
            clip: params.ground_effect_clip(),
        },
        drag: V3::new(drag_x, drag_y, drag_z),
        lag_share: if actuators.lag > 0.0 { -(-dt / actuators.lag).exp_m1() } else { 1.0 },
        hover_rpm: hover,
        rpm_above_hover: max - hover,
        gains: actuators.gains,
        gain_errors: actuators.gains.map(|gain| gain - 1.0),
        max_change: max * actuators.saturation - hover,
        cylinder,
        min_up: if crash.max_tilt < std::f64::consts::PI { crash.max_tilt.cos() } else { -2.0 },
        task: options,
        start,
    };
    let plan = Plan {
        task: kind,
        one_action: action_type == ActionType::OneDRpm,
        substeps: simulation.substeps(),
        sim_freq: simulation.sim_freq(),
        episode_steps,
        autoreset,
        ground: effects.ground,
        drag: effects.drag,
        lag: actuators.lag > 0.0,
        medium: medium.is_some(),
        body_fixed: world.forcing == Forcing::BodyFixed,
        relative,
    };
    Ok((plan, parameters))
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

/// Checks that a contact with the floor ends the episode: the kernels detect contacts, and do not compute their forces.
fn check_crash(crash: &CrashConditions) -> Result<(), GpuError> {
    if !crash.floor_contact {
        return not_ported("crash.floor_contact", false, "true");
    }
    Ok(())
}
