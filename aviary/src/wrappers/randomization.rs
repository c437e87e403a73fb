use super::forward_env;
use crate::env::{Env, EnvError, Randomization, Step};
use crate::observation::Observation;

/// An environment whose body, motors, sensors, gravity, wind and start are drawn anew for every episode:
/// [`Env::set_randomization`] said once, where the environment is made.
///
/// ```
/// use aviary::env::{Env, Randomization};
/// use aviary::tasks::Hover;
/// use aviary::wrappers::RandomizationWrapper;
///
/// let mut env = RandomizationWrapper::new(Hover::builder().build()?, Randomization::default())?;
/// env.reset(Some(1))?;
/// let drawn = env.draw().map(|draw| draw.drones[0].mass);
/// assert!(drawn.is_some_and(|mass| (0.8..=1.2).contains(&mass)));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug)]
pub struct RandomizationWrapper<E> {
    env: E,
}

impl<E: Env> RandomizationWrapper<E> {
    /// Around an environment, from its next reset on.
    ///
    /// # Errors
    /// [`EnvError::Option`] naming a range that is none.
    pub fn new(mut env: E, randomization: Randomization) -> Result<Self, EnvError> {
        env.set_randomization(Some(randomization))?;
        Ok(Self { env })
    }

    /// The environment within.
    pub fn inner(&self) -> &E {
        &self.env
    }
}

impl<E: Env> Env for RandomizationWrapper<E> {
    forward_env!(self => self.env);

    fn reset(&mut self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        self.env.reset(seed)
    }

    fn step(&mut self, action: &[f64]) -> Result<Step<'_>, EnvError> {
        self.env.step(action)
    }
}
