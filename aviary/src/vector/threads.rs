use std::io;
use std::sync::{Mutex, PoisonError};
use std::thread::{Builder, JoinHandle};

use rayon::{ThreadBuilder, ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};

/// Threads of a batch, which are gone once it has been dropped.
///
/// A rayon pool only tells its threads to end. The program could end before they do, while exit handlers free what an OpenGL
/// driver keeps for each of them.
#[derive(Debug)]
pub(super) struct Threads {
    /// `None` only while it is dropped.
    pool: Option<ThreadPool>,
    handles: Vec<JoinHandle<()>>,
}

impl Threads {
    /// Starts so many threads.
    pub fn new(count: usize) -> Result<Self, ThreadPoolBuildError> {
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
                // those that have started are told to end where the pool is given up
                join(handles);
                Err(error)
            }
        }
    }

    /// Runs something on one of the threads, which may use the others.
    pub fn run<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
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
        // a panic of a task has already been passed on to whoever ran it
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
