//! Environments around environments: each changes one thing and passes the rest on.

mod curriculum;
mod randomization;
mod safety;
mod wind;

pub use curriculum::{Curriculum, CurriculumConfig, CurriculumMetric, CurriculumState, CurriculumWrapper};
pub use randomization::RandomizationWrapper;
pub(crate) use safety::Guard;
pub use safety::SafetyWrapper;
pub use wind::WindWrapper;

use crate::env::{Env, EnvError, Step};
use crate::observation::Observation;

/// The methods of [`Env`](crate::env::Env) that a wrapper passes on, but for `reset` and `step`: `forward_env!(self => self.env)`.
macro_rules! forward_env {
    ($self:ident => $inner:expr) => {
        fn name(&$self) -> &'static str {
            $inner.name()
        }

        fn observation_space(&$self) -> &$crate::env::ObservationSpace {
            $inner.observation_space()
        }

        fn action_space(&$self) -> &$crate::env::BoxSpace {
            $inner.action_space()
        }

        fn observation(&$self) -> &$crate::observation::Observation {
            $inner.observation()
        }

        fn info(&$self) -> $crate::env::Info {
            $inner.info()
        }

        fn measures(&$self, report: &mut dyn FnMut(&'static str, f64)) {
            $inner.measures(report);
        }

        fn drone_end(&$self, drone: usize) -> Option<$crate::env::EndReason> {
            $inner.drone_end(drone)
        }

        fn drone_reward(&$self, drone: usize) -> f64 {
            $inner.drone_reward(drone)
        }

        fn action_type(&$self) -> $crate::action::ActionType {
            $inner.action_type()
        }

        fn set_wind(&mut $self, wind: Option<$crate::physics::wind::WindConfig>) -> Result<(), $crate::env::EnvError> {
            $inner.set_wind(wind)
        }

        fn set_randomization(
            &mut $self,
            randomization: Option<$crate::env::Randomization>,
        ) -> Result<(), $crate::env::EnvError> {
            $inner.set_randomization(randomization)
        }

        fn draw(&$self) -> Option<&$crate::env::Draw> {
            $inner.draw()
        }

        fn episode_steps(&$self) -> u64 {
            $inner.episode_steps()
        }

        fn reference(&$self, drone: usize) -> $crate::control::Reference {
            $inner.reference(drone)
        }

        fn plan(&$self, drone: usize) -> Option<Box<dyn $crate::control::trajectory::Trajectory>> {
            $inner.plan(drone)
        }

        fn plans(&$self) -> Vec<Option<Box<dyn $crate::control::trajectory::Trajectory>>> {
            $inner.plans()
        }

        fn extent(&$self) -> Vec<nalgebra::Vector3<f64>> {
            $inner.extent()
        }

        fn may_be_constant(&$self, entry: usize) -> bool {
            $inner.may_be_constant(entry)
        }

        fn action_of_motor_speeds(
            &$self,
            speeds: &[[f64; 4]],
            action: &mut [f64],
        ) -> Result<(), $crate::env::EnvError> {
            $inner.action_of_motor_speeds(speeds, action)
        }

        fn render(
            &mut $self,
            view: $crate::vision::View,
            size: $crate::vision::ImageSize,
            rgb: &mut [u8],
        ) -> Result<(), $crate::env::EnvError> {
            $inner.render(view, size, rgb)
        }

        fn simulation(&$self) -> &$crate::simulation::Simulation {
            $inner.simulation()
        }
    };
}
pub(crate) use forward_env;

/// A borrowed environment is one, so that loops and wrappers need not own it.
impl<E: Env + ?Sized> Env for &mut E {
    forward_env!(self => (**self));

    fn reset(&mut self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        (**self).reset(seed)
    }

    fn step(&mut self, action: &[f64]) -> Result<Step<'_>, EnvError> {
        (**self).step(action)
    }
}

/// A boxed environment is one, so that wrappers go around what [`make`](crate::tasks::make) gives.
impl<E: Env + ?Sized> Env for Box<E> {
    forward_env!(self => (**self));

    fn reset(&mut self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        (**self).reset(seed)
    }

    fn step(&mut self, action: &[f64]) -> Result<Step<'_>, EnvError> {
        (**self).step(action)
    }
}
