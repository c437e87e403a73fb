//! Bit-identity of batches and single environments under every condition: wind, slow and late motors, noisy and late
//! sensors, sampled parameters, obstacles, action types, control rates.

use mujoco_drones_gym::engine::flight::Width;
use mujoco_drones_gym::env::{
    ActuatorRanges, AerodynamicRanges, AviaryBuilder, EnvironmentRanges, Randomization, SensorRanges,
};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::physics::wind::{DrydenFilter, WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::world::{Forcing, Integrator, Medium};
use proptest::prelude::*;

use super::common::conditions::{all, everything, forest, late_motors, sensors, strong, with_effects};
use super::common::supplied;
use super::pair::Pair;
use super::{Wander, bits};

/// Sizes of batches with their numbers of threads.
const SIZES: [(usize, usize); 8] = [(1, 1), (40, 5), (7, 1), (13, 2), (24, 3), (8, 1), (9, 2), (40, 2)];

const AUTORESETS: [Autoreset; 3] = [Autoreset::NextStep, Autoreset::SameStep, Autoreset::Disabled];

/// Returns the n-th configuration of a batch: sizes, threads, instruction sets and resets in turn.
fn config(n: usize) -> VecConfig {
    let (environments, threads) = SIZES[n % SIZES.len()];
    let widths: Vec<_> = Width::available().collect();
    let (width, autoreset) = (widths[(n / 3 + n) % widths.len()], AUTORESETS[n % AUTORESETS.len()]);
    VecConfig { threads, width, autoreset, ..VecConfig::new(environments) }
}

/// Returns Hover under a condition. With `tough`, contacts and tilts do not end the episode: drones fly for seconds,
/// tumble, fall and take off again.
fn hover(condition: &EnvConfig, tough: bool) -> AviaryBuilder<Hover> {
    let builder = condition.clone().with_task(Hover::default()).engine(EngineKind::Hybrid);
    let start = |height: f64| builder.clone().initial_positions([[0.0, 0.0, height]]);
    if !tough {
        return start(0.5).episode_seconds(1.3);
    }
    start(1.2).episode_seconds(2.5).task(|hover| {
        (hover.crash.floor_contact, hover.crash.obstacle_contact, hover.crash.max_tilt) = (false, false, 4.0);
        hover.max_height = 20.0;
    })
}

/// Random actions of the environments of a pair, within the bounds of their action type and sometimes beyond.
struct Pilot {
    wander: Wander,
    /// Action at hover and at one and a half times of it, if actions are motor speeds in rpm or duties.
    speeds: Option<[f32; 2]>,
    actions: Vec<f32>,
}

impl Pilot {
    fn new<T: Task + Clone + Send + Sync>(pair: &Pair<T>, seed: u64) -> Self {
        let env = &pair.alone[0];
        let params = &env.simulation().world().drones[0].params;
        let hover = params.hover_rpm() as f32;
        let duty = params.motors.duty(params.hover_rpm(), params.nominal_voltage()) as f32;
        Self {
            wander: Wander::new(seed, pair.batch.num_envs(), pair.batch.action_size()),
            speeds: match env.action_type() {
                ActionType::RawRpm => Some([hover, 1.5 * hover]),
                ActionType::Duty => Some([duty, 1.5 * duty]),
                _ => None,
            },
            actions: Vec::new(),
        }
    }

    fn act(&mut self) -> &[f32] {
        let [zero, one] = self.speeds.unwrap_or([0.0, 1.0]);
        self.actions.clear();
        self.actions.extend(self.wander.next().iter().map(|x| zero + (one - zero) * x));
        &self.actions
    }
}

/// Flies a pair for some seconds, compares every number, and returns the number of episodes that ended. Every `peek`
/// steps it compares an environment in double precision, and at the end all of them.
fn fly<T: Task + Clone + Send + Sync>(
    builder: &AviaryBuilder<T>,
    config: VecConfig,
    seed: u64,
    seconds: f64,
    peek: usize,
) -> usize {
    let mut pair = Pair::new(builder, config, seed);
    let mut pilot = Pilot::new(&pair, seed);
    let steps = (seconds / pair.batch.control_period()) as usize;
    for step in 1..=steps {
        pair.step(pilot.act());
        if step % peek == 0 {
            pair.compare_exactly(step / peek % config.environments);
        }
    }
    pair.compare_all_exactly();
    pair.ended
}

/// Calls a function and names the condition if it panics.
fn under(condition: &str, work: impl FnOnce()) {
    if let Err(panic) = std::panic::catch_unwind(std::panic::AssertUnwindSafe(work)) {
        let text = panic.downcast_ref::<String>().map_or("a panic", String::as_str);
        panic!("{condition}: {text}");
    }
}

#[test]
fn every_condition_is_bit_identical_in_a_batch_and_alone() {
    let mut ended = 0;
    for (n, (name, condition)) in all().into_iter().enumerate() {
        under(&name, || {
            ended += fly(&hover(&condition, false), config(n), 11, 1.7, usize::MAX);
        });
    }
    assert!(ended > 300, "{ended}");
}

/// Environments that do not fly in lanes keep wind, late commands and late observations of their own, too.
#[test]
fn every_condition_is_bit_identical_with_engines_that_do_not_fly_in_lanes() {
    type Change = fn(AviaryBuilder<Hover>) -> AviaryBuilder<Hover>;
    let engines: [(&str, Change); 3] = [
        ("mujoco", |builder| builder.engine(EngineKind::Mujoco)),
        ("hybrid, Euler", |builder| builder.integrator(Integrator::Euler)),
        ("dyn", |builder| builder.physics(Physics::Dyn).engine(EngineKind::Explicit)),
    ];
    let mut flown = 0;
    for (n, (name, condition)) in all().into_iter().enumerate() {
        for (m, (engine, with_engine)) in engines.into_iter().enumerate() {
            let builder = with_engine(hover(&condition, false));
            // the explicit engine has neither obstacles nor MuJoCo's fluid forces nor aerodynamic effects
            if builder.clone().build().is_err() {
                assert_eq!(engine, "dyn", "{name}");
                continue;
            }
            under(&format!("{name}, {engine}"), || {
                let config = VecConfig { environments: 9 + 4 * m, threads: 1 + (n + m) % 2, ..config(n) };
                fly(&builder, config, 11, 0.5, 7);
            });
            flown += 1;
        }
    }
    assert!(flown > 100, "{flown}");
}

/// MuJoCo's contact points are inexact at tilts of about 1e-15 rad: there a drone in reach of the floor is computed as
/// in contact, alone and in a batch.
#[test]
fn gentle_landings_of_almost_level_drones_are_bit_identical() {
    let mut landed = 0;
    for (n, roll) in [2e-15, 1e-15, 6e-16, 3e-16, 1e-14, 1e-13, 1e-11, 0.0].into_iter().enumerate() {
        for k in 0..12 {
            let (yaw, pitch) = (0.05 + 0.525 * f64::from(k) - 3.0, if k % 2 == 0 { roll } else { 0.0 });
            let builder = Hover::builder()
                .engine(EngineKind::Hybrid)
                .initial_positions([[0.0, 0.0, 0.06]])
                .initial_rpys([[roll, pitch, yaw]])
                .episode_seconds(2.0);
            let mut pair = Pair::new(&builder, VecConfig { threads: 1, ..VecConfig::new(1 + n % 2) }, 1);
            let actions = vec![-0.01; 4 * pair.batch.num_envs()];
            (0..90).for_each(|_| pair.step(&actions));
            pair.compare_all_exactly();
            landed += pair.ended;
        }
    }
    assert!(landed > 90, "{landed}");
}

#[test]
fn long_flights_with_contacts_under_every_condition_are_bit_identical_in_a_batch_and_alone() {
    for (n, (name, condition)) in all().into_iter().enumerate() {
        under(&name, || {
            // few environments, because they fly for longer than an episode
            let config = VecConfig { environments: [1, 3, 9][n % 3], threads: 1 + n % 2, ..config(n + 1) };
            fly(&hover(&condition, true), config, 5, 3.0, 17);
        });
    }
}

#[test]
#[ignore = "minutes"]
fn every_condition_is_bit_identical_in_every_size_instruction_set_and_reset() {
    for (name, condition) in all() {
        for (n, (environments, threads)) in SIZES.into_iter().enumerate() {
            for width in Width::available() {
                for (m, autoreset) in AUTORESETS.into_iter().enumerate() {
                    under(&format!("{name}, {environments}, {threads}, {width}, {autoreset:?}"), || {
                        let config = VecConfig { threads, width, autoreset, ..VecConfig::new(environments) };
                        fly(&hover(&condition, (n + m) % 2 == 0), config, n as u64, 1.7, 31);
                    });
                }
            }
        }
    }
}

/// Swarms in wakes of each other, among obstacles, with different bodies, winds and latencies.
#[test]
fn swarms_under_every_condition_are_bit_identical_in_a_batch_and_alone() {
    for (n, (name, condition)) in all().into_iter().enumerate().filter(|(n, _)| n % 2 == 0) {
        under(&name, || {
            let drones = 2 + n / 2 % 3;
            let builder = condition.clone().with_task(MultiHover::default()).engine(EngineKind::Hybrid);
            let config = VecConfig { environments: 3 + n % 7, threads: 1, ..config(n) };
            fly(&builder.num_drones(drones).episode_seconds(1.1), config, 3, 1.2, usize::MAX);
        });
    }
}

/// Combination of conditions, sizes and resets.
#[derive(Debug, Clone)]
struct Case {
    task: usize,
    drones: usize,
    condition: EnvConfig,
    config: VecConfig,
    seed: u64,
}

impl Case {
    /// Flies the task for a second of episodes of 0.8 s.
    fn fly(&self) -> usize {
        match self.task {
            0 => self.fly_task(Hover::default(), 1),
            1 => self.fly_task(Velocity::default(), 1),
            2 => self.fly_task(Stabilize::default(), 1),
            3 => self.fly_task(Track::default(), 1),
            4 => self.fly_task(FlyThrough::default(), 1),
            5 => self.fly_task(Race::default(), 1),
            6 => self.fly_task(Formation::default(), self.drones),
            7 => self.fly_task(Antipodal::default(), self.drones),
            _ => self.fly_task(MultiHover::default(), self.drones),
        }
    }

    fn fly_task<T: Task + Clone + Send + Sync>(&self, task: T, drones: usize) -> usize {
        let builder = self.condition.clone().with_task(task).engine(EngineKind::Hybrid).episode_seconds(0.8);
        fly(&builder.num_drones(drones), self.config, self.seed, 1.0, 19)
    }
}

/// Returns one of the values of a list.
fn one_of<V: Clone + std::fmt::Debug + 'static>(values: impl Into<Vec<V>>) -> impl Strategy<Value = V> {
    proptest::sample::select(values.into())
}

fn winds() -> impl Strategy<Value = Option<WindConfig>> {
    let filters = one_of([DrydenFilter::FirstOrder, DrydenFilter::MilF8785c]);
    let wind = (one_of(WindModel::ALL), filters, -3.0..3.0, 0.0..10.0, any::<bool>());
    let wind = wind.prop_map(|(model, filter, x, turbulence, still_air_drag)| {
        let velocity = [x, 1.0 - x, 0.2 * x];
        WindConfig { filter, velocity, turbulence, still_air_drag, ..strong(model) }
    });
    proptest::option::of(wind)
}

fn motors() -> impl Strategy<Value = ActuatorParams> {
    let lag = prop_oneof![Just(0.0), 0.004..0.1];
    let latency =
        prop_oneof![2 => Just(0.0), 2 => (0_u32..30).prop_map(|steps| f64::from(steps) / 240.0), 1 => 0.0..0.3];
    let gains = prop_oneof![Just([1.0; 4]), [0.9..1.1, 0.9..1.1, 0.9..1.1, 0.9..1.1]];
    (lag, latency, gains, prop_oneof![Just(1.0), 0.7..1.2])
        .prop_map(|(lag, latency, gains, saturation)| ActuatorParams { lag, latency, gains, saturation })
}

/// Returns some groups of the default randomization. If the environment has wind, none is sampled.
fn randomizations() -> impl Strategy<Value = Option<Randomization>> {
    let groups = (any::<[bool; 6]>(), prop_oneof![Just([0.0; 2]), Just([0.0, 0.02]), Just([0.0, 0.2])], any::<bool>());
    let some = groups.prop_map(|([body, aerodynamics, actuators, sensors, environment, initial], latency, quiet)| {
        let sensors =
            sensors.then(|| SensorRanges { latency, bias: if quiet { 0.0 } else { 1.0 }, ..SensorRanges::default() });
        let torques = [0.5, 1.5];
        Randomization {
            body: body.then(Default::default),
            aerodynamics: aerodynamics.then_some(AerodynamicRanges {
                moment: torques,
                damping: torques,
                ..Default::default()
            }),
            actuators: actuators.then(Default::default),
            sensors,
            environment: environment.then(Default::default),
            initial: initial.then(Default::default),
            battery: None,
            // in place of the first three groups
            airframe: (!(body || aerodynamics || actuators)).then(Default::default),
        }
    });
    prop_oneof![2 => Just(None), 3 => some.prop_map(Some), 1 => Just(Some(Randomization::default()))]
}

/// Built-in airframes with a law from duty to speed, some of them with a battery, some with effects of their own
/// parameters.
fn airframes() -> impl Strategy<Value = DroneParams> {
    let seconds = prop_oneof![2 => Just(None), 1 => (0.3..10.0).prop_map(Some)];
    let time = || prop_oneof![Just(0.0), 0.0..0.1];
    let effects = proptest::option::of(([time(), time(), time()], 0.0..2.0f64));
    (one_of(DroneModel::ALL), seconds, effects).prop_map(|(model, seconds, effects)| {
        let params = supplied(model.params(), seconds);
        match effects {
            Some((times, strength)) => with_effects(params, times, strength),
            None => params,
        }
    })
}

fn cases() -> impl Strategy<Value = Case> {
    let rates = one_of([(240, 48), (240, 48), (240, 24), (240, 60), (240, 120), (240, 240), (480, 48), (500, 100)]);
    let flight = (any::<[bool; 5]>(), one_of(ActionType::ALL), rates, airframes(), 0..4_u32);
    let batch =
        (1..=14_usize, one_of([1, 2, 3, 5]), one_of(AUTORESETS), one_of(Width::available().collect::<Vec<_>>()));
    let task = (0..9_usize, 2..=4_usize, 0..1000_u64);
    (flight, batch, task, winds(), motors(), randomizations()).prop_map(
        |(flight, (environments, threads, autoreset, width), (task, drones, seed), wind, motors, mut randomization)| {
            let ([ground, drag, downwash, body_fixed, medium], action_type, (sim, ctrl), drone, obstacles) = flight;
            let is_racer = drone.name == DroneModel::Race.name();
            let has_battery = drone.battery.is_some();
            let mut condition = EnvConfig::default()
                .drone(drone)
                .sim_freq(sim)
                .ctrl_freq(ctrl)
                .effects(Effects { ground, drag, downwash })
                .action_type(action_type)
                .actuators(motors)
                .wind(wind);
            if body_fixed {
                condition = condition.forcing(Forcing::BodyFixed);
            }
            if medium {
                condition = condition.medium(Medium::AIR);
            }
            // only among the obstacles of these tasks is room for the start of every airframe
            if obstacles < 2 && task == 0 && !is_racer {
                condition = condition.obstacle_generator(forest(obstacles == 0));
            }
            if let (Some(wind), Some(Randomization { environment: Some(ranges), .. })) = (wind, &mut randomization)
                && wind.model != WindModel::None
            {
                ranges.wind = [0.0; 2];
            }
            if let Some(randomization) = &mut randomization {
                randomization.battery = has_battery.then(Default::default);
            }
            let config = VecConfig { threads, autoreset, width, ..VecConfig::new(environments) };
            Case { task, drones, condition: condition.randomization(randomization), config, seed }
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_combination_of_conditions_is_bit_identical_in_a_batch_and_alone(case in cases()) {
        case.fly();
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    #[ignore = "minutes"]
    fn thousands_of_combinations_of_conditions_are_bit_identical_in_a_batch_and_alone(case in cases()) {
        case.fly();
    }
}

/// Late commands and late observations belong to an environment: a single environment continues the flight of an
/// environment of a batch from a snapshot.
#[test]
fn a_flight_continues_alone_from_a_snapshot_of_a_batch() {
    let late = EnvConfig::default()
        .actuators(late_motors(0.06))
        .randomization(sensors(0.052, true))
        .wind(strong(WindModel::Combined));
    let fixed = EnvConfig::default().actuators(late_motors(0.3)).wind(strong(WindModel::Dryden));
    for condition in [late, fixed, everything()] {
        let builder = hover(&condition, true);
        let config = VecConfig { threads: 2, ..VecConfig::new(11) };
        let mut pair = Pair::new(&builder, config, 4);
        let mut pilot = Pilot::new(&pair, 4);
        let mut branch = builder.build().unwrap();
        for step in 0..100 {
            pair.step(pilot.act());
            if step % 23 == 7 {
                // the single environment forgets its own flight and goes on with that of the batch
                let i = step % 11;
                let snapshot = pair.batch.with(i, |env| env.snapshot()).unwrap();
                branch.restore(&snapshot).unwrap();
                std::mem::swap(&mut branch, &mut pair.alone[i]);
            }
        }
        pair.compare_all_exactly();
    }
}

/// Reading an environment changes nothing, in any step of the flight.
#[test]
fn reading_environments_in_flight_does_not_change_them() {
    for (name, condition) in all().into_iter().filter(|(name, _)| name.contains("late") || name.contains("every")) {
        under(&name, || {
            fly(&hover(&condition, false), VecConfig { threads: 2, ..VecConfig::new(10) }, 8, 1.1, 1);
        });
    }
}

/// Commands that are late by 100,000 control steps take 26 MB per block of environments.
#[test]
fn a_batch_that_does_not_fit_in_memory_is_an_error() {
    let actuators = ActuatorRanges { latency: [1.0; 2], ..ActuatorRanges::default() };
    let late = Randomization { actuators: Some(actuators), ..Randomization::NONE };
    let builder = Hover::builder().sim_freq(100_000).ctrl_freq(100_000).randomization(late);
    let count = VecConfig::MAX_ENVIRONMENTS;
    let error = VecAviary::new(builder, VecConfig::new(count)).unwrap_err().to_string();
    assert!(error.starts_with("environments is 16777216, expected a batch that fits in memory"), "{error}");
}

/// Changes of wind, latencies and randomization of one environment in flight. Its neighbours keep their bits, and it
/// equals a single environment with the same changes.
#[test]
fn changes_of_one_environment_in_flight_are_those_of_a_single_environment() {
    let late = |latency: f64| Randomization {
        actuators: Some(ActuatorRanges { latency: [latency; 2], ..ActuatorRanges::default() }),
        sensors: Some(SensorRanges { latency: [0.5 * latency; 2], ..SensorRanges::default() }),
        ..Randomization::NONE
    };
    let plain = EnvConfig::default();
    let motors = plain.clone().actuators(late_motors(0.03)).randomization(sensors(0.03, true));
    for (name, condition) in [
        ("still air", plain.clone()),
        ("late motors and sensors", motors),
        ("wind", plain.wind(strong(WindModel::Combined))),
        ("everything", everything()),
    ] {
        under(name, || {
            let builder = hover(&condition, name != "still air");
            let config = VecConfig { threads: 3, autoreset: Autoreset::SameStep, ..VecConfig::new(29) };
            let mut pair = Pair::new(&builder, config, 6);
            let mut pilot = Pilot::new(&pair, 6);
            let mut fly = |pair: &mut Pair<Hover>, steps| (0..steps).for_each(|_| pair.step(pilot.act()));
            let wind = |wind: Option<WindConfig>| move |env: &mut Aviary<Hover>| env.set_wind(wind).unwrap();
            let randomize = |randomization: Option<Randomization>| {
                move |env: &mut Aviary<Hover>| env.set_randomization(randomization.clone()).unwrap()
            };
            fly(&mut pair, 9);
            pair.change(4, wind(Some(strong(WindModel::Dryden))));
            pair.change(17, wind(None));
            fly(&mut pair, 8);
            // longer latencies than those of the other environments, from the next episode on
            pair.change(12, wind(None));
            pair.change(12, randomize(Some(late(0.2))));
            pair.change(5, wind(None));
            // the samples must not replace the wind of the environment
            let environment = Some(EnvironmentRanges { wind: [0.0; 2], ..EnvironmentRanges::default() });
            pair.change(5, randomize(Some(Randomization { environment, ..Randomization::default() })));
            fly(&mut pair, 8);
            let some = |i: usize| (0..29).map(|j| j % 5 == i).collect::<Vec<_>>();
            pair.reset_where(&some(2), None);
            fly(&mut pair, 11);
            pair.change(12, randomize(Some(late(0.005))));
            pair.change(4, wind(Some(strong(WindModel::Gust))));
            pair.change(20, randomize(None));
            pair.change(8, |env| env.task_mut().target_height = 0.7);
            pair.cut_off(8);
            fly(&mut pair, 12);
            pair.reset_where(&some(0), Some(9));
            fly(&mut pair, 60);
            pair.change(12, randomize(None));
            pair.change(4, wind(None));
            fly(&mut pair, 30);
            pair.compare_all_exactly();
        });
    }
}

/// An environment that fails leaves the conditions of its neighbours as they are, and starts again like a single one.
#[test]
fn a_fault_under_every_condition_is_the_same_in_a_batch_and_alone() {
    for (n, autoreset) in AUTORESETS.into_iter().enumerate() {
        for condition in [everything(), EnvConfig::default().actuators(late_motors(0.05)).wind(strong(WindModel::Gust))]
        {
            let config = VecConfig { threads: 2, autoreset, on_fault: OnFault::Truncate, ..VecConfig::new(13) };
            let mut pair = Pair::new(&hover(&condition, false), config, n as u64);
            let mut pilot = Pilot::new(&pair, 2);
            for step in 0..62 {
                let mut actions = pilot.act().to_vec();
                if step % 9 == 5 {
                    actions[4 * (step % 13) + 1] = f32::NAN;
                }
                pair.step(&actions);
            }
            pair.compare_all_exactly();
        }
    }
}

#[test]
fn every_number_of_threads_gives_the_same_bits_under_every_condition_at_once() {
    let mut digests = Vec::new();
    for threads in [1, 2, 3, 5] {
        for width in Width::available() {
            let config = VecConfig { threads, width, autoreset: Autoreset::SameStep, ..VecConfig::new(43) };
            let mut batch = BufferedVecEnv::new(VecAviary::new(hover(&everything(), false), config).unwrap());
            assert_eq!(batch.env().num_threads(), threads);
            batch.reset(Some(7)).unwrap();
            let mut wander = Wander::new(3, 43, 4);
            let mut digest = Vec::new();
            for _ in 0..70 {
                let step = batch.step(wander.next()).unwrap();
                digest.extend(bits(&step.observations));
                digest.extend(bits(&step.rewards));
            }
            digests.push(digest);
        }
    }
    assert!(digests.windows(2).all(|pair| pair[0] == pair[1]));
}
