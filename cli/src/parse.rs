//! Parsers of option values: names, files, sizes.

use std::ffi::OsStr;
use std::fmt::{self, Display};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use aviary::NamedEnum;
use aviary::control::trajectory;
use aviary::drone::DroneModel;
use aviary::physics::Effects;
use aviary::record::Overlays;
use aviary::tasks::{self, RaceTrack, TaskSummary};
use aviary::vision::ImageSize;
use aviary::world::ObstacleKind;
use clap::builder::{PossibleValue, TypedValueParser};
use clap::error::ErrorKind;
use clap::{Arg, Command};
use learn::benchmark::Suite;

use crate::failure::shortened;

/// Longest message that fits into a line of 120 columns after `error: `.
const MAX_MESSAGE: usize = 113;

/// Command that lists the names of most options.
const HELP: &str = "aviary COMMAND -h";

/// Parser of a value by its name, which shells complete.
#[derive(Debug, Clone)]
pub struct Names<T> {
    names: fn() -> Vec<&'static str>,
    find: fn(&str) -> Option<T>,
    /// Makes the value of a file whose name ends in .toml, if the option takes files.
    file: Option<fn(PathBuf) -> T>,
    /// Command that lists the names, if they do not fit into a message.
    command: &'static str,
}

impl<T: Clone + Send + Sync + 'static> TypedValueParser for Names<T> {
    type Value = T;

    fn parse_ref(&self, _: &Command, argument: Option<&Arg>, value: &OsStr) -> Result<T, clap::Error> {
        let path = Path::new(value);
        if let Some(file) = self.file.filter(|_| path.extension().is_some_and(|extension| extension == "toml")) {
            return Ok(file(path.into()));
        }
        value.to_str().and_then(self.find).ok_or_else(|| {
            let (name, names) = (shortened(&value.to_string_lossy()), (self.names)());
            let file = if self.file.is_some() { ", or a .toml file" } else { "" };
            let near = aviary::did_you_mean(&name, &names);
            let wrong = format!("{} is `{name}`", option(argument));
            let message = format!("{wrong}, expected one of: {}{file}{near}", names.join(", "));
            refusal(match message.chars().count() <= MAX_MESSAGE {
                true => message,
                false if near.is_empty() => format!("{wrong}, expected one of those that `{}` lists", self.command),
                false => format!("{wrong}{near}"),
            })
        })
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        Some(Box::new((self.names)().into_iter().map(PossibleValue::new)))
    }
}

/// Returns the name of an option in messages.
fn option(argument: Option<&Arg>) -> String {
    match argument {
        Some(argument) => argument.get_long().map_or(format!("the {}", argument.get_id()), |long| format!("--{long}")),
        None => "a value".into(),
    }
}

fn refusal(message: String) -> clap::Error {
    clap::Error::raw(ErrorKind::InvalidValue, message)
}

/// Creates a parser of a named enum.
pub fn named<T: NamedEnum>() -> Names<T> {
    Names { names: || T::NAMES.to_vec(), find: |name| name.parse().ok(), file: None, command: HELP }
}

/// Creates a parser of aerodynamic effects: names, separated by commas.
pub fn effects() -> Names<Effects> {
    let names = || std::iter::once("none").chain(Effects::NAMES.iter().copied()).collect();
    Names { names, find: |text| text.parse().ok(), file: None, command: HELP }
}

/// Creates a parser of a task.
pub fn task() -> Names<TaskSummary> {
    let find = |name: &str| tasks::summary(name).ok();
    Names { names: || tasks::NAMES.to_vec(), find, file: None, command: "aviary tasks" }
}

/// Creates a parser of the kind of obstacles. It refuses `custom`, which requires a list of obstacles in a file.
pub fn obstacles() -> Names<ObstacleKind> {
    const fn has_name(kind: ObstacleKind) -> bool {
        !matches!(kind, ObstacleKind::Custom)
    }
    Names {
        names: || ObstacleKind::ALL.into_iter().filter(|&kind| has_name(kind)).map(ObstacleKind::name).collect(),
        find: |name| name.parse().ok().filter(|&kind| has_name(kind)),
        file: None,
        command: HELP,
    }
}

/// Name of a value, or the TOML file that describes it.
#[derive(Debug, Clone)]
pub enum NameOrFile<T> {
    /// Value with a name.
    Name(T),
    /// TOML file.
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

/// Creates a parser of an airframe.
pub fn airframe() -> Names<NameOrFile<DroneModel>> {
    Names {
        names: || DroneModel::NAMES.to_vec(),
        find: |name| name.parse().ok().map(NameOrFile::Name),
        file: Some(NameOrFile::File),
        command: HELP,
    }
}

/// Creates a parser of a trajectory.
pub fn trajectory() -> Names<NameOrFile<&'static str>> {
    Names {
        names: || trajectory::NAMES.to_vec(),
        find: |name| trajectory::NAMES.into_iter().find(|known| *known == name).map(NameOrFile::Name),
        file: Some(NameOrFile::File),
        command: HELP,
    }
}

/// Creates a parser of a track.
pub fn track() -> Names<NameOrFile<&'static str>> {
    Names {
        names: || RaceTrack::NAMES.to_vec(),
        find: |name| RaceTrack::NAMES.into_iter().find(|known| *known == name).map(NameOrFile::Name),
        file: Some(NameOrFile::File),
        command: HELP,
    }
}

/// Suite of a benchmark; `None` for all.
#[derive(Debug, Clone, Copy)]
pub struct SuiteChoice(pub Option<Suite>);

/// Creates a parser of a suite.
pub fn suite() -> Names<SuiteChoice> {
    Names {
        names: || Suite::NAMES.iter().copied().chain(["all"]).collect(),
        find: |name| {
            if name == "all" { Some(SuiteChoice(None)) } else { name.parse().ok().map(|s| SuiteChoice(Some(s))) }
        },
        file: None,
        command: HELP,
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
    /// No variation beyond that of the task and the configuration file.
    pub const NONE: Self = Self { starts: false, layouts: false };

    const NAMED: [(&'static str, Self); 4] = [
        ("all", Self { starts: true, layouts: true }),
        ("starts", Self { starts: true, layouts: false }),
        ("layouts", Self { starts: false, layouts: true }),
        ("none", Self::NONE),
    ];
}

/// Creates a parser of a variation.
pub fn variation() -> Names<Variation> {
    Names {
        names: || Variation::NAMED.map(|(name, _)| name).to_vec(),
        find: |name| Variation::NAMED.into_iter().find(|(known, _)| *known == name).map(|(_, variation)| variation),
        file: None,
        command: HELP,
    }
}

/// Parser of overlays: names, separated by commas.
#[derive(Debug, Clone)]
pub struct OverlayNames;

impl TypedValueParser for OverlayNames {
    type Value = Overlays;

    fn parse_ref(&self, _: &Command, argument: Option<&Arg>, value: &OsStr) -> Result<Overlays, clap::Error> {
        let wrong = |error: String| refusal(format!("{}: {error}", option(argument)));
        value.to_string_lossy().parse().map_err(wrong)
    }
}

/// Parses a width and a height, as in `640x480`.
pub fn size(text: &str) -> Result<ImageSize, String> {
    let expected = || format!("expected WIDTHxHEIGHT in pixels, each from 1 to {}", ImageSize::MAX_SIDE);
    let (width, height) = text.split_once('x').ok_or_else(expected)?;
    let side =
        |text: &str| text.parse().ok().filter(|side| (1..=ImageSize::MAX_SIDE).contains(side)).ok_or_else(expected);
    Ok(ImageSize { width: side(width)?, height: side(height)? })
}

/// Part of a run that several programs share: the index from 1 and the number of parts, as in `2/4`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    index: u64,
    count: u64,
}

impl Shard {
    /// The only part.
    pub const WHOLE: Self = Self { index: 1, count: 1 };

    /// Returns this part's range of `items`. The ranges of all parts adjoin each other, and their lengths differ by at
    /// most one.
    pub fn range(self, items: u64) -> Range<u64> {
        // the product exceeds 64 bits
        let bound = |part: u64| (u128::from(items) * u128::from(part) / u128::from(self.count)) as u64;
        bound(self.index - 1)..bound(self.index)
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let expected = || "expected I/N with I from 1 to N, as in 2/4".to_owned();
        let (index, count) = text.split_once('/').ok_or_else(expected)?;
        let (index, count) = (index.parse().map_err(|_| expected())?, count.parse().map_err(|_| expected())?);
        if (1..=count).contains(&index) { Ok(Self { index, count }) } else { Err(expected()) }
    }
}

impl Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

#[cfg(test)]
mod tests {
    use super::Shard;

    #[test]
    fn the_ranges_of_all_parts_adjoin_and_differ_by_at_most_one() {
        for items in [0, 1, 7, 100, u64::MAX] {
            for count in [1_u64, 2, 3, 8, 11] {
                let ranges: Vec<_> = (1..=count)
                    .map(|index| format!("{index}/{count}").parse::<Shard>().unwrap().range(items))
                    .collect();
                let lengths = || ranges.iter().map(|range| range.end - range.start);
                assert!(ranges.windows(2).all(|pair| pair[0].end == pair[1].start), "{ranges:?}");
                assert_eq!((ranges[0].start, ranges[ranges.len() - 1].end), (0, items));
                assert!(lengths().max().unwrap() - lengths().min().unwrap() <= 1, "{ranges:?}");
            }
        }
    }

    #[test]
    fn parts_outside_the_run_are_refused() {
        for text in ["", "1", "0/2", "3/2", "1/0", "-1/2", "1/2/3", "a/2", "1/ 2", "1.0/2"] {
            assert!(text.parse::<Shard>().unwrap_err().contains("expected I/N"), "{text}");
        }
    }
}
