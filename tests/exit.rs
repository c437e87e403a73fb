//! Exit of programs after a batch has rendered on its threads.

use mujoco_drones_gym::mujoco::gl_info;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::vector::VecImages;

#[path = "../mujoco-rs/tests/exit/mod.rs"]
mod exit;

/// Creates a batch and renders its cameras on four threads.
fn batch() -> VecAviary<Hover> {
    let size = ImageSize { width: 16, height: 12 };
    let builder = Hover::builder().observation_type(ObservationType::KIN_RGB).camera_size(size);
    let mut env = VecAviary::new(builder, VecConfig { threads: 4, ..VecConfig::new(32) }).unwrap();
    let mut buffers = VecBuffers::new(&env);
    env.reset(Some(1), &mut buffers.observations).unwrap();
    let mut rgb = vec![0; env.num_envs() * 4 * size.pixels()];
    env.render_images(VecImages { rgb: &mut rgb, ..VecImages::default() }).unwrap();
    assert!(rgb.iter().any(|&value| value > 0 && value < 255));
    env
}

const PROGRAMS: [(&str, fn()); 2] = [("batch", || drop(batch())), ("leaked batch", || std::mem::forget(batch()))];

fn backend() -> Option<String> {
    gl_info().ok().map(|info| info.backend.to_string())
}

/// Regression test: 9 of 130 runs ended in a double free, because threads of the batch exited while the exit handler of
/// libEGL freed their data.
///
/// `EXIT_RUNS=500 cargo test --test exit` takes half an hour.
fn main() {
    exit::main("a_program_exits_successfully_after_a_batch_has_rendered", backend, &PROGRAMS, 2);
}
