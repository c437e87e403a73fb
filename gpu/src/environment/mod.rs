//! Step and reset of one drone of an environment, for numbers of the host and for those of a kernel.

mod contact;
mod draws;
mod flight;
mod memory;
mod tasks;

use ::flight::math::{Turn, V3};
use ::flight::sensors::{Sensed, SensorParams};
use ::flight::state::FlightState;
use ::flight::tasks::CRASH_PENALTY;
use ::flight::tasks::crash::CLEAR_OF_FLOOR;
use ::flight::wind::WindState;
use aviary::env::EndReason;
use aviary::vector::Autoreset;

use self::flight::{Flown, advance, choose_motion, command, positions};
use crate::number::{Number, Word};
use crate::parameters::Parameters;
use crate::plan::{Plan, code_of};
use draws::Start;
pub(crate) use draws::{Place, drawn_parameters};
pub(crate) use memory::{COMMAND, Memory, count_numbers};
use tasks::Scene;

/// Bits of [`Outcome::end`] above the number of the reason.
pub(crate) mod end {
    /// Bits of the number of the reason.
    pub const REASON: u32 = 0xff;
    /// The drones fulfil the task.
    pub const SUCCESS: u32 = 1 << 8;
    /// The task ended the episode.
    pub const TERMINATED: u32 = 1 << 9;
    /// The episode was cut off.
    pub const TRUNCATED: u32 = 1 << 10;
}

/// Largest distance from the origin, m, speed, m/s, and body rate, rad/s.
const MAX_MAGNITUDE: f64 = 1e8;

/// Results of a control step of a drone.
#[derive(Debug, Clone)]
pub(crate) struct Outcome<N: Number> {
    /// The drone after the step.
    pub memory: Memory<N>,
    /// Observation, of the next episode where [`Autoreset::SameStep`] has started it.
    pub observation: Vec<N>,
    /// Observation before the reset of [`Autoreset::SameStep`].
    pub last_observation: Vec<N>,
    /// Reward of the environment.
    pub reward: N,
    /// Number of the reason of the end of the environment's episode and bits of [`end`]; 0 while it continues.
    pub end: N::Word,
}

/// Returns the rotation by `first` and then, in the rotated frame, by `second`.
fn composed<N: Number>(first: &Turn<N>, second: &Turn<N>) -> Turn<N> {
    let (a, b) = (first, second);
    Turn { w: a.w * b.w - a.v.dot(b.v), v: b.v * a.w + a.v * b.w + a.v.cross(b.v) }
}

/// Returns the parameters of an episode: the nominal ones, and those that its start has drawn.
fn parameters_of<N: Number>(plan: &Plan, nominal: &Parameters<N>, memory: &Memory<N>) -> Parameters<N> {
    let (mut parameters, mut drawn) = (*nominal, memory.drawn.iter());
    let mut varies = plan.drawn.iter();
    parameters.each(&mut |number| {
        if varies.next() == Some(&true)
            && let Some(own) = drawn.next()
        {
            *number = *own;
        }
    });
    parameters
}

/// Returns a list of the parameters that are drawn.
fn drawn_of<N: Number>(plan: &Plan, parameters: &Parameters<N>) -> Vec<N> {
    let all = parameters.numbers();
    all.into_iter().zip(&plan.drawn).filter_map(|(number, drawn)| drawn.then_some(number)).collect()
}

/// Returns 1 where a drone is clear of the floor, 0 elsewhere.
fn clear_of_floor<N: Number>(parameters: &Parameters<N>, motion: &FlightState<N>) -> N {
    let clearance = parameters.cylinder.floor_clearance(motion.position.z, motion.attitude.up().z);
    let zero = clearance.all(0.0);
    N::choose(zero.all(CLEAR_OF_FLOOR).less(clearance), zero.all(1.0), zero)
}

/// Starts an episode of a drone with these nominal parameters, and observes it.
pub(crate) fn reset<N: Number>(
    plan: &Plan,
    nominal: &Parameters<N>,
    memory: &Memory<N>,
    environment: N::Word,
    drone: N::Word,
) -> (Memory<N>, Vec<N>) {
    let stream = environment.plus(N::Word::of(plan.stream));
    let place = Place { seed: memory.seed, environment: stream, drone, episode: memory.episode };
    let Start { parameters, motion, task, key } = Start::sample(plan, nominal, place);
    let none = N::Word::of(0);
    // motors with lag or latency turn at hover speed when an episode begins
    let at_start =
        if plan.relative { parameters.initial_change } else { parameters.initial_change + parameters.hover_rpm };
    let zero = at_start.all(0.0);
    let memory = Memory {
        motion,
        rotors: [at_start; 4],
        command: memory.command.map(|_| [at_start; 4]),
        airborne: if plan.floor { clear_of_floor(&parameters, &motion) } else { zero.all(1.0) },
        loops: memory.loops.map(|_| Memory::fresh_loops(zero)),
        wind: plan.wind.map(|_| WindState::start(&parameters.wind, N::key(key), motion.position.z)),
        late_commands: vec![[at_start; 4]; plan.late_commands],
        late_states: vec![motion; plan.late_states],
        task,
        drawn: drawn_of(plan, &parameters),
        seed: memory.seed,
        episode: memory.episode.plus(N::Word::of(1)),
        steps: none,
        end: none,
        key,
    };
    let observation = observe(plan, nominal, &parameters, &memory, drone);
    (memory, observation)
}

/// Returns the observation of a drone: the state that its sensors measure, and the numbers of the task.
fn observe<N: Number>(
    plan: &Plan,
    nominal: &Parameters<N>,
    parameters: &Parameters<N>,
    memory: &Memory<N>,
    drone: N::Word,
) -> Vec<N> {
    let motion = &memory.motion;
    let mut observed = *motion;
    let latency = parameters.sensor_latency;
    for (index, state) in memory.late_states.iter().enumerate() {
        // the recorded state of control step k is observed by latencies of more than (k − 1)·m physics steps
        let is_late = latency.all(f64::from(plan.substeps) * index as f64 + 0.5).less(latency);
        observed = choose_motion::<N>(is_late, state, &observed);
    }
    let mut rpy = observed.attitude.rpy();
    if let Some(ranges) = &plan.ranges.sensors {
        let sigmas = [ranges.position, ranges.velocity, ranges.attitude, ranges.angular_velocity];
        let sensors = SensorParams { sigmas: sigmas.map(|sigma| latency.all(sigma)), biases: parameters.biases };
        let FlightState { position, attitude, velocity, rate } = observed;
        let noise = N::key(memory.key).at(N::wide(memory.steps, N::Word::of(0)));
        let measured = sensors.measure(noise, &Sensed { position, attitude, rpy, velocity, rate });
        let Sensed { position, attitude, velocity, rate, .. } = measured;
        (observed, rpy) = (FlightState { position, attitude, velocity, rate }, measured.rpy);
    }
    let time = memory.steps_so_far() * plan.control_period();
    let scene = Scene { plan, parameters: nominal, drone, before: motion.position, motion, rpy, time, positions: &[] };
    tasks::observe(&scene, &observed, rpy, &memory.task)
}

/// Reward and end of a control step of an environment.
struct Judgement<N: Number> {
    reward: N,
    end: N::Word,
}

/// Returns the number of a reason as a number of the device.
fn code<N: Number>(like: N, reason: EndReason) -> N {
    like.all(f64::from(code_of(reason)))
}

/// Evaluates a control step. Updates the state of the task in `memory`, whose state is that after the step.
fn evaluate<N: Number>(
    plan: &Plan,
    nominal: &Parameters<N>,
    memory: &mut Memory<N>,
    drone: N::Word,
    before: V3<N>,
    flown: &Flown<N>,
) -> Judgement<N> {
    let motion = memory.motion;
    let zero = motion.position.x.all(0.0);
    let rpy = motion.attitude.rpy();
    let positions = if plan.drones > 1 { positions(plan, motion.position) } else { vec![motion.position] };
    let time = memory.steps_so_far() * plan.control_period();
    let scene = Scene { plan, parameters: nominal, drone, before, motion: &motion, rpy, time, positions: &positions };
    let evaluation = tasks::evaluate(&scene, &mut memory.task);
    // the reason of the end of the drone, in ascending order of precedence
    let mut found = zero;
    if let Some((mask, reason)) = evaluation.end {
        found = N::choose(mask, code(zero, reason), found);
    }
    let mut crashed = zero.less(zero);
    if let Some(upright) = plan.crash.upright {
        let tilted = motion.attitude.up().z.less(zero.all(upright));
        found = N::choose(tilted, code(zero, EndReason::Tilt), found);
        crashed = crashed | tilted;
    }
    if plan.crash.below_floor {
        let below = motion.position.z.less(zero);
        found = N::choose(below, code(zero, EndReason::BelowFloor), found);
        crashed = crashed | below;
    }
    if plan.drones > 1 && plan.crash.drones {
        let touches = !zero.less(flown.nearest);
        found = N::choose(touches, code(zero, EndReason::DroneContact), found);
        crashed = crashed | touches;
    }
    let touches = !zero.less(flown.lowest);
    found = N::choose(touches, code(zero, EndReason::FloorContact), found);
    crashed = crashed | touches;
    let penalty = N::choose(crashed, zero.all(CRASH_PENALTY), zero);
    let reward = N::choose(evaluation.idle, zero, evaluation.reward) - penalty;
    let succeeds = N::choose(evaluation.success & !crashed, zero.all(1.0), zero);
    let crash = N::choose(crashed, zero.all(1.0), zero);
    let all = N::gather(plan.drones, &[reward, found, crash, succeeds, evaluation.share]);
    judge(plan, memory, &all)
}

/// Combines the evaluations of the drones of a world: reward, reason of the end, 1 for a crash, 1 for success, share.
fn judge<N: Number>(plan: &Plan, memory: &Memory<N>, all: &[Vec<N>]) -> Judgement<N> {
    let zero = all[0][0].all(0.0);
    let (mut reward, mut share, mut successes, mut completed) = (zero, zero, zero, zero);
    let complete = code(zero, EndReason::Completed);
    let (mut crash, mut early) = (zero, zero);
    // the first drone has precedence
    for drone in all.iter().rev() {
        let &[_, found, crashed, succeeds, _] = &drone[..] else { unreachable!("five numbers per drone") };
        let ends = zero.less(found);
        let completes = (found - complete).abs().less(zero.all(0.5));
        completed = completed + N::choose(completes, zero.all(1.0), zero);
        crash = N::choose(zero.less(crashed), found, crash);
        early = N::choose(ends & !completes, found, early);
        successes = successes + succeeds;
    }
    for drone in all {
        (reward, share) = (reward + drone[0], share + drone[4]);
    }
    let most = zero.all(f64::from(plan.drones) - 0.5);
    let end = N::choose(most.less(completed), complete, zero);
    let end = N::choose(zero.less(early), early, end);
    let end = N::choose(zero.less(crash), crash, end);
    let mut success = most.less(successes);
    if let Some(together) = tasks::world_success(plan, share, memory.steps_so_far()) {
        success = success & together;
    }
    let mut word = N::Word::of(0);
    for reason in EndReason::ALL.iter().copied() {
        let here = (end - code(zero, reason)).abs().less(zero.all(0.5));
        word = N::Word::choose(here, N::Word::of(code_of(reason) | end::TERMINATED), word);
    }
    let is_last = !memory.steps.less(N::Word::of(plan.episode_steps));
    let ended = N::Word::of(0).less(word);
    let timeout = N::Word::of(code_of(EndReason::TimeLimit));
    let cut = N::Word::choose(ended, word, timeout).plus(N::Word::of(end::TRUNCATED));
    let word = N::Word::choose(is_last, cut, word);
    let fulfilled = (ended | is_last) & success;
    Judgement { reward, end: N::Word::choose(fulfilled, word.plus(N::Word::of(end::SUCCESS)), word) }
}

/// Returns true where a state and an action are usable numbers.
fn is_valid<N: Number>(motion: &FlightState<N>, action: &[N; 4]) -> N::Mask {
    // comparisons with NaN are false; drivers may simplify a product with zero, which other tests of finite numbers use
    let within = |square: N, max: f64| square.less(square.all(max));
    let FlightState { position, attitude, velocity, rate } = motion;
    let most = MAX_MAGNITUDE * MAX_MAGNITUDE;
    let mut valid = within(position.dot(*position) + velocity.dot(*velocity) + rate.dot(*rate), most)
        & within(attitude.w * attitude.w + attitude.v.dot(attitude.v), 4.0);
    for number in action {
        // of the largest numbers of single precision
        valid = valid & within(number.abs(), f64::from(f32::MAX));
    }
    valid
}

/// Advances a drone by one control step, with the reset that the plan asks for.
pub(crate) fn control_step<N: Number>(
    plan: &Plan,
    nominal: &Parameters<N>,
    memory: &Memory<N>,
    environment: N::Word,
    drone: N::Word,
    action: [N; 4],
) -> Outcome<N> {
    let none = N::Word::of(0);
    let parameters = parameters_of(plan, nominal, memory);
    let zero = parameters.hover_rpm.all(0.0);
    let before = memory.motion.position;
    let mut stepped = memory.clone();
    let command = command(plan, &parameters, &mut stepped, action);
    if let Some(last) = &mut stepped.command {
        *last = command;
    }
    let flown = advance(plan, &parameters, &mut stepped, drone, command);
    stepped.motion = flown.motion;
    stepped.rotors = flown.rotors;
    stepped.wind = flown.wind;
    if let Some(newest) = stepped.late_states.last_mut() {
        *newest = flown.recorded;
        stepped.late_states.rotate_right(1);
    }
    if plan.floor {
        // a drone that stands on the floor may be clear of it for a step
        let clear = clear_of_floor(&parameters, &flown.motion);
        let rises = N::choose(flown.stands, zero, clear);
        stepped.airborne = memory.airborne.greater(rises);
    }
    // a fault of one drone is one of its world
    let valid = is_valid(&stepped.motion, &action);
    let valid = if plan.drones > 1 {
        let own = N::choose(valid, zero, zero.all(1.0));
        let all = N::gather(plan.drones, &[own]);
        let faults = all.iter().fold(zero, |sum, drone| sum + drone[0]);
        faults.less(zero.all(0.5))
    } else {
        valid
    };
    // an environment without an episode waits for a reset
    let mut waits = memory.episode.less(N::Word::of(1));
    if plan.autoreset == Autoreset::Disabled {
        waits = waits | none.less(memory.end);
    }
    let valid = valid & !waits;
    // a state that is not a number would stay one
    let (before_step, after_step) = (memory.numbers(), stepped.numbers());
    let numbers: Vec<N> =
        before_step.iter().zip(&after_step).map(|(before, after)| N::choose(valid, *after, *before)).collect();
    let mut stepped = stepped.with(&numbers, &memory.words());
    stepped.steps = memory.steps.plus(N::Word::of(1));
    let Judgement { reward, end } = evaluate(plan, nominal, &mut stepped, drone, before, &flown);
    // a step that fails does not count
    stepped.steps = N::Word::choose(valid, stepped.steps, memory.steps);
    for (new, old) in stepped.task.iter_mut().zip(&memory.task) {
        *new = N::choose(valid, *new, *old);
    }
    let fault = N::Word::of(code_of(EndReason::Fault) | end::TRUNCATED);
    let (mut reward, mut end) = (N::choose(valid, reward, zero), N::Word::choose(valid, end, fault));
    stepped.end = N::Word::choose(waits, memory.end, end);
    let observation = observe(plan, nominal, &parameters, &stepped, drone);
    let begins = match plan.autoreset {
        Autoreset::SameStep => none.less(end) & !waits,
        Autoreset::NextStep => {
            let begins = none.less(memory.end) & !waits;
            (reward, end) = (N::choose(begins, zero, reward), N::Word::choose(begins, none, end));
            begins
        }
        Autoreset::Disabled => {
            return Outcome {
                memory: stepped,
                observation: observation.clone(),
                last_observation: observation,
                reward,
                end,
            };
        }
    };
    // the next step of `NextStep` starts an episode where this one has ended
    stepped.end = if plan.autoreset == Autoreset::NextStep { N::Word::choose(waits, none, end) } else { none };
    let count = stepped.numbers().len();
    let with_observation = |memory: &Memory<N>, observation: &[N]| {
        let mut numbers = memory.numbers();
        numbers.extend_from_slice(observation);
        (numbers, memory.words())
    };
    let (numbers, words) = N::when(begins, with_observation(&stepped, &observation), || {
        let (started, first) = reset(plan, nominal, memory, environment, drone);
        with_observation(&started, &first)
    });
    Outcome {
        memory: stepped.with(&numbers[..count], &words),
        observation: numbers[count..].to_vec(),
        last_observation: observation,
        reward,
        end,
    }
}
