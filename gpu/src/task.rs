//! Rewards of the tasks, *MuJoCo-Drones-Gym* (Tayal), without the penalty for a crash.

use flight::math::{Real, V3};
use flight::state::FlightState;

/// Returns true at the target of Hover, which is a point, world frame, m.
pub(crate) fn at_target<R: Real>(position: V3<R>, target: V3<R>) -> R::Mask {
    let (apart, limit) = (position - target, position.x.all(0.05));
    apart.z.abs().less(limit) & apart.level_norm().less(limit)
}

/// Returns the reward of Hover, for a target in the world frame, m.
pub(crate) fn hover_reward<R: Real>(state: &FlightState<R>, rpy: V3<R>, target: V3<R>) -> R {
    let apart = state.position - target;
    let zero = apart.z.all(0.0);
    -apart.z.abs() - apart.level_norm() * 0.1 - state.velocity.norm() * 0.05 - (rpy.x.abs() + rpy.y.abs()) * 0.05
        + R::choose(at_target(state.position, target), zero.all(0.5), zero)
}

/// Returns true where a drone is at rest for Stabilize.
pub(crate) fn at_rest<R: Real>(state: &FlightState<R>) -> R::Mask {
    let (speed, rate) = (state.velocity.norm(), state.rate.norm());
    speed.less(speed.all(0.05)) & rate.less(rate.all(0.1))
}

/// Returns the reward of Stabilize.
pub(crate) fn stabilize_reward<R: Real>(state: &FlightState<R>, rpy: V3<R>) -> R {
    let zero = rpy.x.all(0.0);
    -state.velocity.norm() - state.rate.norm() * 0.1 - (rpy.x.abs() + rpy.y.abs()) * 0.05
        + R::choose(at_rest(state), zero.all(0.5), zero)
}
