//! After construction, stepping and resetting allocate nothing in Rust (MuJoCo itself works on buffers of its own).

use allocation_counter::measure;
use mujoco_drones_gym::prelude::*;

#[test]
fn a_step_of_the_simulation_allocates_nothing_in_the_air_and_on_the_floor() {
    for count in [1, 12] {
        let mut simulation = Simulation::builder(DroneModel::Cf2x).num_drones(count).build().unwrap();
        let commands = vec![[9_000.0; 4]; count];
        let mut touched = 0;
        let allocations = measure(|| {
            for _ in 0..200 {
                simulation.step(&commands).unwrap();
                touched += simulation.contacts().len();
            }
            simulation.reset().unwrap();
        });
        assert!(touched > 100 * count, "the floor was reached");
        assert_eq!(allocations.count_total, 0, "{count} drones");
    }
}

#[test]
fn a_step_and_a_reset_of_the_environment_allocate_nothing() {
    let mut env = Hover::builder().build().unwrap();
    let mut pid = PidControl::new(env.simulation().params(0));
    env.reset(Some(1)).unwrap();
    let allocations = measure(|| {
        let mut action = [0.0; 4];
        for _ in 0..100 {
            let rpm = pid.control(1.0 / 48.0, &env.simulation().states()[0], &env.reference(0)).rpm;
            env.action_of_motor_speeds(&[rpm], &mut action).unwrap();
            env.step(&action).unwrap();
            assert!(env.info().position_error < 1.0);
        }
        env.reset(Some(2)).unwrap();
        env.step(&action).unwrap();
    });
    assert_eq!(allocations.count_total, 0);
}
