//! The paper's three PID demos: a hover with the plain PID, a square of waypoints with the DSL-PID, and three drones at
//! staggered heights under ground effect, drag and downwash.
//!
//! `cargo run --release --example pid -- [DIRECTORY] [SECONDS]` writes, for each, a directory with the flight as CSV and its
//! plots (`flight.svg`, `path.svg`), and a picture of the three drones (by default to `out/pid`, 16 s).

use std::path::Path;

use mujoco_drones_gym::control::ControllerKind;
use mujoco_drones_gym::control::trajectory::{Steps, Trajectory};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::picture::png_rgb;
use mujoco_drones_gym::record::plot::Plot;
use mujoco_drones_gym::record::{Flight, Recorder};
use mujoco_drones_gym::vision::SceneRenderer;

/// Flies every drone along its own way and gives the simulation at the end.
#[allow(clippy::print_stdout)]
fn fly(to: &Path, physics: Physics, kind: ControllerKind, ways: &[Steps], seconds: f64) -> anyhow::Result<Simulation> {
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .physics(physics)
        .num_drones(ways.len())
        .initial_positions(ways.iter().map(|way| way.start().position.into()))
        .build()?;
    let mut controllers: Vec<_> = (0..ways.len()).map(|drone| kind.build(simulation.params(drone))).collect();
    let mut recorder = Recorder::create(to, ways.len())?;
    let dt = simulation.control_period();
    loop {
        let t = simulation.time();
        // without a task there is no reward
        recorder.record_with(&simulation, |drone| (0.0, Some(ways[drone].reference(t))))?;
        if t > seconds - 0.5 * dt {
            break;
        }
        let drones = controllers.iter_mut().zip(simulation.states().iter().zip(ways));
        let commands: Vec<_> =
            drones.map(|(controller, (state, way))| controller.control(dt, state, &way.reference(t)).rpm).collect();
        simulation.step(&commands)?;
    }
    let flight = Flight::read(to)?;
    let name = to.file_name().unwrap_or_default().to_string_lossy();
    Plot::of_flight(&name, &flight)?.save(to.join("flight.svg"))?;
    Plot::of_paths(&name, &flight)?.save(to.join("path.svg"))?;
    let errors = ways.iter().enumerate().map(|(i, way)| simulation.distance(i, &way.reference(seconds).position));
    println!("{}: largest error at the end {:.2} cm", to.display(), 100.0 * errors.fold(0.0, f64::max));
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
    let (mut renderer, mut picture) = (SceneRenderer::for_people(&three.scene())?, vec![0; 3 * size.pixels()]);
    renderer.update(three.states())?;
    renderer.rgb(View::Track, size, &mut picture)?;
    std::fs::write(directory.join("swarm.png"), png_rgb(size, &picture)?)?;
    println!("{}", directory.join("swarm.png").display());
    Ok(())
}
