//! Batches of environments on a GPU, from the same equations as the CPU.
//!
//! `GpuAviary` is a `VecEnv` of `aviary` whose environments are in the memory of a GPU. The equations of flight are
//! those of the crate `flight`, generic over the type of their numbers. This crate calls them once on the host with
//! numbers that emit the operations of a kernel, so that no equation is written a second time.
//!
//! The crate is empty without a runtime: enable the feature `vulkan` (NVIDIA, AMD, Intel, and Mesa's lavapipe) or
//! `metal` (Apple).
#![cfg(feature = "wgpu")]

mod batch;
mod device;
mod environment;
mod error;
mod kernel;
mod launch;
#[cfg(feature = "learn")]
mod learn;
mod number;
mod parameters;
mod plan;
mod random;
mod tasks;
mod traced;

#[cfg(feature = "burn")]
pub use batch::DeviceStep;
pub use batch::{GpuAviary, Precision};
pub use device::{Adapter, AdapterKind, GpuDevice, adapters};
pub use error::GpuError;
pub use launch::bandwidth;
#[cfg(feature = "learn")]
pub use learn::GpuPpo;
pub use number::Word;
pub use random::philox;
pub use tasks::GpuTask;
