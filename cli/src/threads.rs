//! Threads of commands that compute in parallel.

use std::error::Error as _;

use anyhow::anyhow;

use crate::failure::Failure;

/// Starts the threads of rayon, one per core or as many as `RAYON_NUM_THREADS`. Without this call, rayon starts them
/// at its first use, and panics if the system does not allow so many.
pub fn start() -> Result<(), Failure> {
    match rayon::ThreadPoolBuilder::new().build_global() {
        // an error without a source says that the threads run already
        Err(error) if error.source().is_some() => Err(Failure::work(anyhow!(
            "{} threads cannot be started ({error}), expected fewer in RAYON_NUM_THREADS",
            std::env::var("RAYON_NUM_THREADS").unwrap_or_else(|_| "the".into())
        ))),
        _ => Ok(()),
    }
}
