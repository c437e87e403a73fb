//! A dataset for perception: colour, depth and segmentation images with poses, from a flight on a circle in a forest.
//!
//! `cargo run --release --example camera_dataset -- [DIRECTORY] [FRAMES]` writes `rgb_00000.png`, `depth_00000.png` (16
//! bit, millimetres) and `objects_00000.png` (16 bit) for each frame, `poses.csv`, and `sheet.png`, an overview of the
//! last frame. Defaults: directory `out/camera_dataset`, 24 frames. `aviary capture` writes such images for any task.

use mujoco_drones_gym::control::GeometricControl;
use mujoco_drones_gym::control::trajectory::{PeriodicTrajectory, Trajectory};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::CsvLog;
use mujoco_drones_gym::record::images::{
    depth_in_colour, png_depth, png_rgb, png_segmentation, segmentation_in_colour,
};
use mujoco_drones_gym::vision::SceneRenderer;
use mujoco_drones_gym::world::{ObstacleConfig, ObstacleKind};
use mujoco_drones_gym::{Rng, SeedableRng as _};

const SIZE: ImageSize = ImageSize { width: 240, height: 180 };

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/camera_dataset".into()));
    let frames: usize = arguments.next().map_or(Ok(24), |text| text.parse())?;
    std::fs::create_dir_all(&directory)?;

    let circle = PeriodicTrajectory::circle(0.5, 6.0)?.centre([0.0, 0.0, 0.6]);
    let start = circle.start();
    let forest = ObstacleConfig {
        count: 40,
        arena: [6.0, 6.0, 2.0],
        safe_zone: 1.2,
        ..ObstacleConfig::new(ObstacleKind::Forest)
    };
    let trees = forest.generate(&[start.position.into()], &mut Rng::seed_from_u64(5))?;
    let mut simulation = Simulation::builder(DroneModel::Cf2x)
        .initial_positions([start.position.into()])
        .initial_rpys([[0.0, 0.0, start.yaw]])
        .obstacles(trees)
        .build()?;
    let mut controller = GeometricControl::new(simulation.params(0));
    let mut renderer = SceneRenderer::for_observations(&simulation.scene())?;
    let mut poses = CsvLog::new(std::fs::File::create(directory.join("poses.csv"))?)?;
    let (mut rgb, mut depth) = (vec![0; 3 * SIZE.pixels()], vec![0.0; SIZE.pixels()]);
    let mut objects = vec![[0; 2]; SIZE.pixels()];
    let dt = simulation.control_period();
    for frame in 0..frames {
        renderer.update(simulation.states())?;
        renderer.rgb(View::Fpv, SIZE, &mut rgb)?;
        renderer.depth(View::Fpv, SIZE, &mut depth)?;
        renderer.segmentation(View::Fpv, SIZE, &mut objects)?;
        let save = |kind: &str, png: Vec<u8>| std::fs::write(directory.join(format!("{kind}_{frame:05}.png")), png);
        save("rgb", png_rgb(SIZE, &rgb)?)?;
        save("depth", png_depth(SIZE, &depth)?)?;
        save("objects", png_segmentation(SIZE, &objects)?)?;
        poses.record(&simulation)?;
        for _ in 0..12 {
            let reference = circle.reference(simulation.time());
            simulation.step(&[controller.control(dt, &simulation.states()[0], &reference).rpm])?;
        }
    }
    poses.finish()?;
    let images = [rgb, depth_in_colour(&depth, 100.0), segmentation_in_colour(&objects)];
    let row = 3 * SIZE.width as usize;
    let rows = (0..SIZE.height as usize).flat_map(|y| images.iter().flat_map(move |rgb| &rgb[y * row..(y + 1) * row]));
    let (sheet, size) = (rows.copied().collect::<Vec<_>>(), ImageSize { width: 3 * SIZE.width, ..SIZE });
    std::fs::write(directory.join("sheet.png"), png_rgb(size, &sheet)?)?;
    println!("{}: {frames} frames, poses.csv, sheet.png", directory.display());
    Ok(())
}
