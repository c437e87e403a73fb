//! Wrappers: environments that modify another environment and forward everything else ([`Wrapper`]).

mod curriculum;
mod safety;
mod wrapper;

pub use curriculum::{Curriculum, CurriculumConfig, CurriculumMetric, CurriculumState, CurriculumWrapper};
pub use safety::SafetyWrapper;
pub(crate) use safety::VelocityFilter;
pub use wrapper::Wrapper;
