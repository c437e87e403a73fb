//! Obstacle figure of the *MuJoCo-Drones-Gym* paper (Tayal): forest, urban, indoor, random and gate obstacles from a
//! seed.
//!
//! `cargo run --release --example obstacles -- [DIRECTORY] [SEED]` writes one PNG file per kind. Defaults: directory
//! `out/obstacles`, seed 3.

use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::images::png_rgb;
use mujoco_drones_gym::vision::SceneRenderer;
use mujoco_drones_gym::world::{ObstacleConfig, ObstacleKind};

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/obstacles".into()));
    let seed: u64 = arguments.next().map_or(Ok(3), |text| text.parse())?;
    std::fs::create_dir_all(&directory)?;
    let size = ImageSize { width: 640, height: 480 };
    let mut rgb = vec![0; 3 * size.pixels()];
    for (kind, count) in [
        (ObstacleKind::Forest, 25),
        (ObstacleKind::Urban, 12),
        (ObstacleKind::Indoor, 8),
        (ObstacleKind::Random, 20),
        (ObstacleKind::Gates, 5),
    ] {
        // low walls let the camera look into the room
        let height = if kind == ObstacleKind::Indoor { 0.8 } else { 1.6 };
        let field = ObstacleConfig { count, seed: Some(seed), arena: [3.5, 3.5, height], ..ObstacleConfig::new(kind) };
        let mut env = Hover::builder().initial_positions([[0.0, 0.0, 0.5]]).obstacle_generator(field).build()?;
        env.reset(Some(seed))?;
        let mut renderer = SceneRenderer::for_people(&env.simulation().scene())?;
        renderer.set_stage([0.0, 0.0, 0.4], 1.1);
        renderer.update(env.simulation().states())?;
        renderer.rgb(View::Fixed, size, &mut rgb)?;
        let path = directory.join(format!("{}.png", kind.name()));
        std::fs::write(&path, png_rgb(size, &rgb)?)?;
        let nearest = env.simulation().obstacle_distance(0);
        println!("{}: {} geoms, the nearest {nearest:.2} m away", path.display(), env.simulation().obstacles().len());
    }
    Ok(())
}
