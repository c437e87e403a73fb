//! Antipodal figure of the *MuJoCo-Drones-Gym* paper (Tayal): twelve drones on a circle swap places behind a
//! collision-cone safety filter.
//!
//! `cargo run --release --example antipodal -- [DIRECTORY] [SECONDS]` writes `antipodal.png`: six top views with safety
//! rings and goals. Defaults: directory `out/antipodal`, last view after 7.5 s.

use mujoco_drones_gym::control::CollisionCone;
use mujoco_drones_gym::mujoco::Quality;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::images::png_rgb;
use mujoco_drones_gym::tasks::Antipodal;
use mujoco_drones_gym::vision::{SceneRenderer, VisualEffects};
use mujoco_drones_gym::wrappers::SafetyWrapper;
use nalgebra::Vector3;

/// Width and height of a view, pixels.
const SIDE: u32 = 400;

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/antipodal".into()));
    let seconds: f64 = arguments.next().map_or(Ok(7.5), |text| text.parse())?;
    std::fs::create_dir_all(&directory)?;

    let task = Antipodal::builder().action_type(ActionType::Vel).controller(ControllerKind::Geometric);
    let env = SafetyWrapper::new(task.build()?, CollisionCone::new(0.36))?;
    // the reference velocities point slightly to the right of the goals, which breaks the symmetry
    let pilot = ControllerPolicy::new(ControllerKind::Geometric, &env);
    let mut rollout = Rollout::start(env, pilot, Some(1))?;
    // the default effects have no shadows and reflections, which would clutter the views
    let mut renderer =
        SceneRenderer::new(&rollout.env().simulation().scene(), Quality::PRETTY, VisualEffects::default())?;
    renderer.set_stage([0.0, 0.0, 1.0], 1.3);
    let (tile, sheet) = (ImageSize { width: SIDE, height: SIDE }, ImageSize { width: 3 * SIDE, height: 2 * SIDE });
    let (mut rgb, mut sheet_rgb) = (vec![0; 3 * tile.pixels()], vec![0; 3 * sheet.pixels()]);
    let colour = |drone: usize| {
        let wave = |shift: f32| 0.55 + 0.45 * (std::f32::consts::TAU * (drone as f32 / 12.0 + shift)).cos();
        [wave(0.0), wave(0.33), wave(0.66), 1.0]
    };
    for shot in 0..6 {
        while rollout.env().simulation().time() < seconds * shot as f64 / 5.0 {
            rollout.step()?;
        }
        let env = rollout.env();
        renderer.update(env.simulation().states())?;
        for drone in 0..12 {
            let (here, goal) = (env.simulation().states()[drone].position, env.reference(drone).position);
            renderer.add_ring(here, Vector3::z(), 0.15, 0.024, colour(drone));
            renderer.add_dots(&[goal], 0.04, colour(drone));
        }
        renderer.rgb(View::Top, tile, &mut rgb)?;
        for (row, line) in rgb.chunks_exact(3 * SIDE as usize).enumerate() {
            let start = 3 * ((shot / 3 * SIDE as usize + row) * sheet.width as usize + shot % 3 * SIDE as usize);
            let line = if row < 3 { &[255; 3 * SIDE as usize][..] } else { line };
            sheet_rgb[start..][..line.len()].copy_from_slice(line);
            sheet_rgb[start..][..9].fill(255);
        }
    }
    let path = directory.join("antipodal.png");
    std::fs::write(&path, png_rgb(sheet, &sheet_rgb)?)?;
    println!("{}", path.display());
    println!("success: {}", rollout.summary().success);
    println!("minimum distance: {:.3} m (safety radius 0.3 m)", rollout.env().inner().task().minimum_distance());
    Ok(())
}
