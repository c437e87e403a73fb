//! Vertical circle of the *MuJoCo-Drones-Gym* paper (Tayal): 0.3 m and 8 s in the YZ plane, flown by the SE(3)
//! controller from rest on the circle.
//!
//! `cargo run --release --example vertical_circle -- [DIRECTORY] [SECONDS]` writes `vertical_circle.png`, a front view
//! with the planned circle as white dots and the path in cyan. Defaults: directory `out/vertical_circle`, 8 s.

use mujoco_drones_gym::control::GeometricControl;
use mujoco_drones_gym::control::trajectory::{PeriodicTrajectory, Plane, Trajectory};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::images::png_rgb;
use mujoco_drones_gym::vision::SceneRenderer;

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/vertical_circle".into()));
    let seconds: f64 = arguments.next().map_or(Ok(8.0), |text| text.parse())?;
    std::fs::create_dir_all(&directory)?;

    let circle = PeriodicTrajectory::circle(0.3, 8.0)?.plane(Plane::YZ).centre([0.0, 0.0, 0.75]);
    let mut simulation =
        Simulation::builder(DroneModel::Cf2x).initial_positions([circle.start().position.into()]).build()?;
    let mut controller = GeometricControl::new(simulation.params(0));
    let dt = simulation.control_period();
    let (mut flown, mut errors) = (vec![simulation.states()[0].position], vec![]);
    while simulation.time() < seconds - 0.5 * dt {
        let output = controller.control(dt, &simulation.states()[0], &circle.reference(simulation.time()));
        simulation.step(&[output.rpm])?;
        flown.push(simulation.states()[0].position);
        errors.push(simulation.distance(0, &circle.reference(simulation.time()).position));
    }

    let size = ImageSize { width: 800, height: 600 };
    let mut rgb = vec![0; 3 * size.pixels()];
    let mut renderer = SceneRenderer::for_people(&simulation.scene())?;
    renderer.set_stage([0.0, 0.0, 0.75], 0.0);
    renderer.update(simulation.states())?;
    let planned: Vec<_> = (0..80).map(|i| circle.reference(0.1 * f64::from(i)).position).collect();
    renderer.add_dots(&planned, 0.005, [1.0, 1.0, 1.0, 1.0]);
    renderer.add_line(&flown, 0.0025, [0.0, 0.85, 0.95, 1.0]);
    renderer.rgb(View::Front, size, &mut rgb)?;
    let path = directory.join("vertical_circle.png");
    std::fs::write(&path, png_rgb(size, &rgb)?)?;
    println!("{}", path.display());
    let (mean, peak) = (errors.iter().sum::<f64>() / errors.len() as f64, errors.iter().copied().fold(0.0, f64::max));
    println!("position error: mean {:.3} cm, peak {:.3} cm", 100.0 * mean, 100.0 * peak);
    Ok(())
}
