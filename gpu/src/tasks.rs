//! Tasks that the kernels have, with their options.

use aviary::env::Task;
use aviary::tasks::{
    Antipodal, CrashConditions, FlyThrough, Formation, Hover, MultiHover, Race, Stabilize, Track, Velocity,
};

/// Task of this library that runs on a GPU.
pub trait GpuTask: Task + Clone + Send + Sync + private::Sealed {
    #[doc(hidden)]
    fn kernel(&self, drones: usize) -> (KernelTask, CrashConditions);
}

mod private {
    use aviary::tasks::{Antipodal, FlyThrough, Formation, Hover, MultiHover, Race, Stabilize, Track, Velocity};

    /// Tasks have kernels of this crate.
    pub trait Sealed {}

    macro_rules! seal {
        ($($task:ty),*) => { $(impl Sealed for $task {})* };
    }

    seal!(Antipodal, FlyThrough, Formation, Hover, MultiHover, Race, Stabilize, Track, Velocity);
}

/// Points that a drone passes in order.
#[derive(Debug, Clone, PartialEq)]
pub struct Course {
    /// Positions, world frame, m.
    pub(crate) points: Vec<[f64; 3]>,
    pub(crate) laps: usize,
    /// Distance within which a point is passed, m.
    pub(crate) radius: f64,
    /// Reward for a point.
    pub(crate) reward: f64,
}

/// Task of a kernel with its options.
#[derive(Debug, Clone, PartialEq)]
#[doc(hidden)]
#[non_exhaustive]
pub enum KernelTask {
    /// Hovering of each drone at its height (m) above its start.
    Hover {
        /// One height per drone, m.
        heights: Vec<f64>,
        /// Height above which the episode ends, m.
        max_height: f64,
        /// True for targets above the starts of the drones, false for those above the origin.
        above_start: bool,
    },
    /// Maxima of the initial speed (m/s), roll and pitch (rad) and body rate (rad/s) along each axis.
    Stabilize { max_speed: f64, max_lean: f64, max_rate: f64 },
    /// Circle of the reference.
    Track { radius: f64, height: f64, speed: f64, max_distance: f64 },
    /// Maxima of the target velocity (m/s) along each axis and yaw rate (rad/s).
    Velocity { max_speed: f64, max_yaw_rate: f64 },
    /// Waypoints, and the penalty for the distance.
    FlyThrough { course: Course, distance_penalty: f64 },
    /// Gates, the reward for the speed and the penalty for the distance.
    Race { course: Course, weights: [f64; 2] },
    /// Slots relative to the centre, the closed path of the centre, m, and its speed, m/s.
    Formation { offsets: Vec<[f64; 3]>, path: Vec<[f64; 3]>, speed: f64 },
    /// Goal of each drone, m, and the distance below which two drones are too close, m.
    Antipodal { goals: Vec<[f64; 3]>, safety_radius: f64 },
}

impl GpuTask for Hover {
    fn kernel(&self, drones: usize) -> (KernelTask, CrashConditions) {
        let heights = vec![self.target_height; drones];
        (KernelTask::Hover { heights, max_height: self.max_height, above_start: false }, self.crash.clone())
    }
}

impl GpuTask for MultiHover {
    fn kernel(&self, drones: usize) -> (KernelTask, CrashConditions) {
        let heights = (0..drones).map(|drone| self.height(drone, drones)).collect();
        (KernelTask::Hover { heights, max_height: self.max_height, above_start: true }, self.crash.clone())
    }
}

impl GpuTask for Stabilize {
    fn kernel(&self, _: usize) -> (KernelTask, CrashConditions) {
        let Self { max_speed, max_lean, max_rate, .. } = *self;
        (KernelTask::Stabilize { max_speed, max_lean, max_rate }, self.crash.clone())
    }
}

impl GpuTask for Track {
    fn kernel(&self, _: usize) -> (KernelTask, CrashConditions) {
        let Self { radius, height, speed, max_distance, .. } = *self;
        (KernelTask::Track { radius, height, speed, max_distance }, self.crash.clone())
    }
}

impl GpuTask for Velocity {
    fn kernel(&self, _: usize) -> (KernelTask, CrashConditions) {
        let Self { max_speed, max_yaw_rate, .. } = *self;
        (KernelTask::Velocity { max_speed, max_yaw_rate }, self.crash.clone())
    }
}

impl GpuTask for FlyThrough {
    fn kernel(&self, _: usize) -> (KernelTask, CrashConditions) {
        let points = self.waypoints.clone();
        let course = Course { points, laps: 1, radius: self.radius, reward: self.capture_reward };
        (KernelTask::FlyThrough { course, distance_penalty: self.distance_penalty }, self.crash.clone())
    }
}

impl GpuTask for Race {
    fn kernel(&self, _: usize) -> (KernelTask, CrashConditions) {
        let points = self.gates.clone();
        let course = Course { points, laps: self.laps, radius: self.radius, reward: self.gate_reward };
        (KernelTask::Race { course, weights: [self.speed_reward, self.distance_penalty] }, self.crash.clone())
    }
}

impl GpuTask for Formation {
    fn kernel(&self, drones: usize) -> (KernelTask, CrashConditions) {
        let offsets = (0..drones).map(|drone| self.offset(drone, drones).into()).collect();
        (KernelTask::Formation { offsets, path: self.path.clone(), speed: self.speed }, self.crash.clone())
    }
}

impl GpuTask for Antipodal {
    fn kernel(&self, drones: usize) -> (KernelTask, CrashConditions) {
        let goals = (0..drones).map(|drone| self.goal_of(drone, drones).into()).collect();
        (KernelTask::Antipodal { goals, safety_radius: self.safety_radius }, self.crash.clone())
    }
}
