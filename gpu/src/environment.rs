//! Control step and reset of one environment, generic over the numbers of the host and of a kernel.

use aviary::env::EndReason;
use aviary::vector::Autoreset;
use flight::body::Push;
use flight::drag;
use flight::math::{Turn, V3, clamped};
use flight::motors;
use flight::state::FlightState;
use flight::tasks::{CRASH_PENALTY, STATE_SIZE, hover, observe_state, stabilize};

use crate::number::{Number, Word};
use crate::plan::{MOTION, Parameters, Plan, TaskKind, code_of, motion_numbers, motion_of};
use crate::random::Draws;

/// Number of numbers of an environment between two steps: the state and the rotor speeds.
pub(crate) const NUMBERS: usize = MOTION + 4;

/// Number of words of an environment between two steps: seed 2, next episode, control steps, end of the episode.
pub(crate) const WORDS: usize = 5;

/// Length of an observation.
pub(crate) const OBSERVATION: usize = STATE_SIZE;

/// Bits of [`Outcome::end`] above the number of the reason.
pub(crate) mod end {
    /// Bits of the number of the reason.
    pub const REASON: u32 = 0xff;
    /// The drone fulfils the task.
    pub const SUCCESS: u32 = 1 << 8;
    /// The task ended the episode.
    pub const TERMINATED: u32 = 1 << 9;
    /// The episode was cut off.
    pub const TRUNCATED: u32 = 1 << 10;
}

/// Magnitude of the body rate times a physics step above which the rotation of the step loses precision, rad.
const MAX_TURN: f64 = 2.0;

/// Largest distance from the origin, m, and largest speed, m/s.
const MAX_MAGNITUDE: f64 = 1e8;

/// An environment between two steps.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Memory<N: Number> {
    /// State of the drone.
    pub motion: FlightState<N>,
    /// Rotor speeds, rpm; relative to the hover speed with [`Plan::relative`].
    pub rotors: [N; 4],
    /// Seed, lower half first.
    pub seed: [N::Word; 2],
    /// Number of the next episode since the seed was set.
    pub episode: N::Word,
    /// Control steps since the start of the episode.
    pub steps: N::Word,
    /// [`Outcome::end`] of the last step.
    pub end: N::Word,
}

impl<N: Number> Memory<N> {
    /// Creates the memory of its numbers and words.
    pub fn new(numbers: &[N; NUMBERS], [low, high, episode, steps, end]: [N::Word; WORDS]) -> Self {
        let (motion, rotors) = split(numbers);
        Self { motion, rotors, seed: [low, high], episode, steps, end }
    }

    /// Returns the numbers.
    pub fn numbers(&self) -> [N; NUMBERS] {
        joined(&self.motion, &self.rotors)
    }

    /// Returns the words.
    pub fn words(&self) -> [N::Word; WORDS] {
        [self.seed[0], self.seed[1], self.episode, self.steps, self.end]
    }
}

/// Results of a control step.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Outcome<N: Number> {
    /// The environment after the step.
    pub memory: Memory<N>,
    /// Observation, of the next episode where [`Autoreset::SameStep`] has started it.
    pub observation: [N; OBSERVATION],
    /// Observation before the reset of [`Autoreset::SameStep`].
    pub last_observation: [N; OBSERVATION],
    /// Reward.
    pub reward: N,
    /// Number of the reason of the end and bits of [`end`]; 0 while the episode continues.
    pub end: N::Word,
}

fn split<R: Copy>(numbers: &[R; NUMBERS]) -> (FlightState<R>, [R; 4]) {
    (motion_of(&std::array::from_fn(|index| numbers[index])), std::array::from_fn(|index| numbers[MOTION + index]))
}

fn joined<R: Copy>(motion: &FlightState<R>, rotors: &[R; 4]) -> [R; NUMBERS] {
    let motion = motion_numbers(motion);
    std::array::from_fn(|index| if index < MOTION { motion[index] } else { rotors[index - MOTION] })
}

/// Returns the rotor speeds that an action commands, rpm, after gains and saturation.
fn target_speeds<N: Number>(plan: &Plan, parameters: &Parameters<N>, action: [N; 4]) -> [N; 4] {
    let Parameters { hover_rpm: hover, rpm_above_hover: above, max_change, gains, gain_errors, .. } = *parameters;
    let (zero, one) = (hover.all(0.0), hover.all(1.0));
    std::array::from_fn(|motor| {
        let command = clamped(action[motor], -one, one);
        if plan.relative {
            let change = command * N::choose(zero.less(command), above, hover);
            clamped(change + (change + hover) * gain_errors[motor], -hover, max_change)
        } else {
            let speed = N::choose(zero.less(command), command * above + hover, (command + 1.0) * hover);
            motors::target(speed, gains[motor], max_change + hover)
        }
    })
}

/// Advances a drone by the physics steps of a control step. Returns the lowest clearance from the floor as well, m.
fn advance<N: Number>(
    plan: &Plan,
    parameters: &Parameters<N>,
    target: [N; 4],
    motion: &FlightState<N>,
    rotors: &[N; 4],
) -> (FlightState<N>, [N; 4], N) {
    let dt = 1.0 / f64::from(plan.sim_freq);
    let numbers = joined(motion, rotors);
    // far above the floor
    let start: [N; NUMBERS + 1] =
        std::array::from_fn(|index| numbers.get(index).copied().unwrap_or(target[0].all(MAX_MAGNITUDE)));
    let last = N::repeat(plan.substeps, start, |values| {
        let (motion, mut rotors) = split(&std::array::from_fn(|index| values[index]));
        for motor in 0..4 {
            rotors[motor] = if plan.lag {
                motors::follow(rotors[motor], target[motor], parameters.lag_share)
            } else {
                target[motor]
            };
        }
        let next = physics_step(plan, parameters, dt, &motion, &rotors);
        let room = parameters.cylinder.floor_clearance(next.position.z, next.attitude.up().z);
        let (numbers, lowest) = (joined(&next, &rotors), room.lesser(values[NUMBERS]));
        std::array::from_fn(|index| numbers.get(index).copied().unwrap_or(lowest))
    });
    let (motion, rotors) = split(&std::array::from_fn(|index| last[index]));
    (motion, rotors, last[NUMBERS])
}

/// Advances a drone by one physics step at these rotor speeds.
fn physics_step<N: Number>(
    plan: &Plan,
    parameters: &Parameters<N>,
    dt: f64,
    motion: &FlightState<N>,
    rotors: &[N; 4],
) -> FlightState<N> {
    let hover = parameters.hover_rpm;
    let (thrust, torque) = if plan.relative {
        parameters.rotors.thrust_and_torque_about(hover, rotors)
    } else {
        parameters.rotors.thrust_and_torque(rotors)
    };
    let mut force = V3::zero(thrust);
    if plan.ground {
        force.z = force.z + parameters.ground.force(motion.position.z, motion.attitude.up().z, thrust);
    }
    if plan.drag {
        let rpm = if plan.relative { rotors.map(|change| hover + change) } else { *rotors };
        force = force + drag::force(parameters.drag, &motion.attitude, &rpm, motion.velocity);
    }
    let (body, push) = (&parameters.body, Push { thrust, torque, force });
    match (plan.body_fixed, plan.medium) {
        (false, false) => body.rk4::<false, false>(dt, &push, motion),
        (false, true) => body.rk4::<false, true>(dt, &push, motion),
        (true, false) => body.rk4::<true, false>(dt, &push, motion),
        (true, true) => body.rk4::<true, true>(dt, &push, motion),
    }
}

/// Returns the observation of a state.
fn observe<N: Number>(motion: &FlightState<N>, rpy: V3<N>) -> [N; OBSERVATION] {
    // every task of the kernels observes the state vector
    let mut observation = [rpy.x; OBSERVATION];
    observe_state(motion, rpy, observation.as_mut_slice());
    observation
}

/// Reward and end of a control step.
struct TaskOutcome<N: Number> {
    reward: N,
    end: N::Word,
}

/// Evaluates a control step. `lowest` is the lowest clearance from the floor during the step, m, and `steps` the number
/// of control steps including this one.
fn evaluate<N: Number>(
    plan: &Plan,
    parameters: &Parameters<N>,
    motion: &FlightState<N>,
    rpy: V3<N>,
    lowest: N,
    steps: N::Word,
) -> TaskOutcome<N> {
    let (zero, up) = (lowest.all(0.0), motion.attitude.up().z);
    let touches = !zero.less(lowest);
    let tilted = up.less(parameters.min_up);
    let crashed = touches | tilted;
    let reason = |reason: EndReason| N::Word::of(code_of(reason) | end::TERMINATED);
    // reasons in ascending order of their precedence
    let mut found = N::Word::of(0);
    let (reward, success) = match plan.task {
        TaskKind::Hover => {
            let [height, max_height, _] = parameters.task;
            let target = V3::vertical(height);
            found =
                N::Word::choose(hover::is_too_high(motion.position, max_height), reason(EndReason::OutOfBounds), found);
            (hover::reward(motion, rpy, target), hover::at_target(motion.position, target))
        }
        TaskKind::Stabilize => (stabilize::reward(motion, rpy), stabilize::at_rest(motion)),
    };
    found = N::Word::choose(tilted, reason(EndReason::Tilt), found);
    found = N::Word::choose(touches, reason(EndReason::FloorContact), found);
    let reward = N::choose(crashed, reward - CRASH_PENALTY, reward);
    let is_last = !steps.less(N::Word::of(plan.episode_steps));
    let ended = N::Word::of(0).less(found);
    let timeout = N::Word::of(code_of(EndReason::TimeLimit));
    let found =
        N::Word::choose(is_last, N::Word::choose(ended, found, timeout).plus(N::Word::of(end::TRUNCATED)), found);
    let over = ended | is_last;
    let fulfilled = over & success & !crashed;
    TaskOutcome { reward, end: N::Word::choose(fulfilled, found.plus(N::Word::of(end::SUCCESS)), found) }
}

/// Returns true where a state and an action are usable numbers.
fn is_valid<N: Number>(plan: &Plan, motion: &FlightState<N>, action: &[N; 4]) -> N::Mask {
    // comparisons with NaN are false; drivers may simplify a product with zero, which other tests of finite numbers use
    let within = |square: N, max: f64| square.less(square.all(max * max));
    let FlightState { position, attitude, velocity, rate } = motion;
    let [a, b, c, d] = *action;
    within(position.dot(*position) + velocity.dot(*velocity), MAX_MAGNITUDE)
        & within(attitude.w * attitude.w + attitude.v.dot(attitude.v), 2.0)
        & within(rate.dot(*rate), MAX_TURN * f64::from(plan.sim_freq))
        & within(a * a + b * b + c * c + d * d, MAX_MAGNITUDE)
}

/// Starts an episode: returns the state and the rotor speeds.
fn begin<N: Number>(
    plan: &Plan,
    parameters: &Parameters<N>,
    seed: [N::Word; 2],
    environment: N::Word,
    episode: N::Word,
) -> (FlightState<N>, [N; 4]) {
    let mut motion = parameters.start;
    let mut draws = Draws::<N>::new(seed, environment, episode);
    match plan.task {
        TaskKind::Hover => {}
        TaskKind::Stabilize => {
            let [max_speed, max_lean, max_rate] = parameters.task;
            let mut triple = |max: V3<N>| V3::new(draws.symmetric(), draws.symmetric(), draws.symmetric()).times(max);
            motion.velocity = motion.velocity + triple(V3::new(max_speed, max_speed, max_speed));
            let yaw = max_lean.all(std::f64::consts::PI);
            let turn = Turn::from_rpy(triple(V3::new(max_lean, max_lean, yaw)));
            motion.attitude = composed(&motion.attitude, &turn);
            motion.rate = motion.rate + triple(V3::new(max_rate, max_rate, max_rate));
        }
    }
    // motors with lag turn at hover speed when an episode begins
    let at_hover = if plan.relative { parameters.hover_rpm.all(0.0) } else { parameters.hover_rpm };
    let max = if plan.relative { parameters.max_change } else { parameters.max_change + parameters.hover_rpm };
    let rotors = if plan.lag { at_hover.lesser(max) } else { at_hover };
    (motion, [rotors; 4])
}

/// Returns the rotation by `first` and then, in the rotated frame, by `second`.
fn composed<N: Number>(first: &Turn<N>, second: &Turn<N>) -> Turn<N> {
    let (a, b) = (first, second);
    Turn { w: a.w * b.w - a.v.dot(b.v), v: b.v * a.w + a.v * b.w + a.v.cross(b.v) }
}

/// Starts an episode and observes it.
pub(crate) fn reset<N: Number>(
    plan: &Plan,
    parameters: &Parameters<N>,
    memory: &Memory<N>,
    environment: N::Word,
) -> (Memory<N>, [N; OBSERVATION]) {
    let (motion, rotors) = begin(plan, parameters, memory.seed, environment, memory.episode);
    let none = N::Word::of(0);
    let episode = memory.episode.plus(N::Word::of(1));
    let memory = Memory { motion, rotors, seed: memory.seed, episode, steps: none, end: none };
    (memory, observe(&motion, motion.attitude.rpy()))
}

/// Advances an environment by one control step, with the reset that the plan asks for.
pub(crate) fn control_step<N: Number>(
    plan: &Plan,
    parameters: &Parameters<N>,
    memory: &Memory<N>,
    environment: N::Word,
    action: [N; 4],
) -> Outcome<N> {
    let none = N::Word::of(0);
    let target = target_speeds(plan, parameters, action);
    let (moved, turned, lowest) = advance(plan, parameters, target, &memory.motion, &memory.rotors);
    let valid = is_valid(plan, &moved, &action);
    // a state that is not a number would stay one
    let (before, after) = (memory.numbers(), joined(&moved, &turned));
    let numbers: [N; NUMBERS] = std::array::from_fn(|index| N::choose(valid, after[index], before[index]));
    let (motion, rotors) = split(&numbers);
    let rpy = motion.attitude.rpy();
    let steps = memory.steps.plus(N::Word::of(1));
    let TaskOutcome { reward, end } = evaluate(plan, parameters, &motion, rpy, lowest, steps);
    let zero = lowest.all(0.0);
    let fault = N::Word::of(code_of(EndReason::Fault) | end::TRUNCATED);
    let (mut reward, mut end) = (N::choose(valid, reward, zero), N::Word::choose(valid, end, fault));
    let observation = observe(&motion, rpy);
    let stepped = Memory { motion, rotors, steps, end, ..*memory };
    let begins = match plan.autoreset {
        Autoreset::SameStep => none.less(end),
        Autoreset::NextStep => {
            let begins = none.less(memory.end);
            (reward, end) = (N::choose(begins, zero, reward), N::Word::choose(begins, none, end));
            begins
        }
        // the host rejects a step after the end of an episode
        Autoreset::Disabled => {
            return Outcome { memory: stepped, observation, last_observation: observation, reward, end };
        }
    };
    let numbers = joined_with_observation(&stepped.numbers(), &observation);
    let words = [memory.episode, steps];
    let (numbers, [episode, steps]) = N::when(begins, (numbers, words), || {
        let (started, first) = reset(plan, parameters, memory, environment);
        (joined_with_observation(&started.numbers(), &first), [started.episode, started.steps])
    });
    let (motion, rotors) = split(&std::array::from_fn(|index| numbers[index]));
    // the next step of `NextStep` starts an episode where this one has ended
    let kept = if plan.autoreset == Autoreset::NextStep { end } else { none };
    Outcome {
        memory: Memory { motion, rotors, seed: memory.seed, episode, steps, end: kept },
        observation: std::array::from_fn(|index| numbers[NUMBERS + index]),
        last_observation: observation,
        reward,
        end,
    }
}

fn joined_with_observation<R: Copy>(
    numbers: &[R; NUMBERS],
    observation: &[R; OBSERVATION],
) -> [R; NUMBERS + OBSERVATION] {
    std::array::from_fn(|index| if index < NUMBERS { numbers[index] } else { observation[index - NUMBERS] })
}
