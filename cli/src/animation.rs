//! Options for animations of a flight (GIF, MP4, PNG files), and their writers.

use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom, Write as _};
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
        Ok(Some(AnimationWriter { recorder, gif, video, frames: frames.map_err(Failure::work)?, kept: None }))
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
    /// Frames of the episode, which the outputs receive at its end, for a flight that can be rewound.
    kept: Option<KeptFrames>,
}

impl AnimationWriter {
    /// Prepares the animations for [`rewind`](Self::rewind). The outputs then receive the frames of an episode at its
    /// end.
    pub fn allow_rewind(&mut self) -> Result<(), Failure> {
        self.kept = Some(KeptFrames::create(self.recorder.size())?);
        Ok(())
    }

    /// Removes the frames after a control step of the episode.
    pub fn rewind(&mut self, step: u64) {
        self.recorder.rewind(step);
        if let Some(kept) = &mut self.kept {
            kept.rewind(step);
        }
    }

    /// Gives the outputs the frames of an episode that has ended.
    pub fn end_episode(&mut self) -> Result<(), Failure> {
        let Self { gif, video, frames, kept, .. } = self;
        kept.as_mut().map_or(Ok(()), |kept| kept.drain(|rgb| put(rgb, gif, video, frames)))
    }

    /// Writes a frame if one is due.
    pub fn look(&mut self, simulation: &Simulation, reference: impl Fn(usize) -> Reference) -> Result<(), Failure> {
        let Self { recorder, gif, video, frames, kept } = self;
        let rgb = recorder.look_at(simulation, |drone| Some(reference(drone)));
        match (rgb.map_err(vision_failure)?, kept) {
            (Some(rgb), Some(kept)) => kept.push(simulation.control_steps(), rgb),
            (Some(rgb), None) => put(rgb, gif, video, frames),
            (None, _) => Ok(()),
        }
    }

    /// Writes the last frame and gives the files their names.
    pub fn finish(mut self, simulation: &Simulation, reference: impl Fn(usize) -> Reference) -> Result<(), Failure> {
        self.end_episode()?;
        let Self { recorder, gif, video, frames, .. } = &mut self;
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

/// Frames of an episode in a temporary file.
struct KeptFrames {
    file: File,
    /// Control steps of the frames.
    steps: Vec<u64>,
    /// Size of a frame, bytes.
    bytes: usize,
}

impl KeptFrames {
    fn create(size: ImageSize) -> Result<Self, Failure> {
        let file = Self::checked(tempfile::tempfile())?;
        Ok(Self { file, steps: Vec::new(), bytes: 3 * size.pixels() })
    }

    /// Returns an error of the file with its purpose.
    fn checked<T>(done: std::io::Result<T>) -> Result<T, Failure> {
        done.context("temporary file for the frames").map_err(Failure::work)
    }

    fn push(&mut self, step: u64, rgb: &[u8]) -> Result<(), Failure> {
        let start = (self.steps.len() * self.bytes) as u64;
        Self::checked(self.file.seek(SeekFrom::Start(start)).and_then(|_| self.file.write_all(rgb)))?;
        self.steps.push(step);
        Ok(())
    }

    fn rewind(&mut self, step: u64) {
        self.steps.retain(|&of_frame| of_frame <= step);
    }

    /// Passes the frames on and removes them.
    fn drain(&mut self, mut put: impl FnMut(&[u8]) -> Result<(), Failure>) -> Result<(), Failure> {
        let mut rgb = vec![0; self.bytes];
        Self::checked(self.file.rewind())?;
        for _ in self.steps.drain(..) {
            Self::checked(self.file.read_exact(&mut rgb))?;
            put(&rgb)?;
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

#[cfg(test)]
mod tests {
    use aviary::env::{DroneEnv, Env as _, EnvConfig};
    use aviary::tasks::make;
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        options: AnimationOptions,
    }

    /// Flies steps with an action for each, and looks at the state before each of them.
    fn fly(env: &mut dyn DroneEnv, animation: &mut AnimationWriter, actions: impl IntoIterator<Item = f64>) {
        for action in actions {
            animation.look(env.simulation(), |drone| env.reference(drone)).unwrap();
            env.step(&[action; 4]).unwrap();
        }
    }

    fn files(dir: &std::path::Path) -> Vec<Vec<u8>> {
        let names = (0..).map(|index| dir.join(format!("{index:05}.png")));
        names.take_while(|path| path.exists()).map(|path| std::fs::read(path).unwrap()).collect()
    }

    /// The animation of a flight that was rewound, and restarted, has no frame of the states that were taken back.
    #[test]
    fn a_rewound_flight_has_no_frames_of_the_states_that_were_taken_back() {
        if mujoco_rs::gl_info().is_err() {
            return;
        }
        let animation = |rewinds: &[(u64, u64)]| -> Vec<Vec<u8>> {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("frames");
            let line = ["test", "--size", "80x60", "--overlay", "trails", "--png", path.to_str().unwrap()];
            let options = Line::try_parse_from(line).unwrap().options;
            let mut env = make("hover", EnvConfig::default()).unwrap();
            env.reset(Some(1)).unwrap();
            let mut animation = options.begin(env.simulation(), &[], |_| None).unwrap().unwrap();
            animation.allow_rewind().unwrap();
            for episode in 0..2 {
                let mut step = 0;
                for &(from, to) in rewinds {
                    fly(&mut *env, &mut animation, (step..to).map(|_| 0.1));
                    let saved = env.snapshot();
                    // another flight, which is taken back
                    fly(&mut *env, &mut animation, (to..from).map(|_| 0.3));
                    env.restore(&saved).unwrap();
                    animation.rewind(to);
                    step = to;
                }
                fly(&mut *env, &mut animation, (step..40).map(|_| 0.1));
                if episode == 0 {
                    env.reset(Some(2)).unwrap();
                    animation.end_episode().unwrap();
                    assert_eq!(files(&path).len(), 20);
                }
            }
            animation.finish(env.simulation(), |drone| env.reference(drone)).unwrap();
            files(&path)
        };
        let plain = animation(&[]);
        assert_eq!(plain.len(), 41);
        for rewinds in [&[(31, 10)][..], &[(30, 0), (25, 13)], &[(12, 11), (40, 11), (39, 38)]] {
            let rewound = animation(rewinds);
            assert_eq!(rewound.len(), plain.len(), "{rewinds:?}");
            assert!(rewound == plain, "{rewinds:?}");
        }
    }
}
