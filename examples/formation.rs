//! Formation figure of the *MuJoCo-Drones-Gym* paper (Tayal): drones on a circle with a moving centre, with the path
//! of each drone.
//!
//! `cargo run --release --example formation -- [DIRECTORY] [SECONDS] [DRONES]` writes `formation.png`, `flight.svg` and
//! `path.svg`. Defaults: directory `out/formation`, 30 s, three drones.

use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::Flight;
use mujoco_drones_gym::record::images::png_rgb;
use mujoco_drones_gym::record::plot::{Plot, colour_of};
use mujoco_drones_gym::vision::SceneRenderer;

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/formation".into()));
    let seconds: f64 = arguments.next().map_or(Ok(30.0), |text| text.parse())?;
    let drones: usize = arguments.next().map_or(Ok(3), |text| text.parse())?;
    std::fs::create_dir_all(&directory)?;

    let mut env = Formation::builder().num_drones(drones).episode_seconds(seconds).build()?;
    let mut pilot = ControllerPolicy::new(ControllerKind::Geometric, &env);
    let mut flight = Flight::default();
    let mut worst = 0.0_f64;
    let mut rollout = Rollout::start(&mut env, &mut pilot, Some(1))?;
    flight.note(rollout.env());
    rollout.finish(|env| {
        flight.note(env);
        // the drones need the first seconds to reach their places
        if env.info().time > 5.0 {
            worst = worst.max(env.info().position_error);
        }
    })?;
    let size = ImageSize { width: 800, height: 600 };
    let mut rgb = vec![0; 3 * size.pixels()];
    let mut renderer = SceneRenderer::for_people(&env.simulation().scene())?;
    renderer.update(env.simulation().states())?;
    for drone in 0..drones {
        renderer.add_thread(&flight.positions(drone), 4.0, colour_of(drone, drones));
    }
    renderer.rgb(View::Track, size, &mut rgb)?;
    std::fs::write(directory.join("formation.png"), png_rgb(size, &rgb)?)?;
    Plot::of_flight("Formation", &flight)?.save(directory.join("flight.svg"))?;
    Plot::of_paths("Formation", &flight)?.save(directory.join("path.svg"))?;
    for name in ["formation.png", "flight.svg", "path.svg"] {
        println!("{}", directory.join(name).display());
    }
    println!("largest position error after 5 s: {:.2} cm", 100.0 * worst);
    Ok(())
}
