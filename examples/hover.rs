//! First figure of the *MuJoCo-Drones-Gym* paper (Tayal): a Crazyflie under the paper's PID takes off and hovers at
//! 1 m, in the track view.
//!
//! `cargo run --release --example hover -- [DIRECTORY] [SECONDS]` writes `hover.gif`, `hover.png`, the flight as
//! `drone0.csv` and its plots `flight.png` and `path.png`. Defaults: directory `out/hover`, 10 s.

use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::animation::{Animation, GifAnimation};
use mujoco_drones_gym::record::images::png_rgb;
use mujoco_drones_gym::record::plot::Plot;
use mujoco_drones_gym::record::{Flight, FrameRecorder, Overlays, Recorder};

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/hover".into()));
    let seconds: f64 = arguments.next().map_or(Ok(10.0), |text| text.parse())?;

    let mut env = Hover::builder().episode_seconds(seconds).build()?;
    let mut pilot = ControllerPolicy::new(ControllerKind::Pid, &env);
    let mut rollout = Rollout::start(&mut env, &mut pilot, Some(1))?;
    let mut recorder = Recorder::create(&directory, 1)?;
    let size = ImageSize { width: 320, height: 240 };
    let mut frames = FrameRecorder::new(rollout.env(), View::Track, size, Overlays::default())?;
    let mut gif =
        GifAnimation::new(std::fs::File::create(directory.join("hover.gif"))?, size, frames.seconds_per_frame())?;
    loop {
        recorder.record(rollout.env())?;
        if let Some(rgb) = frames.look(rollout.env())? {
            gif.frame(rgb)?;
        }
        if rollout.is_over() {
            break;
        }
        rollout.step()?;
    }
    gif.finish()?;

    let size = ImageSize { width: 640, height: 480 };
    let mut rgb = vec![0; 3 * size.pixels()];
    env.render(View::Track, size, &mut rgb)?;
    std::fs::write(directory.join("hover.png"), png_rgb(size, &rgb)?)?;
    // recorded flights are plotted from their files
    let flight = Flight::read(&directory)?;
    Plot::of_flight("Hover", &flight)?.save(directory.join("flight.png"))?;
    Plot::of_paths("Hover", &flight)?.save(directory.join("path.png"))?;
    for name in ["hover.gif", "hover.png", "drone0.csv", "flight.png", "path.png"] {
        println!("{}", directory.join(name).display());
    }
    println!("{:.2} cm position error after {seconds} s", 100.0 * env.info().position_error);
    Ok(())
}
