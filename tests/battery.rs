//! Duties and batteries in flight.

mod common;

use common::{airframe_with_battery, airframe_with_duty, assert_contract};
use mujoco_drones_gym::action::{ActionDecoder, ActionLimits};
use mujoco_drones_gym::drone::{BatteryParams, MotorParams};
use mujoco_drones_gym::env::{AviaryBuilder, BatteryRanges, EnvConfig, Randomization};
use mujoco_drones_gym::multi_agent::AgentMap;
use mujoco_drones_gym::physics::actuators::ActuatorParams;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::simulation::SimData;
use mujoco_drones_gym::tasks::make;
use nalgebra::Vector3;
use proptest::prelude::*;

const ENGINES: [EngineKind; 3] = [EngineKind::Mujoco, EngineKind::Hybrid, EngineKind::Explicit];

/// Returns the Crazyflie with a battery, with motors that need more than 3 V to hover.
fn weak(capacity: f64) -> DroneParams {
    let params = airframe_with_battery(capacity);
    DroneParams { motors: MotorParams { speed_per_volt: 4200.0, ..params.motors }, ..params }
}

/// Flies at hover speed with duties that follow from the present voltage, until the battery is empty or `steps` are
/// over. Returns the largest duty and the states of the battery after each step.
fn hover(simulation: &mut Simulation, steps: usize) -> Vec<(f64, f64, f64, f64)> {
    let (hover, motors) = (simulation.params(0).hover_rpm(), simulation.params(0).motors);
    let mut rows = Vec::new();
    for _ in 0..steps {
        let duty = motors.duty(hover, simulation.voltage(0));
        let speed = motors.speed(duty, simulation.voltage(0));
        simulation.step(&vec![[speed; 4]; simulation.num_drones()]).unwrap();
        let battery = simulation.battery(0).unwrap();
        rows.push((duty, battery.charge, battery.voltage, battery.current));
        if battery.charge == 0.0 {
            break;
        }
    }
    rows
}

#[test]
fn a_hovering_drone_needs_more_duty_as_its_battery_empties_and_sinks_in_the_end() {
    for engine in ENGINES {
        let builder = Simulation::builder(weak(0.01)).engine(engine);
        let mut simulation = builder.initial_positions([[0.0, 0.0, 40.0]]).build().unwrap();
        let rows = hover(&mut simulation, 48 * 120);
        let (first, last) = (&rows[10], rows.iter().rposition(|row| row.0 < 1.0).unwrap());
        // the duty never falls, and rises by more than a tenth
        for pair in rows[10..last].windows(2) {
            assert!(pair[1].0 >= pair[0].0 - 1e-9 && pair[1].2 <= pair[0].2 + 1e-9, "{engine}: {pair:?}");
        }
        assert!(rows[last - 1].0 > 1.1 * first.0, "{engine}: {} after {}", rows[last - 1].0, first.0);
        // full duty does not suffice at the end, where the drone sinks with some charge left
        let full: Vec<_> = rows.iter().filter(|row| row.0 == 1.0).collect();
        assert!(full.len() > 10 && full[0].1 > 0.0, "{engine}: {} steps", full.len());
        let sinking = simulation.states()[0].velocity.z;
        assert!(sinking < -0.1, "{engine}: {sinking} m/s");
        // an empty battery supplies nothing
        assert_eq!(simulation.battery(0).unwrap().charge, 0.0);
        for _ in 0..10 {
            simulation.step(&[[20_000.0; 4]]).unwrap();
        }
        assert_eq!(simulation.motor_speeds()[0], [0.0; 4]);
        assert!(simulation.states()[0].velocity.z < sinking - 1.0, "{engine}");
        // a reset charges it
        simulation.reset().unwrap();
        let full = simulation.battery(0).unwrap();
        assert!(full.charge == 1.0 && full.voltage > 4.0);
    }
}

/// The charge of a hover at constant power P lasts for ∫ V dq / P with V between the open-circuit voltage and the
/// voltage at the largest current.
#[test]
fn the_hover_time_agrees_with_the_calculation_by_hand() {
    let params = airframe_with_battery(0.01);
    let BatteryParams { resistance, efficiency, idle_current, .. } = params.battery.unwrap();
    let omega = params.hover_rpm() * std::f64::consts::TAU / 60.0;
    let power = 4.0 * params.torque_coefficient * params.hover_rpm().powi(2) * omega / efficiency;
    // midpoint rule over the charge: dt = dq / I with the current of the stationary voltage
    let cell = params.battery.unwrap();
    let parts = 20_000;
    let mut seconds = 0.0;
    for part in 0..parts {
        let open = cell.open_circuit_voltage((f64::from(part) + 0.5) / f64::from(parts)) - resistance * idle_current;
        let voltage = 0.5 * (open + (open * open - 4.0 * resistance * power).sqrt());
        // below this voltage the motors are slower
        if params.motors.speed(1.0, voltage) < params.hover_rpm() {
            continue;
        }
        seconds += 36.0 / f64::from(parts) / (power / voltage + idle_current);
    }
    let mut simulation = Simulation::builder(params).initial_positions([[0.0, 0.0, 5.0]]).build().unwrap();
    let rows = hover(&mut simulation, 48 * 120);
    let hovered = rows.iter().take_while(|row| row.0 < 1.0).count();
    assert!((hovered as f64 / 48.0 - seconds).abs() < 0.1, "{} s, expected {seconds} s", hovered as f64 / 48.0);
}

#[test]
fn every_command_is_limited_to_the_speed_at_full_duty() {
    let full = |params: DroneParams, voltage| params.motors.speed(1.0, voltage);
    // constant voltage
    let motors = MotorParams { voltage: 3.0, ..airframe_with_duty().motors };
    let params = DroneParams { motors, ..airframe_with_duty() };
    let limit = full(params.clone(), 3.0);
    assert!(limit < params.max_rpm() && params.max_command_rpm() == limit);
    let mut simulation = Simulation::builder(params).build().unwrap();
    simulation.step(&[[1e6, limit + 1.0, limit - 1.0, 0.0]]).unwrap();
    assert_eq!(simulation.motor_speeds()[0], [limit, limit, limit - 1.0, 0.0]);
    // battery
    let battery = BatteryParams { initial_charge: 0.05, ..weak(1.0).battery.unwrap() };
    let params = DroneParams { battery: Some(battery), ..weak(1.0) };
    for action_type in [ActionType::Rpm, ActionType::RawRpm, ActionType::OneDRpm, ActionType::Duty] {
        let builder =
            Hover::builder().drone(params.clone()).action_type(action_type).initial_positions([[0.0, 0.0, 1.0]]);
        let mut env = builder.build().unwrap();
        env.reset(Some(1)).unwrap();
        for _ in 0..5 {
            let limit = full(params.clone(), env.simulation().voltage(0));
            let high = env.action_space().high().to_vec();
            env.step(&high).unwrap();
            assert_eq!(env.simulation().motor_speeds()[0], [limit; 4], "{action_type}");
        }
    }
}

#[test]
fn an_airframe_without_law_or_battery_refuses_duties_and_charges_on_one_line() {
    let error = |result: Result<(), EnvError>| {
        let text = result.unwrap_err().to_string();
        assert!(!text.contains('\n'), "{text}");
        text
    };
    let build = |config: EnvConfig| error(make("hover", config).map(|_| ()));
    let duty = EnvConfig::default().action_type(ActionType::Duty);
    assert_eq!(
        build(duty.clone()),
        "action_type is duty for the airframe cf2x, which has no law from duty to motor speed, expected an airframe \
         with [motors] speed_per_volt, or another action type"
    );
    let batch = VecAviary::new(duty.with_task(Hover::default()), VecConfig::new(4)).map(|_| ());
    assert!(error(batch).starts_with("action_type is duty for the airframe cf2x"));
    let charge = Randomization { battery: Some(BatteryRanges::default()), ..Randomization::NONE };
    let expected =
        "the randomized battery is set for cf2x, which has none, expected an airframe with a section [battery]";
    assert_eq!(build(EnvConfig::default().randomization(charge.clone())), expected);
    let mut env = Hover::builder().build().unwrap();
    assert_eq!(error(env.set_randomization(Some(charge))), expected);
    let wrong = Randomization { battery: Some(BatteryRanges { charge: [0.5, 1.1] }), ..Randomization::NONE };
    let refused = build(EnvConfig::default().drone(airframe_with_battery(1.0)).randomization(wrong));
    assert_eq!(refused, "the randomized battery.charge is [0.5, 1.1], expected a range from 0 to 1");

    let refused = |change: fn(&mut DroneParams), expected: &str| {
        let mut params = airframe_with_battery(0.25);
        change(&mut params);
        let text = params.validate().unwrap_err().to_string();
        assert!(text.starts_with(expected) && text.contains("expected") && !text.contains('\n'), "{text}");
    };
    refused(|params| params.motors.speed_per_volt = 0.0, "motors.speed_per_volt is 0");
    refused(|params| params.battery = None, "motors.voltage is 0");
    refused(|params| params.motors.speed_at_zero = -1e5, "motors.speed_at_zero is -100000");
    refused(|params| params.battery.as_mut().unwrap().capacity = 0.0, "battery.capacity is 0");
    refused(|params| params.battery.as_mut().unwrap().efficiency = 1.5, "battery.efficiency is 1.5");
    refused(|params| params.battery.as_mut().unwrap().initial_charge = -0.1, "battery.initial_charge is -0.1");
    refused(|params| params.battery.as_mut().unwrap().resistance = f64::NAN, "battery.resistance is NaN");
    refused(|params| params.battery.as_mut().unwrap().cells = 0, "battery.cells is 0");
    refused(|params| params.battery.as_mut().unwrap().idle_current = 30.0, "battery.idle_current is 30");
    let text = include_str!("../assets/airframes/cf2x.toml");
    let supplied =
        |section: &str| DroneParams::from_toml(&format!("{text}\n[motors]\nspeed_per_volt = 5000\n{section}"));
    let own = supplied("[battery]\ncapacity = 0.25\nresistance = 0.1\nefficiency = 0.3\n").unwrap();
    let expected = BatteryParams { capacity: 0.25, resistance: 0.1, efficiency: 0.3, ..BatteryParams::default() };
    assert_eq!(own.battery, Some(expected));
    let missing = supplied("[battery]\nresistance = 0.1\nefficiency = 0.3\n").unwrap_err().to_string();
    assert!(missing.contains("capacity") && missing.contains("line"), "{missing}");
    assert!(supplied("[battery]\ncapacity = 1\nresistance = 0\nefficiency = 1\nvolts = 3\n").is_err());
}

#[test]
fn controllers_fly_with_duties() {
    for (params, action_type) in [
        (airframe_with_duty(), ActionType::Duty),
        (airframe_with_battery(0.25), ActionType::Duty),
        (airframe_with_battery(0.25), ActionType::Rpm),
    ] {
        for kind in ControllerKind::ALL {
            let mut env = Hover::builder().drone(params.clone()).action_type(action_type).build().unwrap();
            let mut pilot = ControllerPolicy::new(kind, &env);
            let summary = fly_episode(&mut env, &mut pilot, Some(1)).unwrap();
            assert!(summary.success, "{kind} with {action_type}: {summary:?}");
        }
    }
    // the duties of a speed, and the speed of the duties
    let mut env =
        MultiHover::builder().drone(airframe_with_battery(0.25)).action_type(ActionType::Duty).build().unwrap();
    env.reset(Some(1)).unwrap();
    let speeds = [[9000.0, 14_000.0, 15_500.0, 2000.0], [14_000.0; 4]];
    let mut action = vec![0.0; 8];
    for _ in 0..3 {
        env.action_of_motor_speeds(&speeds, &mut action).unwrap();
        assert!(action.iter().all(|duty| (0.0..1.0).contains(duty)));
        env.step(&action).unwrap();
        let close = |(a, b): (&f64, &f64)| (a - b).abs() < 1e-8;
        let flown = env.simulation().motor_speeds().as_flattened();
        assert!(flown.iter().zip(speeds.as_flattened()).all(close), "{flown:?}");
    }
}

#[test]
fn the_decoder_takes_the_voltage_of_the_charged_battery_by_default() {
    let params = airframe_with_battery(0.25);
    let (limits, state) = (ActionLimits::default(), DroneState::default());
    let mut decoder = ActionDecoder::new(ActionType::Duty, ControllerKind::Pid, &params, &limits).unwrap();
    assert!(!decoder.has_memory());
    let duties = [0.0, 0.25, 0.5, 1.0];
    let [full, low] =
        [params.nominal_voltage(), 3.0].map(|voltage| duties.map(|duty| params.motors.speed(duty, voltage)));
    assert_eq!(decoder.motor_speeds(0.02, &state, &duties), full);
    assert_eq!(decoder.motor_speeds_at(3.0, 0.02, &state, &duties), low);
    assert!((params.nominal_voltage() - 4.103).abs() < 1e-3 && low[3] < full[3]);
}

#[test]
fn agents_command_duties() {
    let builder = || {
        let task = MultiHover::multi_agent();
        AviaryBuilder::new(task).num_drones(3).drone(airframe_with_battery(0.002)).action_type(ActionType::Duty)
    };
    assert_contract(|| builder().build().unwrap());
    let mut env = ParallelAviary::new(builder().build().unwrap());
    env.reset(Some(1)).unwrap();
    let agents: Vec<_> = env.agents().to_vec();
    for _ in 0..20 {
        let actions: AgentMap<Vec<f64>> = agents.iter().map(|agent| (agent.clone(), vec![0.63; 4])).collect();
        env.step(&actions).unwrap();
    }
    let charges: Vec<_> = (0..3).map(|drone| env.simulation().battery(drone).unwrap().charge).collect();
    assert!(charges.iter().all(|charge| (0.0..0.99).contains(charge)), "{charges:?}");
}

#[test]
fn snapshots_and_files_keep_the_battery() {
    let builder = || {
        Hover::builder()
            .drone(airframe_with_battery(0.002))
            .action_type(ActionType::Duty)
            .initial_positions([[0.0, 0.0, 2.0]])
            .engine(EngineKind::Hybrid)
    };
    let fly = |env: &mut Aviary<Hover>, from: u32, steps: u32| {
        let mut rows = Vec::new();
        for step in from..from + steps {
            let duty = 0.62 + 0.02 * f64::from(step).sin();
            env.step(&[duty, duty + 0.001, duty, duty - 0.001]).unwrap();
            rows.push((env.simulation().states()[0], env.simulation().battery(0)));
        }
        rows
    };
    let mut env = builder().build().unwrap();
    env.reset(Some(3)).unwrap();
    fly(&mut env, 0, 30);
    let (snapshot, data) = (env.snapshot(), env.simulation().snapshot());
    let expected = fly(&mut env, 30, 20);
    env.restore(&snapshot).unwrap();
    assert_eq!(fly(&mut env, 30, 20), expected);
    let text = serde_json::to_string(&snapshot).unwrap();
    let mut other = builder().build().unwrap();
    other.restore(&serde_json::from_str(&text).unwrap()).unwrap();
    assert_eq!(fly(&mut other, 30, 20), expected);

    // damaged files
    let text = serde_json::to_string(&data).unwrap();
    let charge = data_battery(&text);
    for (from, to) in [
        (format!("\"charge\":{charge}"), "\"charge\":1.5".to_string()),
        (format!("\"charge\":{charge}"), "\"charge\":-0.1".to_string()),
    ] {
        let error = serde_json::from_str::<SimData>(&text.replace(&from, &to)).unwrap_err().to_string();
        assert!(error.contains("a battery is") && error.contains("expected a charge from 0 to 1"), "{error}");
    }
    let begin = text.find("\"batteries\":").unwrap();
    let end = begin + text[begin..].find("],").unwrap() + 2;
    let without = format!("{}{}", &text[..begin], &text[end..]);
    let error = serde_json::from_str::<SimData>(&without).unwrap_err().to_string();
    assert!(error.contains("`batteries` has 0 entries, expected 1"), "{error}");
    // airframes without a battery are written as before, and have no other number of entries
    let plain = Simulation::builder(DroneModel::Cf2x).build().unwrap();
    let plain = serde_json::to_string(&plain.snapshot()).unwrap();
    assert!(!plain.contains("batter"));
    let entry = &text[begin + "\"batteries\":[".len()..end - 2];
    let twice = plain.replacen('{', &format!("{{\"batteries\":[{entry},{entry}],"), 1);
    let error = serde_json::from_str::<SimData>(&twice).unwrap_err().to_string();
    assert!(error.contains("`batteries` has 2 entries, expected 1"), "{error}");
}

/// Returns the text of the charge in serialized data.
fn data_battery(text: &str) -> String {
    let (_, rest) = text.split_once("\"batteries\":[{\"charge\":").unwrap();
    rest.split_once(',').unwrap().0.to_string()
}

#[test]
fn sampled_charges_are_the_charges_at_the_start_and_leave_other_samples_alone() {
    let config = |battery| {
        let randomization = Randomization { battery, ..Randomization::default() };
        MultiHover::builder().num_drones(3).drone(airframe_with_battery(0.25)).randomization(randomization)
    };
    let ranges = BatteryRanges { charge: [0.2, 0.6] };
    let mut sampled = config(Some(ranges)).build().unwrap();
    let mut plain = config(None).build().unwrap();
    let mut seen = Vec::new();
    for seed in 0..10 {
        sampled.reset(Some(seed)).unwrap();
        plain.reset(Some(seed)).unwrap();
        let (with, without) = (sampled.sampled_params().unwrap().clone(), plain.sampled_params().unwrap());
        for (drone, (with, without)) in with.drones.iter().zip(&without.drones).enumerate() {
            let charge = with.charge.unwrap();
            assert_eq!(sampled.simulation().battery(drone).unwrap().charge, f64::from(charge));
            assert_eq!((plain.simulation().battery(drone).unwrap().charge, without.charge), (1.0, None));
            assert_eq!((with.mass, with.actuators, with.initial), (without.mass, without.actuators, without.initial));
            assert!((0.2..=0.6).contains(&charge));
            seen.push(charge);
        }
    }
    seen.sort_by(f32::total_cmp);
    seen.dedup();
    assert!(seen.len() == 30 && seen[0] < 0.25 && seen[29] > 0.55, "{seen:?}");
    // without the randomization the battery is full again
    sampled.set_randomization(None).unwrap();
    sampled.reset(Some(1)).unwrap();
    assert_eq!(sampled.simulation().battery(1).unwrap().charge, 1.0);
}

#[test]
fn a_battery_can_be_added_to_a_drone_in_flight() {
    let mut simulation = Simulation::builder(airframe_with_duty()).num_drones(2).build().unwrap();
    assert!(simulation.battery(1).is_none() && simulation.voltage(1) == 3.7);
    let mut data = simulation.snapshot();
    data.set_params(1, airframe_with_battery(0.25)).unwrap();
    simulation.restore(&data).unwrap();
    assert_eq!((simulation.battery(0), simulation.battery(1).unwrap().charge), (None, 1.0));
    simulation.step(&[[14_000.0; 4]; 2]).unwrap();
    assert!(simulation.battery(1).unwrap().charge < 1.0 && simulation.battery(0).is_none());
    // an invalid airframe changes nothing
    let kept = simulation.battery(1);
    let mut data = simulation.snapshot();
    assert!(data.set_params(1, DroneParams { mass: -1.0, ..airframe_with_battery(0.1) }).is_err());
    simulation.restore(&data).unwrap();
    assert_eq!(simulation.battery(1), kept);
}

#[test]
fn metrics_have_the_weakest_battery() {
    let mut env = MultiHover::builder().drone(airframe_with_battery(0.25)).build().unwrap();
    env.reset(Some(1)).unwrap();
    env.step(&[0.0, 0.0, 0.0, 0.0, 0.3, 0.3, 0.3, 0.3]).unwrap();
    let second = env.simulation().battery(1).unwrap();
    let map = env.info_map();
    let numbers = ["battery_charge", "battery_voltage", "battery_current"].map(|name| map[name]);
    assert_eq!(numbers, [second.charge, second.voltage, second.current]);
    assert!(!Hover::builder().build().unwrap().info_map().contains_key("battery_charge"));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]

    /// Over any flight the charge decreases by ∫ I dt, in every engine, for several drones, odd rates and slow motors.
    #[test]
    fn the_charge_decreases_by_the_integral_of_the_current(
        engine in prop::sample::select(&ENGINES[..]), drones in 1..4_usize,
        (sim, ctrl) in prop::sample::select(&[(240, 48), (240, 240), (300, 100), (500, 20)][..]),
        lag in 0.0..0.08, latency in 0.0..0.03, duties in prop::collection::vec(0.2..1.0, 4..40), yaw in -3.0..3.0,
    ) {
        let params = airframe_with_battery(0.02);
        let actuators = ActuatorParams { lag, latency, ..ActuatorParams::default() };
        let mut simulation = Simulation::builder(params.clone())
            .num_drones(drones)
            .initial_positions((0..drones).map(|i| [i as f64, 0.5, 30.0]))
            .initial_rpys((0..drones).map(|_| [0.3, -0.2, yaw]))
            .initial_angular_velocities((0..drones).map(|i| [3.0, i as f64, -2.0]))
            .engine(engine)
            .actuators(actuators)
            .sim_freq(sim)
            .ctrl_freq(ctrl)
            .build()
            .unwrap();
        let mut drawn = vec![0.0; drones];
        for (step, &duty) in duties.iter().enumerate() {
            let commands: Vec<_> = (0..drones)
                .map(|drone| [0.0, 0.1, 0.2, 0.3].map(|more| {
                    params.motors.speed(f64::min(duty + more + 0.05 * drone as f64, 1.0), simulation.voltage(drone))
                }))
                .collect();
            simulation.step(&commands).unwrap();
            for (drone, drawn) in drawn.iter_mut().enumerate() {
                let battery = simulation.battery(drone).unwrap();
                *drawn += battery.current / f64::from(ctrl);
                let charge = 1.0 - *drawn / (3600.0 * 0.02);
                prop_assert!((battery.charge - charge.max(0.0)).abs() < 1e-12, "step {step}");
                prop_assert!(battery.voltage > 0.0 && battery.voltage < 4.2 && battery.current > 0.0);
                // the speeds stay within reach
                let reach = params.motors.speed(1.0, 4.11);
                prop_assert!(simulation.rotor_speeds(drone).iter().all(|rpm| (0.0..=reach).contains(rpm)));
            }
        }
        prop_assert!(simulation.states().iter().all(|state| Vector3::from(state.position).norm() < 1e3));
    }

    #[test]
    fn engines_agree_with_a_battery(duties in prop::collection::vec(prop::array::uniform4(0.55..0.7), 30)) {
        let fly = |engine| {
            let builder = Simulation::builder(airframe_with_battery(0.002)).engine(engine);
            let mut simulation = builder.initial_positions([[0.0, 0.0, 3.0]]).build().unwrap();
            for duties in &duties {
                let voltage = simulation.voltage(0);
                let motors = simulation.params(0).motors;
                simulation.step(&[duties.map(|duty| motors.speed(duty, voltage))]).unwrap();
            }
            (simulation.states()[0], simulation.battery(0).unwrap())
        };
        let (mujoco, hybrid) = (fly(EngineKind::Mujoco), fly(EngineKind::Hybrid));
        prop_assert!((mujoco.0.position - hybrid.0.position).norm() < 1e-11);
        prop_assert_eq!(mujoco.1, hybrid.1);
    }
}
