//! Priority of threads.
#![allow(unsafe_code)]

/// Gives the calling thread the lowest priority, for flights in the background of other work.
pub fn lower() {
    // SAFETY: changes a number of the calling thread, which Linux identifies by 0.
    unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, 19) };
}

/// Returns the id of the calling thread.
pub(super) fn own_thread() -> i32 {
    // SAFETY: returns a number.
    unsafe { libc::gettid() }
}

/// Gives a thread of this process the lowest priority.
pub(super) fn lower_thread(thread: i32) {
    // SAFETY: changes a number of the thread; the call fails if the thread has ended.
    unsafe { libc::setpriority(libc::PRIO_PROCESS, thread as libc::id_t, 19) };
}
