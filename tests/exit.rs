//! Programs that end after a batch has drawn on its threads.

use mujoco_drones_gym::mujoco::gl_info;
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::vector::VecPictures;

#[path = "../mujoco-rs/tests/exit/mod.rs"]
mod exit;

/// A batch that has drawn on four threads.
fn batch() -> VecAviary<Hover> {
    let size = ImageSize { width: 16, height: 12 };
    let builder = Hover::builder().observation_type(ObservationType::KIN_RGB).camera_size(size);
    let mut env = VecAviary::new(builder, VecConfig { threads: 4, ..VecConfig::new(32) }).unwrap();
    let mut buffers = VecBuffers::new(&env);
    env.reset(Some(1), &mut buffers.observations).unwrap();
    let mut rgb = vec![0; env.num_envs() * 4 * size.pixels()];
    env.pictures(VecPictures { rgb: &mut rgb, ..VecPictures::default() }).unwrap();
    assert!(rgb.iter().any(|&value| value > 0 && value < 255));
    env
}

const PROGRAMS: [(&str, fn()); 2] = [("batch", || drop(batch())), ("batch that is kept", || std::mem::forget(batch()))];

fn backend() -> Option<String> {
    gl_info().ok().map(|info| info.backend.to_string())
}

/// It was a double free in 9 of 130 runs: threads of the batch ended while libEGL's exit handler freed what they had.
///
/// `EXIT_RUNS=500 cargo test --test exit` takes half an hour.
fn main() {
    exit::main("a_program_ends_well_after_a_batch_has_drawn", backend, &PROGRAMS, 2);
}
