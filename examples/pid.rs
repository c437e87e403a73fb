//! Three PID demos of the *MuJoCo-Drones-Gym* paper (Tayal): a hover with the PID, a square of waypoints with the
//! DSL-PID, and three drones at staggered heights with ground effect, drag and downwash.
//!
//! `cargo run --release --example pid -- [DIRECTORY] [SECONDS]` writes a directory per flight with CSV logs and plots
//! (`flight.svg`, `path.svg`), and an image of the three drones. Defaults: directory `out/pid`, 16 s.

use std::path::Path;

use mujoco_drones_gym::control::ControllerKind;
use mujoco_drones_gym::control::trajectory::{Steps, Trajectory};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::images::png_rgb;
use mujoco_drones_gym::record::plot::Plot;
use mujoco_drones_gym::record::{Flight, Recorder};
use mujoco_drones_gym::vision::SceneRenderer;

/// Flies each drone along its path, records and plots the flight, and returns the simulation at the end.
#[allow(clippy::print_stdout)]
fn fly(to: &Path, physics: Physics, kind: ControllerKind, paths: &[Steps], seconds: f64) -> anyhow::Result<Simulation> {
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .physics(physics)
        .num_drones(paths.len())
        .initial_positions(paths.iter().map(|path| path.start().position.into()))
        .build()?;
    let mut controllers: Vec<_> = (0..paths.len()).map(|drone| kind.build(simulation.params(drone))).collect();
    let mut recorder = Recorder::create(to, paths.len())?;
    let dt = simulation.control_period();
    loop {
        let t = simulation.time();
        // a simulation without a task has no reward
        recorder.record_with(&simulation, |drone| (0.0, Some(paths[drone].reference(t))))?;
        if t > seconds - 0.5 * dt {
            break;
        }
        let drones = controllers.iter_mut().zip(simulation.states().iter().zip(paths));
        let commands: Vec<_> =
            drones.map(|(controller, (state, path))| controller.control(dt, state, &path.reference(t)).rpm).collect();
        simulation.step(&commands)?;
    }
    let flight = Flight::read(to)?;
    let name = to.file_name().unwrap_or_default().to_string_lossy();
    Plot::of_flight(&name, &flight)?.save(to.join("flight.svg"))?;
    Plot::of_paths(&name, &flight)?.save(to.join("path.svg"))?;
    let errors = paths.iter().enumerate().map(|(i, path)| simulation.distance(i, &path.reference(seconds).position));
    println!("{}: largest position error at the end {:.2} cm", to.display(), 100.0 * errors.fold(0.0, f64::max));
    Ok(simulation)
}

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/pid".into()));
    let seconds: f64 = arguments.next().map_or(Ok(16.0), |text| text.parse())?;

    let hover = Steps::step([0.0, 0.0, 0.1], [0.0, 0.0, 1.0], seconds)?;
    fly(&directory.join("hover"), Physics::Mjc, ControllerKind::Pid, &[hover], seconds)?;
    fly(&directory.join("square"), Physics::Mjc, ControllerKind::Dsl, &[Steps::square(1.0, 4.0)?], seconds)?;
    let swarm = [0.0, 1.0, 2.0].map(|i| {
        let x = 0.3 * i;
        Steps::step([x, 0.0, 0.1 + x], [x, 0.0, 0.7 + x], seconds)
    });
    let swarm = swarm.into_iter().collect::<Result<Vec<_>, _>>()?;
    let three = fly(&directory.join("swarm"), Physics::MjcGndDragDw, ControllerKind::Pid, &swarm, seconds)?;

    let size = ImageSize { width: 640, height: 480 };
    let (mut renderer, mut rgb) = (SceneRenderer::for_people(&three.scene())?, vec![0; 3 * size.pixels()]);
    renderer.update(three.states())?;
    renderer.rgb(View::Track, size, &mut rgb)?;
    std::fs::write(directory.join("swarm.png"), png_rgb(size, &rgb)?)?;
    println!("{}", directory.join("swarm.png").display());
    Ok(())
}
