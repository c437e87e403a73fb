use crate::control::Reference;
use crate::state::DroneState;

/// Maximum commanded speed, horizontally and vertically, m/s.
const SPEED: f64 = 1.0;

/// Returns the [`ActionType::Vel`](crate::action::ActionType::Vel) command that moves a drone to its reference:
/// velocity in the heading frame (m/s) and a yaw rate of 0.
///
/// The course has a bias to the right while the reference is far, so that two approaching drones avoid each other.
pub(super) fn velocity_to(state: &DroneState, reference: &Reference) -> [f64; 4] {
    let path = reference.position - state.position;
    let aside = 0.25 * (path.xy().norm() - 0.3).clamp(0.0, 1.0);
    let (x, y) = (path.x + aside * path.y, path.y - aside * path.x);
    let fast = 1.5 * x.hypot(y);
    let share = 1.5 * (SPEED / fast.max(SPEED));
    let (sin, cos) = state.yaw().sin_cos();
    [share * (cos * x + sin * y), share * (cos * y - sin * x), (2.0 * path.z).clamp(-SPEED, SPEED), 0.0]
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn speed_is_limited_and_the_bias_to_the_right_vanishes_near_the_reference() {
        let at = |yaw: f64| DroneState::at_rest(Vector3::zeros(), Vector3::new(0.0, 0.0, yaw));
        let to = |x: f64| Reference::hover(Vector3::new(x, 0.0, 0.0), 0.0);
        let [x, y, z, yaw_rate] = velocity_to(&at(0.0), &to(3.0));
        assert!((x.hypot(y) - SPEED).abs() < 1e-12 && y < -0.2 && (z, yaw_rate) == (0.0, 0.0));
        let [x, y, ..] = velocity_to(&at(0.0), &to(0.2));
        assert!((x - 0.3).abs() < 1e-12 && y == 0.0);
        // the x axis of the world is to the right of a drone that faces left
        let [x, y, ..] = velocity_to(&at(std::f64::consts::FRAC_PI_2), &to(0.2));
        assert!(x.abs() < 1e-12 && (y + 0.3).abs() < 1e-12);
        assert_eq!(velocity_to(&at(0.0), &Reference::hover(Vector3::new(0.0, 0.0, -9.0), 0.0))[2], -SPEED);
    }
}
