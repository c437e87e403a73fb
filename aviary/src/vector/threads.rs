//! Threads that wait for the steps of a batch.

use std::any::Any;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

/// Work that all threads do at the same time, each with its index.
type Work<'a> = dyn Fn(usize) + Sync + 'a;

/// Time for which a thread waits for work in a loop before it sleeps.
const SPIN: Duration = Duration::from_micros(50);

/// Threads of a batch. Between two steps they wait in a loop for a short time, because waking a thread takes as long
/// as a step of many environments; then they sleep. Dropping them waits for the threads to end: exit handlers could
/// otherwise free the thread-local memory of an OpenGL driver while a thread still uses it.
#[derive(Debug)]
pub(super) struct Threads {
    shared: Arc<Shared>,
    handles: Vec<JoinHandle<()>>,
}

/// A value in its own cache line, so that writes to it do not slow down readers of its neighbours.
#[derive(Debug, Default)]
#[repr(align(128))]
struct Padded<T>(T);

#[derive(Debug, Default)]
struct Shared {
    /// Number of pieces of work that have been started.
    started: Padded<AtomicUsize>,
    /// The current work; valid from the change of `started` until all threads have finished.
    work: Padded<Mutex<Option<Erased>>>,
    /// Number of threads that have not finished the current work.
    busy: Padded<AtomicUsize>,
    /// True for threads that sleep or are about to.
    asleep: Vec<Padded<AtomicBool>>,
    /// Panic of a thread during the current work.
    panic: Mutex<Option<Box<dyn Any + Send>>>,
    ending: AtomicBool,
}

/// Pointer to work of an unknown lifetime.
#[derive(Debug, Clone, Copy)]
struct Erased(*const Work<'static>);

// SAFETY: the pointee is `Sync`, and `Threads::run` keeps it alive until no thread uses it.
#[allow(unsafe_code)]
unsafe impl Send for Erased {}

impl Threads {
    /// Starts `count` threads.
    pub fn new(count: usize) -> io::Result<Self> {
        let asleep = std::iter::repeat_with(Padded::default).take(count).collect();
        let mut threads = Self { shared: Arc::new(Shared { asleep, ..Shared::default() }), handles: Vec::new() };
        for index in 0..count {
            let shared = threads.shared.clone();
            // if a thread cannot start, the drop ends the others
            let handle = Builder::new().name(format!("aviary{}", index + 1)).spawn(move || shared.serve(index))?;
            threads.handles.push(handle);
        }
        Ok(threads)
    }

    /// Calls `work` with 0 on this thread and with 1, 2, … on the others, and waits for all of them.
    ///
    /// # Panics
    /// With the panic of a thread.
    pub fn run(&mut self, work: &Work<'_>) {
        let shared = &*self.shared;
        let erased: *const Work<'_> = work;
        // SAFETY: only the lifetime changes. `Finish` waits, also during a panic, until no thread uses the pointer.
        #[allow(unsafe_code)]
        let erased = Erased(unsafe { std::mem::transmute::<*const Work<'_>, *const Work<'static>>(erased) });
        shared.busy.0.store(self.handles.len(), Ordering::Relaxed);
        *lock(&shared.work.0) = Some(erased);
        let finish = Finish(shared);
        // sequentially consistent with the flags of sleeping threads: a thread sees the work or is seen asleep
        shared.started.0.fetch_add(1, Ordering::SeqCst);
        for (asleep, handle) in shared.asleep.iter().zip(&self.handles) {
            if asleep.0.load(Ordering::SeqCst) {
                handle.thread().unpark();
            }
        }
        work(0);
        drop(finish);
        if let Some(panic) = lock(&shared.panic).take() {
            resume_unwind(panic);
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> std::sync::MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Waits on its drop until all threads have finished the current work.
struct Finish<'a>(&'a Shared);

impl Drop for Finish<'_> {
    fn drop(&mut self) {
        let mut turns = 0_u32;
        while self.0.busy.0.load(Ordering::Acquire) > 0 {
            turns += 1;
            // the other threads may need this core
            if turns.is_multiple_of(1 << 10) { std::thread::yield_now() } else { std::hint::spin_loop() }
        }
        *lock(&self.0.work.0) = None;
    }
}

impl Shared {
    /// Does all work until the end of the thread.
    fn serve(&self, index: usize) {
        let mut done = 0;
        loop {
            let started = self.wait(index, done);
            if self.ending.load(Ordering::SeqCst) {
                return;
            }
            done = started;
            let work = *lock(&self.work.0);
            if let Some(Erased(work)) = work {
                // SAFETY: `Threads::run` keeps the work alive while `busy` counts this thread.
                #[allow(unsafe_code)]
                let work = unsafe { &*work };
                if let Err(panic) = catch_unwind(AssertUnwindSafe(|| work(index + 1))) {
                    *lock(&self.panic) = Some(panic);
                }
            }
            self.busy.0.fetch_sub(1, Ordering::Release);
        }
    }

    /// Waits for more than `done` pieces of work, or for the end, and returns their number.
    fn wait(&self, index: usize, done: usize) -> usize {
        let start = Instant::now();
        let mut turns = 0_u32;
        loop {
            let started = self.started.0.load(Ordering::Acquire);
            if started != done {
                return started;
            }
            turns += 1;
            if !turns.is_multiple_of(1 << 6) || start.elapsed() < SPIN {
                std::hint::spin_loop();
                continue;
            }
            let asleep = &self.asleep[index].0;
            asleep.store(true, Ordering::SeqCst);
            while self.started.0.load(Ordering::SeqCst) == done {
                std::thread::park();
            }
            asleep.store(false, Ordering::SeqCst);
        }
    }
}

impl Drop for Threads {
    fn drop(&mut self) {
        self.shared.ending.store(true, Ordering::SeqCst);
        self.shared.started.0.fetch_add(1, Ordering::SeqCst);
        let this = std::thread::current().id();
        for handle in self.handles.drain(..).filter(|handle| handle.thread().id() != this) {
            handle.thread().unpark();
            // `run` has already passed a panic of the work on to its caller
            let _ = handle.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    thread_local! {
        static LATE: Late = const { Late };
    }

    static ENDED: AtomicUsize = AtomicUsize::new(0);

    struct Late;

    impl Drop for Late {
        fn drop(&mut self) {
            std::thread::sleep(Duration::from_millis(30));
            ENDED.fetch_add(1, Ordering::SeqCst);
        }
    }

    #[test]
    fn every_thread_has_ended_when_the_batch_is_gone() {
        let mut threads = Threads::new(3).unwrap();
        threads.run(&|index| {
            if index > 0 {
                LATE.with(|_| ());
            }
        });
        assert_eq!(ENDED.load(Ordering::SeqCst), 0);
        drop(threads);
        assert_eq!(ENDED.load(Ordering::SeqCst), 3);
    }

    #[test]
    fn every_thread_works_once_in_every_run_awake_or_asleep() {
        let mut threads = Threads::new(2).unwrap();
        for run in 0..200 {
            let calls: [AtomicUsize; 3] = Default::default();
            threads.run(&|index| {
                calls[index].fetch_add(1, Ordering::Relaxed);
            });
            assert_eq!(calls.map(|calls| calls.into_inner()), [1; 3], "run {run}");
            if run % 20 == 0 {
                // longer than a thread waits awake
                std::thread::sleep(4 * SPIN);
            }
        }
    }

    #[test]
    fn a_panic_reaches_the_caller_and_the_threads_work_on() {
        let mut threads = Threads::new(2).unwrap();
        for bad in 0..3 {
            let panic = catch_unwind(AssertUnwindSafe(|| threads.run(&|index| assert_ne!(index, bad, "on purpose"))));
            assert!(panic.is_err());
            let sum = AtomicUsize::new(0);
            threads.run(&|index| {
                sum.fetch_add(index, Ordering::Relaxed);
            });
            assert_eq!(sum.into_inner(), 3);
        }
    }
}
