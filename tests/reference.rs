//! Flights of an independent implementation of the paper's equations over another MuJoCo, flown again.

use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::state::wxyz;
use nalgebra::Vector3;

fn rows(name: &str) -> Vec<Vec<f64>> {
    let path = format!("{}/tests/reference/{name}", env!("CARGO_MANIFEST_DIR"));
    let mut reader = csv::Reader::from_path(path).unwrap();
    reader.records().map(|row| row.unwrap().iter().map(|x| x.parse().unwrap()).collect()).collect()
}

#[test]
fn open_loop_flight_of_the_crazyflie_agrees() {
    let mut simulation = Simulation::builder(DroneModel::Cf2x).build().unwrap();
    let start = DroneState::at_rest(Vector3::new(0.2, -0.1, 60.0), Vector3::new(0.1, -0.2, 0.7));
    simulation.reset_to(&[start]).unwrap();
    let (actions, expected) = (rows("mjc_cf2x.actions.csv"), rows("mjc_cf2x.expected.csv"));
    assert_eq!((actions.len(), expected.len()), (144, 144));
    let mut worst: f64 = 0.0;
    for (action, expected) in actions.iter().zip(&expected) {
        simulation.step(&[[action[0], action[1], action[2], action[3]]]).unwrap();
        let state = simulation.states()[0];
        assert_eq!(simulation.time(), expected[0]);
        let numbers = (state.position.iter().chain(&wxyz(&state.attitude)).copied())
            .chain(state.velocity.iter().copied())
            .chain(state.angular_velocity.iter().copied())
            .collect::<Vec<_>>();
        for (got, wanted) in numbers.iter().zip(&expected[2..]) {
            worst = worst.max((got - wanted).abs());
        }
    }
    assert!(worst < 1e-8, "largest difference {worst:e}");
}
