use super::{FlyThrough, Race};

/// A task in which a drone flies through points, for functions that take either of them, such as
/// [`make_vec_course`](crate::vector::make_vec_course).
///
/// ```
/// use aviary::env::EnvConfig;
/// use aviary::tasks::{Course, Race};
/// use aviary::vector::{VecConfig, make_vec_course};
///
/// // a reward for speed, which the paper's task does not have
/// let mut race = Race::default();
/// race.speed_reward = 0.5;
/// let env = make_vec_course(Course::Race(race), EnvConfig::default(), VecConfig::new(8))?;
/// assert_eq!((env.name(), env.num_envs()), ("race", 8));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone)]
pub enum Course {
    /// Visit waypoints.
    FlyThrough(FlyThrough),
    /// Fly laps through gates.
    Race(Race),
}
