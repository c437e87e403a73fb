//! Exit codes and error lines, in one place.

use std::error::Error as _;
use std::num::{IntErrorKind, ParseFloatError, ParseIntError};
use std::process::ExitCode;

use clap::error::{ContextKind, ContextValue, ErrorKind};

use crate::interrupt::Interruption;
use crate::output;

/// Why a command did not do its work.
#[derive(Debug)]
pub enum Failure {
    /// The command line or an input file is wrong: status 2.
    Input(anyhow::Error),
    /// The work itself failed: status 1, or that of an [`Interruption`].
    Work(anyhow::Error),
}

impl Failure {
    /// Something in the command line or an input file.
    pub fn input(error: impl Into<anyhow::Error>) -> Self {
        Self::Input(error.into())
    }

    /// Something that happened on the way.
    pub fn work(error: impl Into<anyhow::Error>) -> Self {
        Self::Work(error.into())
    }
}

/// Prints the error on one line and gives the exit status.
pub fn report(failure: &Failure) -> ExitCode {
    let (error, status) = match failure {
        Failure::Input(error) => (error, 2),
        Failure::Work(error) => (error, error.downcast_ref().map_or(1, Interruption::status)),
    };
    // some errors repeat what is behind them
    let mut message = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if !message.contains(&cause) {
            message += if message.is_empty() { "" } else { ": " };
            message += &cause;
        }
    }
    line(&message);
    ExitCode::from(status)
}

fn line(message: &str) {
    let message = message.split_whitespace().collect::<Vec<_>>().join(" ");
    use std::io::Write as _;
    // nobody is left to tell when standard error is closed
    let _ = writeln!(std::io::stderr(), "error: {message}");
}

/// What clap has to say: help and version as they are, everything else on one line.
pub fn usage(error: &clap::Error) -> ExitCode {
    match error.kind() {
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion => match output::print(&error.to_string()) {
            Ok(()) => ExitCode::SUCCESS,
            Err(failure) => report(&failure),
        },
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => {
            line("no command given; `aviary --help` lists them");
            ExitCode::from(2)
        }
        _ => {
            if let Some(message) = wrong_number(error) {
                line(&message);
                return ExitCode::from(2);
            }
            let text = error.to_string();
            let parts: Vec<_> = text
                .lines()
                .map(str::trim)
                .filter(|line| {
                    !line.is_empty() && !line.starts_with("Usage:") && !line.starts_with("For more information")
                })
                .map(|line| line.trim_start_matches("error: ").trim_start_matches("tip: "))
                .collect();
            line(&parts.join("; ").replace(":;", ":"));
            ExitCode::from(2)
        }
    }
}

/// The message for an option whose value is not the number that the option takes; `None` for every other error.
fn wrong_number(error: &clap::Error) -> Option<String> {
    let text = |kind| match error.get(kind) {
        Some(ContextValue::String(text)) => Some(text.as_str()),
        _ => None,
    };
    // `--duration <DURATION>`
    let option = text(ContextKind::InvalidArg)?.split(' ').next()?;
    let value = text(ContextKind::InvalidValue)?;
    let source = error.source()?;
    let range = source.to_string();
    let expected = if source.is::<ParseFloatError>() {
        "a number".to_string()
    } else if let Some(error) = source.downcast_ref::<ParseIntError>() {
        match error.kind() {
            // options have different limits, and the error does not name that of this one
            IntErrorKind::PosOverflow => "a smaller whole number".into(),
            _ => "a whole number, zero or positive".into(),
        }
    } else if let Some((_, range)) = range.split_once(" is not in ") {
        let (low, high) = range.split_once("..=")?;
        format!("a whole number from {low} to {high}")
    } else {
        return None;
    };
    Some(format!("{option} is `{value}`, expected {expected}"))
}
