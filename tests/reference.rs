//! Reference flights: an independent implementation of the paper's equations on another version of MuJoCo.
//!
//! "The paper" is *MuJoCo-Drones-Gym* (Tayal).

use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::{Scenario, read_actions};
use mujoco_drones_gym::state::wxyz;

fn path(name: &str) -> String {
    format!("{}/tests/reference/{name}", env!("CARGO_MANIFEST_DIR"))
}

/// Returns the contents of the first TOML block of a Markdown text that contains `word`.
fn toml_block<'a>(markdown: &'a str, word: &str) -> &'a str {
    let mut blocks = markdown.split("```toml").skip(1).filter_map(|rest| rest.split("```").next());
    blocks.find(|block| block.contains(word)).expect("a TOML block with the word")
}

/// Flies a scenario and returns the largest absolute difference between any number of the state and its expected value.
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
    assert!(actions.len() >= 24, "the flight takes at least 0.5 s");

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
fn reference_flights_agree_in_position_attitude_velocity_and_angular_velocity() {
    for name in ["mjc_cf2x", "mjc_gnd_race", "mjc_dw_close", "dyn_cf2p", "body_fixed_cf2x"] {
        let explicit = name.starts_with("dyn");
        let engines = if explicit { &[EngineKind::Explicit][..] } else { &EngineKind::WITH_CONTACTS[..] };
        for &engine in engines {
            let worst = worst_difference(name, engine);
            assert!(worst < 1e-8, "{name}, {engine}: largest difference {worst:e}");
        }
    }
}

/// The comparison detects a wrong mode: the same flight without ground effect differs.
#[test]
fn a_flight_without_ground_effect_differs_from_its_reference() {
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

#[test]
fn the_airframe_in_the_guide_hovers() {
    let text = toml_block(include_str!("../docs/airframes.md"), "thrust_coefficient");
    let params = DroneParams::from_toml(text).unwrap();
    let mut env = Hover::builder().drone(params).build().unwrap();
    let mut pilot = ControllerPolicy::new(ControllerKind::Pid, &env);
    assert!(fly_episode(&mut env, &mut pilot, None).unwrap().success);
}

#[test]
fn the_conditions_of_the_guide_are_valid() {
    let text = toml_block(include_str!("../docs/conditions.md"), "[wind]");
    let conditions = mujoco_drones_gym::env::Conditions::from_toml(text).unwrap();
    let env = make("hover", EnvConfig::default().conditions(&conditions)).unwrap();
    assert_eq!(env.simulation().obstacles().len(), 15);
    assert!(conditions.randomization.unwrap().sensors.is_some());
}
