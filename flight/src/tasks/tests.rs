use super::*;
use crate::clearance::CollisionCylinder;
use crate::math::Turn;
use crash::CrashLimits;

fn v(x: f64, y: f64, z: f64) -> V3<f64> {
    V3::new(x, y, z)
}

fn state() -> FlightState<f64> {
    FlightState {
        position: v(0.3, -0.4, 1.5),
        attitude: Turn::from_rpy(v(0.1, -0.2, 0.3)),
        velocity: v(2.0, -1.0, 2.0),
        rate: v(0.0, 3.0, 4.0),
    }
}

fn rpy() -> V3<f64> {
    v(0.1, -0.2, 0.3)
}

#[test]
fn rewards_have_hand_computed_values() {
    let (state, rpy) = (state(), rpy());
    let near = |got: f64, expected: f64| assert!((got - expected).abs() < 1e-12, "{got}, expected {expected}");
    near(hover::reward(&state, rpy, v(0.0, 0.0, 1.0)), -0.5 - 0.05 - 0.15 - 0.015);
    near(stabilize::reward(&state, rpy), -3.0 - 0.5 - 0.015);
    near(track::reward(&state, rpy, v(0.3, -0.4, 1.49), v(2.0, -1.0, 0.0)), -0.01 - 0.2 - 0.015 + 0.5);
    near(velocity::reward(&state, rpy, v(2.0, -1.0, 0.0), 1.0), -2.0 - 0.3 - 0.015);
    near(fly_through::reward(10.0, 0.1, 2.0, state.rate), 10.0 - 0.2 - 0.05);
    near(race::reward(20.0, [2.0, 0.05], state.velocity, 4.0), 20.0 + 6.0 - 0.2);
    near(formation::reward(0.5, 0.4), -0.6);
    near(antipodal::reward(0.05, 2.0), -0.005 + 0.5 - 2.0);
}

#[test]
fn observations_begin_with_the_state_vector() {
    let (state, rpy, target) = (state(), rpy(), v(1.0, 2.0, 3.0));
    let expected = [0.3, -0.4, 1.5, 0.1, -0.2, 0.3, 2.0, -1.0, 2.0, 0.0, 3.0, 4.0];
    let mut out = [f64::NAN; 21];
    race::observe(&state, rpy, [target, v(0.3, -0.4, 1.5)], &mut out[..]);
    assert_eq!((&out[..12], &out[12..15], &out[18..]), (&expected[..], &[1.0, 2.0, 3.0][..], &[0.0; 3][..]));
    // the body frame turns a vector, and keeps its length
    let apart = target - state.position;
    assert!((v(out[15], out[16], out[17]).norm() - apart.norm()).abs() < 1e-12);
    assert!((state.attitude.forth(v(out[15], out[16], out[17])) - apart).norm() < 1e-12);
    track::observe(&state, rpy, target, v(7.0, 8.0, 9.0), &mut out[..18]);
    assert_eq!(
        (&out[..12], &out[12..15], &out[15..18]),
        (&expected[..], &[apart.x, apart.y, apart.z][..], &[7.0, 8.0, 9.0][..],)
    );
}

#[test]
fn a_drone_crashes_below_its_lowest_height_and_beyond_its_tilt() {
    let cylinder = CollisionCylinder { radius: 0.06, height: 0.03 };
    let limits = CrashLimits { cylinder, lowest: 0.0, upright: 0.0 };
    let at = |z: f64, roll: f64| FlightState {
        position: v(0.0, 0.0, z),
        attitude: Turn::from_rpy(v(roll, 0.0, 0.0)),
        ..state()
    };
    assert_eq!(
        [at(0.015, 0.0), at(0.026, 0.0), at(0.07, 1.57)].map(|state| limits.is_clear(&state)),
        [false, true, false,]
    );
    assert_eq!(
        [at(-1e-9, 0.0), at(1.0, 1.58), at(1.0, 1.56)].map(|state| limits.are_exceeded(&state)),
        [true, true, false,]
    );
}

#[test]
fn a_path_passes_a_point_that_its_leg_comes_close_to() {
    let distance = |to: V3<f64>| waypoints::distance_to_leg(v(0.0, 0.0, 0.0), to, v(1.0, 1.0, 0.0));
    assert_eq!([distance(v(2.0, 0.0, 0.0)), distance(v(1.0, 0.0, 0.0))], [1.0, 1.0]);
    assert_eq!(distance(v(0.0, 0.0, 0.0)), 2.0_f64.sqrt());
}
