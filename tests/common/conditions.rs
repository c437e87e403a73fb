//! Conditions under which tests fly, each with its name.

use mujoco_drones_gym::drone::{AirParams, MotorParams};
use mujoco_drones_gym::env::{BatteryRanges, EnvironmentRanges, InitialRanges, Randomization, SensorRanges};
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::physics::wind::{DrydenFilter, WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::world::{Forcing, Medium, ObstacleConfig, ObstacleKind};

use super::supplied;

/// Batteries of the conditions, and how long a drone hovers with them, s.
const HOVER_SECONDS: [(&str, f64); 2] = [("battery", 10.0), ("small battery", 1.0)];

/// Rise time, fall time and latency of the motors in the conditions with effects of the airframe, s.
const TIMES: [f64; 3] = [0.05, 0.03, 0.02];
const LATE_TIMES: [f64; 3] = [0.02, 0.06, 0.013];

/// Returns a drone with the airframe of a condition: with effects of its own parameters, a battery or a law from duty
/// to speed where the condition has them.
pub fn airframe_for(condition: &str, drone: DroneModel) -> DroneParams {
    let battery = HOVER_SECONDS.iter().find(|(name, _)| condition.starts_with(name)).map(|(_, seconds)| *seconds);
    let params = match condition {
        _ if !(condition.contains("effects of the airframe") || condition.contains("randomized airframe")) => {
            drone.params()
        }
        _ if battery.is_some() => with_effects(drone.params(), TIMES, 0.5),
        _ if condition.contains("without lag") => with_effects(drone.params(), [0.0; 3], 1.0),
        _ if condition.contains("late motors") => with_effects(drone.params(), LATE_TIMES, 4.0),
        _ => with_effects(drone.params(), TIMES, 1.0),
    };
    let needs_supply = battery.is_some() || condition.contains("duty");
    if needs_supply { supplied(params, battery) } else { params }
}

/// Length of a physics step at the default rate, s.
const STEP: f64 = 1.0 / 240.0;

/// Motors that differ from each other, with lag, latency and saturation.
const MOTORS: ActuatorParams =
    ActuatorParams { lag: 0.03, latency: 0.017, gains: [1.02, 0.98, 1.0, 0.99], saturation: 0.9 };

/// Returns an airframe with every effect of its own parameters. `times` are rise time, fall time and latency of its
/// motors, s. The effects of `strength` 1 are stronger than those that flights show.
pub fn with_effects(params: DroneParams, [rise_time, fall_time, latency]: [f64; 3], strength: f64) -> DroneParams {
    let scaled = |numbers: [f64; 3]| numbers.map(|x| x * strength);
    let motors = MotorParams { rise_time, fall_time, latency, rotor_inertia: 4e-8 * strength, ..params.motors };
    // a torque of the velocity without damping, or more lift, makes a flight so unstable that it amplifies rounding
    // errors to meters within an episode
    let air = AirParams {
        linear_drag: scaled([0.02, 0.03, 0.04]),
        translational_lift: 0.002 * strength,
        velocity_moment: 2e-4 * strength,
        rotational_damping: scaled([4e-4, 5e-4, 3e-4]),
        trim_torque: scaled([1e-5, -2e-5, 5e-6]),
    };
    DroneParams { center_of_mass: [1e-3, -5e-4], motors, air, ..params }
}

/// Returns motors with a latency, s.
pub fn late_motors(latency: f64) -> ActuatorParams {
    ActuatorParams { latency, ..ActuatorParams::default() }
}

/// Returns sensors with a latency and, if `noisy`, with noise and bias.
pub fn sensors(latency: f64, noisy: bool) -> Randomization {
    let exact =
        SensorRanges { position: 0.0, velocity: 0.0, attitude: 0.0, angular_velocity: 0.0, ..Default::default() };
    let noise = if noisy { SensorRanges::default() } else { exact };
    Randomization { sensors: Some(SensorRanges { latency: [latency; 2], ..noise }), ..Randomization::NONE }
}

/// Returns a wind that is strong enough to move a Crazyflie by several centimetres in a second.
pub fn strong(model: WindModel) -> WindConfig {
    WindConfig {
        velocity: [1.5, -2.0, 0.4],
        gust_force: 0.05,
        gust_duration: 0.3,
        gust_rate: 3.0,
        turbulence: 8.0,
        sinusoidal_force: 0.01,
        sinusoidal_frequency: 5.0,
        ..WindConfig::new(model)
    }
}

/// Returns a forest among which a drone with random actions meets a tree.
pub fn forest(new_layout: bool) -> ObstacleConfig {
    ObstacleConfig {
        count: 12,
        arena: [2.4, 2.4, 2.0],
        safe_zone: 0.3,
        new_layout,
        ..ObstacleConfig::new(ObstacleKind::Forest)
    }
}

/// Returns a randomization of one group.
fn only(change: impl FnOnce(&mut Randomization)) -> Randomization {
    let mut randomization = Randomization::NONE;
    change(&mut randomization);
    randomization
}

/// Returns a configuration with every condition at once.
pub fn everything() -> EnvConfig {
    let randomization = Randomization {
        environment: Some(EnvironmentRanges { wind: [0.0; 2], ..EnvironmentRanges::default() }),
        ..Randomization::default()
    };
    EnvConfig::default()
        .physics(Physics::MjcGndDragDw)
        .forcing(Forcing::BodyFixed)
        .medium(Medium::AIR)
        .wind(WindConfig { filter: DrydenFilter::MilF8785c, ..strong(WindModel::Combined) })
        .actuators(MOTORS)
        .obstacle_generator(forest(true))
        .randomization(randomization)
}

/// Returns every condition alone, and all of them together.
pub fn all() -> Vec<(String, EnvConfig)> {
    let base = EnvConfig::default;
    let mut all = Vec::new();
    let mut add = |name: &str, config: EnvConfig| all.push((name.to_string(), config));

    add("still air", base());
    add("all effects", base().physics(Physics::MjcGndDragDw));
    add("body-fixed forcing", base().forcing(Forcing::BodyFixed));
    add("medium", base().medium(Medium::AIR));
    add("body-fixed forcing in a medium", base().forcing(Forcing::BodyFixed).medium(Medium::AIR));

    // multiples of the control period of five physics steps, others, and a latency that rounds to none
    for steps in [0.4, 1.0, 4.0, 5.0, 7.0, 10.0, 72.0] {
        add(&format!("motors {steps} steps late"), base().actuators(late_motors(steps * STEP)));
        let motors = ActuatorParams { latency: steps * STEP, ..MOTORS };
        add(&format!("slow motors {steps} steps late"), base().actuators(motors));
        add(&format!("sensors {steps} steps late"), base().randomization(sensors(steps * STEP, false)));
    }
    add("slow motors", base().actuators(ActuatorParams { lag: 0.03, ..ActuatorParams::default() }));
    let unequal = ActuatorParams { gains: [1.05, 0.95, 1.0, 0.9], saturation: 0.8, ..ActuatorParams::default() };
    add("unequal motors", base().actuators(unequal));
    add("noisy late sensors", base().randomization(sensors(0.03, true)).physics(Physics::MjcDrag));

    for model in WindModel::ALL.into_iter().filter(|model| *model != WindModel::None) {
        add(&format!("{model} wind"), base().wind(strong(model)));
    }
    for model in [WindModel::Dryden, WindModel::Combined] {
        let wind = WindConfig { filter: DrydenFilter::MilF8785c, ..strong(model) };
        add(&format!("{model} wind of MIL-F-8785C"), base().wind(wind));
        add(
            &format!("{model} wind with a medium and effects"),
            base().wind(wind).medium(Medium::AIR).effects(Effects::ALL),
        );
    }
    let still = WindConfig { still_air_drag: true, ..WindConfig::default() };
    add("drag in still air", base().wind(still));
    add("gusts with drag in still air", base().wind(WindConfig { still_air_drag: true, ..strong(WindModel::Gust) }));

    add("randomized bodies", base().randomization(only(|r| r.body = Some(Default::default()))));
    let effects = base().physics(Physics::MjcGndDragDw);
    add("randomized aerodynamics", effects.randomization(only(|r| r.aerodynamics = Some(Default::default()))));
    add("randomized motors", base().randomization(only(|r| r.actuators = Some(Default::default()))));
    add("randomized sensors", base().randomization(only(|r| r.sensors = Some(Default::default()))));
    add("randomized gravity and wind", base().randomization(only(|r| r.environment = Some(Default::default()))));
    add("randomized starts", base().randomization(only(|r| r.initial = Some(InitialRanges::default()))));
    add("default randomization", base().randomization(Randomization::default()));

    add("obstacles", base().obstacle_generator(forest(false)));
    add("new obstacles", base().obstacle_generator(forest(true)));
    add("obstacles in wind", base().obstacle_generator(forest(false)).wind(strong(WindModel::Combined)));
    let late = base().randomization(Randomization::default());
    add("new obstacles and default randomization", late.obstacle_generator(forest(true)));

    for action_type in ActionType::ALL.into_iter().filter(|kind| *kind != ActionType::Rpm) {
        let base = || base().drone(supplied(DroneModel::Cf2x.params(), None));
        add(&format!("{action_type} actions"), base().action_type(action_type));
        let randomized = base().action_type(action_type).randomization(Randomization::default());
        add(&format!("{action_type} actions and default randomization"), randomized);
    }

    // a battery that lasts for the flight, and one that becomes empty
    for (name, seconds) in HOVER_SECONDS {
        let flown = || base().drone(supplied(DroneModel::Cf2x.params(), Some(seconds)));
        add(name, flown());
        add(&format!("{name}, duty"), flown().action_type(ActionType::Duty));
        add(&format!("{name}, motors"), flown().actuators(MOTORS).action_type(ActionType::Duty));
        let sampled = Randomization { battery: Some(BatteryRanges::default()), ..Randomization::default() };
        add(&format!("{name}, randomization"), flown().action_type(ActionType::Ctbr).randomization(sampled));
        let charge = only(|r| r.battery = Some(BatteryRanges { charge: [0.0, 1.0] }));
        add(&format!("{name}, charge"), flown().action_type(ActionType::Duty).randomization(charge));
        let effects = supplied(with_effects(DroneModel::Cf2x.params(), TIMES, 0.5), Some(seconds));
        add(&format!("{name}, effects of the airframe"), base().drone(effects).action_type(ActionType::Duty));
        add(&format!("{name} among obstacles"), flown().obstacle_generator(forest(true)).action_type(ActionType::Duty));
    }

    for rate in [24, 60, 80, 120, 240] {
        let late = base().ctrl_freq(rate).actuators(MOTORS).randomization(sensors(0.021, true));
        add(&format!("control at {rate} Hz"), late.wind(strong(WindModel::Dryden)));
    }
    let rates = base().sim_freq(500).ctrl_freq(100).randomization(Randomization::default());
    add("physics at 500 Hz", rates.physics(Physics::MjcGndDragDw));

    add("everything", everything());
    add("everything at 60 Hz", everything().ctrl_freq(60));

    // every effect, with motors that the kernel for a common lag does not fly
    let drone = base().drone(with_effects(DroneModel::Cf2x.params(), TIMES, 1.0));
    add("effects of the airframe", drone.clone());
    add("effects of the airframe without lag", base().drone(with_effects(DroneModel::Cf2x.params(), [0.0; 3], 1.0)));
    add(
        "effects of the airframe with late motors",
        base().drone(with_effects(DroneModel::Cf2x.params(), LATE_TIMES, 4.0)),
    );
    add("effects of the airframe under a lag of the environment", drone.clone().actuators(MOTORS));
    for forcing in [Forcing::Frozen, Forcing::BodyFixed] {
        let physics = drone.clone().physics(Physics::MjcGndDragDw).forcing(forcing).medium(Medium::AIR);
        let name = format!("effects of the airframe in wind and a medium, {forcing:?}");
        add(&name, physics.wind(strong(WindModel::Combined)));
    }
    add("effects of the airframe in a constant wind", drone.clone().wind(strong(WindModel::Constant)));
    add("effects of a randomized airframe", drone.randomization(Randomization::default()));
    add("whole airframes", base().randomization(only(|r| r.airframe = Some(Default::default()))));
    let some = |r: &mut Randomization| {
        r.airframe = Some(Default::default());
        r.initial = Some(Default::default());
    };
    add(
        "whole airframes with effects",
        base().randomization(only(some)).physics(Physics::MjcGndDragDw).actuators(MOTORS),
    );
    all
}
