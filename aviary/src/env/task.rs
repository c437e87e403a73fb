use nalgebra::Vector3;

use super::{BoxSpace, EndReason, EnvError, Rng, Saved};
use crate::control::trajectory::Trajectory;
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::observation::STATE_SIZE;
use crate::simulation::SimView;
use crate::state::DroneState;
use crate::world::{Marker, MarkerPose, MovingMarker};

/// What a task starts from unless the caller says otherwise.
#[derive(Debug, Clone, PartialEq)]
pub struct TaskDefaults {
    /// Number of drones.
    pub num_drones: usize,
    /// Length of an episode, s.
    pub episode_seconds: f64,
    /// The built-in controller that flies it.
    pub controller: ControllerKind,
}

/// A task: what is seen, what is rewarded and when it ends, drone by drone. [`Aviary`](super::Aviary) makes an environment
/// of it, in which one agent commands all drones, sees their blocks of numbers one after the other and is paid the
/// sum of their rewards; [`ParallelAviary`](crate::multi_agent::ParallelAviary) one in which every drone is an agent.
///
/// The order of calls is `start`, `reset`, `observe` at the start of an episode, and after every control step `update`,
/// `end`, `reward`, `observe`: what `update` changes (a waypoint that was reached) is seen by all that follow.
///
/// A task is `Clone`: batches and snapshots copy it with everything that it remembers. Snapshots in files need
/// [`save`](Self::save) and [`load`](Self::load) as well.
///
/// A worked example is `examples/custom_task.rs`.
///
/// ```
/// use aviary::control::{ControllerKind, Reference};
/// use aviary::drone::DroneParams;
/// use aviary::env::{AviaryBuilder, BoxSpace, EndReason, Env, Rng, Task, TaskDefaults};
/// use aviary::simulation::SimView;
/// use nalgebra::Vector3;
///
/// /// Climb to 2 m, the sooner the better.
/// #[derive(Debug, Clone)]
/// struct Climb;
///
/// impl Task for Climb {
///     fn name(&self) -> &'static str { "climb" }
///     fn defaults(&self) -> TaskDefaults {
///         TaskDefaults { num_drones: 1, episode_seconds: 5.0, controller: ControllerKind::Pid }
///     }
///     fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
///         (0..drones.len()).map(|drone| [drone as f64, 0.0, 0.1]).collect()
///     }
///     fn observation_space(&self) -> BoxSpace { BoxSpace::new([[f64::NEG_INFINITY, f64::INFINITY]; 2]) }
///     fn reset(&mut self, _: SimView<'_>, _: &mut Rng) {}
///     fn update(&mut self, _: SimView<'_>) {}
///     fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
///         self.success(simulation, drone).then_some(EndReason::Completed)
///     }
///     fn reward(&self, simulation: SimView<'_>, drone: usize, _: Option<EndReason>) -> f64 {
///         simulation.states()[drone].position.z - 2.0
///     }
///     fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
///         let state = &simulation.states()[drone];
///         out.copy_from_slice(&[state.position.z, state.velocity.z]);
///     }
///     fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
///         simulation.states()[drone].position.z > 2.0
///     }
///     fn reference(&self, _: SimView<'_>, drone: usize) -> Reference {
///         Reference::hover(Vector3::new(drone as f64, 0.0, 2.1), 0.0)
///     }
/// }
///
/// let mut env = AviaryBuilder::new(Climb).build()?;
/// env.reset(Some(1))?;
/// while env.info().end.is_none() {
///     env.step(&[0.5; 4])?;
/// }
/// assert_eq!(env.info().end, Some(EndReason::Completed));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
pub trait Task: std::fmt::Debug + 'static {
    /// Name, in lower snake case.
    fn name(&self) -> &'static str;

    /// Where it starts from.
    fn defaults(&self) -> TaskDefaults;

    /// Initial positions for these drones, world frame, m.
    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]>;

    /// What the observation of one drone looks like. Entries 0 to 11 are those of
    /// [`state_vector`](crate::observation::state_vector) in every task that comes with this crate.
    fn observation_space(&self) -> BoxSpace;

    /// Checks the task's own options against the drones.
    ///
    /// # Errors
    /// [`EnvError::Option`] naming one that is impossible.
    fn validate(&self, drones: &[DroneParams]) -> Result<(), EnvError> {
        let _ = drones;
        Ok(())
    }

    /// What is to be seen of it: gates, waypoints.
    fn markers(&self) -> Vec<Marker> {
        Vec::new()
    }

    /// Returns the markers that move, with their poses at the start of an episode; they are asked for once, when the environment is
    /// built. See [`move_markers`](Self::move_markers).
    fn moving_markers(&self) -> Vec<MovingMarker> {
        Vec::new()
    }

    /// Sets the poses of the [moving markers](Self::moving_markers) at this moment, in their order; `poses` holds those of the start.
    /// It is called after [`reset`](Self::reset) and after every [`update`](Self::update), and must depend on nothing but the task and
    /// the simulation. Markers stand still during a control step, also those that drones collide with.
    fn move_markers(&self, simulation: SimView<'_>, poses: &mut [MarkerPose]) {
        let _ = (simulation, poses);
    }

    /// Changes the states that an episode starts from, if the task has an idea of its own; whether it did. It is called before
    /// [`reset`](Self::reset); every random draw comes from `rng`.
    fn start(&mut self, simulation: SimView<'_>, rng: &mut Rng, states: &mut [DroneState]) -> bool {
        let _ = (simulation, rng, states);
        false
    }

    /// Starts an episode; every random draw comes from `rng`.
    fn reset(&mut self, simulation: SimView<'_>, rng: &mut Rng);

    /// Looks at the new state after a control step.
    fn update(&mut self, simulation: SimView<'_>);

    /// Why the episode is over for a drone, if it is (the time limit is not the task's). An episode ends with the first drone that
    /// is lost, or in `Completed` once all drones report that in the same step: one that is done goes on reporting it.
    fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason>;

    /// A drone's share of the last control step's reward; `end` is how that step ended for it.
    fn reward(&self, simulation: SimView<'_>, drone: usize, end: Option<EndReason>) -> f64;

    /// Writes a drone's observation.
    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]);

    /// Whether a drone fulfils its part of the task at this moment.
    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool;

    /// How much of its part a drone has done, from 0 to 1.
    fn progress(&self, simulation: SimView<'_>, drone: usize) -> f64 {
        f64::from(u8::from(self.success(simulation, drone)))
    }

    /// Where the task wants a drone to be now. It may be asked for before the first [`reset`](Self::reset).
    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference;

    /// A way that fulfils the task from the drone's present state, at whose time 0 it is, for controllers that follow trajectories; `None` where
    /// following [`reference`](Self::reference) does.
    fn plan(&self, simulation: SimView<'_>, drone: usize) -> Option<Box<dyn Trajectory>> {
        let _ = (simulation, drone);
        None
    }

    /// Returns the [`plan`](Self::plan) of every drone. A task whose plans depend on each other computes them here at once.
    fn plans(&self, simulation: SimView<'_>) -> Vec<Option<Box<dyn Trajectory>>> {
        (0..simulation.num_drones()).map(|drone| self.plan(simulation, drone)).collect()
    }

    /// Returns points (world frame, m) that a drone comes by in an episode of so many seconds, for cameras that stand still: by
    /// default the present [`reference`](Self::reference) and points along the [`plan`](Self::plan). A task whose reference moves
    /// returns points along its path.
    fn extent(&self, simulation: SimView<'_>, drone: usize, seconds: f64) -> Vec<Vector3<f64>> {
        let _ = seconds;
        let plan = self.plan(simulation, drone);
        let planned = plan.iter().flat_map(|plan| path_points(plan.duration(), |time| plan.reference(time).position));
        std::iter::once(self.reference(simulation, drone).position).chain(planned).collect()
    }

    /// Reports further numbers by name: gates passed, formation error.
    fn metrics(&self, simulation: SimView<'_>, report: &mut dyn FnMut(&'static str, f64)) {
        let _ = (simulation, report);
    }

    /// Saves its options and everything that it remembers, for snapshots in files; `None`, the default, for a task that cannot be
    /// saved. A task that implements serde's traits returns `Saved::new(self)`.
    fn save(&self) -> Option<Saved> {
        None
    }

    /// Takes over what [`save`](Self::save) has returned; a task that implements serde's traits does `*self = saved.read()?`.
    ///
    /// # Errors
    /// [`EnvError::SavedSnapshot`] for a value of another kind, and then nothing has changed.
    fn load(&mut self, saved: &Saved) -> Result<(), EnvError> {
        let _ = saved;
        Err(EnvError::SavedSnapshot { message: format!("the task `{}` cannot be loaded", self.name()) })
    }

    /// Whether an entry of a drone's observation may stay the same for a whole episode, as a target does. The checker
    /// complains of every other one that does.
    fn may_be_constant(&self, entry: usize) -> bool {
        entry >= STATE_SIZE
    }
}

/// Points of a path that takes so many seconds, close enough together for a picture.
pub(crate) fn path_points(seconds: f64, at: impl Fn(f64) -> Vector3<f64>) -> impl Iterator<Item = Vector3<f64>> {
    const POINTS: u32 = 120;
    (0..=POINTS).map(move |i| at(seconds * f64::from(i) / f64::from(POINTS)))
}
