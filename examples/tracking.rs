//! Tracking errors of every controller on every airframe: prints the table of `docs/control.md`.
//!
//! `cargo run --release --example tracking`

use mujoco_drones_gym::control::ControllerKind;
use mujoco_drones_gym::control::trajectory::{PeriodicTrajectory, Plane, Steps, Trajectory, named};
use mujoco_drones_gym::prelude::*;

/// Flies a trajectory and returns the mean, peak and final position error, m.
fn fly(model: DroneModel, kind: ControllerKind, path: &dyn Trajectory, seconds: f64) -> anyhow::Result<[f64; 3]> {
    let mut simulation = Simulation::builder(model).initial_positions([path.start().position.into()]).build()?;
    let mut controller = kind.build(simulation.params(0));
    let dt = simulation.control_period();
    let (mut sum, mut peak, mut last) = (0.0, 0.0_f64, 0.0);
    while simulation.time() < seconds - 0.5 * dt {
        let output = controller.control(dt, &simulation.states()[0], &path.reference(simulation.time()));
        simulation.step(&[output.rpm])?;
        last = simulation.distance(0, &path.reference(simulation.time()).position);
        (sum, peak) = (sum + last, peak.max(last));
        anyhow::ensure!(simulation.contacts().is_empty(), "{model} crashed with {kind}");
    }
    Ok([sum / simulation.control_steps() as f64, peak, last])
}

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    use ControllerKind::{Dsl, Geometric, Pid};
    use DroneModel::{Cf2p, Cf2x, Race};
    let hover = Steps::step([0.0, 0.0, 0.1], [0.0, 0.0, 1.0], 10.0)?;
    let square = Steps::square(1.0, 4.0)?;
    let circle = PeriodicTrajectory::circle(0.3, 8.0)?.plane(Plane::YZ);
    let eight = PeriodicTrajectory::lemniscate_at(2.0, 1.0, 3.0)?.turns(3.0)?.ramp(2.0)?;
    let over = named("loop").expect("a trajectory of that name");
    let (all, crazyflies_and_racer) = ([Pid, Dsl, Geometric], [Cf2x, Cf2p, Race]);
    println!("| trajectory | controller | airframe | mean (cm) | peak (cm) | final (cm) |");
    println!("| --- | --- | --- | --- | --- | --- |");
    let table = |name: &str, path: &dyn Trajectory, kinds: &[ControllerKind], models: &[DroneModel]| {
        for (&kind, &model) in kinds.iter().flat_map(|kind| models.iter().map(move |model| (kind, model))) {
            let [mean, peak, last] = fly(model, kind, path, path.duration())?.map(|metres| 100.0 * metres);
            println!("| {name} | {kind} | {model} | {mean:.2} | {peak:.2} | {last:.2} |");
        }
        anyhow::Ok(())
    };
    table("step from 0.1 m to 1 m", &hover, &all, &crazyflies_and_racer)?;
    table("square of 1 m, step at each corner", &square, &all, &crazyflies_and_racer)?;
    table("vertical circle, 0.3 m, 8 s", &circle, &all, &crazyflies_and_racer)?;
    table("lemniscate, 3 m/s at its centre", &eight, &[Dsl, Geometric], &crazyflies_and_racer)?;
    table("loop, upside down at its top", &*over, &[Geometric], &[Race])?;
    Ok(())
}
