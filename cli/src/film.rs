//! Pictures of a flight: GIF, MP4, numbered PNG files.

use std::path::PathBuf;

use anyhow::{Context as _, anyhow};
use aviary::control::Reference;
use aviary::control::trajectory::Trajectory;
use aviary::record::Overlays;
use aviary::record::animation::{Animation, GifAnimation, Mp4, PngSequence};
use aviary::simulation::Simulation;
use aviary::vision::{ImageSize, View};
use clap::{ArgGroup, Args, ValueHint};
use nalgebra::Vector3;

use crate::failure::Failure;
use crate::options::vision_failure;
use crate::output::{FileWriter, OutputDir, OutputFile};
use crate::parse::{self, OverlayNames, size};

/// What to film, and where to put it.
#[derive(Debug, Args)]
#[command(group(ArgGroup::new("pictures").multiple(true)))]
pub struct FilmOptions {
    /// Animation to write, as GIF; like the others it has 24 frames a second, or as near to it as control steps come
    #[arg(long, group = "pictures", value_name = "FILE.gif", value_hint = ValueHint::FilePath)]
    gif: Option<PathBuf>,
    /// Video to write, as MP4; needs the program ffmpeg
    #[arg(long, group = "pictures", value_name = "FILE.mp4", value_hint = ValueHint::FilePath)]
    video: Option<PathBuf>,
    /// Directory for the frames as PNG files: 00000.png and on
    #[arg(long, group = "pictures", value_name = "DIR", value_hint = ValueHint::DirPath)]
    png: Option<PathBuf>,
    /// The name that --png had in earlier versions
    #[arg(long, group = "pictures", hide = true)]
    frames: Option<PathBuf>,
    /// Camera of these: track (follows the drones), fpv (on board the first one), and, standing still
    /// with the whole flight in the frame, fixed (from aside), front (from ahead), top (from above)
    #[arg(long, default_value = "track", value_parser = parse::named::<View>(), hide_possible_values = true, requires = "pictures")]
    camera: View,
    /// Size of these, pixels
    #[arg(long, value_parser = size, default_value = "320x240", requires = "pictures")]
    size: ImageSize,
    /// What to draw into them, with commas between: trails, references, wind, rings
    #[arg(long, value_parser = OverlayNames, requires = "pictures")]
    overlay: Option<Overlays>,
}

impl FilmOptions {
    /// Checks what can be checked before anything is flown.
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

    /// The files, and the directory of frames, that are there when it is done.
    pub fn files(&self) -> Vec<PathBuf> {
        [&self.gif, &self.video, &self.png].into_iter().flatten().cloned().collect()
    }

    /// Returns whether where the camera stands hangs on where drones will be.
    pub fn wants_preview(&self, simulation: &Simulation) -> bool {
        !self.files().is_empty() && is_previewed(self.camera, simulation)
    }

    /// Begins the film, if one is asked for, of drones that have a way to fly or none. A camera that stands still keeps the points
    /// `kept` (world frame, m) in the frame, if there are any.
    pub fn begin<'a>(
        &self,
        simulation: &Simulation,
        kept: &[Vector3<f64>],
        way: impl Fn(usize) -> Option<&'a dyn Trajectory>,
    ) -> Result<Option<Film>, Failure> {
        if self.files().is_empty() {
            return Ok(None);
        }
        let size = self.size;
        let gif = self.gif.as_deref().map(OutputFile::begin).transpose()?;
        let video = self.video.as_deref().map(OutputFile::begin).transpose()?;
        let overlays = self.overlay.unwrap_or_default();
        let mut film =
            aviary::record::FrameRecorder::of(simulation, self.camera, size, overlays).map_err(vision_failure)?;
        if !kept.is_empty() {
            film.renderer().keep_in_frame(kept);
        }
        for drone in 0..simulation.num_drones() {
            if let Some(way) = way(drone) {
                film.set_way(drone, way);
            }
        }
        let seconds = film.seconds_per_frame();
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
        Ok(Some(Film { film, gif, video, frames: frames.map_err(Failure::work)? }))
    }
}

/// Whether the pose of a camera hangs on the whole flight: one that stands still, or that looks for a direction without obstacles.
pub fn is_previewed(view: View, simulation: &Simulation) -> bool {
    match view {
        View::Fpv => false,
        View::Track => !simulation.obstacles().is_empty(),
        View::Fixed | View::Front | View::Top => true,
    }
}

/// A film being made.
pub struct Film {
    film: aviary::record::FrameRecorder,
    gif: Option<GifAnimation<FileWriter>>,
    video: Option<(Mp4, OutputFile)>,
    frames: Option<PngSequence>,
}

impl Film {
    /// Takes a frame if it is time for one.
    pub fn look(&mut self, simulation: &Simulation, reference: impl Fn(usize) -> Reference) -> Result<(), Failure> {
        let Self { film, gif, video, frames } = self;
        let rgb = film.look_at(simulation, |drone| Some(reference(drone)));
        match rgb.map_err(vision_failure)? {
            Some(rgb) => put(rgb, gif, video, frames),
            None => Ok(()),
        }
    }

    /// Adds the last moment and gives the files their names.
    pub fn finish(mut self, simulation: &Simulation, reference: impl Fn(usize) -> Reference) -> Result<(), Failure> {
        let Self { film, gif, video, frames } = &mut self;
        let rgb = film.frame(simulation, |drone| Some(reference(drone))).map_err(vision_failure)?;
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

/// Puts a frame where frames go.
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
