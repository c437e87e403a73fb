//! Kernels: one thread per environment reads its numbers and words, advances the environment and writes them back.
//!
//! Numbers and words are structures of arrays: row r of environment i is entry r·M + i, so that neighbouring threads
//! access neighbouring memory. Actions and observations are rows of environments, the layout of the host and of
//! tensors.

use cubecl::frontend::{assign, cast_value};
use cubecl::ir::ExpandValue;
use cubecl::prelude::*;
use flight::math::Real as _;

use crate::environment::{Memory, NUMBERS, OBSERVATION, WORDS, control_step, reset};
use crate::number::Word as _;
use crate::plan::{Parameters, Plan};
#[cfg(test)]
use crate::random::philox;
use crate::traced::{Traced, TracedWord, within};

/// Kernel of a control step of `count` environments.
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
    count: u32,
    #[comptime] plan: Plan,
    #[comptime] keeps_last: bool,
) {
    if ABSOLUTE_POS < count as usize {
        step_one::<F>(
            numbers,
            words,
            actions,
            parameters,
            observations,
            last_observations,
            rewards,
            ends,
            ABSOLUTE_POS,
            count as usize,
            plan,
            keeps_last,
        );
    }
}

/// Kernel of a reset. `selection` has a row of `count` entries that are 0 for environments that continue, 1 for
/// environments that continue their random stream, and 2 for those with a new seed, and two rows with the halves of the
/// seeds.
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
) {
    if ABSOLUTE_POS < count as usize && selection[ABSOLUTE_POS] > 0 {
        reset_one::<F>(numbers, words, parameters, selection, observations, ABSOLUTE_POS, count as usize, plan);
    }
}

/// Kernel of the random words of counters, for the test of their known answers: a key and a counter per thread.
#[cfg(test)]
#[cube(launch_unchecked)]
pub(crate) fn philox_kernel(input: &[u32], output: &mut [u32], count: u32) {
    if ABSOLUTE_POS < count as usize {
        philox_one(input, output, ABSOLUTE_POS, count as usize);
    }
}

/// Advances one environment; `step_one::expand` emits its operations.
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
    index: usize,
    count: usize,
    plan: Plan,
    keeps_last: bool,
) {
    unreachable!("kernels run on the device")
}

/// Starts an episode of one environment; `reset_one::expand` emits its operations.
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

/// Largest number of single precision below π.
const PI_INSIDE: f64 = 3.141_592_502_593_994;

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

fn load<E: CubePrimitive<ExpandType = NativeExpand<E>>>(
    scope: &Scope,
    from: &NativeExpand<[E]>,
    at: Index,
) -> ExpandValue {
    ExpandValue::Value(from.__expand_index_method(scope, at).read_value(scope))
}

fn store<E: CubePrimitive<ExpandType = NativeExpand<E>>>(
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

/// Stores an observation in single precision. Angles are rounded towards the inside of their bounds.
fn store_observation<F: Float>(
    scope: &Scope,
    to: &mut NativeExpand<[f32]>,
    index: Index,
    observation: &[Traced<F>; OBSERVATION],
) {
    for (column, number) in observation.iter().enumerate() {
        let mut number = single(scope, *number);
        if (3..6).contains(&column) {
            number = number.lesser(number.all(PI_INSIDE)).greater(number.all(-PI_INSIDE));
        }
        store(scope, to, cell(scope, index, OBSERVATION, column), number.0);
    }
}

fn load_parameters<F: Float>(scope: &Scope, from: &NativeExpand<[F]>) -> Parameters<Traced<F>> {
    let mut next = 0;
    Parameters::read(|| {
        next += 1;
        Traced::new(load(scope, from, Index::from_lit(scope, next - 1)))
    })
}

fn load_memory<F: Float>(
    scope: &Scope,
    numbers: &NativeExpand<[F]>,
    words: &NativeExpand<[u32]>,
    count: Index,
    index: Index,
) -> Memory<Traced<F>> {
    let numbers: [Traced<F>; NUMBERS] =
        std::array::from_fn(|row| Traced::new(load(scope, numbers, entry(scope, row, count, index))));
    let words: [TracedWord; WORDS] =
        std::array::from_fn(|row| TracedWord(load(scope, words, entry(scope, row, count, index))));
    Memory::new(&numbers, words)
}

fn store_memory<F: Float>(
    scope: &Scope,
    memory: &Memory<Traced<F>>,
    numbers: &mut NativeExpand<[F]>,
    words: &mut NativeExpand<[u32]>,
    count: Index,
    index: Index,
) {
    for (row, number) in memory.numbers().into_iter().enumerate() {
        store(scope, numbers, entry(scope, row, count, index), number.0);
    }
    for (row, word) in memory.words().into_iter().enumerate() {
        store(scope, words, entry(scope, row, count, index), word.0);
    }
}

/// Returns the index of an environment as a word.
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
        index: Index,
        count: Index,
        plan: Plan,
        keeps_last: bool,
    ) {
        within(scope, || {
            let constants = load_parameters(scope, parameters);
            let memory = load_memory(scope, numbers, words, count, index);
            let size = plan.action_size();
            let action: [Traced<F>; 4] =
                std::array::from_fn(|motor| Traced::new(load(scope, actions, cell(scope, index, size, motor % size))));
            let outcome = control_step(&plan, &constants, &memory, word_of(scope, index), action);
            store_memory(scope, &outcome.memory, numbers, words, count, index);
            store_observation(scope, observations, index, &outcome.observation);
            if keeps_last {
                store_observation(scope, last_observations, index, &outcome.last_observation);
            }
            store(scope, rewards, index, single(scope, outcome.reward).0);
            store(scope, ends, index, outcome.end.0);
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
            let constants = load_parameters(scope, parameters);
            let mut memory = load_memory(scope, numbers, words, count, index);
            let [kind, low, high] =
                [0, 1, 2].map(|row| TracedWord(load(scope, selection, entry(scope, row, count, index))));
            let seeded = TracedWord::of(1).less(kind);
            memory.seed =
                [TracedWord::choose(seeded, low, memory.seed[0]), TracedWord::choose(seeded, high, memory.seed[1])];
            memory.episode = TracedWord::choose(seeded, TracedWord::of(0), memory.episode);
            let (memory, observation) = reset(&plan, &constants, &memory, word_of(scope, index));
            store_memory(scope, &memory, numbers, words, count, index);
            store_observation(scope, observations, index, &observation);
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
    use crate::device::GpuDevice;
    use crate::random::tests::KNOWN;

    #[test]
    #[allow(unsafe_code)]
    fn philox_has_the_known_answers_on_the_device() {
        // the other tests report that there is no device
        let Ok(device) = GpuDevice::open(None) else { return };
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
