//! Kernels: one thread per drone reads its numbers and words, advances the drone and writes them back.
//!
//! Numbers and words are structures of arrays: row r of drone i is entry r·M·N + i for M environments of N drones, so
//! that neighbouring threads access neighbouring memory. Actions and observations are rows of drones, the layout of
//! the host and of tensors. The drones of an environment are neighbours in one workgroup and exchange their positions.

#[cfg(feature = "learn")]
pub(crate) mod begin;

use cubecl::frontend::branch::if_expand;
use cubecl::frontend::{assign, cast_value};
use cubecl::ir::ExpandValue;
use cubecl::prelude::*;
use flight::math::Real as _;

use crate::environment::{Memory, control_step, count_numbers, reset};
use crate::number::Word as _;
use crate::parameters::Parameters;
use crate::plan::Plan;
#[cfg(test)]
use crate::random::philox;
use crate::traced::{Group, Traced, TracedWord, within, within_group};

/// Kernel of a control step of `count` drones, with `threads` threads in all workgroups. `exchange` has
/// [`Group::ROWS`] rows of a number per thread if an environment has several drones.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)] // the buffers of a kernel
pub(crate) fn step_kernel<F: Float>(
    numbers: &mut [F],
    words: &mut [u32],
    actions: &[F],
    parameters: &[F],
    observations: &mut [f32],
    last_observations: &mut [f32],
    rewards: &mut [f32],
    ends: &mut [u32],
    exchange: &mut [F],
    count: u32,
    threads: u32,
    #[comptime] plan: Plan,
    #[comptime] keeps_last: bool,
) {
    step_one::<F>(
        numbers,
        words,
        actions,
        parameters,
        observations,
        last_observations,
        rewards,
        ends,
        exchange,
        ABSOLUTE_POS,
        count as usize,
        threads as usize,
        plan,
        keeps_last,
    );
}

/// Kernel of a reset of `count` drones of M environments. `selection` has a row of M entries that are 0 for
/// environments that continue, 1 for environments that continue their random stream, and 2 for those with a new seed,
/// and two rows with the halves of the seeds.
#[cube(launch_unchecked)]
#[allow(clippy::too_many_arguments)]
pub(crate) fn reset_kernel<F: Float>(
    numbers: &mut [F],
    words: &mut [u32],
    parameters: &[F],
    selection: &[u32],
    observations: &mut [f32],
    count: u32,
    #[comptime] plan: Plan,
    #[comptime] drones: u32,
) {
    if ABSOLUTE_POS < count as usize && selection[ABSOLUTE_POS / drones as usize] > 0 {
        reset_one::<F>(numbers, words, parameters, selection, observations, ABSOLUTE_POS, count as usize, plan);
    }
}

/// Kernel of a copy, for measurements.
#[cube(launch_unchecked)]
pub(crate) fn copy_kernel(from: &[f32], to: &mut [f32]) {
    to[ABSOLUTE_POS] = from[ABSOLUTE_POS];
}

/// Kernel of the random words of counters, for the test of their known answers: a key and a counter per thread.
#[cfg(test)]
#[cube(launch_unchecked)]
pub(crate) fn philox_kernel(input: &[u32], output: &mut [u32], count: u32) {
    if ABSOLUTE_POS < count as usize {
        philox_one(input, output, ABSOLUTE_POS, count as usize);
    }
}

/// Advances one drone; `step_one::expand` emits its operations.
#[allow(unused_variables, clippy::too_many_arguments)]
fn step_one<F: Float>(
    numbers: &mut [F],
    words: &mut [u32],
    actions: &[F],
    parameters: &[F],
    observations: &mut [f32],
    last_observations: &mut [f32],
    rewards: &mut [f32],
    ends: &mut [u32],
    exchange: &mut [F],
    position: usize,
    count: usize,
    threads: usize,
    plan: Plan,
    keeps_last: bool,
) {
    unreachable!("kernels run on the device")
}

/// Starts an episode of one drone; `reset_one::expand` emits its operations.
#[allow(unused_variables, clippy::too_many_arguments)]
fn reset_one<F: Float>(
    numbers: &mut [F],
    words: &mut [u32],
    parameters: &[F],
    selection: &[u32],
    observations: &mut [f32],
    index: usize,
    count: usize,
    plan: Plan,
) {
    unreachable!("kernels run on the device")
}

/// Computes the random words of one counter; `philox_one::expand` emits its operations.
#[cfg(test)]
#[allow(unused_variables)]
fn philox_one(input: &[u32], output: &mut [u32], index: usize, count: usize) {
    unreachable!("kernels run on the device")
}

type Index = NativeExpand<usize>;

/// Returns `row · count + index`.
fn entry(scope: &Scope, row: usize, count: Index, index: Index) -> Index {
    use cubecl::prelude::{AddExpand as _, MulExpand as _};
    let row = Index::from_lit(scope, row);
    row.__expand_mul_method(scope, count).__expand_add_method(scope, index)
}

/// Returns `index · size + column`.
fn cell(scope: &Scope, index: Index, size: usize, column: usize) -> Index {
    use cubecl::prelude::{AddExpand as _, MulExpand as _};
    let (size, column) = (Index::from_lit(scope, size), Index::from_lit(scope, column));
    index.__expand_mul_method(scope, size).__expand_add_method(scope, column)
}

/// Returns the quotient and the rest of an index.
fn divided(scope: &Scope, index: Index, divisor: u32) -> [Index; 2] {
    use cubecl::prelude::{DivExpand as _, RemExpand as _};
    let divisor = Index::from_lit(scope, divisor as usize);
    [index.__expand_div_method(scope, divisor), index.__expand_rem_method(scope, divisor)]
}

pub(crate) fn load<E: CubePrimitive<ExpandType = NativeExpand<E>>>(
    scope: &Scope,
    from: &NativeExpand<[E]>,
    at: Index,
) -> ExpandValue {
    ExpandValue::Value(from.__expand_index_method(scope, at).read_value(scope))
}

pub(crate) fn store<E: CubePrimitive<ExpandType = NativeExpand<E>>>(
    scope: &Scope,
    to: &mut NativeExpand<[E]>,
    at: Index,
    value: ExpandValue,
) {
    let place = to.__expand_index_mut_method(scope, at);
    assign::expand_element(scope, value, place.expand);
}

/// Converts a number to single precision.
fn single<F: Float>(scope: &Scope, number: Traced<F>) -> Traced<f32> {
    let value = number.0.read_value(scope);
    Traced::new(ExpandValue::Value(cast_value(scope, value, f32::__expand_as_type(scope))))
}

/// Returns the largest number of single precision up to a bound, or the smallest one from a bound on.
fn inside(bound: f64, upper: bool) -> f32 {
    let nearest = bound as f32;
    match f64::from(nearest) {
        rounded if upper && rounded > bound => nearest.next_down(),
        rounded if !upper && rounded < bound => nearest.next_up(),
        _ => nearest,
    }
}

/// Stores an observation in single precision, within the bounds of its space.
fn store_observation<F: Float>(
    scope: &Scope,
    plan: &Plan,
    to: &mut NativeExpand<[f32]>,
    index: Index,
    observation: &[Traced<F>],
) {
    for (column, (number, &[low, high])) in observation.iter().zip(plan.observation_bounds.iter()).enumerate() {
        let mut number = single(scope, *number);
        if low.is_finite() && high.is_finite() {
            let [low, high] = [inside(low, false), inside(high, true)].map(|bound| number.all(f64::from(bound)));
            number = number.lesser(high).greater(low);
        }
        store(scope, to, cell(scope, index, observation.len(), column), number.0);
    }
}

/// Buffers of a batch in a kernel.
struct Batch<'a, F: Float> {
    numbers: &'a mut NativeExpand<[F]>,
    words: &'a mut NativeExpand<[u32]>,
    parameters: &'a NativeExpand<[F]>,
    /// Number of drones in all environments.
    count: Index,
    /// Number of this drone.
    index: Index,
}

impl<F: Float> Batch<'_, F> {
    /// Loads the nominal parameters of a drone of every environment.
    fn parameters(&self, scope: &Scope, drone: Index) -> Parameters<Traced<F>> {
        let mut next = 0;
        Parameters::read(|| {
            next += 1;
            Traced::new(load(scope, self.parameters, cell(scope, drone, Parameters::COUNT, next - 1)))
        })
    }

    fn memory(&self, scope: &Scope, plan: &Plan) -> Memory<Traced<F>> {
        let at = |row| entry(scope, row, self.count, self.index);
        let numbers: Vec<Traced<F>> =
            (0..count_numbers(plan)).map(|row| Traced::new(load(scope, self.numbers, at(row)))).collect();
        let words: Vec<TracedWord> =
            (0..Memory::<f64>::WORDS).map(|row| TracedWord(load(scope, self.words, at(row)))).collect();
        Memory::filled(plan, numbers[0], words[0]).with(&numbers, &words)
    }

    fn store(&mut self, scope: &Scope, memory: &Memory<Traced<F>>) {
        for (row, number) in memory.numbers().into_iter().enumerate() {
            store(scope, self.numbers, entry(scope, row, self.count, self.index), number.0);
        }
        for (row, word) in memory.words().into_iter().enumerate() {
            store(scope, self.words, entry(scope, row, self.count, self.index), word.0);
        }
    }
}

/// Returns an index as a word.
fn word_of(scope: &Scope, index: Index) -> TracedWord {
    let value = index.expand.read_value(scope);
    TracedWord(ExpandValue::Value(cast_value(scope, value, u32::__expand_as_type(scope))))
}

mod step_one {
    use super::*;

    #[allow(clippy::too_many_arguments)]
    pub fn expand<F: Float>(
        scope: &Scope,
        numbers: &mut NativeExpand<[F]>,
        words: &mut NativeExpand<[u32]>,
        actions: &NativeExpand<[F]>,
        parameters: &NativeExpand<[F]>,
        observations: &mut NativeExpand<[f32]>,
        last_observations: &mut NativeExpand<[f32]>,
        rewards: &mut NativeExpand<[f32]>,
        ends: &mut NativeExpand<[u32]>,
        exchange: &mut NativeExpand<[F]>,
        position: Index,
        count: Index,
        threads: Index,
        plan: Plan,
        keeps_last: bool,
    ) {
        use cubecl::prelude::{OrdExpand as _, PartialEqExpand as _, PartialOrdExpand as _, SubExpand as _};
        within(scope, || {
            // threads beyond the last drone compute its step, too, because all threads of a workgroup meet at its
            // barriers, and store nothing
            let last = count.__expand_sub_method(scope, Index::from_lit(scope, 1));
            let index = position.__expand_min_method(scope, last);
            let [environment, _] = divided(scope, index, plan.drones);
            // workgroups have whole worlds
            let [_, drone] = divided(scope, position, plan.drones);
            let mut batch = Batch { numbers, words, parameters, count, index };
            let (nominal, memory) = (batch.parameters(scope, drone), batch.memory(scope, &plan));
            let size = plan.action_size();
            let action: [Traced<F>; 4] =
                std::array::from_fn(|motor| Traced::new(load(scope, actions, cell(scope, index, size, motor % size))));
            let (world, own) = (word_of(scope, environment), word_of(scope, drone));
            let members = Group::new(exchange, plan.drones, threads, position);
            let outcome = within_group(members, || control_step(&plan, &nominal, &memory, world, own, action));
            let exists = position.__expand_lt_method(scope, &count);
            if_expand(scope, exists, |scope| {
                within(scope, || {
                    batch.store(scope, &outcome.memory);
                    store_observation(scope, &plan, observations, index, &outcome.observation);
                    if keeps_last {
                        store_observation(scope, &plan, last_observations, index, &outcome.last_observation);
                    }
                    let is_first = drone.__expand_eq_method(scope, &Index::from_lit(scope, 0));
                    if_expand(scope, is_first, |scope| {
                        store(scope, rewards, environment, single(scope, outcome.reward).0);
                        store(scope, ends, environment, outcome.end.0);
                    });
                });
            });
        });
    }
}

mod reset_one {
    use super::*;

    #[allow(clippy::too_many_arguments)]
    pub fn expand<F: Float>(
        scope: &Scope,
        numbers: &mut NativeExpand<[F]>,
        words: &mut NativeExpand<[u32]>,
        parameters: &NativeExpand<[F]>,
        selection: &NativeExpand<[u32]>,
        observations: &mut NativeExpand<[f32]>,
        index: Index,
        count: Index,
        plan: Plan,
    ) {
        within(scope, || {
            let mut batch = Batch { numbers, words, parameters, count, index };
            let [environment, drone] = divided(scope, index, plan.drones);
            let [environments, _] = divided(scope, count, plan.drones);
            let (nominal, mut memory) = (batch.parameters(scope, drone), batch.memory(scope, &plan));
            let [kind, low, high] =
                [0, 1, 2].map(|row| TracedWord(load(scope, selection, entry(scope, row, environments, environment))));
            let seeded = TracedWord::of(1).less(kind);
            memory.seed =
                [TracedWord::choose(seeded, low, memory.seed[0]), TracedWord::choose(seeded, high, memory.seed[1])];
            memory.episode = TracedWord::choose(seeded, TracedWord::of(0), memory.episode);
            let (world, own) = (word_of(scope, environment), word_of(scope, drone));
            let (memory, observation) = reset(&plan, &nominal, &memory, world, own);
            batch.store(scope, &memory);
            store_observation(scope, &plan, observations, index, &observation);
        });
    }
}

#[cfg(test)]
mod philox_one {
    use super::*;

    pub fn expand(
        scope: &Scope,
        input: &NativeExpand<[u32]>,
        output: &mut NativeExpand<[u32]>,
        index: Index,
        count: Index,
    ) {
        within(scope, || {
            let word = |row| TracedWord(load(scope, input, entry(scope, row, count, index)));
            let random = philox([word(0), word(1)], [word(2), word(3), word(4), word(5)]);
            for (row, word) in random.into_iter().enumerate() {
                store(scope, output, entry(scope, row, count, index), word.0);
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::tests::KNOWN;

    #[test]
    #[allow(unsafe_code)]
    fn philox_has_the_known_answers_on_the_device() {
        let Some(device) = crate::device::for_tests() else { return };
        let (count, client) = (KNOWN.len(), device.client());
        let mut input = vec![0; 6 * count];
        for (index, (key, counter, _)) in KNOWN.iter().enumerate() {
            for (row, word) in key.iter().chain(counter).enumerate() {
                input[row * count + index] = *word;
            }
        }
        let (input, output) = (client.create_from_slice(u32::as_bytes(&input)), client.empty(16 * count));
        // SAFETY: both buffers have the lengths that are passed with them, and the kernel has a thread per column
        unsafe {
            philox_kernel::launch_unchecked(
                client,
                CubeCount::Static(1, 1, 1),
                CubeDim::new_1d(32),
                BufferArg::from_raw_parts(input, 6 * count),
                BufferArg::from_raw_parts(output.clone(), 4 * count),
                count as u32,
            );
        }
        let bytes = client.read_one(output).unwrap();
        let words = u32::from_bytes(&bytes);
        for (index, (_, _, expected)) in KNOWN.iter().enumerate() {
            assert_eq!([0, 1, 2, 3].map(|row| words[row * count + index]), *expected);
        }
    }
}
