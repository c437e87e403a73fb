//! Programs whose `main` returns while threads that have drawn still run, or are about to end themselves.

use std::sync::mpsc;

use mujoco_rs::{Camera, Data, ImageSize, Model, Quality, Renderer, Scene, gl_info};

#[path = "exit/mod.rs"]
mod exit;

const THREADS: usize = 16;

/// Starts threads that nobody joins, and returns when each has drawn. Then they end, or draw for as long as the program runs.
fn draw_on_threads(endless: bool) {
    let model = Model::from_xml("<mujoco><worldbody><geom type='box' size='.5 .5 .5'/></worldbody></mujoco>").unwrap();
    let mut data = Data::new(model).unwrap();
    data.forward().unwrap();
    let (done, all_done) = mpsc::channel();
    for _ in 0..THREADS {
        let (model, done) = (data.shared_model(), done.clone());
        std::thread::spawn(move || {
            let mut data = Data::new(model).unwrap();
            data.forward().unwrap();
            let size = ImageSize { width: 16, height: 12 };
            let mut rgb = vec![0; 3 * size.pixels()];
            loop {
                let mut scene = Scene::new(data.shared_model(), 0).unwrap();
                let camera = Camera::Free { lookat: [0.0; 3], distance: 2.0, azimuth: 90.0, elevation: 0.0 };
                scene.update(&mut data, &camera).unwrap();
                let mut renderer = Renderer::new(data.shared_model(), Quality::FAST).unwrap();
                (0..4).for_each(|_| renderer.rgb(&mut scene, size, &mut rgb).unwrap());
                drop(renderer);
                done.send(()).unwrap();
                if !endless {
                    return;
                }
            }
        });
    }
    // a thread that fails sends nothing: the channel then ends early
    drop(done);
    assert_eq!(all_done.iter().take(THREADS).count(), THREADS, "threads that have drawn");
    // the sender of a thread that draws on must find its receiver
    std::mem::forget(all_done);
}

const PROGRAMS: [(&str, fn()); 2] =
    [("threads that end", || draw_on_threads(false)), ("threads that draw", || draw_on_threads(true))];

fn backend() -> Option<String> {
    gl_info().ok().map(|info| info.backend.to_string())
}

/// It was a double free in libEGL's exit handler, or a crash in the driver under a thread that draws.
///
/// `EXIT_RUNS=500 cargo test -p mujoco-rs --test exit` takes half an hour.
fn main() {
    exit::main("a_program_ends_well_after_threads_that_it_does_not_join_have_drawn", backend, &PROGRAMS, 3);
}
