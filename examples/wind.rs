//! Wind figure of the *MuJoCo-Drones-Gym* paper (Tayal): hover in combined wind of 0.9 m/s along +y with turbulence,
//! under the paper's PID and under a geometric controller with an integral term.
//!
//! `cargo run --release --example wind -- [DIRECTORY] [SECONDS]` writes `wind.png` (trail of the PID and an arrow along
//! the wind) and `wind.svg`. Defaults: directory `out/wind`, 20 s.

use mujoco_drones_gym::control::{Bandwidths, GeometricControl};
use mujoco_drones_gym::physics::wind::{WindConfig, WindModel};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::images::png_rgb;
use mujoco_drones_gym::record::plot::{Plot, Series};
use mujoco_drones_gym::vision::{Decor, SceneRenderer};
use nalgebra::Vector3;

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/wind".into()));
    let seconds: f64 = arguments.next().map_or(Ok(20.0), |text| text.parse())?;
    std::fs::create_dir_all(&directory)?;

    let wind = WindConfig::new(WindModel::Combined);
    let config = Hover::builder().initial_positions([[0.0, 0.0, 1.0]]).episode_seconds(seconds).wind(wind);
    let params = DroneModel::Cf2x.params();
    let integral = Bandwidths { integral: 0.1, ..Bandwidths::default() };
    let pid = ControllerPolicy::with_controllers([PidControl::new(&params)]);
    let geometric = ControllerPolicy::with_controllers([GeometricControl::with_bandwidths(&params, integral)]);
    let size = ImageSize { width: 800, height: 600 };
    let (mut lines, mut rgb) = (vec![], vec![0; 3 * size.pixels()]);
    for (name, pilot) in [("the paper's PID", pid), ("SE(3) with an integral term", geometric)] {
        let mut env = config.clone().build()?;
        let (mut trail, mut points) = (vec![], vec![]);
        Rollout::start(&mut env, pilot, Some(4))?.finish(|env| {
            trail.push(env.simulation().states()[0].position);
            points.push((env.info().time, env.simulation().states()[0].position.y));
        })?;
        let half = points.len() / 2;
        let drift = points[half..].iter().map(|(_, y)| y).sum::<f64>() / (points.len() - half) as f64;
        println!("{name}: {:.1} cm downwind on average over the second half", 100.0 * drift);
        lines.push(Series { name: name.to_string(), points });
        if lines.len() == 1 {
            let mut renderer = SceneRenderer::for_people(&env.simulation().scene())?;
            renderer.set_stage([0.0, 0.1, 1.0], -0.35);
            renderer.update(env.simulation().states())?;
            let dots: Vec<_> = trail.iter().step_by(8).copied().collect();
            renderer.add_dots(&dots, 0.003, [1.0, 1.0, 1.0, 1.0]);
            let (from, along) = (Vector3::new(0.0, -0.25, 1.15), Vector3::from(wind.velocity) * 0.25);
            let arrow = Decor::Arrow { from: from.into(), to: (from + along).into(), radius: 0.008 };
            renderer.add(arrow, [0.0, 0.85, 0.95, 1.0]);
            renderer.rgb(View::Front, size, &mut rgb)?;
        }
    }
    std::fs::write(directory.join("wind.png"), png_rgb(size, &rgb)?)?;
    Plot::time_series("Hover in combined wind", &[("y (m), downwind", lines)])?.save(directory.join("wind.svg"))?;
    for name in ["wind.svg", "wind.png"] {
        println!("{}", directory.join(name).display());
    }
    Ok(())
}
