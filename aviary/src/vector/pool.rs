//! Threads of a batch and the division of its environments among them.

use std::io;
use std::sync::{Mutex, PoisonError};
use std::thread::{Builder, JoinHandle};

use rayon::{ThreadBuilder, ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use smallvec::SmallVec;

use super::shard::{BatchModel, Shard};
use super::worker::{Faults, Worker};
use crate::env::{EnvError, Task};

/// Workers of a batch, one per thread.
#[derive(Debug)]
pub(super) struct WorkerPool<T> {
    pub workers: Vec<Mutex<Worker<T>>>,
    /// `None` for a single worker, which runs on the caller's thread.
    threads: Option<Threads>,
    pub faults: Faults,
}

impl<T: Task + Send> WorkerPool<T> {
    /// Creates a pool with a thread for every worker if there are several.
    pub fn new(workers: Vec<Worker<T>>) -> Result<Self, EnvError> {
        let count = workers.len();
        let threads = (count > 1).then(|| Threads::new(count)).transpose().map_err(|error| EnvError::Option {
            option: "threads",
            got: format!("{count} ({error})"),
            expected: "a number of threads that the system can start",
        })?;
        Ok(Self { workers: workers.into_iter().map(Mutex::new).collect(), threads, faults: Faults::default() })
    }

    /// Calls `work` for every environment of a shard, on all threads.
    pub fn run(
        &self,
        model: &BatchModel,
        mut shard: Shard<'_, T>,
        work: &(impl Fn(&mut Worker<T>, &mut Shard<'_, T>, &Faults) + Sync),
    ) -> Result<(), EnvError> {
        if self.workers.iter().any(Mutex::is_poisoned) {
            return Err(EnvError::Panicked);
        }
        let Some(threads) = &self.threads else {
            // a single worker needs no queue, which would be slow compared with the step of one environment
            let mut worker = self.workers[0].lock().unwrap_or_else(PoisonError::into_inner);
            work(&mut worker, &mut shard, &self.faults);
            return Ok(());
        };
        let queue = WorkQueue::new(model, shard, self.workers.len());
        // any thread takes each worker once and keeps it until the queue is empty, so that a task that uses the
        // threads may meet another worker on its thread but never its own
        let take = |index: usize| {
            let mut worker = self.workers[index].lock().unwrap_or_else(PoisonError::into_inner);
            while let Some(mut shard) = queue.next(model, index) {
                work(&mut worker, &mut shard, &self.faults);
            }
        };
        threads.run(|| for_each(0..self.workers.len(), &take));
        Ok(())
    }
}

/// Shards that wait for a worker. Every worker has the same shard in every step, which is still in the cache of its
/// thread. A worker that finishes early takes small parts from the far end of other shards.
struct WorkQueue<'a, T> {
    shards: SmallVec<[Mutex<Option<Shard<'a, T>>>; 16]>,
    /// Number of blocks that a worker takes at a time.
    grain: usize,
}

impl<'a, T> WorkQueue<'a, T> {
    fn new(model: &BatchModel, shard: Shard<'a, T>, workers: usize) -> Self {
        let blocks = shard.blocks();
        let grain = blocks.div_ceil(8 * workers).max(1);
        let mut shards = SmallVec::new();
        let mut rest = shard;
        for worker in 0..workers {
            let (own, others) = rest.split(model, blocks * (worker + 1) / workers - blocks * worker / workers);
            shards.push(Mutex::new(Some(own)));
            rest = others;
        }
        Self { shards, grain }
    }

    /// Returns the next shard of a worker: from its own shard, then from those of other workers.
    fn next(&self, model: &BatchModel, worker: usize) -> Option<Shard<'a, T>> {
        let count = self.shards.len();
        let mut others = 1..count;
        self.take(model, worker, true).or_else(|| others.find_map(|by| self.take(model, (worker + by) % count, false)))
    }

    /// Takes `grain` blocks from the front or the far end of a worker's shard.
    fn take(&self, model: &BatchModel, worker: usize, front: bool) -> Option<Shard<'a, T>> {
        let mut waiting = self.shards[worker].lock().unwrap_or_else(PoisonError::into_inner);
        let shard = waiting.take()?;
        let blocks = shard.blocks();
        let at = if front { self.grain } else { blocks.saturating_sub(self.grain) };
        let (first, second) = shard.split(model, at.min(blocks));
        let (taken, left) = if front { (first, second) } else { (second, first) };
        *waiting = (left.blocks() > 0).then_some(left);
        (taken.blocks() > 0).then_some(taken)
    }
}

/// Calls `act` with every index, in parallel.
fn for_each(range: std::ops::Range<usize>, act: &(impl Fn(usize) + Sync)) {
    match range.len() {
        0 => {}
        1 => act(range.start),
        count => {
            let middle = range.start + count / 2;
            rayon::join(|| for_each(range.start..middle, act), || for_each(middle..range.end, act));
        }
    }
}

/// Threads of a batch. Dropping them waits for the threads to end.
///
/// A rayon pool only tells its threads to end. Without the wait, exit handlers could free the thread-local memory
/// of an OpenGL driver while a thread still uses it.
#[derive(Debug)]
struct Threads {
    /// `None` only during the drop.
    pool: Option<ThreadPool>,
    handles: Vec<JoinHandle<()>>,
}

impl Threads {
    /// Starts `count` threads.
    fn new(count: usize) -> Result<Self, ThreadPoolBuildError> {
        let handles = Mutex::new(Vec::with_capacity(count));
        let spawn = |thread: ThreadBuilder| -> io::Result<()> {
            let handle = Builder::new().name(format!("aviary{}", thread.index())).spawn(|| thread.run())?;
            handles.lock().unwrap_or_else(PoisonError::into_inner).push(handle);
            Ok(())
        };
        let pool = ThreadPoolBuilder::new().num_threads(count).spawn_handler(spawn).build();
        let handles = handles.into_inner().unwrap_or_else(PoisonError::into_inner);
        match pool {
            Ok(pool) => Ok(Self { pool: Some(pool), handles }),
            Err(error) => {
                // the pool's builder has told the threads that did start to end
                join(handles);
                Err(error)
            }
        }
    }

    /// Runs `work` on one of the threads. `work` may use the others.
    fn run<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        match &self.pool {
            Some(pool) => pool.install(work),
            None => work(),
        }
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        drop(self.pool.take());
        join(std::mem::take(&mut self.handles));
    }
}

fn join(handles: Vec<JoinHandle<()>>) {
    let this = std::thread::current().id();
    for handle in handles.into_iter().filter(|handle| handle.thread().id() != this) {
        // rayon has already passed a panic of a task on to the caller
        let _ = handle.join();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    thread_local! {
        static LATE: Late = const { Late };
    }

    static ENDED: AtomicUsize = AtomicUsize::new(0);

    struct Late;

    impl Drop for Late {
        fn drop(&mut self) {
            std::thread::sleep(std::time::Duration::from_millis(30));
            ENDED.fetch_add(1, Ordering::SeqCst);
        }
    }

    #[test]
    fn every_thread_has_ended_when_the_batch_is_gone() {
        let threads = Threads::new(3).unwrap();
        threads.run(|| rayon::broadcast(|_| LATE.with(|_| ())));
        assert_eq!(ENDED.load(Ordering::SeqCst), 0);
        drop(threads);
        assert_eq!(ENDED.load(Ordering::SeqCst), 3);
    }
}
