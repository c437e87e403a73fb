use std::collections::HashSet;
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::PathBuf;

use anyhow::{Context as _, anyhow};
use append_file::AppendFile;
use aviary::env::EndReason;
use aviary::record::{STATE_COLUMNS, images, state_numbers};
use aviary::vision::{CAMERA_SIZE, ImageSize, SceneRenderer, intrinsics};
use aviary::world::World;
use clap::{Args, ValueHint};
use serde_json::{Map, Value, json};

use crate::failure::Failure;
use crate::options::{FlightOptions, vision_failure};
use crate::output::{self, OutputDir};
use crate::parse::{self, Shard, Variation, size};
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
  aviary capture --task fly_through --obstacles forest --frames 200 --vary layouts --out out/forest
  aviary capture --task hover --frames 1000 --shard 2/4 --out out/part2")]
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
    /// Part of the dataset that this run writes, from 1/N to N/N [default: all]
    ///
    /// The parts have consecutive frames with the numbers that they have in the whole dataset.
    /// Together they are bit-identical to one run without this option.
    #[arg(long, verbatim_doc_comment, value_name = "I/N")]
    shard: Option<Shard>,
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
        let (mut obstacles, mut markers) = (scene.obstacles, scene.markers);
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

        let own = self.shard.unwrap_or(Shard::WHOLE).range(self.frames);
        let mut seen = Seen::default();
        let mut images = FrameImages::new(self.size);
        let mut episode = 0;
        let bar = output::progress(own.end - own.start, "capturing");
        for frame in 0..own.end {
            if own.contains(&frame) {
                let simulation = pilot.env().simulation();
                // of another episode, or moved by the task
                if obstacles != simulation.obstacles() {
                    obstacles = simulation.obstacles().to_vec();
                    renderer.set_obstacles(&obstacles).map_err(vision_failure)?;
                }
                if markers != simulation.markers() {
                    markers = simulation.markers();
                    renderer.set_markers(&markers).map_err(vision_failure)?;
                }
                renderer.update(simulation.states()).map_err(vision_failure)?;
                for (drone, state) in simulation.states().iter().enumerate() {
                    let files = images.write(&mut renderer, drone, frame, &out)?;
                    let numbers = state_numbers(state);
                    seen.note(&images.rgb, &numbers);
                    let mut row = format!("{frame},{episode},{},{drone}", simulation.time());
                    for number in numbers {
                        row += &format!(",{number}");
                    }
                    row += &format!(",{}\n", files.join(","));
                    // after its images: a row never names a missing file
                    rows.append(row.as_bytes()).map_err(unwritten)?;
                }
                bar.inc(1);
            }
            if frame + 1 < own.end
                && let Some(end) = self.advance(&mut pilot)?
            {
                episode += 1;
                seen.end_episode(end.is_crash());
            }
        }
        bar.finish_and_clear();
        seen.end_episode(false);
        let frames = own.end - own.start;
        let images = frames * pilot.env().simulation().num_drones() as u64;
        if self.json {
            return output::print_json(&json!({
                "task": pilot.env().name(),
                "frames": frames,
                "first_frame": own.start,
                "shard": self.shard.map(|shard| shard.to_string()),
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
            ("frames", frames.to_string()),
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

    /// Advances the flight to the next frame. Returns the reason of the end if an episode has ended and the next one
    /// has started.
    fn advance(&self, pilot: &mut Pilot) -> Result<Option<EndReason>, Failure> {
        for _ in 0..self.every {
            pilot.rollout.step().map_err(Failure::work)?;
            if pilot.rollout.is_over() {
                let end = pilot.env().info().end;
                pilot.restart().map_err(|failure| match failure {
                    Failure::Work(error) => Failure::Work(error.context("the next episode cannot begin")),
                    other => other,
                })?;
                return Ok(end);
            }
        }
        Ok(None)
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
    /// Number of ended episodes with frames.
    episodes: u64,
    /// Number of them that are not a prefix of an earlier one.
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

    /// Ends the current episode, if it has frames.
    fn end_episode(&mut self, crashed: bool) {
        let Some(whole) = self.current.last() else { return };
        self.episodes += 1;
        self.crashes += u64::from(crashed);
        self.distinct += u64::from(!self.prefixes.contains(whole));
        self.prefixes.extend(self.current.drain(..));
    }
}

/// Images of one frame and drone.
struct FrameImages {
    size: ImageSize,
    rgba: Vec<u8>,
    rgb: Vec<u8>,
    depth: Vec<f32>,
    objects: Vec<[i32; 2]>,
}

impl FrameImages {
    fn new(size: ImageSize) -> Self {
        let pixels = size.pixels();
        Self {
            size,
            rgba: vec![0; 4 * pixels],
            rgb: Vec::with_capacity(3 * pixels),
            depth: vec![0.0; pixels],
            objects: vec![[0; 2]; pixels],
        }
    }

    /// Renders and writes the images of a drone's camera. Returns the names of the files.
    fn write(
        &mut self,
        renderer: &mut SceneRenderer,
        drone: usize,
        frame: u64,
        out: &OutputDir,
    ) -> Result<[String; 3], Failure> {
        let size = self.size;
        renderer.onboard_rgba(drone, size, &mut self.rgba).map_err(vision_failure)?;
        renderer.onboard_depth(drone, size, &mut self.depth).map_err(vision_failure)?;
        renderer.onboard_segmentation(drone, size, &mut self.objects).map_err(vision_failure)?;
        self.rgb.clear();
        self.rgb.extend(self.rgba.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]));
        let files = ["rgb", "depth", "segmentation"].map(|kind| format!("{kind}/{frame:06}_{drone}.png"));
        out.write(&files[0], &images::png_rgb(size, &self.rgb).map_err(Failure::work)?)?;
        out.write(&files[1], &images::png_depth(size, &self.depth).map_err(Failure::work)?)?;
        out.write(&files[2], &images::png_segmentation(size, &self.objects).map_err(Failure::work)?)?;
        Ok(files)
    }
}

fn pretty(value: &Value) -> Vec<u8> {
    format!("{value:#}\n").into_bytes()
}
