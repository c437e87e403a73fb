//! The paper's three PID demos: a hover with the plain PID, a square of waypoints with the DSL-PID, and three drones at
//! staggered heights under ground effect, drag and downwash.
//!
//! `cargo run --release --example pid -- [DIRECTORY] [SECONDS]` writes a CSV log and a plot for each, and a picture of the
//! three drones (by default to `out/pid`, 16 s).

use std::fs::File;
use std::path::Path;

use mujoco_drones_gym::control::ControllerKind;
use mujoco_drones_gym::control::trajectory::{Steps, Trajectory};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::CsvLog;
use mujoco_drones_gym::record::picture::png_rgb;
use mujoco_drones_gym::record::plot::{Series, time_series};
use mujoco_drones_gym::vision::Painter;

/// Flies every drone along its own way and gives the simulation at the end.
#[allow(clippy::print_stdout)]
fn fly(to: &Path, physics: Physics, kind: ControllerKind, ways: &[Steps], seconds: f64) -> anyhow::Result<Simulation> {
    let name = to.file_name().unwrap_or_default().to_string_lossy();
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .physics(physics)
        .num_drones(ways.len())
        .initial_positions(ways.iter().map(|way| way.start().position.into()))
        .build()?;
    let mut controllers: Vec<_> = (0..ways.len()).map(|drone| kind.build(simulation.params(drone))).collect();
    let mut log = CsvLog::new(File::create(to.with_extension("csv"))?)?;
    let dt = simulation.control_period();
    let mut lines = [vec![], vec![], vec![]];
    lines.iter_mut().for_each(|panel| panel.resize_with(ways.len(), Vec::new));
    while simulation.time() < seconds - 0.5 * dt {
        log.record(&simulation)?;
        let (t, states) = (simulation.time(), simulation.states());
        let commands: Vec<_> = controllers
            .iter_mut()
            .zip(states.iter().zip(ways))
            .map(|(controller, (state, way))| controller.control(dt, state, &way.reference(t)).rpm)
            .collect();
        for (drone, state) in states.iter().enumerate() {
            lines.iter_mut().zip(&state.position).for_each(|(panel, &x)| panel[drone].push((t, x)));
        }
        simulation.step(&commands)?;
    }
    log.finish()?;
    let series = |(drone, points)| Series { name: format!("drone {drone}"), points };
    let panels = ["x (m)", "y (m)", "z (m)"].into_iter().zip(lines);
    let panels: Vec<_> =
        panels.map(|(label, lines)| (label, lines.into_iter().enumerate().map(series).collect())).collect();
    std::fs::write(to.with_extension("svg"), time_series(&name, &panels)?)?;
    let errors = ways.iter().enumerate().map(|(i, way)| simulation.distance(i, &way.reference(seconds).position));
    println!("{}.csv and .svg: largest error at the end {:.2} cm", to.display(), 100.0 * errors.fold(0.0, f64::max));
    Ok(simulation)
}

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/pid".into()));
    let seconds: f64 = arguments.next().map_or(Ok(16.0), |text| text.parse())?;
    std::fs::create_dir_all(&directory)?;

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
    let (mut painter, mut picture) = (Painter::for_people(three.world())?, vec![0; 3 * size.pixels()]);
    painter.update(three.states())?;
    painter.rgb(View::Track, size, &mut picture)?;
    std::fs::write(directory.join("swarm.png"), png_rgb(size, &picture)?)?;
    println!("{}", directory.join("swarm.png").display());
    Ok(())
}
