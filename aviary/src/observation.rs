//! What an agent sees: vectors made of a drone's state.

use crate::state::DroneState;

/// Length of the kinematic vector per drone.
pub const KIN_SIZE: usize = 20;

/// Length of the state vector per drone.
pub const STATE_SIZE: usize = 12;

/// The paper's `KIN`: `[position 3, quaternion wxyz 4, rpy 3, velocity 3, angular velocity 3, motor speeds rpm 4]`;
/// position and velocity in the world frame, angular velocity in the body frame.
pub fn kinematic(state: &DroneState, motor_speeds: &[f64; 4]) -> [f64; KIN_SIZE] {
    let mut out = [0.0; KIN_SIZE];
    out[0..3].copy_from_slice(state.position.as_slice());
    out[3..7].copy_from_slice(&crate::state::wxyz(&state.attitude));
    out[7..10].copy_from_slice(state.rpy().as_slice());
    out[10..13].copy_from_slice(state.velocity.as_slice());
    out[13..16].copy_from_slice(state.angular_velocity.as_slice());
    out[16..20].copy_from_slice(motor_speeds);
    out
}

/// The tasks' state vector: `[position 3, rpy 3, velocity 3, angular velocity 3]`, frames as in [`kinematic`].
pub fn state_vector(state: &DroneState) -> [f64; STATE_SIZE] {
    let mut out = [0.0; STATE_SIZE];
    out[0..3].copy_from_slice(state.position.as_slice());
    out[3..6].copy_from_slice(state.rpy().as_slice());
    out[6..9].copy_from_slice(state.velocity.as_slice());
    out[9..12].copy_from_slice(state.angular_velocity.as_slice());
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn both_vectors_have_their_parts_in_the_papers_order() {
        let state = DroneState {
            velocity: Vector3::new(7.0, 8.0, 9.0),
            angular_velocity: Vector3::new(10.0, 11.0, 12.0),
            ..DroneState::at_rest(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.4, 0.5, 0.6))
        };
        let q = crate::state::wxyz(&state.attitude);
        let kin = kinematic(&state, &[13.0, 14.0, 15.0, 16.0]);
        assert_eq!(kin[..3], [1.0, 2.0, 3.0]);
        assert_eq!(kin[3..7], q);
        assert!(q[0] > 0.8, "the scalar comes first");
        assert_eq!(kin[10..], [7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0]);
        let short = state_vector(&state);
        assert_eq!(short[..3], kin[..3]);
        assert_eq!(short[3..6], kin[7..10]);
        assert_eq!(short[6..], kin[10..16]);
        for (got, wanted) in short[3..6].iter().zip([0.4, 0.5, 0.6]) {
            assert!((got - wanted).abs() < 1e-12);
        }
    }
}
