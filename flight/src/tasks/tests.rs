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
fn terms_have_hand_computed_values() {
    let (state, rpy) = (state(), rpy());
    let check = |got: Vec<(&str, f64)>, expected: &[(&str, f64)]| {
        let near = |((name, got), (other, expected)): (&(&str, f64), &(&str, f64))| {
            name == other && (got - expected).abs() < 1e-12
        };
        assert!(got.len() == expected.len() && got.iter().zip(expected).all(near), "{got:?}, expected {expected:?}");
    };
    check(
        hover::terms(&state, rpy, v(0.0, 0.0, 1.0)),
        &[("height_error", -0.5), ("horizontal_error", -0.05), ("speed", -0.15), ("tilt", -0.015), ("at_target", 0.0)],
    );
    check(
        hover::terms(&state, rpy, v(0.3, -0.36, 1.52)),
        &[
            ("height_error", -0.02),
            ("horizontal_error", -0.004),
            ("speed", -0.15),
            ("tilt", -0.015),
            ("at_target", 0.5),
        ],
    );
    check(
        stabilize::terms(&state, rpy),
        &[("speed", -3.0), ("angular_velocity", -0.5), ("tilt", -0.015), ("at_rest", 0.0)],
    );
    check(
        track::terms(&state, rpy, v(0.3, -0.4, 1.49), v(2.0, -1.0, 0.0)),
        &[("position_error", -0.01), ("velocity_error", -0.2), ("tilt", -0.015), ("tracked", 0.5)],
    );
    check(
        velocity::terms(&state, rpy, v(2.0, -1.0, 0.0), 1.0),
        &[("velocity_error", -2.0), ("yaw_rate_error", -0.3), ("tilt", -0.015), ("tracked", 0.0)],
    );
    check(
        fly_through::terms(10.0, 0.1, 2.0, state.rate),
        &[("capture", 10.0), ("distance", -0.2), ("angular_velocity", -0.05)],
    );
    check(race::terms(20.0, [2.0, 0.05], state.velocity, 4.0), &[("gate", 20.0), ("speed", 6.0), ("distance", -0.2)]);
    check(formation::terms(0.5, 0.4), &[("slot_error", -0.5), ("distance_errors", -0.1)]);
    check(antipodal::terms(0.05, 2.0), &[("distance", -0.005), ("at_goal", 0.5), ("too_close", -2.0)]);
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

/// Asserts that terms have unique names in lower snake case, and that their sum is the reward.
fn check_terms(terms: &[(&str, f64)], reward: f64) {
    for (index, (name, value)) in terms.iter().enumerate() {
        assert!(name.bytes().all(|byte| byte.is_ascii_lowercase() || byte == b'_'), "{name}");
        assert!(terms[..index].iter().all(|(other, _)| other != name) && *name != CRASH, "{name} twice in {terms:?}");
        // a list has no negative zeros
        assert!(*value != 0.0 || value.is_sign_positive(), "{terms:?}");
    }
    let sum = terms.iter().map(|(_, value)| value).sum::<f64>();
    assert!(sum == reward, "{terms:?}: {sum}, expected {reward}");
}

#[test]
fn terms_add_up_to_the_reward() {
    use proptest::prelude::*;

    let number = -3.0..3.0;
    proptest!(|(x in proptest::array::uniform18(number), is_near: bool)| {
        let three = |first: usize| v(x[first], x[first + 1], x[first + 2]);
        let scale = if is_near { 0.01 } else { 1.0 };
        let state = FlightState {
            position: three(0) + three(9) * scale,
            attitude: Turn::from_rpy(three(6)),
            velocity: three(12) * scale,
            rate: three(15) * scale,
        };
        let (rpy, target) = (three(6), three(0));
        check_terms(&hover::terms::<f64, Vec<_>>(&state, rpy, target), hover::reward(&state, rpy, target));
        check_terms(&stabilize::terms::<f64, Vec<_>>(&state, rpy), stabilize::reward(&state, rpy));
        let velocity = state.velocity + three(3) * scale;
        check_terms(
            &track::terms::<f64, Vec<_>>(&state, rpy, target, velocity),
            track::reward(&state, rpy, target, velocity),
        );
        check_terms(
            &velocity::terms::<f64, Vec<_>>(&state, rpy, velocity, x[3]),
            velocity::reward(&state, rpy, velocity, x[3]),
        );
        let (distance, rate) = (x[9].abs(), state.rate);
        check_terms(
            &fly_through::terms::<f64, Vec<_>>(x[1], x[2], distance, rate),
            fly_through::reward(x[1], x[2], distance, rate),
        );
        let (weights, velocity) = ([x[2], x[3]], state.velocity);
        check_terms(
            &race::terms::<f64, Vec<_>>(x[1], weights, velocity, distance),
            race::reward(x[1], weights, velocity, distance),
        );
        let deviations = x[10].abs();
        check_terms(&formation::terms::<f64, Vec<_>>(distance, deviations), formation::reward(distance, deviations));
        let distance = distance * scale;
        check_terms(&antipodal::terms::<f64, Vec<_>>(distance, 2.0), antipodal::reward(distance, 2.0));
    });
}

/// A drone that has passed its last point keeps the names of its terms, and batches have −0 as its reward.
#[test]
fn a_finished_drone_has_the_same_terms_with_the_value_zero() {
    let names = |terms: &[(&'static str, f64)]| terms.iter().map(|(name, _)| *name).collect::<Vec<_>>();
    let zero = v(0.0, 0.0, 0.0);
    let terms: [Vec<(&str, f64)>; 2] = [fly_through::terms(1.0, 0.1, 2.0, zero), race::terms(1.0, [2.0; 2], zero, 3.0)];
    let finished: [Vec<(&str, f64)>; 2] = [fly_through::no_terms(), race::no_terms()];
    for (terms, finished) in terms.iter().zip(&finished) {
        assert_eq!(names(finished), names(terms));
        assert!(finished.iter().all(|(_, value)| *value == 0.0));
    }
    let rewards: [f64; 2] = [fly_through::no_terms(), race::no_terms()];
    assert_eq!(rewards.map(f64::to_bits), [(-0.0_f64).to_bits(); 2]);
}
