//! Threads of a batch and the division of its environments among them.

use std::sync::{Mutex, PoisonError};

use smallvec::SmallVec;

use super::shard::{BatchModel, Shard};
use super::threads::Threads;
use super::worker::{Faults, Worker};
use crate::env::{EnvError, Task};

/// Workers of a batch, one per thread.
#[derive(Debug)]
pub(super) struct WorkerPool<T> {
    pub workers: Vec<Mutex<Worker<T>>>,
    /// `None` for a single worker. The caller's thread runs the first worker.
    threads: Option<Threads>,
    pub faults: Faults,
}

impl<T: Task + Send> WorkerPool<T> {
    /// Creates a pool with a thread for every worker but the first.
    pub fn new(workers: Vec<Worker<T>>) -> Result<Self, EnvError> {
        let count = workers.len();
        let threads = (count > 1).then(|| Threads::new(count - 1)).transpose().map_err(|error| EnvError::Option {
            option: "threads",
            got: format!("{count} ({error})"),
            expected: "a number of threads that the system can start",
        })?;
        Ok(Self { workers: workers.into_iter().map(Mutex::new).collect(), threads, faults: Faults::default() })
    }

    /// Calls `work` for every environment of a shard, on all threads.
    pub fn run(
        &mut self,
        model: &BatchModel,
        mut shard: Shard<'_, T>,
        work: &(impl Fn(&mut Worker<T>, &mut Shard<'_, T>, &Faults) + Sync),
    ) -> Result<(), EnvError> {
        if self.workers.iter().any(Mutex::is_poisoned) {
            return Err(EnvError::Panicked);
        }
        let Self { workers, threads, faults } = self;
        let Some(threads) = threads else {
            // a single worker needs no queue, which would be slow compared with the step of one environment
            let mut worker = workers[0].lock().unwrap_or_else(PoisonError::into_inner);
            work(&mut worker, &mut shard, faults);
            return Ok(());
        };
        let queue = WorkQueue::new(model, shard, workers.len());
        threads.run(&|index: usize| {
            let mut worker = workers[index].lock().unwrap_or_else(PoisonError::into_inner);
            while let Some(mut shard) = queue.next(model, index) {
                work(&mut worker, &mut shard, faults);
            }
        });
        Ok(())
    }
}

/// Blocks that a worker takes at least from its own shard.
const GRAIN: usize = 4;

/// Shards that wait for a worker. Every worker has the same shard in every step, which is still in the cache of its
/// thread. A worker that finishes early takes parts from the far end of other shards.
struct WorkQueue<'a, T> {
    shards: SmallVec<[Mutex<Option<Shard<'a, T>>>; 16]>,
}

impl<'a, T> WorkQueue<'a, T> {
    fn new(model: &BatchModel, shard: Shard<'a, T>, workers: usize) -> Self {
        let blocks = shard.blocks();
        let mut shards = SmallVec::new();
        let mut rest = shard;
        for worker in 0..workers {
            let (own, others) = rest.split(model, blocks * (worker + 1) / workers - blocks * worker / workers);
            shards.push(Mutex::new(Some(own)));
            rest = others;
        }
        Self { shards }
    }

    /// Returns the next shard of a worker: from its own shard, then from those of other workers.
    fn next(&self, model: &BatchModel, worker: usize) -> Option<Shard<'a, T>> {
        let count = self.shards.len();
        let mut others = 1..count;
        self.take(model, worker, true).or_else(|| others.find_map(|by| self.take(model, (worker + by) % count, false)))
    }

    /// Takes half of the blocks that are left, from the front or the far end of a worker's shard. A worker does not
    /// divide a short rest of its own shard: that would cost as much as the steps of some environments.
    fn take(&self, model: &BatchModel, worker: usize, front: bool) -> Option<Shard<'a, T>> {
        let mut waiting = self.shards[worker].lock().unwrap_or_else(PoisonError::into_inner);
        let shard = waiting.take()?;
        let blocks = shard.blocks();
        let (first, second) = shard.split(model, if front { blocks.div_ceil(2).max(GRAIN) } else { blocks / 2 });
        let (taken, left) = if front { (first, second) } else { (second, first) };
        *waiting = (left.blocks() > 0).then_some(left);
        (taken.blocks() > 0).then_some(taken)
    }
}
