//! Frames per second of onboard cameras and of MuJoCo's stock settings, in one run on one machine and one backend.
//!
//! `cargo bench --bench render`. "Stock" is the scene of the package of the *MuJoCo-Drones-Gym* paper (Tayal) with
//! MuJoCo's default settings: a reflecting floor of 200 × 200 rectangles, a 2048² shadow map, sky, four samples per
//! pixel and a buffer of 640 × 480. If `MJ_DRONES_CF2_ASSETS` is a directory with MuJoCo Menagerie's meshes, stock
//! renders those; otherwise it renders the lighter meshes of this project.

#![allow(clippy::print_stdout)]

use std::fmt::Write as _;
use std::process::Command;
use std::sync::Barrier;
use std::time::Instant;

use mujoco_drones_gym::mujoco::{Assets, Camera, CameraId, Data, Model, Quality, Renderer, Scene, VisualEffects};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::vision::{ImageSize, SceneRenderer};

const SMALL: ImageSize = ImageSize { width: 64, height: 48 };
const LARGE: ImageSize = ImageSize { width: 640, height: 480 };

/// Scene of the paper's package with MuJoCo's default settings.
struct Stock {
    data: Data,
    scene: Scene,
    renderer: Renderer,
    camera: Camera,
}

impl Stock {
    fn new(meshes: &str) -> Self {
        let mut assets = Assets::new();
        let (mut list, mut geoms) = (String::new(), String::new());
        for index in 0..7 {
            let path = format!("{meshes}/cf2_{index}.obj");
            assets.insert(
                format!("cf2_{index}.obj"),
                std::fs::read(&path).unwrap_or_else(|error| panic!("{path}: {error}")),
            );
            let _ = write!(list, "<mesh file='cf2_{index}.obj'/>");
            let _ = write!(geoms, "<geom type='mesh' mesh='cf2_{index}' group='2' contype='0' conaffinity='0'/>");
        }
        let xml = format!(
            "<mujoco><asset>{list}
               <texture type='skybox' builtin='gradient' rgb1='.3 .5 .7' rgb2='0 0 0' width='512' height='3072'/>
               <texture type='2d' name='grid' builtin='checker' rgb1='.2 .3 .4' rgb2='.1 .2 .3' width='300' height='300'/>
               <material name='grid' texture='grid' texuniform='true' texrepeat='5 5' reflectance='.2'/></asset>
             <worldbody><light pos='0 0 3' dir='0 0 -1' directional='true'/>
               <geom name='floor' type='plane' size='10 10 0.05' material='grid'/>
               <body name='cf2' pos='0 0 1'><freejoint/><inertial pos='0 0 0' mass='.027' diaginertia='2e-5 2e-5 3e-5'/>
                 {geoms}<camera name='eye' pos='.02 0 0' xyaxes='0 -1 0 0 0 1' fovy='60'/></body></worldbody></mujoco>"
        );
        let mut data = Data::new(Model::from_xml_with_assets(&xml, &assets).expect("a model")).expect("a simulation");
        data.kinematics().expect("kinematics");
        let model = data.shared_model();
        let camera = Camera::Fixed(model.find::<CameraId>("eye").expect("a camera"));
        let mut scene = Scene::new(model.clone(), 0).expect("a scene");
        scene.set_effects(VisualEffects { haze: false, ..VisualEffects::pretty() });
        let mut renderer = Renderer::new(model, Quality { samples: 4, shadow_map: 2048 }).expect("a renderer");
        // a large frame first: the buffer keeps its size for small frames
        scene.update(&mut data, &camera).expect("an update");
        renderer.rgb(&mut scene, LARGE, &mut vec![0; 3 * LARGE.pixels()]).expect("an image");
        Self { data, scene, renderer, camera }
    }

    fn frame(&mut self, size: ImageSize, rgb: &mut [u8]) {
        self.data.kinematics().expect("kinematics");
        self.scene.update(&mut self.data, &self.camera).expect("an update");
        self.renderer.rgb(&mut self.scene, size, rgb).expect("an image");
    }
}

/// Returns the frames per second in a measurement of at least `seconds`.
fn rate(seconds: f64, mut frame: impl FnMut()) -> f64 {
    for _ in 0..3 {
        frame();
    }
    let start = Instant::now();
    let mut frames = 0;
    while start.elapsed().as_secs_f64() < seconds {
        frame();
        frames += 1;
    }
    f64::from(frames) / start.elapsed().as_secs_f64()
}

/// Onboard camera of an agent. Every frame includes an update of the scene.
struct Onboard {
    simulation: Simulation,
    renderer: SceneRenderer,
}

impl Onboard {
    fn new() -> Self {
        Self::among(1)
    }

    /// Creates the camera of the first of `count` drones; the others are in front of it.
    fn among(count: usize) -> Self {
        let simulation = Simulation::builder(DroneModel::Cf2x)
            .num_drones(count)
            .initial_positions((0..count).map(|i| match i {
                0 => [0.0, 0.0, 1.0],
                _ => [0.3 * i as f64, 0.1 * ((i % 3) as f64 - 1.0), 1.0],
            }))
            .build()
            .expect("a simulation");
        let renderer = SceneRenderer::for_observations(&simulation.scene()).expect("a renderer");
        Self { simulation, renderer }
    }

    fn rgb(&mut self, size: ImageSize, rgba: &mut [u8]) {
        self.renderer.update(self.simulation.states()).expect("an update");
        self.renderer.onboard_rgba(0, size, rgba).expect("an image");
    }
}

/// Returns the total frames per second of `count` threads with a renderer each.
fn threads(count: usize, seconds: f64) -> f64 {
    let barrier = Barrier::new(count);
    std::thread::scope(|scope| {
        let workers: Vec<_> = (0..count)
            .map(|_| {
                scope.spawn(|| {
                    let mut onboard = Onboard::new();
                    let mut rgba = vec![0; 4 * SMALL.pixels()];
                    barrier.wait();
                    rate(seconds, || onboard.rgb(SMALL, &mut rgba))
                })
            })
            .collect();
        workers.into_iter().map(|worker| worker.join().expect("a worker")).sum()
    })
}

fn main() {
    const STOCK: &str = "RENDER_BENCH_STOCK";
    let meshes = std::env::var("MJ_DRONES_CF2_ASSETS").ok().filter(|path| !path.is_empty());
    let own = concat!(env!("CARGO_MANIFEST_DIR"), "/assets/cf2").to_string();
    if std::env::var_os(STOCK).is_some() {
        let mut stock = Stock::new(&meshes.unwrap_or(own));
        let (mut small, mut large) = (vec![0; 3 * SMALL.pixels()], vec![0; 3 * LARGE.pixels()]);
        println!("{} {}", rate(3.0, || stock.frame(SMALL, &mut small)), rate(3.0, || stock.frame(LARGE, &mut large)));
        return;
    }

    // each stock run is a child process, because the software rasteriser reads its number of threads at startup
    let stock = |threads: Option<&str>| {
        let mut command = Command::new(std::env::current_exe().expect("this program"));
        command.env(STOCK, "1");
        match threads {
            Some(count) => command.env("LP_NUM_THREADS", count),
            // the rasteriser's default is one thread per core
            None => {
                command.env("LP_NUM_THREADS", std::thread::available_parallelism().map_or(1, usize::from).to_string())
            }
        };
        let output = command.output().expect("the stock run");
        let text = String::from_utf8_lossy(&output.stdout);
        let rates: Vec<f64> = text.split_whitespace().filter_map(|word| word.parse().ok()).collect();
        assert!(rates.len() == 2, "{}", String::from_utf8_lossy(&output.stderr));
        (rates[0], rates[1])
    };
    println!("renderer: {:?}", mujoco_drones_gym::mujoco::gl_info().expect("OpenGL"));
    println!("stock meshes: {}", meshes.as_deref().unwrap_or("this project's"));
    let stock_own_threads = stock(None);
    let stock_one_core = stock(Some("0"));
    println!(
        "stock, default threads: {:.0} frames/s at {SMALL}, {:.0} at {LARGE}",
        stock_own_threads.0, stock_own_threads.1
    );
    println!("stock, on one core:     {:.0} frames/s at {SMALL}, {:.0} at {LARGE}", stock_one_core.0, stock_one_core.1);

    let mut onboard = Onboard::new();
    let mut small = vec![0; 4 * SMALL.pixels()];
    let mut large = vec![0; 4 * LARGE.pixels()];
    let mut depth = vec![0.0; SMALL.pixels()];
    let mut objects = vec![[0; 2]; SMALL.pixels()];
    let row = |name: &str, rate: f64, stock: f64| {
        println!("{name:<30}{rate:>8.0} frames/s  {:>6.1} × stock on one core", rate / stock)
    };
    row(&format!("RGB {SMALL}"), rate(2.0, || onboard.rgb(SMALL, &mut small)), stock_one_core.0);
    let depth_rate = rate(2.0, || {
        onboard.renderer.update(onboard.simulation.states()).expect("an update");
        onboard.renderer.onboard_depth(0, SMALL, &mut depth).expect("an image");
    });
    row(&format!("depth {SMALL}"), depth_rate, stock_one_core.0);
    let segmentation_rate = rate(2.0, || {
        onboard.renderer.update(onboard.simulation.states()).expect("an update");
        onboard.renderer.onboard_segmentation(0, SMALL, &mut objects).expect("an image");
    });
    row(&format!("segmentation {SMALL}"), segmentation_rate, stock_one_core.0);
    row(&format!("RGB {LARGE}"), rate(2.0, || onboard.rgb(LARGE, &mut large)), stock_one_core.1);
    let mut group = Onboard::among(4);
    row(&format!("RGB {SMALL}, 3 drones ahead"), rate(2.0, || group.rgb(SMALL, &mut small)), stock_one_core.0);
    drop((onboard, group));

    let mut ratios: Vec<_> = (0..5)
        .map(|_| {
            let one = threads(1, 1.0);
            threads(2, 1.0) / one
        })
        .collect();
    ratios.sort_by(f64::total_cmp);
    println!("frames of two threads over frames of one: {:.2} (median of {})", ratios[2], ratios.len());
}
