//! Randomization figure of the *MuJoCo-Drones-Gym* paper (Tayal): five episodes with sampled parameters under the
//! same controller.
//!
//! `cargo run --release --example randomization -- [DIRECTORY] [SECONDS]` writes `randomization.png` (front view of the
//! five trails) and `randomization.svg`, and prints the sampled parameters. Defaults: directory `out/randomization`,
//! 6 s.

use mujoco_drones_gym::env::Randomization;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::images::png_rgb;
use mujoco_drones_gym::record::plot::{Plot, Series};
use mujoco_drones_gym::vision::SceneRenderer;

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/randomization".into()));
    let seconds: f64 = arguments.next().map_or(Ok(6.0), |text| text.parse())?;
    std::fs::create_dir_all(&directory)?;
    let colours = [[0.0, 0.45, 0.7], [0.84, 0.37, 0.0], [0.0, 0.62, 0.45], [0.8, 0.47, 0.65], [0.34, 0.71, 0.91]];

    let config = Hover::builder().initial_positions([[0.0, 0.0, 0.5]]).episode_seconds(seconds);
    let mut env = config.randomization(Randomization::default()).build()?;
    let size = ImageSize { width: 800, height: 600 };
    let mut renderer = SceneRenderer::for_people(&env.simulation().scene())?;
    let (mut heights, mut offsets, mut trails) = (vec![], vec![], vec![]);
    println!(
        "{:>5}{:>8}{:>8}{:>10}{:>9}{:>13}{:>8}{:>11}",
        "seed", "mass", "thrust", "lag (ms)", "latency", "wind (m/s)", "end", "error"
    );
    let mut pilot = ControllerPolicy::new(ControllerKind::Dsl, &env);
    for seed in 0..5 {
        let (mut z, mut y, mut trail) = (vec![], vec![], vec![]);
        Rollout::start(&mut env, &mut pilot, Some(seed))?.finish(|env| {
            let position = env.simulation().states()[0].position;
            trail.push(position);
            z.push((env.info().time, position.z));
            y.push((env.info().time, position.y));
        })?;
        let name = format!("seed {seed}");
        heights.push(Series { name: name.clone(), points: z });
        offsets.push(Series { name, points: y });
        trails.push(trail);
        let (info, Some(sampled)) = (env.info(), env.sampled_params()) else { continue };
        let (drone, end) = (&sampled.drones[0], info.end.map_or("", |end| end.name()));
        let wind = sampled.wind.map_or(0.0, |wind| nalgebra::Vector3::from(wind.velocity).norm());
        let (lag, latency) = (1e3 * drone.actuators.lag, 1e3 * drone.actuators.latency);
        let (mass, thrust, error) = (drone.mass, drone.thrust, 100.0 * info.position_error);
        println!("{seed:>5}{mass:>8.2}{thrust:>8.2}{lag:>10.0}{latency:>6.0} ms{wind:>13.2}{end:>12}{error:>8.1} cm");
    }
    renderer.set_stage([0.0, 0.0, 0.8], -0.1);
    renderer.update(env.simulation().states())?;
    for (trail, [r, g, b]) in trails.iter().zip(colours) {
        renderer.add_line(trail, 0.004, [r, g, b, 1.0]);
    }
    let mut rgb = vec![0; 3 * size.pixels()];
    renderer.rgb(View::Front, size, &mut rgb)?;
    let plot = Plot::time_series("Hover with sampled parameters", &[("z (m)", heights), ("y (m)", offsets)])?;
    plot.save(directory.join("randomization.svg"))?;
    std::fs::write(directory.join("randomization.png"), png_rgb(size, &rgb)?)?;
    for name in ["randomization.svg", "randomization.png"] {
        println!("{}", directory.join(name).display());
    }
    Ok(())
}
