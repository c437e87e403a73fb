//! State that a drone keeps between two control steps.

use aviary::control::ControlMemory;
use flight::math::V3;
use flight::state::FlightState;
use flight::wind::WindState;

use super::tasks;
use crate::number::{Number, Word};
use crate::parameters::{MOTION, motion_numbers, motion_of};
use crate::plan::{Decoding, Plan};

/// A drone between two steps.
#[derive(Debug, Clone)]
pub(crate) struct Memory<N: Number> {
    /// State of the drone.
    pub motion: FlightState<N>,
    /// Rotor speeds, rpm; relative to the hover speed with [`Plan::relative`].
    pub rotors: [N; 4],
    /// 1 if the drone has been clear of the floor since the start of the episode, 0 before.
    pub airborne: N,
    /// Last command of control loops, as the rotor speeds.
    pub command: Option<[N; 4]>,
    /// State of the control loops.
    pub loops: Option<ControlMemory<N>>,
    pub wind: Option<WindState<N>>,
    /// Commands of the last control steps, newest first, as the rotor speeds.
    pub late_commands: Vec<[N; 4]>,
    /// Recorded states of the last control steps, newest first.
    pub late_states: Vec<FlightState<N>>,
    /// State of the task.
    pub task: Vec<N>,
    /// Parameters of the episode that are drawn.
    pub drawn: Vec<N>,
    /// Seed, lower half first.
    pub seed: [N::Word; 2],
    /// Number of the next episode since the seed was set.
    pub episode: N::Word,
    /// Control steps since the start of the episode.
    pub steps: N::Word,
    /// [`Outcome::end`](super::Outcome::end) of the last step.
    pub end: N::Word,
    /// Key of the random numbers of wind and sensors.
    pub key: [N::Word; 2],
}

/// Number of the first of the numbers of [`Memory::command`].
pub(crate) const COMMAND: usize = MOTION + 5;

/// Number above every yaw: the mark of a setpoint that is not set.
const UNSET: f64 = 1e32;

impl<N: Number> Memory<N> {
    /// Number of words.
    pub const WORDS: usize = 7;

    /// Creates a memory of a plan whose numbers and words are all these ones.
    pub fn filled(plan: &Plan, number: N, word: N::Word) -> Self {
        let vector = V3 { x: number, y: number, z: number };
        let motion = FlightState {
            position: vector,
            attitude: flight::math::Turn { w: number, v: vector },
            velocity: vector,
            rate: vector,
        };
        let keeps = matches!(&plan.decoding, Decoding::Loops(decoder) if decoder.keeps_memory());
        Self {
            motion,
            rotors: [number; 4],
            airborne: number,
            command: matches!(plan.decoding, Decoding::Loops(_)).then_some([number; 4]),
            loops: keeps.then(|| ControlMemory::default().map(|_| number)),
            wind: plan.wind.map(|_| WindState::default().map(|_: &f64| number)),
            late_commands: vec![[number; 4]; plan.late_commands],
            late_states: vec![motion; plan.late_states],
            task: vec![number; tasks::state_size(&plan.task)],
            drawn: vec![number; plan.drawn.iter().filter(|drawn| **drawn).count()],
            seed: [word; 2],
            episode: word,
            steps: word,
            end: word,
            key: [word; 2],
        }
    }

    /// Returns the state of control loops at the start of an episode.
    pub fn fresh_loops(like: N) -> ControlMemory<N> {
        ControlMemory::default().map(|number| like.all(if number.is_nan() { UNSET } else { *number }))
    }

    /// Calls a function with every number, in a fixed order.
    fn each(&mut self, mut visit: impl FnMut(&mut N)) {
        fn motions<N: Copy>(motion: &mut FlightState<N>, visit: &mut impl FnMut(&mut N)) {
            let mut numbers = motion_numbers(motion);
            numbers.iter_mut().for_each(visit);
            *motion = motion_of(&numbers);
        }
        motions(&mut self.motion, &mut visit);
        self.rotors.iter_mut().for_each(&mut visit);
        visit(&mut self.airborne);
        self.command.as_mut_slice().as_flattened_mut().iter_mut().for_each(&mut visit);
        if let Some(loops) = &mut self.loops {
            let V3 { x, y, z } = &mut loops.position_integral;
            let V3 { x: roll, y: pitch, z: yaw } = &mut loops.attitude_integral;
            let V3 { x: east, y: north, z: up } = &mut loops.setpoint;
            for number in [x, y, z, roll, pitch, yaw, east, north, up] {
                visit(number);
            }
            for number in [&mut loops.heading, &mut loops.setpoint_yaw, &mut loops.chart] {
                visit(number);
            }
        }
        if let Some(wind) = &mut self.wind {
            let filters = wind.filters.as_flattened_mut();
            let rest = [&mut wind.elapsed, &mut wind.calm];
            wind.turbulence.iter_mut().chain(filters).chain(&mut wind.peak).chain(rest).for_each(&mut visit);
        }
        self.late_states.iter_mut().for_each(|state| motions(state, &mut visit));
        self.late_commands.as_flattened_mut().iter_mut().for_each(&mut visit);
        self.task.iter_mut().chain(&mut self.drawn).for_each(visit);
    }

    /// Returns the numbers.
    pub fn numbers(&self) -> Vec<N> {
        let mut numbers = Vec::new();
        self.clone().each(|number| numbers.push(*number));
        numbers
    }

    /// Returns the words.
    pub fn words(&self) -> Vec<N::Word> {
        let Self { seed: [a, b], episode, steps, end, key: [c, d], .. } = *self;
        vec![a, b, episode, steps, end, c, d]
    }

    /// Returns a memory with these numbers and words.
    pub fn with(&self, numbers: &[N], words: &[N::Word]) -> Self {
        let (mut memory, mut next) = (self.clone(), numbers.iter());
        let mut set = |number: &mut N| {
            if let Some(new) = next.next() {
                *number = *new;
            }
        };
        memory.each(&mut set);
        let &[a, b, episode, steps, end, c, d] = words else { unreachable!("the list has WORDS entries") };
        Self { seed: [a, b], episode, steps, end, key: [c, d], ..memory }
    }

    /// Returns the number of control steps as a number.
    pub fn steps_so_far(&self) -> N {
        N::of_word(self.steps)
    }
}

/// Returns the number of numbers of a drone between two steps.
pub(crate) fn count_numbers(plan: &Plan) -> usize {
    Memory::<f64>::filled(plan, 0.0, u32::of(0)).numbers().len()
}
