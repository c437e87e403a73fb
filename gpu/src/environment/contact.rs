//! Contacts: a drone on the floor before it is airborne, and the distance between two drones.

use flight::clearance::CollisionCylinder;
use flight::math::{V3, clamped};
use flight::state::FlightState;

use super::flight::Neighbour;
use crate::number::Number;
use crate::parameters::Parameters;

/// Coefficient of friction of the floor.
const FRICTION: f64 = 1.0;

/// Sine of the tilt from which the lowest point of a cylinder is on its rim. Below it the point moves from the centre
/// of the face to the rim, as the mean of the points of a level face does.
const LEVEL: f64 = 0.02;

/// Returns the state of a drone after an inelastic impact of its lowest point on the floor, with Coulomb friction.
///
/// The contact of MuJoCo is soft; it penetrates the floor by less than a millimetre and settles within some steps.
pub(super) fn on_floor<N: Number>(parameters: &Parameters<N>, motion: &FlightState<N>) -> FlightState<N> {
    let Parameters { body, cylinder, .. } = parameters;
    let (zero, one) = (motion.position.x.all(0.0), motion.position.x.all(1.0));
    let up = motion.attitude.up();
    let square = (-(up.z * up.z) + 1.0).greater(zero);
    let sine = square.sqrt();
    let sign = N::choose(up.z.less(zero), -one, one);
    // towards the lowest point of the rim: the part of −z across the axis
    let along = V3::new(up.x * up.z, up.y * up.z, up.z * up.z - 1.0);
    let to_rim = along * (cylinder.radius / sine.greater(zero.all(LEVEL)));
    let arm = to_rim - up * (cylinder.height * 0.5 * sign);
    let turn = motion.attitude.forth(motion.rate);
    let [jx, jy, jz] = body.inverse_inertia;
    // angular velocity, world frame, by an impulse at the point
    let turned = |impulse: V3<N>| {
        let torque = motion.attitude.back(arm.cross(impulse));
        motion.attitude.forth(V3::new(torque.x * jx, torque.y * jy, torque.z * jz))
    };
    let speed = motion.velocity + turn.cross(arm);
    let compliance = |direction: V3<N>| body.inverse_mass + turned(direction).cross(arm).dot(direction);
    let normal = V3::vertical(one);
    let pressed = (-speed.z / compliance(normal)).greater(zero);
    let sideways = speed.level_norm();
    let least = sideways.greater(zero.all(1e-6));
    let direction = V3::new(-speed.x / least, -speed.y / least, zero);
    let rubbed = clamped(sideways / compliance(direction), zero, pressed * FRICTION);
    let impulse = normal * pressed + direction * rubbed;
    let depth = cylinder.floor_clearance(motion.position.z, up.z);
    FlightState {
        position: motion.position - V3::vertical(depth.lesser(zero)),
        attitude: motion.attitude,
        velocity: motion.velocity + impulse * body.inverse_mass,
        rate: motion.rate + motion.attitude.back(turned(impulse)),
    }
}

/// Number of projections between two cylinders.
const PROJECTIONS: usize = 12;

/// Returns an upper bound of the distance between two drones, m, which is 0 where they overlap. It is the distance of
/// their bounding balls where these are apart. Both drones of a pair call it with the same arguments, so that they find
/// the same result.
///
/// Alternating projections converge to the nearest points of two convex sets.
pub(super) fn distance<N: Number>(one: &Neighbour<N>, other: &Neighbour<N>) -> N {
    let cylinder = &one.cylinder;
    // relative to one of them, so that single precision keeps its digits far from the origin
    let there = other.position - one.position;
    let ball = |cylinder: &CollisionCylinder<N>| {
        (cylinder.radius * cylinder.radius + cylinder.height * cylinder.height * 0.25).sqrt()
    };
    let apart = there.norm() - ball(cylinder) - ball(&other.cylinder);
    let zero = apart.all(0.0);
    let (values, _) = N::when(apart.less(zero), (vec![apart], Vec::new()), || {
        let (mut point, mut gap) = (there, zero);
        for _ in 0..PROJECTIONS {
            let here = projected(cylinder, V3::zero(zero), one.up, point);
            point = projected(&other.cylinder, there, other.up, here);
            gap = (point - here).norm();
        }
        // projections converge slowly where the cylinders barely overlap
        let slack = zero.all(1e-5);
        (vec![N::choose(gap.less(slack), zero, gap)], Vec::new())
    });
    values[0]
}

/// Returns the point of a cylinder that is nearest to another point.
fn projected<N: Number>(cylinder: &CollisionCylinder<N>, centre: V3<N>, axis: V3<N>, point: V3<N>) -> V3<N> {
    let arm = point - centre;
    let along = arm.dot(axis);
    let across = arm - axis * along;
    let half = cylinder.height * 0.5;
    let (length, one) = (across.norm(), half.all(1.0));
    let share = N::choose(cylinder.radius.less(length), cylinder.radius / length, one);
    centre + across * share + axis * clamped(along, -half, half)
}
