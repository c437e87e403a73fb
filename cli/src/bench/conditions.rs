//! Batches of hover under the conditions of realistic training and with the action types, measured in turns.

use std::time::{Duration, Instant};

use aviary::action::ActionType;
use aviary::drone::{AirParams, DroneModel, DroneParams, MotorParams};
use aviary::env::{BodyRanges, EnvConfig, EnvError, Randomization};
use aviary::physics::Physics;
use aviary::physics::actuators::ActuatorParams;
use aviary::physics::wind::{WindConfig, WindModel};
use aviary::vector::{VecBuffers, VecConfig, VecEnv, make_vec};

use super::Row;
use super::meter::{Meter, median, spread};
use super::policy::LinearPolicy;

/// Number of environments.
const SIZE: usize = 4096;

/// Conditions and action types with the names of their rows; the first one is the reference of the others.
fn conditions() -> [(&'static str, EnvConfig); 13] {
    let hover = EnvConfig::default;
    let wind = |model| hover().wind(WindConfig::new(model));
    let actions = |kind| hover().action_type(kind).initial_positions([[0.0, 0.0, 1.0]]);
    let body = Randomization { body: Some(BodyRanges::default()), ..Randomization::NONE };
    [
        ("conditions/plain", hover()),
        ("conditions/effects", hover().physics(Physics::MjcGndDragDw)),
        ("conditions/lag", hover().actuators(ActuatorParams { lag: 0.02, ..ActuatorParams::default() })),
        ("conditions/airframe_effects", hover().drone(measured())),
        ("conditions/body", hover().randomization(body)),
        ("conditions/constant_wind", wind(WindModel::Constant)),
        ("conditions/dryden", wind(WindModel::Dryden)),
        ("conditions/default_randomization", hover().randomization(Randomization::default())),
        ("conditions/random_actions", hover()),
        ("actions/vel", actions(ActionType::Vel)),
        ("actions/pid", actions(ActionType::Pid)),
        ("actions/attitude", actions(ActionType::Attitude)),
        ("actions/ctbr", actions(ActionType::Ctbr)),
    ]
}

/// Returns a Crazyflie with every effect that an airframe can have, of the size that flights show.
fn measured() -> DroneParams {
    let motors = MotorParams { rise_time: 0.06, fall_time: 0.08, rotor_inertia: 4e-8, ..MotorParams::default() };
    let air = AirParams {
        linear_drag: [0.012, 0.012, 0.02],
        translational_lift: 0.002,
        velocity_moment: 1e-4,
        rotational_damping: [1e-4, 1e-4, 5e-5],
        trim_torque: [5e-6, -5e-6, 1e-6],
    };
    DroneParams { center_of_mass: [2e-4, -1e-4], motors, air, ..DroneModel::Cf2x.params() }
}

/// A batch under one condition.
struct Batch {
    env: Box<dyn VecEnv>,
    buffers: VecBuffers,
    policy: LinearPolicy,
    source: Source,
}

/// Source of the actions of a batch.
enum Source {
    Policy,
    Random,
    /// Commands of controllers, one of which is repeated after the other.
    Commands {
        all: Vec<Vec<f32>>,
        next: usize,
    },
}

impl Source {
    fn of(name: &str) -> Self {
        match name {
            "conditions/random_actions" => Self::Random,
            _ => match command(name, 0.0) {
                Some(_) => Self::Commands { all: (0..TURN).map(|step| commands(name, step)).collect(), next: 0 },
                None => Self::Policy,
            },
        }
    }
}

/// Number of control steps after which the commands repeat.
const TURN: usize = 8;

/// Returns the commands of all environments in one control step.
fn commands(name: &str, step: usize) -> Vec<f32> {
    let phase = |environment: usize| 0.1 * environment as f32 + std::f32::consts::TAU * step as f32 / TURN as f32;
    (0..SIZE).flat_map(|environment| command(name, phase(environment)).unwrap_or_default()).collect()
}

/// Returns the command of a drone that stays in place on average, for the rows of action types.
fn command(name: &str, phase: f32) -> Option<[f32; 4]> {
    let (sin, cos) = phase.sin_cos();
    match name {
        "actions/vel" => Some([0.2 * sin, 0.2 * cos, 0.05 * sin, 0.3 * cos]),
        "actions/pid" => Some([0.1 * sin, 0.1 * cos, 1.0 + 0.1 * sin, 0.3 * cos]),
        "actions/attitude" => Some([0.01 * sin, 0.05 * sin, 0.05 * cos, 0.1 * sin]),
        "actions/ctbr" => Some([0.01 * sin, 0.01 * sin, 0.01 * cos, 0.02 * sin]),
        _ => None,
    }
}

impl Batch {
    fn step(&mut self, calls: usize) -> Result<Duration, EnvError> {
        let mut spent = Duration::ZERO;
        for _ in 0..calls {
            let action = match &mut self.source {
                Source::Policy => self.policy.act(&self.buffers.observations),
                Source::Random => self.policy.random(),
                Source::Commands { all, next } => {
                    *next = (*next + 1) % all.len();
                    &all[*next]
                }
            };
            let begin = Instant::now();
            self.env.step(action, self.buffers.step())?;
            spent += begin.elapsed();
        }
        Ok(spent)
    }
}

/// Measures a row of every condition and action type that is wanted, and of plain flight.
pub(super) fn rows(meter: &mut Meter, wanted: impl Fn(&str) -> bool) -> Result<Vec<Row>, EnvError> {
    /// Control steps of a measurement.
    const CALLS: usize = 4;
    /// Control steps before the measurements: a second, in which the drones take off.
    const WARM_UP: usize = 48;
    let mut batches = Vec::new();
    for (index, (name, builder)) in conditions().into_iter().enumerate() {
        if index > 0 && !wanted(name) {
            continue;
        }
        let mut env = make_vec("hover", builder, VecConfig { threads: 1, width: meter.width, ..VecConfig::new(SIZE) })?;
        let mut buffers = VecBuffers::new(&*env);
        env.reset(Some(1), &mut buffers.observations)?;
        let policy = LinearPolicy::new(meter.seed, SIZE, 1, env.observation_size()).gentle();
        let mut batch = Batch { env, buffers, policy, source: Source::of(name) };
        batch.step(WARM_UP)?;
        batches.push((name, batch));
    }
    let rounds = meter.rounds_in_turns(batches.len(), |index| batches[index].1.step(CALLS))?;
    let per_call = (CALLS * SIZE) as f64;
    // 240 Hz physics, 48 Hz control
    let substeps = 5.0;
    let row = |(index, (name, batch)): (usize, &(&'static str, Batch))| {
        let of = |pick: &dyn Fn(&Vec<[f64; 2]>) -> f64| rounds.iter().map(pick).collect::<Vec<_>>();
        let mut ratios = of(&|round| round[index][1]);
        let mut to_plain = of(&|round| round[index][0] / round[0][0]);
        let rate = median(&mut of(&|round| round[index][0])) * per_call;
        let steps = batch.env.engine_substeps();
        Row {
            name: (*name).into(),
            engine: "hybrid",
            task: "hover".into(),
            environments: SIZE,
            drones: 1,
            physics: if *name == "conditions/effects" { Physics::MjcGndDragDw } else { Physics::Mjc },
            threads: 1,
            env_steps_per_second: rate,
            physics_steps_per_second: rate * substeps,
            spread: spread(&ratios),
            ratio: median(&mut ratios) * per_call * substeps,
            mujoco_share: Some(steps.mujoco as f64 / (steps.mujoco + steps.flight) as f64),
            ratio_to_plain: Some([median(&mut to_plain), spread(&to_plain)]),
            ratio_in_contact: None,
            bytes_per_environment: batch.env.bytes_per_env(),
            resident_bytes: None,
            frames_per_second: None,
        }
    };
    Ok(batches.iter().enumerate().map(row).collect())
}
