//! Batches of hover under the conditions of realistic training, measured in turns.

use std::time::{Duration, Instant};

use aviary::env::{AviaryBuilder, BodyRanges, EnvError, Randomization};
use aviary::physics::Physics;
use aviary::physics::actuators::ActuatorParams;
use aviary::physics::wind::{WindConfig, WindModel};
use aviary::tasks::Hover;
use aviary::vector::{VecAviary, VecBuffers, VecConfig, VecEnv};

use super::Row;
use super::meter::{Meter, median, spread};
use super::policy::LinearPolicy;

/// Number of environments.
const SIZE: usize = 4096;

/// Conditions with the names of their rows; the first one is the reference of the others.
fn conditions() -> [(&'static str, AviaryBuilder<Hover>); 8] {
    let hover = Hover::builder;
    let wind = |model| hover().wind(WindConfig::new(model));
    let body = Randomization { body: Some(BodyRanges::default()), ..Randomization::NONE };
    [
        ("conditions/plain", hover()),
        ("conditions/effects", hover().physics(Physics::MjcGndDragDw)),
        ("conditions/lag", hover().actuators(ActuatorParams { lag: 0.02, ..ActuatorParams::default() })),
        ("conditions/body", hover().randomization(body)),
        ("conditions/constant_wind", wind(WindModel::Constant)),
        ("conditions/dryden", wind(WindModel::Dryden)),
        ("conditions/default_randomization", hover().randomization(Randomization::default())),
        ("conditions/random_actions", hover()),
    ]
}

/// A batch under one condition.
struct Batch {
    env: VecAviary<Hover>,
    buffers: VecBuffers,
    policy: LinearPolicy,
    random: bool,
}

impl Batch {
    fn step(&mut self, calls: usize) -> Result<Duration, EnvError> {
        let mut spent = Duration::ZERO;
        for _ in 0..calls {
            let action = if self.random { self.policy.random() } else { self.policy.act(&self.buffers.observations) };
            let begin = Instant::now();
            self.env.step(action, self.buffers.step())?;
            spent += begin.elapsed();
        }
        Ok(spent)
    }
}

/// Measures a row of every condition that is wanted, and of plain flight.
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
        let mut env = VecAviary::new(builder, VecConfig { threads: 1, width: meter.width, ..VecConfig::new(SIZE) })?;
        let mut buffers = VecBuffers::new(&env);
        env.reset(Some(1), &mut buffers.observations)?;
        let policy = LinearPolicy::new(meter.seed, SIZE, 1, env.observation_size()).gentle();
        let mut batch = Batch { env, buffers, policy, random: name.ends_with("random_actions") };
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
            physics: if name.ends_with("effects") { Physics::MjcGndDragDw } else { Physics::Mjc },
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
