//! Priority of threads.
#![allow(unsafe_code)]

/// Gives the calling thread, and threads that it starts later, the lowest priority, for flights in the background of
/// other work.
///
/// On Linux the threads run only while a processor has nothing else to do.
pub fn lower() {
    lower_thread(0);
}

/// Returns the id of the calling thread.
pub(super) fn own_thread() -> i32 {
    // SAFETY: returns a number.
    unsafe { libc::gettid() }
}

/// Gives a thread of this process the lowest priority; 0 is the calling thread.
pub(super) fn lower_thread(thread: i32) {
    let parameters = libc::sched_param { sched_priority: 0 };
    // SAFETY: both calls change numbers of the thread, and fail if the thread has ended. Where idle threads are not
    // allowed, the priority remains.
    unsafe {
        libc::setpriority(libc::PRIO_PROCESS, thread as libc::id_t, 19);
        libc::sched_setscheduler(thread, libc::SCHED_IDLE, &raw const parameters);
    }
}
