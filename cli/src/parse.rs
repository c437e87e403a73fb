//! Parsers of option values: names, files, sizes.

use std::ffi::OsStr;
use std::fmt;
use std::path::{Path, PathBuf};

use aviary::NamedEnum;
use aviary::control::trajectory;
use aviary::drone::DroneModel;
use aviary::physics::Effects;
use aviary::record::Overlays;
use aviary::tasks::{self, TaskSummary};
use aviary::vision::ImageSize;
use aviary::world::ObstacleKind;
use clap::builder::{PossibleValue, TypedValueParser};
use clap::error::ErrorKind;
use clap::{Arg, Command};

/// Parser of a value by its name, which shells complete.
#[derive(Debug, Clone)]
pub struct Names<T> {
    names: fn() -> Vec<&'static str>,
    find: fn(&str) -> Option<T>,
    /// The value for a file whose name ends in .toml, where a file may stand for it.
    file: Option<fn(PathBuf) -> T>,
}

impl<T: Clone + Send + Sync + 'static> TypedValueParser for Names<T> {
    type Value = T;

    fn parse_ref(&self, _: &Command, argument: Option<&Arg>, value: &OsStr) -> Result<T, clap::Error> {
        let path = Path::new(value);
        if let Some(file) = self.file.filter(|_| path.extension().is_some_and(|extension| extension == "toml")) {
            return Ok(file(path.into()));
        }
        value.to_str().and_then(self.find).ok_or_else(|| {
            let (name, names) = (value.to_string_lossy(), (self.names)());
            let file = if self.file.is_some() { ", or a file whose name ends in .toml" } else { "" };
            let near = aviary::did_you_mean(&name, &names);
            let option = option(argument);
            refusal(format!("{option} is `{name}`, expected one of: {}{file}{near}", names.join(", ")))
        })
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new((self.names)().into_iter().map(PossibleValue::new)))
    }
}

/// An option as messages name it.
fn option(argument: Option<&Arg>) -> String {
    match argument {
        Some(argument) => argument.get_long().map_or(format!("the {}", argument.get_id()), |long| format!("--{long}")),
        None => "a value".into(),
    }
}

fn refusal(message: String) -> clap::Error {
    clap::Error::raw(ErrorKind::InvalidValue, message)
}

/// Parser of a named enum.
pub fn named<T: NamedEnum>() -> Names<T> {
    Names { names: || T::NAMES.to_vec(), find: |name| name.parse().ok(), file: None }
}

/// Parser of aerodynamic effects: names, separated by commas.
pub fn effects() -> Names<Effects> {
    let names = || std::iter::once("none").chain(Effects::NAMES.iter().copied()).collect();
    Names { names, find: |text| text.parse().ok(), file: None }
}

/// Parser of a task.
pub fn task() -> Names<TaskSummary> {
    Names { names: || tasks::NAMES.to_vec(), find: |name| tasks::summary(name).ok(), file: None }
}

/// Parser of obstacles that can be asked for by name: all but a list of the user's own.
pub fn obstacles() -> Names<ObstacleKind> {
    const fn has_name(kind: ObstacleKind) -> bool {
        !matches!(kind, ObstacleKind::Custom)
    }
    Names {
        names: || ObstacleKind::ALL.into_iter().filter(|&kind| has_name(kind)).map(ObstacleKind::name).collect(),
        find: |name| name.parse().ok().filter(|&kind| has_name(kind)),
        file: None,
    }
}

/// A value by its name, or the TOML file that describes one.
#[derive(Debug, Clone)]
pub enum NameOrFile<T> {
    /// What has the name.
    Name(T),
    /// The file.
    File(PathBuf),
}

impl<T: fmt::Display> fmt::Display for NameOrFile<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Name(name) => name.fmt(f),
            Self::File(path) => path.display().fmt(f),
        }
    }
}

/// Parser of an airframe.
pub fn airframe() -> Names<NameOrFile<DroneModel>> {
    Names {
        names: || DroneModel::NAMES.to_vec(),
        find: |name| name.parse().ok().map(NameOrFile::Name),
        file: Some(NameOrFile::File),
    }
}

/// Parser of a trajectory.
pub fn trajectory() -> Names<NameOrFile<&'static str>> {
    Names {
        names: || trajectory::NAMES.to_vec(),
        find: |name| trajectory::NAMES.into_iter().find(|known| *known == name).map(NameOrFile::Name),
        file: Some(NameOrFile::File),
    }
}

/// Differences between the episodes of one command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Variation {
    /// True if episodes start from sampled states.
    pub starts: bool,
    /// True if episodes have sampled layouts of the obstacles.
    pub layouts: bool,
}

impl Variation {
    /// Episodes differ only in what a task or a configuration file samples.
    pub const NONE: Self = Self { starts: false, layouts: false };

    const NAMED: [(&'static str, Self); 4] = [
        ("all", Self { starts: true, layouts: true }),
        ("starts", Self { starts: true, layouts: false }),
        ("layouts", Self { starts: false, layouts: true }),
        ("none", Self::NONE),
    ];
}

/// Parser of a variation.
pub fn variation() -> Names<Variation> {
    Names {
        names: || Variation::NAMED.map(|(name, _)| name).to_vec(),
        find: |name| Variation::NAMED.into_iter().find(|(known, _)| *known == name).map(|(_, variation)| variation),
        file: None,
    }
}

/// Parser of overlays, names with commas between them.
#[derive(Debug, Clone)]
pub struct OverlayNames;

impl TypedValueParser for OverlayNames {
    type Value = Overlays;

    fn parse_ref(&self, _: &Command, argument: Option<&Arg>, value: &OsStr) -> Result<Overlays, clap::Error> {
        let wrong = |error: String| refusal(format!("{}: {error}", option(argument)));
        value.to_string_lossy().parse().map_err(wrong)
    }
}

/// Width and height as `640x480`.
pub fn size(text: &str) -> Result<ImageSize, String> {
    let expected = || format!("expected WIDTHxHEIGHT in pixels, each from 1 to {}", ImageSize::MAX_SIDE);
    let (width, height) = text.split_once('x').ok_or_else(expected)?;
    let side =
        |text: &str| text.parse().ok().filter(|side| (1..=ImageSize::MAX_SIDE).contains(side)).ok_or_else(expected);
    Ok(ImageSize { width: side(width)?, height: side(height)? })
}
