//! Priority of the window's thread.
#![allow(unsafe_code)]

/// Gives the calling thread the lowest priority.
pub(super) fn lower() {
    // SAFETY: changes a number of the calling thread, which Linux identifies by 0.
    unsafe { libc::setpriority(libc::PRIO_PROCESS, 0, 19) };
}
