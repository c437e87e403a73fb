//! Samples of an episode: parameters of a drone and its start.

use aviary::env::Randomization;
use flight::math::{Turn, V3, sin_cos_of_turns};
use flight::state::FlightState;

use super::tasks;
use crate::number::Number;
use crate::parameters::Parameters;
use crate::plan::Plan;
use crate::random::{Draws, Stream};

/// Clearance from the floor to which the sampler lifts a start, m.
const LIFTED: f64 = 1e-3;

/// Start of an episode of a drone.
pub(super) struct Start<N: Number> {
    pub parameters: Parameters<N>,
    pub motion: FlightState<N>,
    /// State of the task.
    pub task: Vec<N>,
    /// Key of the random numbers of wind and sensors.
    pub key: [N::Word; 2],
}

/// Place of a drone in a batch and in its sequence of episodes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place<W> {
    /// Seed, lower half first.
    pub seed: [W; 2],
    /// Index of the environment's random stream.
    pub environment: W,
    /// Index of the drone in its world.
    pub drone: W,
    /// Number of the episode.
    pub episode: W,
}

impl<N: Number> Start<N> {
    /// Samples an episode of a drone with these nominal parameters.
    pub fn sample(plan: &Plan, nominal: &Parameters<N>, place: Place<N::Word>) -> Self {
        let Place { seed, environment, drone, episode } = place;
        let mut own = Draws::<N>::new(seed, environment, episode, Stream::Drone(drone));
        let mut world = Draws::<N>::new(seed, environment, episode, Stream::World);
        let key = [own.word(), own.word()];
        let parameters = sample_parameters(plan, nominal, &mut own, &mut world);
        let mut motion = nominal.start;
        if let Some(ranges) = &plan.ranges.initial {
            let around = |own: &mut Draws<N>, max: f64| own.symmetric_triple() * max;
            let [x, y, z] = ranges.offset.map(|offset| motion.position.x.all(offset));
            let middle = motion.position + V3::new(x, y, z) + around(&mut own, ranges.position);
            motion.attitude = Turn::from_rpy(motion.attitude.rpy() + around(&mut own, ranges.attitude));
            motion.velocity = motion.velocity + around(&mut own, ranges.velocity);
            let up = motion.attitude.up().z;
            let depth = -nominal.cylinder.floor_clearance(up.all(0.0), up);
            motion.position = V3::new(middle.x, middle.y, middle.z.greater(depth + LIFTED));
        }
        let task = tasks::start(&plan.task, &mut motion, &mut own, &mut world);
        Self { parameters, motion, task, key }
    }
}

/// Samples the parameters of an episode. `own` are random numbers of the drone, `world` those that all drones share.
fn sample_parameters<N: Number>(
    plan: &Plan,
    nominal: &Parameters<N>,
    own: &mut Draws<N>,
    world: &mut Draws<N>,
) -> Parameters<N> {
    let mut sampled = *nominal;
    let Randomization { body, aerodynamics, actuators, sensors, environment, .. } = &*plan.ranges;
    let one = nominal.hover_rpm.all(1.0);
    let (mut arm, mut thrust, mut torque) = (one, one, one);
    if let Some(ranges) = body {
        let mass = own.within(ranges.mass);
        let inertia = own.within(ranges.inertia);
        arm = own.within(ranges.arm_length);
        sampled.body.inverse_mass = nominal.body.inverse_mass / mass;
        sampled.body.inverse_inertia = nominal.body.inverse_inertia.map(|inverse| inverse / inertia);
    }
    if let Some(ranges) = aerodynamics {
        thrust = own.within(ranges.thrust);
        torque = own.within(ranges.torque);
        let [sideways, upwards] = [(); 2].map(|()| own.within(ranges.drag));
        let ground = own.within(ranges.ground);
        let V3 { x, y, z } = nominal.drag;
        sampled.drag = V3::new(x * sideways, y * sideways, z * upwards);
        sampled.ground.coefficient = nominal.ground.coefficient * ground;
        sampled.ground.clip = nominal.ground.clip * ground.sqrt();
        sampled.wake.strength = nominal.wake.strength * own.within(ranges.downwash);
        sampled.wake.cap = nominal.wake.cap * thrust;
    }
    if body.is_some() || aerodynamics.is_some() {
        sampled.rotors.thrust = nominal.rotors.thrust * thrust;
        let levers = [arm * thrust, arm * thrust, torque];
        for (row, lever) in sampled.rotors.torque.iter_mut().zip(levers) {
            row.iter_mut().for_each(|number| *number = *number * lever);
        }
    }
    if let Some(ranges) = actuators {
        let gains = [(); 4].map(|()| own.within(ranges.gain));
        let lag = own.within(ranges.lag);
        let latency = own.within(ranges.latency);
        let saturation = own.within(ranges.max_rpm);
        sampled.gains = gains;
        sampled.gain_errors = gains.map(|gain| gain - 1.0);
        // without lag the exponential vanishes
        let decay = flight::math::exp_of_negative(-(one * plan.dt()) / lag.greater(one.all(1e-9)));
        sampled.lag_share = -decay + 1.0;
        sampled.motor_latency = whole_steps(plan, latency);
        let full = nominal.hover_rpm + nominal.rpm_above_hover;
        sampled.max_change = full * saturation - nominal.hover_rpm;
    }
    if plan.lag || plan.late_commands > 0 {
        // the hover speed of the nominal airframe
        sampled.initial_change = one.all(0.0).lesser(sampled.max_change);
    }
    if let Some(ranges) = sensors {
        let sigmas = [ranges.position, ranges.velocity, ranges.attitude].map(|sigma| ranges.bias * sigma);
        let gyro = ranges.gyro_bias.unwrap_or(ranges.bias * ranges.angular_velocity);
        let [x, y, z] = sigmas;
        sampled.biases = [x, y, z, gyro].map(|sigma| {
            let ([a, b], [c, _]) = (own.normals(), own.normals());
            [a * sigma, b * sigma, c * sigma]
        });
        sampled.sensor_latency = whole_steps(plan, world.within(ranges.latency));
    }
    if let Some(ranges) = environment {
        sampled.body.gravity = nominal.body.gravity * world.within(ranges.gravity);
        let (sin, cos) = sin_cos_of_turns(world.unit());
        let speed = world.within(ranges.wind);
        if let Some(unit) = &plan.sampled_wind {
            let full = unit.params(plan.dt());
            let zero = one.all(0.0);
            // the drag of the nominal wind contains the area
            let wind = full.map(|number| one.all(*number));
            let velocity = [speed * cos, speed * sin, zero];
            sampled.wind = flight::wind::WindParams {
                mean: velocity,
                constant: velocity,
                along: [cos, sin],
                sigma: wind.sigma * speed,
                gust_force: wind.gust_force * speed,
                sinusoidal_force: wind.sinusoidal_force * speed,
                drag: nominal.wind.drag,
                ..wind
            };
        }
    }
    sampled
}

/// Returns a latency (s) as a whole number of physics steps.
fn whole_steps<N: Number>(plan: &Plan, latency: N) -> N {
    // half a step is rounded up, as on the CPU; devices round it up or down
    (latency * f64::from(plan.sim_freq) + 1e-4).rounded()
}

/// Returns for every parameter, in the order of [`Parameters::each`], whether it is drawn for every episode. `nominal`
/// has the parameters of each drone.
pub(crate) fn drawn_parameters(plan: &Plan, nominal: &[Parameters]) -> Vec<bool> {
    // rounded latencies may be equal in most episodes
    let (motors, sensors) = (plan.late_commands > 0, plan.late_states > 0);
    let mark = |is_late: bool| if is_late { f64::NAN } else { 0.0 };
    let marked = Parameters { motor_latency: mark(motors), sensor_latency: mark(sensors), ..nominal[0] };
    let mut drawn: Vec<bool> = marked.numbers().into_iter().map(f64::is_nan).collect();
    for (drone, nominal) in nominal.iter().enumerate() {
        let expected = nominal.numbers();
        // a parameter with a range has another value in almost every episode
        for episode in 0..64 {
            let place = Place { seed: [1, 2], environment: 0, drone: drone as u32, episode };
            let sampled = Start::<f64>::sample(plan, nominal, place).parameters.numbers();
            for ((drawn, sampled), expected) in drawn.iter_mut().zip(sampled).zip(&expected) {
                *drawn |= sampled != *expected;
            }
        }
    }
    drawn
}

#[cfg(test)]
mod tests;
