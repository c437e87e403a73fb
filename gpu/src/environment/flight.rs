//! Physics steps of a control step.

use flight::body::{FreeBody, Push};
use flight::clearance::CollisionCylinder;
use flight::math::{V3, clamped};
use flight::state::FlightState;
use flight::wind::WindState;
use flight::{drag, motors};

use super::contact;
use super::memory::Memory;
use super::tasks::is_drone;
use crate::number::{Number, Word};
use crate::parameters::{MOTION, Parameters, motion_numbers, motion_of};
use crate::plan::{Decoding, Plan};

/// A drone after the physics steps of a control step.
pub(super) struct Flown<N: Number> {
    pub motion: FlightState<N>,
    pub rotors: [N; 4],
    pub wind: Option<WindState<N>>,
    /// Lowest clearance from the floor after a physics step, m.
    pub lowest: N,
    /// Smallest distance between the collision cylinder and that of another drone after a physics step, m.
    pub nearest: N,
    /// True where the drone touched the floor before it was airborne.
    pub stands: N::Mask,
    /// State that the sensors observe later.
    pub recorded: FlightState<N>,
}

/// Distance in place of one that has not been computed, m.
const FAR: f64 = 1e8;

/// Returns the commanded rotor speeds, rpm, relative to the hover speed with [`Plan::relative`].
pub(super) fn command<N: Number>(
    plan: &Plan,
    parameters: &Parameters<N>,
    memory: &mut Memory<N>,
    action: [N; 4],
) -> [N; 4] {
    let Parameters { hover_rpm: hover, rpm_above_hover: above, .. } = *parameters;
    let (zero, one) = (hover.all(0.0), hover.all(1.0));
    let relative_to_hover = |speeds: [N; 4]| if plan.relative { speeds.map(|speed| speed - hover) } else { speeds };
    let bounded = |action: [N; 4]| -> [N; 4] {
        std::array::from_fn(|entry| {
            let [low, high] = plan.action_bounds[entry];
            clamped(action[entry], zero.all(low), zero.all(high))
        })
    };
    match &plan.decoding {
        Decoding::Scaled { .. } => action.map(|command| {
            let command = clamped(command, -one, one);
            if plan.relative {
                command * N::choose(zero.less(command), above, hover)
            } else {
                N::choose(zero.less(command), command * above + hover, (command + 1.0) * hover)
            }
        }),
        Decoding::Raw => relative_to_hover(bounded(action)),
        Decoding::Loops(decoder) => {
            let mut loops = memory.loops.unwrap_or_else(|| Memory::fresh_loops(zero));
            let speeds = decoder.speeds(plan.control_period(), &mut loops, &memory.motion, bounded(action));
            if let Some(kept) = &mut memory.loops {
                *kept = loops;
            }
            relative_to_hover(speeds)
        }
    }
}

/// Returns the rotor speeds that the motors approach under a command: gains and saturation.
fn target<N: Number>(plan: &Plan, parameters: &Parameters<N>, command: [N; 4]) -> [N; 4] {
    let Parameters { hover_rpm: hover, max_change, gains, gain_errors, .. } = *parameters;
    std::array::from_fn(|motor| {
        if plan.relative {
            let change = command[motor];
            clamped(change + (change + hover) * gain_errors[motor], -hover, max_change)
        } else {
            motors::target(command[motor], gains[motor], max_change + hover)
        }
    })
}

/// Largest integer up to the quotient of two integers, the second one a constant.
fn whole_part<N: Number>(x: N, divisor: u32) -> N {
    let inverse = 1.0 / f64::from(divisor);
    ((x + 0.5) * inverse - 0.5).rounded()
}

/// Returns the entry of a list whose index is a number of the device.
fn pick<N: Number, const K: usize>(list: &[[N; K]], index: N, otherwise: [N; K]) -> [N; K] {
    let mut value = otherwise;
    for (position, entry) in list.iter().enumerate() {
        let near = (index - position as f64).abs().less(index.all(0.5));
        value = std::array::from_fn(|part| N::choose(near, entry[part], value[part]));
    }
    value
}

/// Commands that reach the motors in a control step.
struct Arrival<N: Number> {
    /// Target speeds until the other ones arrive.
    early: [N; 4],
    late: [N; 4],
    /// Physics step at which these arrive; `None` if they do so at the first one.
    at: Option<N>,
}

impl<N: Number> Arrival<N> {
    fn new(plan: &Plan, parameters: &Parameters<N>, memory: &mut Memory<N>, command: [N; 4]) -> Self {
        let past = &mut memory.late_commands;
        if past.is_empty() {
            let late = target(plan, parameters, command);
            return Self { early: late, late, at: None };
        }
        let latency = parameters.motor_latency;
        let whole = whole_part(latency, plan.substeps);
        let rest = latency - whole * f64::from(plan.substeps);
        let late = pick(past, whole - 1.0, command);
        let early = pick(past, whole, late);
        past.rotate_right(1);
        past[0] = command;
        let [early, late] = [early, late].map(|command| target(plan, parameters, command));
        Self { early, late, at: Some(rest) }
    }

    fn at(&self, step: N) -> [N; 4] {
        let Some(at) = self.at else { return self.late };
        let is_early = step.less(at);
        std::array::from_fn(|motor| N::choose(is_early, self.early[motor], self.late[motor]))
    }
}

/// Returns the physics step of a control step whose first state is observed later: m − n mod m for a latency of n
/// physics steps and m physics steps per control step.
fn recorded_step<N: Number>(plan: &Plan, latency: N) -> N {
    let count = f64::from(plan.substeps);
    let rest = latency - whole_part(latency, plan.substeps) * count;
    N::choose(rest.less(rest.all(0.5)), rest.all(0.0), -rest + count)
}

/// Advances a drone by the physics steps of a control step.
pub(super) fn advance<N: Number>(
    plan: &Plan,
    parameters: &Parameters<N>,
    memory: &mut Memory<N>,
    drone: N::Word,
    command: [N; 4],
) -> Flown<N> {
    let arrival = Arrival::new(plan, parameters, memory, command);
    let far = command[0].all(FAR);
    let zero = far.all(0.0);
    let records = !memory.late_states.is_empty();
    let recorded_at = recorded_step(plan, parameters.sensor_latency);
    let first_step = memory.steps.times(N::Word::of(plan.substeps));
    let key = N::key(memory.key);
    let blank = memory.clone();
    // the values of the loop: rotors, distances, contact, state, recorded state, wind
    let pack = |flown: &Flown<N>, stands: N| -> Vec<N> {
        let mut values = flown.rotors.to_vec();
        values.extend([flown.lowest, flown.nearest, stands]);
        values.extend(motion_numbers(&flown.motion));
        if records {
            values.extend(motion_numbers(&flown.recorded));
        }
        if let Some(wind) = &flown.wind {
            values.extend(wind_numbers(wind));
        }
        values
    };
    let unpack = |values: &[N]| -> (Flown<N>, N) {
        let part = |start: usize| -> [N; MOTION] { std::array::from_fn(|index| values[start + index]) };
        let motion = motion_of(&part(7));
        let recorded = if records { motion_of(&part(7 + MOTION)) } else { motion };
        let wind_start = 7 + MOTION * if records { 2 } else { 1 };
        let flown = Flown {
            motion,
            rotors: std::array::from_fn(|motor| values[motor]),
            wind: blank.wind.map(|_| wind_of(&values[wind_start..])),
            lowest: values[4],
            nearest: values[5],
            stands: zero.less(zero),
            recorded,
        };
        (flown, values[6])
    };
    let start = Flown {
        motion: memory.motion,
        rotors: memory.rotors,
        wind: memory.wind,
        lowest: far,
        nearest: far,
        stands: zero.less(zero),
        recorded: memory.motion,
    };
    let on_floor = memory.airborne.less(zero.all(0.5));
    let last = N::repeat(plan.substeps, pack(&start, zero), |index, values| {
        let (mut flown, mut stands) = unpack(&values);
        let step = N::of_word(index);
        if records {
            let here = (step - recorded_at).abs().less(zero.all(0.5));
            flown.recorded = choose_motion::<N>(here, &flown.motion, &flown.recorded);
        }
        let noise = key.at(N::wide(first_step.plus(index), N::Word::of(0)));
        let others = if plan.drones > 1 { neighbours(plan, parameters, &flown.motion) } else { Vec::new() };
        for (rotor, target) in flown.rotors.iter_mut().zip(arrival.at(step)) {
            *rotor = if plan.lag { motors::follow(*rotor, target, parameters.lag_share) } else { target };
        }
        let push = push(plan, parameters, &mut flown, drone, &others, noise);
        flown.motion = physics_step(plan, &parameters.body, &push, &flown.motion);
        let clearance = |cylinder: &CollisionCylinder<N>, motion: &FlightState<N>| {
            cylinder.floor_clearance(motion.position.z, motion.attitude.up().z)
        };
        let mut room = clearance(&parameters.cylinder, &flown.motion);
        if plan.floor {
            let touches = on_floor & room.less(zero);
            let values = (motion_numbers(&flown.motion).to_vec(), Vec::new());
            let (values, _) = N::when(touches, values, || {
                let landed = contact::on_floor(parameters, &flown.motion);
                (motion_numbers(&landed).to_vec(), Vec::new())
            });
            flown.motion = motion_of(&std::array::from_fn(|index| values[index]));
            stands = N::choose(touches, zero.all(1.0), stands);
            room = N::choose(touches, far, room);
        }
        flown.lowest = room.lesser(flown.lowest);
        if plan.drones > 1 && plan.crash.drones {
            let others = neighbours(plan, parameters, &flown.motion);
            let own = Neighbour {
                position: flown.motion.position,
                up: flown.motion.attitude.up(),
                cylinder: parameters.cylinder,
                wake: parameters.wake,
            };
            for (other, neighbour) in others.iter().enumerate() {
                // the drone with the lower index is the first one
                let comes_first = drone.less(N::Word::of(other as u32));
                let one = Neighbour::choose(comes_first, &own, neighbour);
                let two = Neighbour::choose(comes_first, neighbour, &own);
                let apart = contact::distance(&one, &two);
                let is_self = is_drone::<N>(drone, other);
                flown.nearest = N::choose(is_self, flown.nearest, apart.lesser(flown.nearest));
            }
        }
        pack(&flown, stands)
    });
    let (flown, stands) = unpack(&last);
    Flown { stands: zero.less(stands), ..flown }
}

/// Another drone of the world.
pub(super) struct Neighbour<N> {
    pub position: V3<N>,
    /// Body z, world frame.
    pub up: V3<N>,
    pub cylinder: CollisionCylinder<N>,
    pub wake: flight::downwash::Wake<N>,
}

impl<N: Number> Neighbour<N> {
    fn choose(mask: N::Mask, yes: &Self, no: &Self) -> Self {
        let (a, b) = (&yes.cylinder, &no.cylinder);
        Self {
            position: V3::choose(mask, yes.position, no.position),
            up: V3::choose(mask, yes.up, no.up),
            cylinder: CollisionCylinder {
                radius: N::choose(mask, a.radius, b.radius),
                height: N::choose(mask, a.height, b.height),
            },
            wake: flight::downwash::Wake::choose(mask, &yes.wake, &no.wake),
        }
    }
}

/// Returns all drones of the world, this one included.
fn neighbours<N: Number>(plan: &Plan, parameters: &Parameters<N>, motion: &FlightState<N>) -> Vec<Neighbour<N>> {
    let (p, up, wake) = (motion.position, motion.attitude.up(), parameters.wake);
    let CollisionCylinder { radius, height } = parameters.cylinder;
    let own = [p.x, p.y, p.z, up.x, up.y, up.z, radius, height, wake.strength, wake.spread, wake.offset, wake.cap];
    let neighbour = |numbers: Vec<N>| Neighbour {
        position: V3::new(numbers[0], numbers[1], numbers[2]),
        up: V3::new(numbers[3], numbers[4], numbers[5]),
        cylinder: CollisionCylinder { radius: numbers[6], height: numbers[7] },
        wake: flight::downwash::Wake {
            strength: numbers[8],
            spread: numbers[9],
            offset: numbers[10],
            cap: numbers[11],
        },
    };
    N::gather(plan.drones, &own).into_iter().map(neighbour).collect()
}

/// Returns the positions of all drones of the world, world frame, m.
pub(super) fn positions<N: Number>(plan: &Plan, position: V3<N>) -> Vec<V3<N>> {
    let all = N::gather(plan.drones, &[position.x, position.y, position.z]);
    all.into_iter().map(|numbers| V3::new(numbers[0], numbers[1], numbers[2])).collect()
}

/// Returns the forces and the torque in a physics step, and advances the wind.
fn push<N: Number>(
    plan: &Plan,
    parameters: &Parameters<N>,
    flown: &mut Flown<N>,
    drone: N::Word,
    others: &[Neighbour<N>],
    noise: flight::random::Noise<N::Integer>,
) -> Push<N> {
    let (hover, rotors, motion) = (parameters.hover_rpm, &flown.rotors, &flown.motion);
    let (thrust, torque) = if plan.relative {
        parameters.rotors.thrust_and_torque_about(hover, rotors)
    } else {
        parameters.rotors.thrust_and_torque(rotors)
    };
    let (mut force, mut air) = (V3::zero(thrust), V3::zero(thrust));
    if let (Some(wind), Some(parts)) = (&mut flown.wind, plan.wind) {
        let dt = plan.dt();
        (force, air) = wind.advance(parts.parts(), dt, &parameters.wind, noise, motion.position.z, motion.velocity);
        if plan.medium {
            force = force + parameters.body.medium_change(&motion.attitude, motion.velocity, air);
        }
    }
    if plan.ground {
        force.z = force.z + parameters.ground.force(motion.position.z, motion.attitude.up().z, thrust);
    }
    if plan.drag {
        let rpm = if plan.relative { rotors.map(|change| hover + change) } else { *rotors };
        force = force + drag::force(parameters.drag, &motion.attitude, &rpm, motion.velocity - air);
    }
    if plan.downwash {
        let zero = thrust.all(0.0);
        let mut sum = zero;
        for (other, upper) in others.iter().enumerate() {
            let apart = upper.position - motion.position;
            let sideways = apart.x * apart.x + apart.y * apart.y;
            // a drone is never below itself
            let pressed = upper.wake.force(apart.z, sideways);
            let is_above = zero.less(apart.z) & !is_drone::<N>(drone, other);
            sum = sum + N::choose(is_above, pressed, zero);
        }
        force.z = force.z + sum;
    }
    Push { thrust, torque, force }
}

/// Advances a drone by one physics step.
fn physics_step<N: Number>(plan: &Plan, body: &FreeBody<N>, push: &Push<N>, motion: &FlightState<N>) -> FlightState<N> {
    let dt = plan.dt();
    let usual = match (plan.body_fixed, plan.medium) {
        (false, false) => body.rk4::<false, false>(dt, push, motion),
        (false, true) => body.rk4::<false, true>(dt, push, motion),
        (true, false) => body.rk4::<true, false>(dt, push, motion),
        (true, true) => body.rk4::<true, true>(dt, push, motion),
    };
    let rate = motion.rate.dot(motion.rate);
    // a margin for the change of the rate within the step
    let limit = 0.9 * FreeBody::MAX_TURN / dt;
    let fast = rate.all(limit * limit).less(rate);
    let (numbers, _) = N::when(fast, (motion_numbers(&usual).to_vec(), Vec::new()), || {
        let next = match (plan.body_fixed, plan.medium) {
            (false, false) => body.rk4_of_any_turn::<false, false>(dt, push, motion),
            (false, true) => body.rk4_of_any_turn::<false, true>(dt, push, motion),
            (true, false) => body.rk4_of_any_turn::<true, false>(dt, push, motion),
            (true, true) => body.rk4_of_any_turn::<true, true>(dt, push, motion),
        };
        (motion_numbers(&next).to_vec(), Vec::new())
    });
    motion_of(&std::array::from_fn(|index| numbers[index]))
}

/// Selects a state.
pub(super) fn choose_motion<N: Number>(mask: N::Mask, yes: &FlightState<N>, no: &FlightState<N>) -> FlightState<N> {
    let (yes, no) = (motion_numbers(yes), motion_numbers(no));
    motion_of(&std::array::from_fn(|index| N::choose(mask, yes[index], no[index])))
}

fn wind_numbers<N: Copy>(wind: &WindState<N>) -> Vec<N> {
    let WindState { turbulence, filters, peak, elapsed, calm } = wind;
    let mut numbers = turbulence.to_vec();
    numbers.extend(filters.as_flattened());
    numbers.extend(peak);
    numbers.extend([elapsed, calm]);
    numbers
}

fn wind_of<N: Copy>(numbers: &[N]) -> WindState<N> {
    let at = |index: usize| numbers[index];
    WindState {
        turbulence: [at(0), at(1), at(2)],
        filters: [[at(3), at(4)], [at(5), at(6)]],
        peak: [at(7), at(8), at(9)],
        elapsed: at(10),
        calm: at(11),
    }
}
