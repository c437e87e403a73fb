//! Every view of a Crazyflie and a racer, three drones in one scene, and depth and segmentation of an onboard camera.
//!
//! `cargo run --release --example views -- [DIRECTORY]` writes PNG files. Default: directory `out/views`.

use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::images;
use mujoco_drones_gym::vision::{ImageSize, SceneRenderer, View};

const SIZE: ImageSize = ImageSize { width: 640, height: 480 };

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let directory = std::path::PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| "out/views".into()));
    std::fs::create_dir_all(&directory)?;
    let save = |name: String, png: Vec<u8>| {
        let path = directory.join(name);
        println!("{}", path.display());
        std::fs::write(path, png)
    };
    let mut rgb = vec![0; 3 * SIZE.pixels()];

    for model in [DroneModel::Cf2x, DroneModel::Race] {
        let simulation =
            Simulation::builder(model).initial_positions([[0.0, 0.0, 1.0]]).initial_rpys([[0.05, 0.1, 0.3]]).build()?;
        let mut renderer = SceneRenderer::for_people(&simulation.scene())?;
        renderer.update(simulation.states())?;
        for view in View::ALL {
            renderer.rgb(view, SIZE, &mut rgb)?;
            save(format!("{model}_{view}.png"), images::png_rgb(SIZE, &rgb)?)?;
        }
    }

    let three = Simulation::builder(DroneModel::Cf2x)
        .drones([DroneModel::Cf2x, DroneModel::Cf2p, DroneModel::Race].map(DroneModel::params))
        .initial_positions([[0.0, 0.0, 0.8], [0.35, 0.12, 0.86], [0.8, -0.2, 0.78]])
        .build()?;
    let mut renderer = SceneRenderer::for_people(&three.scene())?;
    renderer.update(three.states())?;
    renderer.rgb(View::Track, SIZE, &mut rgb)?;
    save("three_track.png".into(), images::png_rgb(SIZE, &rgb)?)?;

    let mut renderer = SceneRenderer::for_observations(&three.scene())?;
    renderer.update(three.states())?;
    renderer.rgb(View::Fpv, SIZE, &mut rgb)?;
    save("three_fpv.png".into(), images::png_rgb(SIZE, &rgb)?)?;
    let mut depth = vec![0.0; SIZE.pixels()];
    renderer.depth(View::Fpv, SIZE, &mut depth)?;
    save("three_fpv_depth.png".into(), images::png_rgb(SIZE, &images::depth_in_colour(&depth, 100.0))?)?;
    let mut objects = vec![[0; 2]; SIZE.pixels()];
    renderer.segmentation(View::Fpv, SIZE, &mut objects)?;
    save("three_fpv_segmentation.png".into(), images::png_rgb(SIZE, &images::segmentation_in_colour(&objects))?)?;
    Ok(())
}
