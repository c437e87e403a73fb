//! Calls of the runtime that evaluates graphs: its threads, its errors and its panics.

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Once;

use crate::FormatError;

/// Returns an error of an ONNX file on one line.
pub(super) fn wrong(message: impl std::fmt::Display) -> FormatError {
    // some errors of the runtime have several lines
    FormatError::Onnx { message: message.to_string().split_whitespace().collect::<Vec<_>>().join(" ") }
}

thread_local! {
    /// True on a thread that calls the runtime.
    static IS_GUARDED: Cell<bool> = const { Cell::new(false) };
}

/// Calls the runtime, on one of its threads. A panic of the runtime, to which some invalid graphs lead, is an error and
/// prints no message.
pub(super) fn guarded<T: Send, E: std::fmt::Display + Send>(
    call: impl FnOnce() -> Result<T, E> + Send,
) -> Result<T, FormatError> {
    static QUIET: Once = Once::new();
    QUIET.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            if !IS_GUARDED.get() {
                before(panic);
            }
        }));
    });
    let result = on_threads_of_the_runtime(|| {
        IS_GUARDED.set(true);
        let result = catch_unwind(AssertUnwindSafe(call));
        IS_GUARDED.set(false);
        result
    });
    match result {
        Ok(result) => result.map_err(wrong),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text = text.or(panic.downcast_ref::<&str>().copied()).unwrap_or("unknown cause");
            Err(wrong(format_args!("the runtime failed: {text}")))
        }
    }
}

/// Runs work on the threads of the runtime, where the evaluation of a graph needs no change of threads. Parallel
/// iterators of rayon within the work use these threads.
///
/// An episode of a small policy takes a third less time there.
pub fn on_threads_of_the_runtime<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    rten::thread_pool().run(work)
}
