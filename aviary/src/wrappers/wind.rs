use super::forward_env;
use crate::env::{Env, EnvError, Step};
use crate::observation::Observation;
use crate::physics::wind::WindConfig;

/// An environment in the wind: [`Env::set_wind`] said once, where the environment is made.
///
/// ```
/// use aviary::env::Env;
/// use aviary::physics::wind::{WindConfig, WindModel};
/// use aviary::tasks::Hover;
/// use aviary::wrappers::WindWrapper;
///
/// let mut env = WindWrapper::new(Hover::builder().build()?, WindConfig::new(WindModel::Combined))?;
/// env.reset(Some(1))?;
/// env.step(&[0.0; 4])?;
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug)]
pub struct WindWrapper<E> {
    env: E,
}

impl<E: Env> WindWrapper<E> {
    /// Around an environment, from its next step on.
    ///
    /// # Errors
    /// [`EnvError::Simulation`] naming a setting that is impossible.
    pub fn new(mut env: E, wind: WindConfig) -> Result<Self, EnvError> {
        env.set_wind(Some(wind))?;
        Ok(Self { env })
    }

    /// The environment within.
    pub fn inner(&self) -> &E {
        &self.env
    }
}

impl<E: Env> Env for WindWrapper<E> {
    forward_env!(self => self.env);

    fn reset(&mut self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        self.env.reset(seed)
    }

    fn step(&mut self, action: &[f64]) -> Result<Step<'_>, EnvError> {
        self.env.step(action)
    }
}
