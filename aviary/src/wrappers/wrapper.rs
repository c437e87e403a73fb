use nalgebra::Vector3;

use crate::action::ActionType;
use crate::control::Reference;
use crate::control::trajectory::Trajectory;
use crate::env::{
    BoxSpace, DroneEnv, EndReason, Env, EnvError, EnvSnapshot, Info, ObservationSpace, Randomization, SampledParams,
    Step, TaskOptions,
};
use crate::observation::Observation;
use crate::physics::wind::WindConfig;
use crate::simulation::Simulation;
use crate::vision::{ImageSize, View};
use crate::world::Obstacle;

/// An environment around another environment. Every function forwards to the inner environment by default; a
/// wrapper overrides the functions that it changes.
///
/// Every type that implements `Wrapper` is an [`Env`] and a [`DroneEnv`]. The functions take `this` instead of
/// `self`, so that `wrapper.step(..)` always means [`Env::step`].
///
/// ```
/// use aviary::env::{DroneEnv, Env, EnvError, Step, check_env};
/// use aviary::tasks::Hover;
/// use aviary::wrappers::Wrapper;
///
/// /// Multiplies rewards by a factor.
/// struct ScaledReward<E> {
///     env: E,
///     factor: f64,
/// }
///
/// impl<E: DroneEnv> Wrapper for ScaledReward<E> {
///     type Inner = E;
///
///     fn inner(this: &Self) -> &E {
///         &this.env
///     }
///
///     fn inner_mut(this: &mut Self) -> &mut E {
///         &mut this.env
///     }
///
///     fn step<'a>(this: &'a mut Self, action: &[f64]) -> Result<Step<'a>, EnvError> {
///         let step = this.env.step(action)?;
///         Ok(Step { reward: this.factor * step.reward, ..step })
///     }
/// }
///
/// let mut env = ScaledReward { env: Hover::builder().build()?, factor: 0.1 };
/// check_env(&mut env)?;
/// env.reset(Some(1))?;
/// let reward = env.step(&[0.0; 4])?.reward;
/// assert!((reward + 0.09).abs() < 1e-4, "0.9 m below the target");
/// assert_eq!(env.reference(0).position.z, 1.0);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub trait Wrapper {
    /// Type of the inner environment.
    type Inner: DroneEnv + ?Sized;

    /// Returns the inner environment.
    fn inner(this: &Self) -> &Self::Inner;

    /// Returns the inner environment for changes.
    fn inner_mut(this: &mut Self) -> &mut Self::Inner;

    /// Implements [`Env::name`].
    fn name(this: &Self) -> &'static str {
        Self::inner(this).name()
    }

    /// Implements [`Env::observation_space`].
    fn observation_space(this: &Self) -> &ObservationSpace {
        Self::inner(this).observation_space()
    }

    /// Implements [`Env::action_space`].
    fn action_space(this: &Self) -> &BoxSpace {
        Self::inner(this).action_space()
    }

    /// Implements [`Env::reset`].
    ///
    /// # Errors
    /// Returns the errors of [`Env::reset`].
    fn reset(this: &mut Self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        Self::inner_mut(this).reset(seed)
    }

    /// Implements [`Env::step`].
    ///
    /// # Errors
    /// Returns the errors of [`Env::step`].
    fn step<'a>(this: &'a mut Self, action: &[f64]) -> Result<Step<'a>, EnvError> {
        Self::inner_mut(this).step(action)
    }

    /// Implements [`Env::snapshot`]. A wrapper with its own state stores that state
    /// [around](EnvSnapshot::with_inner) the snapshot of the inner environment.
    fn snapshot(this: &Self) -> EnvSnapshot {
        Self::inner(this).snapshot()
    }

    /// Implements [`Env::restore`].
    ///
    /// # Errors
    /// Returns the errors of [`Env::restore`].
    fn restore(this: &mut Self, snapshot: &EnvSnapshot) -> Result<(), EnvError> {
        Self::inner_mut(this).restore(snapshot)
    }

    /// Implements [`Env::observation`].
    fn observation(this: &Self) -> &Observation {
        Self::inner(this).observation()
    }

    /// Implements [`Env::info`].
    fn info(this: &Self) -> Info {
        Self::inner(this).info()
    }

    /// Implements [`Env::metrics`].
    fn metrics(this: &Self, report: &mut dyn FnMut(&'static str, f64)) {
        Self::inner(this).metrics(report);
    }

    /// Implements [`Env::render`].
    ///
    /// # Errors
    /// Returns the errors of [`Env::render`].
    fn render(this: &mut Self, view: View, size: ImageSize, rgb: &mut [u8]) -> Result<(), EnvError> {
        Self::inner_mut(this).render(view, size, rgb)
    }

    /// Implements [`DroneEnv::simulation`].
    fn simulation(this: &Self) -> &Simulation {
        Self::inner(this).simulation()
    }

    /// Implements [`DroneEnv::action_type`].
    fn action_type(this: &Self) -> ActionType {
        Self::inner(this).action_type()
    }

    /// Implements [`DroneEnv::action_of_motor_speeds`].
    ///
    /// # Errors
    /// Returns the errors of [`DroneEnv::action_of_motor_speeds`].
    fn action_of_motor_speeds(this: &Self, speeds: &[[f64; 4]], action: &mut [f64]) -> Result<(), EnvError> {
        Self::inner(this).action_of_motor_speeds(speeds, action)
    }

    /// Implements [`DroneEnv::episode_steps`].
    fn episode_steps(this: &Self) -> u64 {
        Self::inner(this).episode_steps()
    }

    /// Implements [`DroneEnv::drone_end`].
    ///
    /// # Panics
    /// If no drone has the index.
    fn drone_end(this: &Self, drone: usize) -> Option<EndReason> {
        Self::inner(this).drone_end(drone)
    }

    /// Implements [`DroneEnv::drone_reward`].
    ///
    /// # Panics
    /// If no drone has the index.
    fn drone_reward(this: &Self, drone: usize) -> f64 {
        Self::inner(this).drone_reward(drone)
    }

    /// Implements [`DroneEnv::reward_terms`].
    ///
    /// # Panics
    /// If no drone has the index.
    fn reward_terms(this: &Self, drone: usize) -> Vec<(&'static str, f64)> {
        Self::inner(this).reward_terms(drone)
    }

    /// Implements [`DroneEnv::reference`].
    fn reference(this: &Self, drone: usize) -> Reference {
        Self::inner(this).reference(drone)
    }

    /// Implements [`DroneEnv::gates`].
    fn gates(this: &Self) -> Vec<[f64; 4]> {
        Self::inner(this).gates()
    }

    /// Implements [`DroneEnv::plan`].
    fn plan(this: &Self, drone: usize) -> Option<Box<dyn Trajectory>> {
        Self::inner(this).plan(drone)
    }

    /// Implements [`DroneEnv::plans`].
    fn plans(this: &Self) -> Vec<Option<Box<dyn Trajectory>>> {
        Self::inner(this).plans()
    }

    /// Implements [`DroneEnv::extent`].
    fn extent(this: &Self) -> Vec<Vector3<f64>> {
        Self::inner(this).extent()
    }

    /// Implements [`DroneEnv::set_wind`].
    ///
    /// # Errors
    /// Returns the errors of [`DroneEnv::set_wind`].
    fn set_wind(this: &mut Self, wind: Option<WindConfig>) -> Result<(), EnvError> {
        Self::inner_mut(this).set_wind(wind)
    }

    /// Implements [`DroneEnv::set_external_force`].
    ///
    /// # Errors
    /// Returns the errors of [`DroneEnv::set_external_force`].
    fn set_external_force(this: &mut Self, drone: usize, force: Vector3<f64>) -> Result<(), EnvError> {
        Self::inner_mut(this).set_external_force(drone, force)
    }

    /// Implements [`DroneEnv::set_motor_gain`].
    ///
    /// # Errors
    /// Returns the errors of [`DroneEnv::set_motor_gain`].
    fn set_motor_gain(this: &mut Self, drone: usize, motor: usize, gain: f64) -> Result<(), EnvError> {
        Self::inner_mut(this).set_motor_gain(drone, motor, gain)
    }

    /// Implements [`DroneEnv::set_obstacles`].
    ///
    /// # Errors
    /// Returns the errors of [`DroneEnv::set_obstacles`].
    fn set_obstacles(this: &mut Self, obstacles: &[Obstacle]) -> Result<(), EnvError> {
        Self::inner_mut(this).set_obstacles(obstacles)
    }

    /// Implements [`DroneEnv::new_obstacles`].
    ///
    /// # Errors
    /// Returns the errors of [`DroneEnv::new_obstacles`].
    fn new_obstacles(this: &mut Self, seed: u64) -> Result<(), EnvError> {
        Self::inner_mut(this).new_obstacles(seed)
    }

    /// Implements [`DroneEnv::set_randomization`].
    ///
    /// # Errors
    /// Returns the errors of [`DroneEnv::set_randomization`].
    fn set_randomization(this: &mut Self, randomization: Option<Randomization>) -> Result<(), EnvError> {
        Self::inner_mut(this).set_randomization(randomization)
    }

    /// Implements [`DroneEnv::set_task_options`].
    ///
    /// # Errors
    /// Returns the errors of [`DroneEnv::set_task_options`].
    fn set_task_options(this: &mut Self, options: &TaskOptions) -> Result<(), EnvError> {
        Self::inner_mut(this).set_task_options(options)
    }

    /// Implements [`DroneEnv::task_options`].
    fn task_options(this: &Self) -> TaskOptions {
        Self::inner(this).task_options()
    }

    /// Implements [`DroneEnv::sampled_params`].
    fn sampled_params(this: &Self) -> Option<&SampledParams> {
        Self::inner(this).sampled_params()
    }

    /// Implements [`DroneEnv::may_be_constant`].
    fn may_be_constant(this: &Self, entry: usize) -> bool {
        Self::inner(this).may_be_constant(entry)
    }
}

impl<W: Wrapper> Env for W {
    fn name(&self) -> &'static str {
        <W as Wrapper>::name(self)
    }

    fn observation_space(&self) -> &ObservationSpace {
        <W as Wrapper>::observation_space(self)
    }

    fn action_space(&self) -> &BoxSpace {
        <W as Wrapper>::action_space(self)
    }

    fn reset(&mut self, seed: Option<u64>) -> Result<&Observation, EnvError> {
        <W as Wrapper>::reset(self, seed)
    }

    fn step(&mut self, action: &[f64]) -> Result<Step<'_>, EnvError> {
        <W as Wrapper>::step(self, action)
    }

    fn snapshot(&self) -> EnvSnapshot {
        <W as Wrapper>::snapshot(self)
    }

    fn restore(&mut self, snapshot: &EnvSnapshot) -> Result<(), EnvError> {
        <W as Wrapper>::restore(self, snapshot)
    }

    fn observation(&self) -> &Observation {
        <W as Wrapper>::observation(self)
    }

    fn info(&self) -> Info {
        <W as Wrapper>::info(self)
    }

    fn metrics(&self, report: &mut dyn FnMut(&'static str, f64)) {
        <W as Wrapper>::metrics(self, report);
    }

    fn render(&mut self, view: View, size: ImageSize, rgb: &mut [u8]) -> Result<(), EnvError> {
        <W as Wrapper>::render(self, view, size, rgb)
    }
}

impl<W: Wrapper> DroneEnv for W {
    fn simulation(&self) -> &Simulation {
        <W as Wrapper>::simulation(self)
    }

    fn action_type(&self) -> ActionType {
        <W as Wrapper>::action_type(self)
    }

    fn action_of_motor_speeds(&self, speeds: &[[f64; 4]], action: &mut [f64]) -> Result<(), EnvError> {
        <W as Wrapper>::action_of_motor_speeds(self, speeds, action)
    }

    fn episode_steps(&self) -> u64 {
        <W as Wrapper>::episode_steps(self)
    }

    fn drone_end(&self, drone: usize) -> Option<EndReason> {
        <W as Wrapper>::drone_end(self, drone)
    }

    fn drone_reward(&self, drone: usize) -> f64 {
        <W as Wrapper>::drone_reward(self, drone)
    }

    fn reward_terms(&self, drone: usize) -> Vec<(&'static str, f64)> {
        <W as Wrapper>::reward_terms(self, drone)
    }

    fn reference(&self, drone: usize) -> Reference {
        <W as Wrapper>::reference(self, drone)
    }

    fn gates(&self) -> Vec<[f64; 4]> {
        <W as Wrapper>::gates(self)
    }

    fn plan(&self, drone: usize) -> Option<Box<dyn Trajectory>> {
        <W as Wrapper>::plan(self, drone)
    }

    fn plans(&self) -> Vec<Option<Box<dyn Trajectory>>> {
        <W as Wrapper>::plans(self)
    }

    fn extent(&self) -> Vec<Vector3<f64>> {
        <W as Wrapper>::extent(self)
    }

    fn set_wind(&mut self, wind: Option<WindConfig>) -> Result<(), EnvError> {
        <W as Wrapper>::set_wind(self, wind)
    }

    fn set_external_force(&mut self, drone: usize, force: Vector3<f64>) -> Result<(), EnvError> {
        <W as Wrapper>::set_external_force(self, drone, force)
    }

    fn set_motor_gain(&mut self, drone: usize, motor: usize, gain: f64) -> Result<(), EnvError> {
        <W as Wrapper>::set_motor_gain(self, drone, motor, gain)
    }

    fn set_obstacles(&mut self, obstacles: &[Obstacle]) -> Result<(), EnvError> {
        <W as Wrapper>::set_obstacles(self, obstacles)
    }

    fn new_obstacles(&mut self, seed: u64) -> Result<(), EnvError> {
        <W as Wrapper>::new_obstacles(self, seed)
    }

    fn set_randomization(&mut self, randomization: Option<Randomization>) -> Result<(), EnvError> {
        <W as Wrapper>::set_randomization(self, randomization)
    }

    fn set_task_options(&mut self, options: &TaskOptions) -> Result<(), EnvError> {
        <W as Wrapper>::set_task_options(self, options)
    }

    fn task_options(&self) -> TaskOptions {
        <W as Wrapper>::task_options(self)
    }

    fn sampled_params(&self) -> Option<&SampledParams> {
        <W as Wrapper>::sampled_params(self)
    }

    fn may_be_constant(&self, entry: usize) -> bool {
        <W as Wrapper>::may_be_constant(self, entry)
    }
}

/// Boxed environments are environments, so that wrappers accept the result of [`make`](crate::tasks::make).
impl<E: DroneEnv + ?Sized> Wrapper for Box<E> {
    type Inner = E;

    fn inner(this: &Self) -> &E {
        this
    }

    fn inner_mut(this: &mut Self) -> &mut E {
        this
    }
}

/// Mutable references to environments are environments, so that wrappers and loops can borrow them.
impl<E: DroneEnv + ?Sized> Wrapper for &mut E {
    type Inner = E;

    fn inner(this: &Self) -> &E {
        this
    }

    fn inner_mut(this: &mut Self) -> &mut E {
        this
    }
}
