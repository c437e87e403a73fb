//! Environments around environments: each changes one thing and forwards the rest ([`Wrapper`]).

mod curriculum;
mod safety;
mod wrapper;

pub use curriculum::{Curriculum, CurriculumConfig, CurriculumMetric, CurriculumState, CurriculumWrapper};
pub use safety::SafetyWrapper;
pub(crate) use safety::VelocityFilter;
pub use wrapper::Wrapper;
