//! Programs whose `main` returns while threads that have rendered still run, or end at the same time.

use std::sync::mpsc;

use mujoco_rs::{Camera, Data, ImageSize, Model, Quality, Renderer, Scene, gl_info};

#[path = "exit/mod.rs"]
mod exit;

const THREADS: usize = 16;

/// Starts threads that are never joined, and returns when each has rendered. Then they end, or with `endless` keep
/// rendering.
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
    // a failed thread sends nothing, so that the channel ends early
    drop(done);
    assert_eq!(all_done.iter().take(THREADS).count(), THREADS, "threads that have drawn");
    // keep the receiver for the threads that continue to send
    std::mem::forget(all_done);
}

const PROGRAMS: [(&str, fn()); 2] =
    [("threads that end", || draw_on_threads(false)), ("threads that draw", || draw_on_threads(true))];

fn backend() -> Option<String> {
    gl_info().ok().map(|info| info.backend.to_string())
}

/// Regression: double free in libEGL's exit handler, or crash of the driver under a rendering thread.
///
/// `EXIT_RUNS=500 cargo test -p mujoco-rs --test exit` takes half an hour.
fn main() {
    exit::main("a_program_exits_cleanly_while_unjoined_threads_have_rendered", backend, &PROGRAMS, 3);
}
