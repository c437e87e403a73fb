use std::path::PathBuf;

use anyhow::anyhow;
use aviary::record::picture;
use aviary::state::wxyz;
use aviary::vision::{CAMERA_SIZE, ImageSize, Painter, intrinsics};
use aviary::world::World;
use clap::Args;
use serde_json::{Map, Value, json};

use crate::failure::Failure;
use crate::options::{FlightOptions, size, vision_failure};
use crate::output::{self, OutputDir};
use crate::pilot::Pilot;

/// Camera observations of a flight: colour, depth and objects of every onboard camera, with the states they belong to
///
/// DIR/frames.csv has one row per frame and drone. Depth is 16-bit PNG in millimetres (0: nothing within 65.5 m),
/// segmentation 16-bit PNG of numbers that DIR/segmentation.json names. DIR/camera.json has the intrinsics and the
/// pose in the body. When an episode ends, the next one begins. An earlier capture in DIR is replaced.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  aviary capture --task hover --frames 100 --out out/frames
  aviary capture --task hover --frames 1000 --every 4 --size 128x96 --out out/frames")]
pub struct Capture {
    #[command(flatten)]
    options: FlightOptions,
    /// Number of frames
    #[arg(long, allow_negative_numbers = true)]
    frames: u64,
    /// Directory to write
    #[arg(long)]
    out: PathBuf,
    /// Size of the pictures, pixels
    #[arg(long, value_parser = size, default_value_t = CAMERA_SIZE)]
    size: ImageSize,
    /// Control steps from one frame to the next
    #[arg(long, default_value_t = 1, allow_negative_numbers = true)]
    every: u64,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
}

const STATE: [&str; 13] = ["x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "wx", "wy", "wz"];

impl Capture {
    pub fn run(&self) -> Result<(), Failure> {
        for (option, value) in [("frames", self.frames), ("every", self.every)] {
            if value == 0 {
                return Err(Failure::input(anyhow!("--{option} is 0, expected at least 1")));
            }
        }
        let mut pilot = Pilot::new(&self.options)?;
        let world = pilot.env().simulation().world().clone();
        let mut painter = Painter::for_observations(&world).map_err(vision_failure)?;
        let out = OutputDir::create(&self.out)?;
        self.clear()?;

        let mut rows = csv::Writer::from_writer(out.begin("frames.csv")?.into_writer());
        let table = |error: csv::Error| Failure::work(anyhow::Error::new(error).context("frames.csv"));
        let header =
            ["frame", "episode", "t", "drone"].into_iter().chain(STATE).chain(["rgb", "depth", "segmentation"]);
        rows.write_record(header).map_err(table)?;

        let pixels = self.size.pixels();
        let (mut rgba, mut depth, mut objects) = (vec![0; 4 * pixels], vec![0.0; pixels], vec![[0; 2]; pixels]);
        let mut episode = 0;
        let bar = output::progress(self.frames, "capturing");
        for frame in 0..self.frames {
            let simulation = pilot.env().simulation();
            painter.update(simulation.states()).map_err(vision_failure)?;
            for (drone, state) in simulation.states().iter().enumerate() {
                painter.onboard_rgba(drone, self.size, &mut rgba).map_err(vision_failure)?;
                painter.onboard_depth(drone, self.size, &mut depth).map_err(vision_failure)?;
                painter.onboard_segmentation(drone, self.size, &mut objects).map_err(vision_failure)?;
                let rgb: Vec<u8> = rgba.chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
                let files = ["rgb", "depth", "segmentation"].map(|kind| format!("{kind}/{frame:06}_{drone}.png"));
                out.write(&files[0], &picture::png_rgb(self.size, &rgb).map_err(Failure::work)?)?;
                out.write(&files[1], &picture::png_depth(self.size, &depth).map_err(Failure::work)?)?;
                out.write(&files[2], &picture::png_segmentation(self.size, &objects).map_err(Failure::work)?)?;

                let numbers = (state.position.iter())
                    .chain(&wxyz(&state.attitude))
                    .chain(&state.velocity)
                    .chain(&state.angular_velocity)
                    .map(f64::to_string)
                    .collect::<Vec<_>>();
                let place = [frame.to_string(), episode.to_string(), simulation.time().to_string(), drone.to_string()];
                rows.write_record(place.iter().chain(&numbers).chain(&files)).map_err(table)?;
            }
            bar.inc(1);
            if frame + 1 < self.frames {
                self.advance(&mut pilot, &mut episode)?;
            }
        }
        bar.finish_and_clear();

        out.write("segmentation.json", &pretty(&self.objects(&painter)))?;
        out.write("camera.json", &pretty(&self.camera()))?;
        let file = rows.into_inner().map_err(|error| Failure::work(anyhow!("frames.csv: {}", error.error())))?;
        file.keep()?;
        if self.json {
            return output::print_json(&json!({
                "task": pilot.env().name(),
                "frames": self.frames,
                "episodes": episode + 1,
                "width": self.size.width,
                "height": self.size.height,
                "directory": self.out,
                "seed": self.options.seed,
            }));
        }
        output::print(&output::table(&[
            ("frames", self.frames.to_string()),
            ("episodes", (episode + 1).to_string()),
            ("size", self.size.to_string()),
            ("directory", self.out.display().to_string()),
        ]))
    }

    /// Removes an earlier capture from the directory: its tables would describe other pictures than are there.
    fn clear(&self) -> Result<(), Failure> {
        let remove = |path: PathBuf| match std::fs::remove_file(&path) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(Failure::work(anyhow!("{}: {error}", path.display())))
            }
            _ => Ok(()),
        };
        for table in ["frames.csv", "camera.json", "segmentation.json"] {
            remove(self.out.join(table))?;
        }
        for kind in ["rgb", "depth", "segmentation"] {
            for entry in std::fs::read_dir(self.out.join(kind)).into_iter().flatten().flatten() {
                let name = entry.file_name();
                // FRAME_DRONE.png, and nothing else that somebody may have put there
                let ours = name.to_str().and_then(|name| name.strip_suffix(".png")).is_some_and(|name| {
                    name.split_once('_').is_some_and(|(frame, drone)| {
                        [frame, drone]
                            .iter()
                            .all(|part| !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit()))
                    })
                });
                if ours {
                    remove(entry.path())?;
                }
            }
        }
        Ok(())
    }

    /// Flies on to the next frame.
    fn advance(&self, pilot: &mut Pilot, episode: &mut u64) -> Result<(), Failure> {
        for _ in 0..self.every {
            if pilot.step()?.over {
                pilot.restart().map_err(|failure| match failure {
                    Failure::Work(error) => Failure::Work(error.context("the next episode cannot begin")),
                    input @ Failure::Input(_) => input,
                })?;
                *episode += 1;
                return Ok(());
            }
        }
        Ok(())
    }

    /// What the numbers in segmentation pictures stand for.
    fn objects(&self, painter: &Painter) -> Value {
        let mut names = Map::new();
        names.insert("0".into(), json!({ "type": "background", "name": null, "drone": null }));
        for object in painter.objects() {
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
            "depth": "distance along the optical axis, in units of depth_scale metres; 0 where there is nothing within 65.535 m",
            // a step of the depth buffer is z^2 / near / 2^24
            "depth_resolution": "0.6 mm at 10 m, 15 mm at 50 m",
            "position_in_body": World::CAMERA_POSITION,
            // columns: the picture's right, down and forward axes in the body frame
            "rotation_in_body": [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]],
            "quaternion_in_body_wxyz": [0.5, -0.5, 0.5, -0.5],
        })
    }
}

fn pretty(value: &Value) -> Vec<u8> {
    format!("{value:#}\n").into_bytes()
}
