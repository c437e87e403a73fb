use std::path::PathBuf;

use anyhow::anyhow;
use aviary::record::images;
use aviary::vision::{ImageKind, ImageSize, SceneRenderer, View};
use aviary::world::World;
use clap::{Args, ValueHint};
use nalgebra::Vector3;
use serde_json::json;

use crate::animation::is_previewed;
use crate::failure::Failure;
use crate::options::{FlightOptions, vision_failure};
use crate::output::{self, OutputFile};
use crate::parse::{self, size};
use crate::pilot::Pilot;

/// Render an image of a task's scene as PNG
///
/// Depth and segmentation are rendered in colours for viewers; `aviary capture` writes their
/// values.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary render --task hover --at 5 --out out/hover.png
  aviary render --task hover --camera fpv --kind depth --out out/depth.png")]
pub struct Render {
    #[command(flatten)]
    options: FlightOptions,
    /// Output file (PNG)
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    out: PathBuf,
    /// Camera: track, fpv, fixed, front or top
    ///
    /// `track` follows the drones, `fpv` is on board the first drone. `fixed` (from the side),
    /// `front` and `top` have the whole flight in the frame.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "NAME",
        default_value = "track",
        value_parser = parse::named::<View>(),
        hide_possible_values = true
    )]
    camera: View,
    /// Kind of the image: rgb, depth or segmentation
    #[arg(
        long,
        value_name = "NAME",
        default_value = "rgb",
        value_parser = parse::named::<ImageKind>(),
        hide_possible_values = true
    )]
    kind: ImageKind,
    /// Size of the image, pixels
    #[arg(long, value_name = "WxH", value_parser = size, default_value = "640x480")]
    size: ImageSize,
    /// Time of the image in the flight, s
    #[arg(long, value_name = "S", default_value_t = 0.0, allow_negative_numbers = true)]
    at: f64,
    /// JSON output instead of a line of text
    #[arg(long)]
    json: bool,
}

impl Render {
    pub fn run(&self) -> Result<(), Failure> {
        let (view, kind) = (self.camera, self.kind);
        if self.out.extension().is_none_or(|ending| !ending.eq_ignore_ascii_case("png")) {
            let out = self.out.display();
            return Err(Failure::input(anyhow!("--out is `{out}`, expected a name that ends in .png")));
        }
        if !(self.at.is_finite() && self.at >= 0.0) {
            return Err(Failure::input(anyhow!(
                "--at is {} s, expected zero or a positive number of seconds",
                aviary::number(self.at)
            )));
        }
        let mut pilot = Pilot::new(&self.options)?;
        let file = OutputFile::begin(&self.out)?;
        let kept = if is_previewed(view, pilot.env().simulation()) { pilot.preview()? } else { Vec::new() };
        // the nearest control step is at most half a step away
        let until = self.at - 0.5 * pilot.env().simulation().control_period();
        while pilot.env().simulation().time() < until {
            pilot.rollout.step().map_err(Failure::work)?;
            let over = pilot.rollout.is_over();
            if over && pilot.env().simulation().time() < until {
                let (time, end) = (pilot.env().info().time, pilot.env().info().end);
                let end = end.map_or("", |end| end.name());
                let at = aviary::number(self.at);
                return Err(Failure::input(anyhow!("--at is {at} s, but the flight ends ({end}) at {time} s")));
            }
        }
        file.write(&self.image(&pilot, view, kind, &kept)?)?;
        if self.json {
            return output::print_json(&json!({
                "task": pilot.env().name(),
                "camera": view.name(),
                "kind": kind.name(),
                "width": self.size.width,
                "height": self.size.height,
                "time": pilot.env().simulation().time(),
                "files": [self.out.to_string_lossy()],
            }));
        }
        output::print_written(std::slice::from_ref(&self.out))
    }

    fn image(&self, pilot: &Pilot, view: View, kind: ImageKind, kept: &[Vector3<f64>]) -> Result<Vec<u8>, Failure> {
        let simulation = pilot.env().simulation();
        let renderer = match kind {
            ImageKind::Rgb => SceneRenderer::for_people(&simulation.scene()),
            ImageKind::Depth | ImageKind::Segmentation => SceneRenderer::for_observations(&simulation.scene()),
        };
        let mut renderer = renderer.map_err(vision_failure)?;
        if !kept.is_empty() {
            renderer.keep_in_frame(kept);
        }
        renderer.update(simulation.states()).map_err(vision_failure)?;
        let pixels = self.size.pixels();
        let rgb = match kind {
            ImageKind::Rgb => {
                let mut rgb = vec![0; 3 * pixels];
                renderer.rgb(view, self.size, &mut rgb).map_err(vision_failure)?;
                rgb
            }
            ImageKind::Depth => {
                let mut depth = vec![0.0; pixels];
                renderer.depth(view, self.size, &mut depth).map_err(vision_failure)?;
                images::depth_in_colour(&depth, World::CLIP_PLANES[1] as f32)
            }
            ImageKind::Segmentation => {
                let mut objects = vec![[0; 2]; pixels];
                renderer.segmentation(view, self.size, &mut objects).map_err(vision_failure)?;
                images::segmentation_in_colour(&objects)
            }
        };
        images::png_rgb(self.size, &rgb).map_err(Failure::work)
    }
}
