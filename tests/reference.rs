//! Flights of an independent implementation of the paper's equations over another MuJoCo, flown again.

use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::{Scenario, read_actions};
use mujoco_drones_gym::state::wxyz;

fn path(name: &str) -> String {
    format!("{}/tests/reference/{name}", env!("CARGO_MANIFEST_DIR"))
}

/// Flies a scenario and gives the largest difference of any number of the state from what is expected.
fn worst_difference(name: &str, engine: EngineKind) -> f64 {
    let text = std::fs::read_to_string(path(&format!("{name}.toml"))).unwrap();
    let mut scenario = Scenario::from_toml(&text).unwrap();
    scenario.engine = Some(engine);
    let mut simulation = scenario.simulation().unwrap();
    let actions = std::fs::File::open(path(&format!("{name}.actions.csv"))).unwrap();
    let actions = read_actions(actions, scenario.num_drones).unwrap();
    let mut reader = csv::Reader::from_path(path(&format!("{name}.expected.csv"))).unwrap();
    let expected: Vec<Vec<f64>> =
        reader.records().map(|row| row.unwrap().iter().map(|x| x.parse().unwrap()).collect()).collect();
    assert_eq!(expected.len(), actions.len() * scenario.num_drones);
    assert!(actions.len() >= 24, "a flight of at least half a second");

    let mut worst: f64 = 0.0;
    for (action, expected) in actions.iter().zip(expected.chunks(scenario.num_drones)) {
        simulation.step(action).unwrap();
        for (drone, (state, expected)) in simulation.states().iter().zip(expected).enumerate() {
            assert_eq!((simulation.time(), drone as f64), (expected[0], expected[1]));
            let numbers = (state.position.iter().chain(&wxyz(&state.attitude)).copied())
                .chain(state.velocity.iter().copied())
                .chain(state.angular_velocity.iter().copied())
                .collect::<Vec<_>>();
            for (got, wanted) in numbers.iter().zip(&expected[2..]) {
                worst = worst.max((got - wanted).abs());
            }
        }
    }
    worst
}

#[test]
fn every_reference_flight_agrees_in_position_attitude_velocity_and_rate() {
    for name in ["mjc_cf2x", "mjc_gnd_race", "mjc_dw_close", "dyn_cf2p", "body_fixed_cf2x"] {
        let explicit = name.starts_with("dyn");
        let engines = if explicit { &[EngineKind::Explicit][..] } else { &EngineKind::WITH_CONTACTS[..] };
        for &engine in engines {
            let worst = worst_difference(name, engine);
            assert!(worst < 1e-8, "{name}, {engine}: largest difference {worst:e}");
        }
    }
}

/// The comparison can fail: the same flight under another mode does not agree.
#[test]
fn another_mode_is_another_flight() {
    let text = std::fs::read_to_string(path("mjc_gnd_race.toml")).unwrap();
    let scenario = Scenario::from_toml(&text.replace("mjc_gnd", "mjc")).unwrap();
    let with = Scenario::from_toml(&text).unwrap();
    let (mut without, mut with) = (scenario.simulation().unwrap(), with.simulation().unwrap());
    let hover = DroneModel::Race.params().hover_rpm();
    for _ in 0..48 {
        without.step(&[[hover; 4]]).unwrap();
        with.step(&[[hover; 4]]).unwrap();
    }
    assert!(with.states()[0].position.z > without.states()[0].position.z + 1e-3);
}

/// The airframe in the documentation is one.
#[test]
fn the_airframe_of_the_guide_flies() {
    let readme = include_str!("../docs/airframes.md");
    let mut blocks = readme.split("```toml").skip(1).filter_map(|rest| rest.split("```").next());
    let text = blocks.find(|block| block.contains("thrust_coefficient")).expect("an airframe");
    let params = DroneParams::from_toml(text).unwrap();
    let mut env = Hover::builder().drone(params.clone()).build().unwrap();
    env.reset(None).unwrap();
    let mut pid = PidControl::new(&params);
    let mut action = [0.0; 4];
    while env.info().end.is_none() {
        let rpm = pid.control(1.0 / 48.0, &env.simulation().states()[0], &env.reference(0)).rpm;
        env.action_of_motor_speeds(&[rpm], &mut action).unwrap();
        env.step(&action).unwrap();
    }
    assert!(env.info().success);
}

/// So are its conditions.
#[test]
fn the_conditions_of_the_readme_are_read() {
    let readme = include_str!("../README.md");
    let mut blocks = readme.split("```toml").skip(1).filter_map(|rest| rest.split("```").next());
    let text = blocks.find(|block| block.contains("[wind]")).expect("conditions");
    let conditions = mujoco_drones_gym::env::Conditions::from_toml(text).unwrap();
    let env = make("hover", EnvConfig::default().conditions(&conditions)).unwrap();
    assert_eq!(env.simulation().obstacles().len(), 15);
    assert!(conditions.randomization.unwrap().sensors.is_some());
}
