//! Start, reward, end and observation of the tasks, for one drone.

use aviary::env::EndReason;
use aviary::tasks::Formation;
use flight::math::V3;
use flight::state::FlightState;
use flight::tasks::formation::Side;
use flight::tasks::track::Circle;
use flight::tasks::{
    antipodal, fly_through, formation, hover, multi_hover, race, stabilize, track, velocity, waypoints,
};

use super::composed;
use crate::number::{Number, Word};
use crate::parameters::Parameters;
use crate::plan::Plan;
use crate::random::Draws;
use crate::tasks::{Course, KernelTask};

/// A drone of a world in a control step.
pub(super) struct Scene<'a, N: Number> {
    pub plan: &'a Plan,
    pub parameters: &'a Parameters<N>,
    /// Index of the drone in its world.
    pub drone: N::Word,
    /// Position before the control step, world frame, m.
    pub before: V3<N>,
    pub motion: &'a FlightState<N>,
    pub rpy: V3<N>,
    /// Time since the start of the episode, s.
    pub time: N,
    /// Positions of all drones after the control step, world frame, m.
    pub positions: &'a [V3<N>],
}

/// Evaluation of a control step of a drone, without crashes.
pub(super) struct Evaluation<N: Number> {
    /// Reward without the penalty for a crash.
    pub reward: N,
    /// True where the reward is that of a drone which has nothing left to do: the penalty for a crash alone.
    pub idle: N::Mask,
    /// Condition that ends the episode, if there is one.
    pub end: Option<(N::Mask, EndReason)>,
    /// True where the drone fulfils the task.
    pub success: N::Mask,
    /// Number that the drones of a world add up, for [`world_success`].
    pub share: N,
}

/// Returns the number that belongs to a drone.
fn of_drone<N: Number>(drone: N::Word, like: N, list: &[f64]) -> N {
    let mut value = like.all(list[list.len() - 1]);
    for (index, &number) in list.iter().enumerate().rev().skip(1) {
        let is_before = drone.less(N::Word::of(index as u32 + 1));
        value = N::choose(is_before, like.all(number), value);
    }
    value
}

/// Returns the vector that belongs to a drone.
fn vector_of_drone<N: Number>(drone: N::Word, like: N, list: &[[f64; 3]]) -> V3<N> {
    let [x, y, z] = [0, 1, 2].map(|axis| {
        let axis: Vec<f64> = list.iter().map(|vector| vector[axis]).collect();
        of_drone(drone, like, &axis)
    });
    V3 { x, y, z }
}

/// Returns the points of a course `ahead` places after the next one, for a number of passed points.
fn point<N: Number>(course: &Course, passed: N, ahead: usize, wraps: bool) -> V3<N> {
    let count = course.points.len();
    let total = count * course.laps;
    let at = |index: usize| {
        let index = if wraps { (index + ahead) % count } else { (index + ahead).min(count - 1) };
        course.points[index].map(|x| passed.all(x))
    };
    let mut value = at(total);
    for index in (0..total).rev() {
        let is_before = passed.less(passed.all(index as f64 + 0.5));
        let here = at(index);
        for (value, here) in value.iter_mut().zip(here) {
            *value = N::choose(is_before, here, *value);
        }
    }
    let [x, y, z] = value;
    V3 { x, y, z }
}

/// Number of the numbers of the task's state.
pub(super) fn state_size(task: &KernelTask) -> usize {
    match task {
        KernelTask::Hover { .. } | KernelTask::Stabilize { .. } => 0,
        // phase and direction
        KernelTask::Track { .. } => 2,
        // target velocity and yaw rate
        KernelTask::Velocity { .. } => 4,
        // number of points passed
        KernelTask::FlyThrough { .. } | KernelTask::Race { .. } => 1,
        // sum of the distances from the slot
        KernelTask::Formation { .. } => 1,
        // smallest distance from another drone
        KernelTask::Antipodal { .. } => 1,
    }
}

/// Distance from other drones before the first control step, m.
const FAR: f64 = 1e8;

/// Starts an episode: changes the state of the drone, and returns the state of the task.
pub(super) fn start<N: Number>(
    task: &KernelTask,
    motion: &mut FlightState<N>,
    own: &mut Draws<N>,
    world: &mut Draws<N>,
) -> Vec<N> {
    let zero = motion.position.x.all(0.0);
    match *task {
        KernelTask::Hover { .. } => Vec::new(),
        KernelTask::Stabilize { max_speed, max_lean, max_rate } => {
            let mut triple =
                |[x, y, z]: [f64; 3]| own.symmetric_triple().times(V3::new(zero.all(x), zero.all(y), zero.all(z)));
            motion.velocity = motion.velocity + triple([max_speed; 3]);
            let turn = flight::math::Turn::from_rpy(triple([max_lean, max_lean, std::f64::consts::PI]));
            motion.attitude = composed(&motion.attitude, &turn);
            motion.rate = motion.rate + triple([max_rate; 3]);
            Vec::new()
        }
        KernelTask::Track { radius, .. } => {
            let clockwise = world.symmetric().less(zero);
            let direction = N::choose(clockwise, zero.all(-1.0), zero.all(1.0));
            let turns = world.unit();
            let (sin, cos) = flight::math::sin_cos_of_turns(turns);
            // keeps changes by the randomization
            motion.position = motion.position + V3::new(cos - 1.0, sin, zero) * radius;
            vec![turns * std::f64::consts::TAU, direction]
        }
        KernelTask::Velocity { max_speed, max_yaw_rate } => {
            let [x, y, z] = [(); 3].map(|()| own.symmetric() * max_speed);
            vec![x, y, z, own.symmetric() * max_yaw_rate]
        }
        KernelTask::FlyThrough { .. } | KernelTask::Race { .. } | KernelTask::Formation { .. } => vec![zero],
        KernelTask::Antipodal { .. } => vec![zero.all(FAR)],
    }
}

/// Returns the circle of a drone from the state of the task.
fn circle<N: Number>(drone: N::Word, radius: f64, height: f64, speed: f64, state: &[N]) -> Circle<N> {
    let like = state[0];
    Circle {
        y: N::of_word(drone) * -(4.0 * radius + 1.0),
        height: like.all(height),
        radius: like.all(radius),
        rate: like.all(speed / radius),
        phase: state[0],
        direction: state[1],
    }
}

/// Returns the slot of a drone, world frame, m.
fn slot<N: Number>(offset: V3<N>, path: &[[f64; 3]], speed: f64, time: N) -> V3<N> {
    let corner = |index: usize| path[index % path.len()];
    let vector = |[x, y, z]: [f64; 3]| V3::new(time.all(x), time.all(y), time.all(z));
    let length = |index: usize| -> f64 {
        let (from, to) = (corner(index), corner(index + 1));
        (0..3).map(|axis| (to[axis] - from[axis]).powi(2)).sum::<f64>().sqrt()
    };
    let lap: f64 = (0..path.len()).map(length).sum();
    if lap < Formation::MIN_LAP {
        return vector(path[0]) + offset;
    }
    let distance = time * speed;
    let none = time.all(0.0);
    let mut sides = Vec::new();
    let mut start = 0.0;
    for index in 0..path.len() {
        let (from, to, length) = (corner(index), corner(index + 1), length(index));
        let direction = [0, 1, 2].map(|axis| if length > 0.0 { (to[axis] - from[axis]) / length } else { 0.0 });
        let side = Side {
            lap: none.all(lap),
            start: none.all(start),
            low: none,
            high: none,
            from: vector(from),
            direction: vector(direction),
        };
        sides.push((side, length));
        start += length;
    }
    // rounding at the end of a lap
    let mut centre = vector(path[0]);
    for (side, length) in sides.iter().rev() {
        let is_here = side.travelled(distance).less(none.all(*length));
        let there = side.point(distance);
        centre = V3::choose(is_here, there, centre);
    }
    centre + offset
}

/// Evaluates a control step, and updates the state of the task.
pub(super) fn evaluate<N: Number>(scene: &Scene<'_, N>, state: &mut [N]) -> Evaluation<N> {
    let Scene { plan, parameters, drone, motion, rpy, time, .. } = *scene;
    let zero = time.all(0.0);
    let never = zero.less(zero);
    let usual = |reward, success| Evaluation { reward, idle: never, end: None, success, share: zero };
    match &*plan.task {
        KernelTask::Hover { heights, max_height, above_start } => {
            let target = hover_target(parameters, drone, heights, *above_start);
            let high = hover::is_too_high(motion.position, zero.all(*max_height));
            let (reward, success) = (hover::reward(motion, rpy, target), hover::at_target(motion.position, target));
            Evaluation { end: Some((high, EndReason::OutOfBounds)), ..usual(reward, success) }
        }
        KernelTask::Stabilize { .. } => usual(stabilize::reward(motion, rpy), stabilize::at_rest(motion)),
        KernelTask::Track { radius, height, speed, max_distance } => {
            let [position, target, _] = circle(drone, *radius, *height, *speed, state).motion(time);
            let far = track::is_too_far(motion, position, zero.all(*max_distance));
            let success = (motion.position - position).norm().less(zero.all(track::TRACKED));
            let reward = track::reward(motion, rpy, position, target);
            Evaluation { end: Some((far, EndReason::OutOfBounds)), ..usual(reward, success) }
        }
        KernelTask::Velocity { .. } => {
            let target = V3::new(state[0], state[1], state[2]);
            let success = (motion.velocity - target).norm().less(zero.all(velocity::TRACKED));
            usual(velocity::reward(motion, rpy, target, state[3]), success)
        }
        KernelTask::FlyThrough { course, distance_penalty } => progress(scene, course, state, |gained, distance| {
            fly_through::reward(gained, zero.all(*distance_penalty), distance, motion.rate)
        }),
        KernelTask::Race { course, weights } => progress(scene, course, state, |gained, distance| {
            race::reward(gained, weights.map(|weight| zero.all(weight)), motion.velocity, distance)
        }),
        KernelTask::Formation { offsets, path, speed } => {
            let own = vector_of_drone(drone, zero, offsets);
            let error = (motion.position - slot(own, path, *speed, time)).norm();
            let mut deviations = zero;
            for (other, position) in scene.positions.iter().enumerate() {
                let desired = offsets[other].map(|x| zero.all(x));
                let desired = V3::new(desired[0], desired[1], desired[2]) - own;
                // zero for the drone itself
                deviations = deviations + formation::deviation(*position - motion.position, desired);
            }
            state[0] = state[0] + error;
            Evaluation { share: state[0], ..usual(formation::reward(error, deviations), !never) }
        }
        KernelTask::Antipodal { goals, safety_radius } => {
            let goal = vector_of_drone(drone, zero, goals);
            let (safe, mut close) = (zero.all(*safety_radius), zero);
            for (other, position) in scene.positions.iter().enumerate() {
                let apart = (*position - motion.position).norm();
                let is_other = !is_drone::<N>(drone, other);
                close = close + N::choose(is_other & apart.less(safe), zero.all(1.0), zero);
                state[0] = N::choose(is_other, apart.lesser(state[0]), state[0]);
            }
            let distance = (motion.position - goal).norm();
            let success = !state[0].less(safe) & distance.less(zero.all(antipodal::AT_GOAL));
            usual(antipodal::reward(distance, close), success)
        }
    }
}

/// Returns true in the thread of a drone.
pub(super) fn is_drone<N: Number>(drone: N::Word, index: usize) -> N::Mask {
    let different = drone.xor(N::Word::of(index as u32));
    different.less(N::Word::of(1))
}

/// Returns true if the drones of a world fulfil the task together, besides each drone on its own. `share` is the sum
/// of [`Evaluation::share`], `steps` the number of control steps.
pub(super) fn world_success<N: Number>(plan: &Plan, share: N, steps: N) -> Option<N::Mask> {
    match *plan.task {
        KernelTask::Formation { .. } => {
            let mean = share / (steps * f64::from(plan.drones));
            Some(mean.less(mean.all(Formation::KEPT)))
        }
        _ => None,
    }
}

/// Returns the target of a hovering drone, world frame, m.
fn hover_target<N: Number>(parameters: &Parameters<N>, drone: N::Word, heights: &[f64], above_start: bool) -> V3<N> {
    let start = parameters.start.position;
    let height = of_drone(drone, start.x, heights);
    if above_start { V3::new(start.x, start.y, height) } else { V3::vertical(height) }
}

/// Evaluates a step along a course, and counts the points that the drone has passed in `state[0]`. `reward` computes
/// the reward of a drone before its last point from the reward for a point and the distance from it (m).
fn progress<N: Number>(
    scene: &Scene<'_, N>,
    course: &Course,
    state: &mut [N],
    reward: impl FnOnce(N, N) -> N,
) -> Evaluation<N> {
    let (passed, zero) = (state[0], state[0].all(0.0));
    let total = zero.all((course.points.len() * course.laps) as f64 - 0.5);
    let flying = passed.less(total);
    let next = point(course, passed, 0, true);
    let distance = (scene.motion.position - next).norm();
    let near = !zero.all(course.radius).less(waypoints::distance_to_leg(scene.before, scene.motion.position, next));
    let passes = flying & near;
    state[0] = N::choose(passes, passed + 1.0, passed);
    let complete = !state[0].less(total);
    let gained = N::choose(passes, zero.all(course.reward), zero);
    Evaluation {
        reward: reward(gained, distance),
        idle: !flying,
        end: Some((complete, EndReason::Completed)),
        success: complete,
        share: zero,
    }
}

/// Writes the observation of a drone. `seen` is the measured state, and `rpy` its roll, pitch and yaw.
pub(super) fn observe<N: Number>(scene: &Scene<'_, N>, seen: &FlightState<N>, rpy: V3<N>, state: &[N]) -> Vec<N> {
    let Scene { plan, parameters, drone, time, .. } = *scene;
    let mut out = vec![time; plan.observation_size()];
    let row: &mut [N] = &mut out;
    match &*plan.task {
        KernelTask::Hover { heights, above_start, .. } if plan.observation_size() > flight::tasks::STATE_SIZE => {
            let target = hover_target(parameters, drone, heights, *above_start);
            multi_hover::observe(seen, rpy, target.z, row);
        }
        KernelTask::Hover { .. } => hover::observe(seen, rpy, row),
        KernelTask::Stabilize { .. } => stabilize::observe(seen, rpy, row),
        KernelTask::Track { radius, height, speed, .. } => {
            let [position, target, _] = circle(drone, *radius, *height, *speed, state).motion(time);
            track::observe(seen, rpy, position, target, row);
        }
        KernelTask::Velocity { .. } => {
            velocity::observe(seen, rpy, V3::new(state[0], state[1], state[2]), state[3], row);
        }
        KernelTask::FlyThrough { course, .. } => {
            fly_through::observe(seen, rpy, point(course, state[0], 0, false), row);
        }
        KernelTask::Race { course, .. } => {
            let [next, second] = [0, 1].map(|ahead| point(course, state[0], ahead, true));
            race::observe(seen, rpy, [next, second], row);
        }
        KernelTask::Formation { offsets, path, speed } => {
            let own = vector_of_drone(drone, time, offsets);
            formation::observe(seen, rpy, slot(own, path, *speed, time), row);
        }
        KernelTask::Antipodal { goals, .. } => {
            antipodal::observe(seen, rpy, vector_of_drone(drone, time, goals), row);
        }
    }
    out
}
