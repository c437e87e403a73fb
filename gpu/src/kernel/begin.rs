//! Kernel of the starts of training episodes, whose initial states have ranges of their own.

use cubecl::prelude::*;
use flight::math::{Turn, V3};
use flight::state::FlightState;
use flight::tasks::crash::CLEAR_OF_FLOOR;

use super::{Batch, Index, divided, entry, load, store_observation, word_of};
use crate::environment::reset;
use crate::number::{Number, Word};
use crate::parameters::Parameters;
use crate::plan::Plan;
use crate::random::philox;
use crate::traced::{Traced, TracedWord, within};

/// Number of numbers of a range: largest change of each coordinate (m), of roll, pitch and yaw (rad), and of each
/// component of the velocity (m/s); offset of the position (m) along x, y and z.
pub(crate) const RANGE: usize = 6;

/// Last word of the counters of the draws of initial states, plus the drone. Other draws of an episode have the drone
/// or the largest word there.
const STREAM: u32 = 1 << 31;

/// Kernel of the start of an episode of `count` drones of M environments in a selection, like
/// [`reset_kernel`](super::reset_kernel). `ranges` has [`RANGE`] rows of M entries; with `ranged`, initial states are
/// drawn around those of the batch.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)] // the buffers of a kernel
pub(crate) fn begin_kernel(
    numbers: &mut [f32],
    words: &mut [u32],
    parameters: &[f32],
    selection: &[u32],
    ranges: &[f32],
    observations: &mut [f32],
    count: u32,
    #[comptime] plan: Plan,
    #[comptime] drones: u32,
    #[comptime] ranged: bool,
) {
    if ABSOLUTE_POS < count as usize && selection[ABSOLUTE_POS / drones as usize] > 0 {
        begin_one(
            numbers,
            words,
            parameters,
            selection,
            ranges,
            observations,
            ABSOLUTE_POS,
            count as usize,
            plan,
            ranged,
        );
    }
}

/// Starts an episode of one drone; `begin_one::expand` emits its operations.
#[allow(unused_variables, clippy::too_many_arguments)]
fn begin_one(
    numbers: &mut [f32],
    words: &mut [u32],
    parameters: &[f32],
    selection: &[u32],
    ranges: &[f32],
    observations: &mut [f32],
    index: usize,
    count: usize,
    plan: Plan,
    ranged: bool,
) {
    unreachable!("kernels run on the device")
}

mod begin_one {
    use super::*;

    #[allow(clippy::too_many_arguments)]
    pub fn expand(
        scope: &Scope,
        numbers: &mut NativeExpand<[f32]>,
        words: &mut NativeExpand<[u32]>,
        parameters: &NativeExpand<[f32]>,
        selection: &NativeExpand<[u32]>,
        ranges: &NativeExpand<[f32]>,
        observations: &mut NativeExpand<[f32]>,
        index: Index,
        count: Index,
        plan: Plan,
        ranged: bool,
    ) {
        within(scope, || {
            let mut batch = Batch { numbers, words, parameters, count, index };
            let [environment, drone] = divided(scope, index, plan.drones);
            let [environments, _] = divided(scope, count, plan.drones);
            let (mut nominal, mut memory) = (batch.parameters(scope, drone), batch.memory(scope, &plan));
            let [kind, low, high] =
                [0, 1, 2].map(|row| TracedWord(load(scope, selection, entry(scope, row, environments, environment))));
            let seeded = TracedWord::of(1).less(kind);
            memory.seed =
                [TracedWord::choose(seeded, low, memory.seed[0]), TracedWord::choose(seeded, high, memory.seed[1])];
            memory.episode = TracedWord::choose(seeded, TracedWord::of(0), memory.episode);
            let (world, own) = (word_of(scope, environment), word_of(scope, drone));
            let environment_stream = world.plus(TracedWord::of(plan.stream));
            if ranged {
                let range: [Traced<f32>; RANGE] = std::array::from_fn(|row| {
                    Traced::new(load(scope, ranges, entry(scope, row, environments, environment)))
                });
                let stream = own.plus(TracedWord::of(STREAM));
                let draws = [0, 1, 2].map(|block| {
                    philox(memory.seed, [environment_stream, memory.episode, TracedWord::of(block), stream])
                        .map(symmetric)
                });
                let [[a, b, c, d], [e, f, g, h], [i, ..]] = draws;
                nominal.start = around(&nominal, &range, [a, b, c, d, e, f, g, h, i]);
            }
            let (memory, observation) = reset(&plan, &nominal, &memory, world, own);
            batch.store(scope, &memory);
            store_observation(scope, &plan, observations, index, &observation);
        });
    }
}

/// Returns a number between −1 and 1.
fn symmetric<N: Number>(word: N::Word) -> N {
    (N::of_word(word) + 0.5) * (2.0 / 4_294_967_296.0) - 1.0
}

/// Returns an initial state around that of the batch from nine numbers between −1 and 1. A position in the floor or
/// too close to it for a drone that is airborne moves up.
fn around<N: Number>(nominal: &Parameters<N>, range: &[N; RANGE], draws: [N; 9]) -> FlightState<N> {
    let start = nominal.start;
    let [position, attitude, velocity, x, y, z] = *range;
    let change = |first: usize, max: N| V3::new(draws[first], draws[first + 1], draws[first + 2]) * max;
    let turn = Turn::from_rpy(start.attitude.rpy() + change(0, attitude));
    let velocity = start.velocity + change(3, velocity);
    let mut place = start.position + V3::new(x, y, z) + change(6, position);
    let clearance = nominal.cylinder.floor_clearance(place.z, turn.up().z);
    // 1 % more, because single precision rounds
    let missing = clearance.all(1.01 * CLEAR_OF_FLOOR) - clearance;
    place.z = place.z + missing.greater(missing.all(0.0));
    FlightState { position: place, attitude: turn, velocity, rate: start.rate }
}

#[cfg(test)]
mod tests {
    use flight::clearance::CollisionCylinder;

    use super::*;

    #[test]
    fn initial_states_are_within_their_ranges_and_clear_of_the_floor() {
        let mut nominal = Parameters::<f64>::read(|| 1.0);
        nominal.cylinder = CollisionCylinder { radius: 0.06, height: 0.03 };
        nominal.start.position = V3::new(1.0, 2.0, 0.1);
        nominal.start.attitude = Turn::from_rpy(V3::new(0.0, 0.0, 0.5));
        nominal.start.velocity = V3::new(0.1, 0.2, 0.3);
        let range = [0.2, 0.1, 0.5, 0.0, 1.0, -0.05];
        let state = around(&nominal, &range, [1.0, -1.0, 0.5, 1.0, 0.0, -1.0, -1.0, 1.0, 0.0]);
        let rpy = state.attitude.rpy();
        for (got, expected) in [(rpy.x, 0.1), (rpy.y, -0.1), (rpy.z, 0.55)] {
            assert!((got - expected).abs() < 1e-12, "{rpy:?}");
        }
        for (got, expected) in [(state.velocity.x, 0.6), (state.velocity.y, 0.2), (state.velocity.z, -0.2)] {
            assert!((got - expected).abs() < 1e-12, "{:?}", state.velocity);
        }
        assert!((state.position.x - 0.8).abs() < 1e-12 && (state.position.y - 3.2).abs() < 1e-12);
        // below the floor without the correction
        let low = around(&nominal, &range, [1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]);
        let clearance = nominal.cylinder.floor_clearance(low.position.z, low.attitude.up().z);
        assert!((CLEAR_OF_FLOOR..1.02 * CLEAR_OF_FLOOR).contains(&clearance), "{clearance}");
        let middle = around(&nominal, &[0.0; RANGE], [0.3; 9]);
        assert!((middle.position - nominal.start.position).norm() < 1e-12);
    }
}
