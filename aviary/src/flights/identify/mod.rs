//! Identification: parameters of an airframe from recorded flights.

mod align;
mod solve;
mod statistics;

pub use align::{Alignment, Correction};
pub use statistics::Estimate;

/// Serializes a number, or null if it is not finite.
#[allow(clippy::trivially_copy_pass_by_ref)] // serde passes a reference
fn finite_or_null<S: serde::Serializer>(number: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    if number.is_finite() { serializer.serialize_f64(*number) } else { serializer.serialize_none() }
}
