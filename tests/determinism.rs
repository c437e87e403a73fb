//! Equal seeds give bit-identical flights in a used environment, after errors, and on other threads.

use mujoco_drones_gym::prelude::*;

/// Flies a fixed sequence of actions, with a tumble, a fall and contacts with the floor, and returns the bits of all
/// observations and rewards.
fn flight(env: &mut Aviary<Hover>, seed: u64, steps: usize) -> Vec<u64> {
    let mut bits: Vec<u64> = env.reset(Some(seed)).unwrap().vector.iter().map(|x| x.to_bits()).collect();
    for k in 0..steps {
        let phase = k as f64 * 0.7;
        let action = [phase.sin() * 0.4, (1.3 * phase).cos() * 0.4, -0.1, 0.2 * phase.sin() - 0.1];
        match env.step(&action) {
            Ok(step) => bits.extend(step.observation.vector.iter().chain([&step.reward]).map(|x| x.to_bits())),
            Err(EnvError::NeedsReset { .. }) => break,
            Err(error) => panic!("{error}"),
        }
    }
    bits
}

/// Creates a Hover environment that continues after contacts with the floor.
fn env() -> Aviary<Hover> {
    Hover::builder()
        .initial_positions([[0.0, 0.0, 0.8]])
        .initial_rpys([[0.2, -0.1, 2.0]])
        .task(|hover| {
            hover.crash.floor_contact = false;
            hover.crash.max_tilt = 4.0;
        })
        .build()
        .unwrap()
}

#[test]
fn a_reset_environment_is_bit_identical_to_a_new_one() {
    let fresh = flight(&mut env(), 5, 300);
    assert!(fresh.len() > 12 + 13 * 200, "the flight is too short: {} numbers", fresh.len());
    let mut used = env();
    for steps in [300, 7, 120] {
        let _ = flight(&mut used, 9, steps);
        assert_eq!(flight(&mut used, 5, 300), fresh, "after an episode of {steps} steps");
    }
}

#[test]
fn flights_are_bit_identical_on_every_thread() {
    let here = flight(&mut env(), 5, 300);
    let threads: Vec<_> = (0..3).map(|_| std::thread::spawn(|| flight(&mut env(), 5, 300))).collect();
    for thread in threads {
        assert_eq!(thread.join().unwrap(), here);
    }
}

#[test]
fn a_reset_clears_all_effects_of_an_error() {
    let commands = |k: usize| [[9_000.0 + 40.0 * k as f64, 14_000.0, 13_000.0, 15_000.0]];
    let fly = |simulation: &mut Simulation| -> Vec<DroneState> {
        simulation.reset().unwrap();
        (0..200)
            .map(|k| {
                simulation.step(&commands(k)).unwrap();
                simulation.states()[0]
            })
            .collect()
    };
    let fresh = fly(&mut Simulation::builder(DroneModel::Cf2x).build().unwrap());
    let mut used = Simulation::builder(DroneModel::Cf2x).build().unwrap();
    assert!(used.step(&[[f64::NAN; 4]]).is_err());
    let mut far = used.states()[0];
    far.position.x = 9.999e9;
    far.velocity.x = 9e9;
    used.reset_to(&[far]).unwrap();
    assert!(matches!((0..48).find_map(|k| used.step(&commands(k)).err()), Some(SimulationError::Diverged { .. })));
    assert_eq!(fly(&mut used), fresh);
}
