//! Simulations of several drones: independence, contacts, errors.

use mujoco_drones_gym::drone::GRAVITY;
use mujoco_drones_gym::engine::{Contact, Touched};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::world::Forcing;
use nalgebra::Vector3;
use proptest::prelude::*;

#[test]
fn separate_drones_fly_as_in_separate_simulations() {
    let airframes = [DroneModel::Cf2x, DroneModel::Race, DroneModel::Cf2p];
    let start = |i: usize| {
        let i = i as f64;
        DroneState {
            velocity: Vector3::new(0.3 * i, -0.2, 0.5),
            angular_velocity: Vector3::new(1.0 + i, -2.0, 0.5),
            ..DroneState::at_rest(Vector3::new(3.0 * i, -i, 20.0), Vector3::new(0.2, -0.3 * i, 1.0 + i))
        }
    };
    let command = |model: DroneModel, k: usize| {
        let hover = model.params().hover_rpm();
        let wave = 0.02 * (k as f64 * 0.3).sin();
        [hover * (1.0 + wave), hover, hover * (1.0 - wave), hover * 1.01]
    };
    for forcing in [Forcing::Frozen, Forcing::BodyFixed] {
        let mut together = Simulation::builder(DroneModel::Cf2x)
            .drones(airframes.map(DroneModel::params))
            .forcing(forcing)
            .build()
            .unwrap();
        together.reset_to(&[start(0), start(1), start(2)]).unwrap();
        let mut alone: Vec<_> =
            airframes.iter().map(|&model| Simulation::builder(model).forcing(forcing).build().unwrap()).collect();
        for (i, simulation) in alone.iter_mut().enumerate() {
            simulation.reset_to(&[start(i)]).unwrap();
        }
        for k in 0..96 {
            together.step(&airframes.map(|model| command(model, k))).unwrap();
            for (i, simulation) in alone.iter_mut().enumerate() {
                simulation.step(&[command(airframes[i], k)]).unwrap();
                let offset = together.states()[i].position - simulation.states()[0].position;
                assert!(offset.norm() < 1e-12, "position error of drone {i} is {} m after {k} steps", offset.norm());
                assert!(together.states()[i].attitude.angle_to(&simulation.states()[0].attitude) < 1e-7);
            }
        }
    }
}

#[test]
fn free_fall_matches_its_closed_form() {
    let mut simulation = Simulation::builder(DroneModel::Race).sim_freq(500).ctrl_freq(50).build().unwrap();
    let start = DroneState {
        velocity: Vector3::new(1.0, -2.0, 3.0),
        ..DroneState::at_rest(Vector3::new(1.0, 2.0, 90.0), Vector3::new(0.4, 0.3, -2.0))
    };
    simulation.reset_to(&[start]).unwrap();
    for _ in 0..100 {
        simulation.step(&[[0.0; 4]]).unwrap();
        let t = simulation.time();
        let expected = start.position + start.velocity * t - Vector3::new(0.0, 0.0, 0.5 * GRAVITY * t * t);
        assert!(simulation.distance(0, &expected) < 1e-11);
    }
}

#[test]
fn each_contact_is_reported_once_per_step() {
    // drone 1 lands on drone 0; drone 2 stays clear of both
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .num_drones(3)
        .initial_positions([[0.0, 0.0, 0.02], [0.0, 0.0, 0.06], [1.0, 0.0, 5.0]])
        .build()
        .unwrap();
    let mut contacts = Vec::new();
    for _ in 0..24 {
        simulation.step(&[[0.0; 4]; 3]).unwrap();
        let mut now = simulation.contacts().to_vec();
        now.sort();
        let length = now.len();
        now.dedup();
        assert_eq!(now.len(), length, "a contact is reported twice");
        contacts = now;
    }
    let contact = |drone, with| Contact { drone, with };
    assert_eq!(contacts, [contact(0, Touched::Floor), contact(0, Touched::Drone(1)), contact(1, Touched::Drone(0))],);
    simulation.reset().unwrap();
    assert!(simulation.contacts().is_empty());
    simulation.engine().contacts(|contact| panic!("{contact:?} after a reset"));
}

#[test]
fn a_hundred_drones_on_the_floor_keep_all_their_contacts() {
    use mujoco_drones_gym::mujoco::WarningKind;
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .num_drones(100)
        .initial_positions((0..100).map(|i| [0.3 * f64::from(i % 10), 0.3 * f64::from(i / 10), 0.02]))
        .build()
        .unwrap();
    for _ in 0..12 {
        simulation.step(&[[0.0; 4]; 100]).unwrap();
    }
    assert_eq!(simulation.contacts().len(), 100);
    for kind in [WarningKind::ContactFull, WarningKind::ConstraintFull] {
        assert_eq!(simulation.mujoco().unwrap().warning(kind).count, 0);
    }
}

#[test]
fn invalid_numbers_of_drones_are_errors() {
    for count in [0, 257, usize::MAX] {
        let text = Simulation::builder(DroneModel::Cf2x).num_drones(count).build().unwrap_err().to_string();
        assert!(text.contains("expected 1 to 256"), "{text}");
    }
}

#[test]
fn invalid_commands_are_errors_with_drone_motor_and_time() {
    let mut simulation = Simulation::builder(DroneModel::Cf2x).num_drones(2).build().unwrap();
    simulation.step(&[[14_000.0; 4]; 2]).unwrap();
    let before = simulation.states().to_vec();
    let error = simulation.step(&[[0.0; 4], [0.0, 0.0, 0.0, f64::NAN]]).unwrap_err();
    assert!(matches!(error, SimulationError::Command { drone: 1, motor: 3, .. }));
    assert!(error.to_string().contains("motor 3 of drone 1 is NaN at t = 0.0208"), "{error}");
    assert!(simulation.step(&[[0.0; 4]; 3]).unwrap_err().to_string().contains("3 entries"));
    assert_eq!(simulation.states(), before);
    assert!(simulation.reset_to(&before[..1]).is_err());
    let nowhere = DroneState { velocity: Vector3::new(0.0, f64::NAN, 0.0), ..before[0] };
    assert_eq!(simulation.reset_to(&[before[0], nowhere]).unwrap_err(), SimulationError::State { drone: 1 });
    assert_eq!(simulation.states(), before);
}

#[test]
fn divergence_is_an_error_with_drone_and_time_and_keeps_the_last_state() {
    let mut simulation = Simulation::builder(DroneModel::Cf2x).num_drones(2).build().unwrap();
    let fast = DroneState { velocity: Vector3::new(9.9e9, 0.0, 0.0), ..simulation.states()[1] };
    let calm = simulation.states()[0];
    simulation.reset_to(&[calm, DroneState { position: Vector3::new(9.9e9, 0.0, 5.0), ..fast }]).unwrap();
    let error =
        (0..48).find_map(|_| simulation.step(&[[0.0; 4]; 2]).err()).expect("the position leaves its valid range");
    assert!(matches!(error, SimulationError::Diverged { drone: 1, quantity: "position", .. }), "{error}");
    let last = simulation.states()[1].position.x;
    assert!(last > 9.9e9 && last < 1e10, "the last valid state is kept: {last}");
    assert_eq!(simulation.step(&[[0.0; 4]; 2]).unwrap_err(), error, "the error persists until a reset");
    simulation.reset().unwrap();
    simulation.step(&[[0.0; 4]; 2]).unwrap();
    assert!(simulation.states()[0].position.z > 0.05);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    /// Any motor commands leave a finite state and a unit quaternion.
    #[test]
    fn states_stay_finite_under_any_commands(
        commands in prop::collection::vec(prop::array::uniform4(-1e9..1e9), 1..60),
    ) {
        let mut simulation = Simulation::builder(DroneModel::Race).build().unwrap();
        for command in commands {
            simulation.step(&[command]).unwrap();
            let state = simulation.states()[0];
            prop_assert!(state.is_finite());
            prop_assert!((state.attitude.coords.norm() - 1.0).abs() < 1e-9);
        }
    }
}

/// Every step with more contacts than the capacity of the scene fails, and so does every later step until a reset.
#[test]
fn contacts_beyond_the_capacity_are_an_error_of_the_step() {
    let heap = |count: usize| {
        let place = move |i: usize| [1e-3 * i as f64, 0.0, 1.0];
        Simulation::builder(DroneModel::Cf2x)
            .num_drones(count)
            .initial_positions((0..count).map(place))
            .build()
            .unwrap()
    };
    let mut few = heap(8);
    few.step(&[[0.0; 4]; 8]).unwrap();
    assert_eq!(few.contacts().len(), 8 * 7, "both drones of each pair report the contact");
    let mut many = heap(40);
    let error = many.step(&[[0.0; 4]; 40]).unwrap_err();
    assert!(error.to_string().contains("more than 320 contacts, the capacity of the scene"), "{error}");
    assert_eq!(many.step(&[[0.0; 4]; 40]), Err(error));
    let apart: Vec<_> =
        (0..40).map(|i| DroneState::at_rest(Vector3::new(f64::from(i), 0.0, 1.0), Vector3::zeros())).collect();
    many.reset_to(&apart).unwrap();
    many.step(&[[0.0; 4]; 40]).unwrap();
}
