//! Options for animations of a flight (GIF, MP4, PNG files), and their writers.

use std::path::PathBuf;

use anyhow::{Context as _, anyhow};
use aviary::control::Reference;
use aviary::control::trajectory::Trajectory;
use aviary::record::animation::{Animation, GifAnimation, Mp4, PngSequence};
use aviary::record::{FrameRecorder, Overlays};
use aviary::simulation::Simulation;
use aviary::vision::{ImageSize, View};
use clap::{ArgGroup, Args, ValueHint};
use nalgebra::Vector3;

use crate::failure::Failure;
use crate::options::vision_failure;
use crate::output::{FileWriter, OutputDir, OutputFile};
use crate::parse::{self, OverlayNames, size};

// not a doc comment, which would replace the description of a command: options for animations of a flight
#[derive(Debug, Args)]
#[command(group(ArgGroup::new("animations").multiple(true)))]
pub struct AnimationOptions {
    /// Animation of the flight as GIF
    ///
    /// Animations have 24 frames per second, rounded to whole control steps. The GIF, the
    /// MP4 and the PNG files show the same frames.
    #[arg(long, verbatim_doc_comment, group = "animations", value_name = "FILE", value_hint = ValueHint::FilePath)]
    gif: Option<PathBuf>,
    /// Animation of the flight as MP4; requires ffmpeg
    #[arg(long, group = "animations", value_name = "FILE", value_hint = ValueHint::FilePath)]
    video: Option<PathBuf>,
    /// Directory for the frames as PNG files
    ///
    /// The files are 00000.png, 00001.png, …
    #[arg(long, group = "animations", value_name = "DIR", value_hint = ValueHint::DirPath)]
    png: Option<PathBuf>,
    /// Earlier name of --png
    #[arg(long, group = "animations", hide = true)]
    frames: Option<PathBuf>,
    /// Camera of the animation: track, fpv, fixed, front or top
    ///
    /// `track` follows the drones, `fpv` is on board the first drone. `fixed` (from the side),
    /// `front` and `top` stand still and have the whole flight in the frame.
    #[arg(
        long,
        verbatim_doc_comment,
        value_name = "NAME",
        default_value = "track",
        value_parser = parse::named::<View>(),
        hide_possible_values = true,
        requires = "animations"
    )]
    camera: View,
    /// Size of the frames, pixels
    #[arg(long, value_name = "WxH", value_parser = size, default_value = "320x240", requires = "animations")]
    size: ImageSize,
    /// Overlays: trails, references, wind, rings
    ///
    /// Names are separated by commas. `trails` are the flown paths, `references` the planned
    /// paths, `wind` is an arrow along the steady wind, `rings` have a radius of 0.15 m around
    /// the drones.
    #[arg(long, verbatim_doc_comment, value_name = "LIST", value_parser = OverlayNames, requires = "animations")]
    overlay: Option<Overlays>,
}

impl AnimationOptions {
    /// Checks the options before the flight.
    pub fn validate(&self) -> Result<(), Failure> {
        if let Some(path) = &self.frames {
            let path = path.display();
            return Err(Failure::input(anyhow!(
                "--frames is `{path}`, expected --png {path}: a directory for PNG files"
            )));
        }
        for (option, path, ending) in [("gif", &self.gif, "gif"), ("video", &self.video, "mp4")] {
            let Some(path) = path else { continue };
            if path.extension().is_none_or(|given| !given.eq_ignore_ascii_case(ending)) {
                let path = path.display();
                return Err(Failure::input(anyhow!("--{option} is `{path}`, expected a name that ends in .{ending}")));
            }
        }
        Ok(())
    }

    /// Returns the output files, and the directory of the frames.
    pub fn files(&self) -> Vec<PathBuf> {
        [&self.gif, &self.video, &self.png].into_iter().flatten().cloned().collect()
    }

    /// Returns true if the pose of the camera depends on the whole flight.
    pub fn wants_preview(&self, simulation: &Simulation) -> bool {
        !self.files().is_empty() && is_previewed(self.camera, simulation)
    }

    /// Starts the animations, if any option is set. `path` returns the planned path of a drone. A camera that stands
    /// still keeps the points `kept` (world frame, m) in the frame.
    pub fn begin<'a>(
        &self,
        simulation: &Simulation,
        kept: &[Vector3<f64>],
        path: impl Fn(usize) -> Option<&'a dyn Trajectory>,
    ) -> Result<Option<AnimationWriter>, Failure> {
        if self.files().is_empty() {
            return Ok(None);
        }
        let size = self.size;
        let gif = self.gif.as_deref().map(OutputFile::begin).transpose()?;
        let video = self.video.as_deref().map(OutputFile::begin).transpose()?;
        let overlays = self.overlay.unwrap_or_default();
        let mut recorder = FrameRecorder::of(simulation, self.camera, size, overlays).map_err(vision_failure)?;
        if !kept.is_empty() {
            recorder.renderer().keep_in_frame(kept);
        }
        for drone in 0..simulation.num_drones() {
            if let Some(path) = path(drone) {
                recorder.set_path(drone, path);
            }
        }
        let seconds = recorder.seconds_per_frame();
        let gif = gif.map(|file| GifAnimation::new(file.into_writer(), size, seconds)).transpose();
        let gif = gif.map_err(Failure::work)?;
        let video = match video {
            Some(file) => Some((Mp4::create(file.path(), size, seconds).map_err(Failure::work)?, file)),
            None => None,
        };
        if let Some(path) = &self.png {
            OutputDir::create(path)?;
        }
        let frames = self.png.as_ref().map(|path| PngSequence::create(path, size)).transpose();
        Ok(Some(AnimationWriter { recorder, gif, video, frames: frames.map_err(Failure::work)? }))
    }
}

/// Returns true if the pose of a camera depends on the whole flight: it stands still, or avoids obstacles.
pub fn is_previewed(view: View, simulation: &Simulation) -> bool {
    match view {
        View::Fpv => false,
        View::Track => !simulation.obstacles().is_empty(),
        View::Fixed | View::Front | View::Top => true,
    }
}

/// Animations of a flight in progress.
pub struct AnimationWriter {
    recorder: FrameRecorder,
    gif: Option<GifAnimation<FileWriter>>,
    video: Option<(Mp4, OutputFile)>,
    frames: Option<PngSequence>,
}

impl AnimationWriter {
    /// Writes a frame if one is due.
    pub fn look(&mut self, simulation: &Simulation, reference: impl Fn(usize) -> Reference) -> Result<(), Failure> {
        let Self { recorder, gif, video, frames } = self;
        let rgb = recorder.look_at(simulation, |drone| Some(reference(drone)));
        match rgb.map_err(vision_failure)? {
            Some(rgb) => put(rgb, gif, video, frames),
            None => Ok(()),
        }
    }

    /// Writes the last frame and gives the files their names.
    pub fn finish(mut self, simulation: &Simulation, reference: impl Fn(usize) -> Reference) -> Result<(), Failure> {
        let Self { recorder, gif, video, frames } = &mut self;
        let rgb = recorder.frame(simulation, |drone| Some(reference(drone))).map_err(vision_failure)?;
        put(rgb, gif, video, frames)?;
        if let Some(gif) = self.gif {
            gif.finish().map_err(Failure::work)?.keep()?;
        }
        if let Some((video, file)) = self.video {
            video.finish().with_context(|| file.target().display().to_string()).map_err(Failure::work)?;
            file.keep()?;
        }
        Ok(())
    }
}

/// Writes a frame to all outputs.
fn put(
    rgb: &[u8],
    gif: &mut Option<GifAnimation<FileWriter>>,
    video: &mut Option<(Mp4, OutputFile)>,
    frames: &mut Option<PngSequence>,
) -> Result<(), Failure> {
    if let Some(gif) = gif {
        gif.frame(rgb).map_err(Failure::work)?;
    }
    if let Some((video, file)) = video {
        video.frame(rgb).with_context(|| file.target().display().to_string()).map_err(Failure::work)?;
    }
    match frames {
        Some(frames) => frames.frame(rgb).map_err(Failure::work),
        None => Ok(()),
    }
}
