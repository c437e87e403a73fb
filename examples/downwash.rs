//! Downwash figure of the *MuJoCo-Drones-Gym* paper (Tayal): a Crazyflie flies over another one, whose thrust rises
//! in the wake.
//!
//! `cargo run --release --example downwash -- [DIRECTORY] [SECONDS]` writes `downwash.svg` and `downwash.png`.
//! Defaults: directory `out/downwash`, 10 s.

use mujoco_drones_gym::control::PidGains;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::images::png_rgb;
use mujoco_drones_gym::record::plot::{Plot, Series};
use mujoco_drones_gym::vision::SceneRenderer;
use nalgebra::Vector3;

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/downwash".into()));
    let seconds: f64 = arguments.next().map_or(Ok(10.0), |text| text.parse())?;
    std::fs::create_dir_all(&directory)?;

    let (low, high) = (Vector3::new(0.0, 0.0, 0.6), Vector3::new(0.0, 0.0, 1.6));
    let start = Vector3::new(-0.6, 0.0, 1.6);
    let params = DroneModel::Cf2x.params();
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .num_drones(2)
        .physics(Physics::MjcGndDragDw)
        .initial_positions([low.into(), start.into()])
        .build()?;
    // with the paper's gains, the constant force of the wake leads to errors of metres
    let mut gains = PidGains::paper(&params);
    gains.position.proportional = Vector3::new(3.0, 3.0, 12.0);
    gains.position.integral = Vector3::new(0.5, 0.5, 6.0);
    gains.position.derivative = Vector3::new(3.0, 3.0, 6.0);
    let mut pilots = [(); 2].map(|()| PidControl::with_gains(&params, gains));
    let (mut heights, mut thrusts) = ([vec![], vec![]], [vec![], vec![]]);
    let dt = simulation.control_period();
    let size = ImageSize { width: 640, height: 480 };
    let mut rgb = vec![0; 3 * size.pixels()];
    let mut renderer = SceneRenderer::for_people(&simulation.scene())?;
    while simulation.time() < seconds {
        // the upper drone moves over the lower one from 2 s to 4 s
        let t = simulation.time();
        let share = ((t - 2.0) / 2.0).clamp(0.0, 1.0);
        let references = [low, start + (high - start) * share].map(|at| Reference::hover(at, 0.0));
        let commands: Vec<_> = (0..2)
            .map(|drone| pilots[drone].control(dt, &simulation.states()[drone], &references[drone]).rpm)
            .collect();
        simulation.step(&commands)?;
        for drone in 0..2 {
            heights[drone].push((simulation.time(), simulation.states()[drone].position.z));
            let share = simulation.loads()[drone].rotors.thrust / params.weight();
            thrusts[drone].push((simulation.time(), share));
        }
    }
    renderer.update(simulation.states())?;
    renderer.rgb(View::Track, size, &mut rgb)?;
    let names = ["lower drone", "upper drone"];
    let lines = |points: [Vec<(f64, f64)>; 2]| {
        names.iter().zip(points).map(|(name, points)| Series { name: name.to_string(), points }).collect::<Vec<_>>()
    };
    let (first, last) = (thrusts[0][0].1, thrusts[0][thrusts[0].len() - 1].1);
    let panels = [("height (m)", lines(heights)), ("thrust / weight", lines(thrusts))];
    Plot::time_series("Downwash", &panels)?.save(directory.join("downwash.svg"))?;
    std::fs::write(directory.join("downwash.png"), png_rgb(size, &rgb)?)?;
    for name in ["downwash.svg", "downwash.png"] {
        println!("{}", directory.join(name).display());
    }
    println!("thrust of the lower drone over its weight: {first:.3} at the start, {last:.3} at the end");
    Ok(())
}
