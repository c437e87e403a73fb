use std::collections::HashSet;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::PathBuf;

use anyhow::{Context as _, anyhow};
use append_file::AppendFile;
use aviary::record::{STATE_COLUMNS, images, state_numbers};
use aviary::vision::{CAMERA_SIZE, ImageSize, SceneRenderer, intrinsics};
use aviary::world::World;
use clap::{Args, ValueHint};
use serde_json::{Map, Value, json};

use crate::failure::Failure;
use crate::options::{FlightOptions, vision_failure};
use crate::output::{self, OutputDir};
use crate::parse::{self, Variation, size};
use crate::pilot::Pilot;

/// Write camera observations of a flight: RGB, depth, segmentation and states
///
/// frames.csv has one row per frame and drone: the state and the names of the images. Depth
/// images are 16-bit PNG in millimetres, with 0 for no surface within 65.5 m. Segmentation
/// images are 16-bit PNG of ids, which segmentation.json maps to objects. camera.json has the
/// intrinsics and the pose of the camera in the body frame.
///
/// After the end of an episode, the next one begins with another start and another layout of
/// the obstacles; see --vary. The command replaces an earlier capture in the directory. It
/// writes each row with its images, so that a crash of the program loses no earlier frame.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary capture --task hover --frames 100 --out out/frames
  aviary capture --task hover --frames 1000 --every 4 --size 128x96 --out out/frames
  aviary capture --task fly_through --obstacles forest --frames 200 --vary layouts --out out/forest")]
pub struct Capture {
    #[command(flatten)]
    options: FlightOptions,
    /// Number of frames
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    frames: u64,
    /// Output directory
    #[arg(long, value_name = "DIR", value_hint = ValueHint::DirPath)]
    out: PathBuf,
    /// Size of the images, pixels
    #[arg(long, value_name = "WxH", value_parser = size, default_value_t = CAMERA_SIZE)]
    size: ImageSize,
    /// Control steps between frames
    #[arg(long, value_name = "N", default_value_t = 1, allow_negative_numbers = true)]
    every: u64,
    /// Variation between episodes: starts, layouts, all or none
    ///
    /// `starts` samples the initial states within ±0.2 m, ±0.1 rad and ±0.5 m/s of the task's,
    /// or within the ranges of --config; the starts of antipodal are fixed. `layouts` samples
    /// the positions of the obstacles.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "NAME",
        default_value = "all",
        value_parser = parse::variation(),
        hide_possible_values = true
    )]
    vary: Variation,
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
}

impl Capture {
    pub fn run(&self) -> Result<(), Failure> {
        for (option, value) in [("frames", self.frames), ("every", self.every)] {
            if value == 0 {
                return Err(Failure::input(anyhow!("--{option} is 0, expected at least 1")));
            }
        }
        let mut pilot = Pilot::varied(&self.options, self.vary)?;
        let scene = pilot.env().simulation().scene();
        let mut renderer = SceneRenderer::for_observations(&scene).map_err(vision_failure)?;
        let out = OutputDir::create(&self.out)?;
        self.clear(&out)?;
        // before the first image: every image on disk can be interpreted
        out.write("camera.json", &pretty(&self.camera()))?;
        out.write("segmentation.json", &pretty(&self.objects(&renderer)))?;
        let table = self.out.join("frames.csv");
        let unwritten =
            |error: std::io::Error| Failure::work(anyhow::Error::new(error).context(table.display().to_string()));
        let mut rows = AppendFile::create(&table).map_err(unwritten)?;
        let header: Vec<_> =
            (["frame", "episode"].into_iter()).chain(STATE_COLUMNS).chain(["rgb", "depth", "segmentation"]).collect();
        rows.append(format!("{}\n", header.join(",")).as_bytes()).map_err(unwritten)?;

        let pixels = self.size.pixels();
        let (mut rgba, mut depth, mut objects) = (vec![0; 4 * pixels], vec![0.0; pixels], vec![[0; 2]; pixels]);
        let mut seen = Seen::default();
        let bar = output::progress(self.frames, "capturing");
        for frame in 0..self.frames {
            let simulation = pilot.env().simulation();
            renderer.update(simulation.states()).map_err(vision_failure)?;
            for (drone, state) in simulation.states().iter().enumerate() {
                renderer.onboard_rgba(drone, self.size, &mut rgba).map_err(vision_failure)?;
                renderer.onboard_depth(drone, self.size, &mut depth).map_err(vision_failure)?;
                renderer.onboard_segmentation(drone, self.size, &mut objects).map_err(vision_failure)?;
                let rgb: Vec<u8> = rgba.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
                let files = ["rgb", "depth", "segmentation"].map(|kind| format!("{kind}/{frame:06}_{drone}.png"));
                out.write(&files[0], &images::png_rgb(self.size, &rgb).map_err(Failure::work)?)?;
                out.write(&files[1], &images::png_depth(self.size, &depth).map_err(Failure::work)?)?;
                out.write(&files[2], &images::png_segmentation(self.size, &objects).map_err(Failure::work)?)?;

                let numbers = state_numbers(state);
                seen.note(&rgb, &numbers);
                let mut row = format!("{frame},{},{},{drone}", seen.episodes, simulation.time());
                for number in numbers {
                    row += &format!(",{number}");
                }
                row += &format!(",{}\n", files.join(","));
                // after its images: a row never names a missing file
                rows.append(row.as_bytes()).map_err(unwritten)?;
            }
            bar.inc(1);
            if frame + 1 < self.frames {
                self.advance(&mut pilot, &mut renderer, &mut seen)?;
            }
        }
        bar.finish_and_clear();
        seen.end_episode();
        let images = self.frames * pilot.env().simulation().num_drones() as u64;
        if self.json {
            return output::print_json(&json!({
                "task": pilot.env().name(),
                "frames": self.frames,
                "images": images,
                "distinct_images": seen.images.len(),
                "episodes": seen.episodes,
                "distinct_episodes": seen.distinct,
                "crashes": seen.crashes,
                "width": self.size.width,
                "height": self.size.height,
                "directory": self.out,
                "seed": self.options.seed,
            }));
        }
        let of = |all: u64, distinct: u64| match all == distinct {
            true => format!("{all}, all distinct"),
            false => format!("{all}, {distinct} distinct"),
        };
        output::print(&output::table(&[
            ("frames", self.frames.to_string()),
            ("RGB images", of(images, seen.images.len() as u64)),
            ("episodes", of(seen.episodes, seen.distinct)),
            ("crashes", seen.crashes.to_string()),
            ("size", self.size.to_string()),
            ("directory", self.out.display().to_string()),
        ]))
    }

    /// Removes an earlier capture from the directory, because its tables would describe other images.
    fn clear(&self, out: &OutputDir) -> Result<(), Failure> {
        out.remove(&["frames.csv", "camera.json", "segmentation.json"])?;
        for kind in ["rgb", "depth", "segmentation"] {
            for entry in std::fs::read_dir(self.out.join(kind)).into_iter().flatten().flatten() {
                let name = entry.file_name();
                // only FRAME_DRONE.png: other files belong to the user
                let ours = name.to_str().and_then(|name| name.strip_suffix(".png")).is_some_and(|name| {
                    name.split_once('_').is_some_and(|(frame, drone)| {
                        [frame, drone]
                            .iter()
                            .all(|part| !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit()))
                    })
                });
                if ours {
                    let path = entry.path();
                    std::fs::remove_file(&path).with_context(|| path.display().to_string()).map_err(Failure::work)?;
                }
            }
        }
        Ok(())
    }

    /// Advances the flight to the next frame.
    fn advance(&self, pilot: &mut Pilot, renderer: &mut SceneRenderer, seen: &mut Seen) -> Result<(), Failure> {
        for _ in 0..self.every {
            pilot.rollout.step().map_err(Failure::work)?;
            if pilot.rollout.is_over() {
                seen.crashes += u64::from(pilot.env().info().crashed());
                seen.end_episode();
                pilot.restart().map_err(|failure| match failure {
                    Failure::Work(error) => Failure::Work(error.context("the next episode cannot begin")),
                    other => other,
                })?;
                renderer.set_obstacles(pilot.env().simulation().obstacles()).map_err(vision_failure)?;
                return Ok(());
            }
        }
        Ok(())
    }

    /// Returns the objects of the ids in segmentation images.
    fn objects(&self, renderer: &SceneRenderer) -> Value {
        let mut names = Map::new();
        names.insert("0".into(), json!({ "type": "background", "name": null, "drone": null }));
        for object in renderer.objects() {
            names.insert(
                (object.index + 1).to_string(),
                json!({ "type": "geom", "name": object.name, "drone": object.drone }),
            );
        }
        Value::Object(names)
    }

    fn camera(&self) -> Value {
        let [fx, fy, cx, cy] = intrinsics(self.size);
        json!({
            "width": self.size.width,
            "height": self.size.height,
            "fx": fx,
            "fy": fy,
            "cx": cx,
            "cy": cy,
            "fovy_degrees": World::CAMERA_FOVY,
            "near": World::CLIP_PLANES[0],
            "far": World::CLIP_PLANES[1],
            "depth_scale": 0.001,
            "depth": "distance along the optical axis, in units of depth_scale metres; 0: no surface within 65.535 m",
            // a step of the depth buffer is z^2 / near / 2^24
            "depth_resolution": "0.6 mm at 10 m, 15 mm at 50 m",
            "position_in_body": World::CAMERA_POSITION,
            // columns: right, down and forward axis of the image in the body frame
            "rotation_in_body": [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]],
            "quaternion_in_body_wxyz": [0.5, -0.5, 0.5, -0.5],
        })
    }
}

/// Counts of a capture so far.
#[derive(Default)]
struct Seen {
    /// Hashes of the RGB images.
    images: HashSet<u64>,
    /// Hashes of the prefixes of all episodes: one per image, of this image and all earlier images of the episode.
    prefixes: HashSet<u64>,
    /// Hashes of the prefixes of the current episode.
    current: Vec<u64>,
    /// Number of ended episodes.
    episodes: u64,
    /// Number of ended episodes that are not a prefix of an earlier one.
    distinct: u64,
    /// Number of episodes that ended in a crash.
    crashes: u64,
}

impl Seen {
    fn note(&mut self, rgb: &[u8], state: &[f64]) {
        let mut image = DefaultHasher::new();
        rgb.hash(&mut image);
        self.images.insert(image.finish());
        let mut prefix = DefaultHasher::new();
        (self.current.last(), image.finish()).hash(&mut prefix);
        state.iter().for_each(|x| x.to_bits().hash(&mut prefix));
        self.current.push(prefix.finish());
    }

    fn end_episode(&mut self) {
        self.episodes += 1;
        let whole = self.current.last();
        self.distinct += u64::from(whole.is_none_or(|whole| !self.prefixes.contains(whole)));
        self.prefixes.extend(self.current.drain(..));
    }
}

fn pretty(value: &Value) -> Vec<u8> {
    format!("{value:#}\n").into_bytes()
}
