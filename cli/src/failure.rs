//! Exit status and error lines of the program.

use std::error::Error as _;
use std::num::{IntErrorKind, ParseFloatError, ParseIntError};
use std::process::ExitCode;

use clap::error::{ContextKind, ContextValue, ErrorKind};
use learn::TrainError;

use crate::interrupt::Interruption;
use crate::output;

/// Error of a command, with its exit status.
#[derive(Debug)]
pub enum Failure {
    /// The command line or an input file is wrong: status 2.
    Input(anyhow::Error),
    /// The work itself failed: status 1, or that of an [`Interruption`].
    Work(anyhow::Error),
}

impl Failure {
    /// Creates a failure of the command line or an input file.
    pub fn input(error: impl Into<anyhow::Error>) -> Self {
        Self::Input(error.into())
    }

    /// Creates a failure of the work.
    pub fn work(error: impl Into<anyhow::Error>) -> Self {
        Self::Work(error.into())
    }
}

/// Errors of a training run before its first iteration: its configuration or checkpoint is wrong.
impl From<TrainError> for Failure {
    fn from(error: TrainError) -> Self {
        Self::input(error)
    }
}

/// Errors of a GPU: a wrong option, or a machine whose GPU does not work.
#[cfg(feature = "gpu")]
impl From<aviary_gpu::GpuError> for Failure {
    fn from(error: aviary_gpu::GpuError) -> Self {
        use aviary_gpu::GpuError;

        match error {
            GpuError::NoAdapter { .. } | GpuError::Open { .. } | GpuError::Device { .. } => Self::work(error),
            error => Self::input(error),
        }
    }
}

/// Prints the error on one line and returns the exit status.
pub fn report(failure: &Failure) -> u8 {
    let (error, status) = match failure {
        Failure::Input(error) => (error, 2),
        Failure::Work(error) => (error, error.downcast_ref().map_or(1, Interruption::status)),
    };
    // some errors repeat their source
    let mut message = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if !message.contains(&cause) {
            message += if message.is_empty() { "" } else { ": " };
            message += &cause;
        }
    }
    line(&message);
    status
}

fn line(message: &str) {
    let message = message.split_whitespace().collect::<Vec<_>>().join(" ");
    use std::io::Write as _;
    // nothing can be reported if standard error is closed
    let _ = writeln!(std::io::stderr(), "error: {message}");
}

/// Prints help and version unchanged and every error of clap on one line; returns the exit status.
pub fn usage(error: &clap::Error) -> ExitCode {
    match error.kind() {
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion => match output::print(&error.to_string()) {
            Ok(()) => ExitCode::SUCCESS,
            Err(failure) => report(&failure).into(),
        },
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => {
            line("no command given; `aviary --help` lists them");
            ExitCode::from(2)
        }
        _ => {
            if let Some(message) = wrong_value(error).or_else(|| missing_option(error)) {
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

/// Returns a value of the command line as messages print it: with an ellipsis if it is long.
pub fn shortened(value: &str) -> String {
    const MAX: usize = 40;
    match value.char_indices().nth(MAX) {
        Some((end, _)) => format!("{}…", &value[..end]),
        None => value.to_string(),
    }
}

/// Returns the string of a context of an error, if it has one.
fn context(error: &clap::Error, kind: ContextKind) -> Option<&str> {
    match error.get(kind) {
        Some(ContextValue::String(text)) => Some(text),
        _ => None,
    }
}

/// Returns the name of an option in messages: `--duration` for `--duration <S>`, `the shell` for `<SHELL>`.
fn option_name(usage: &str) -> String {
    let name = usage.split(' ').next().unwrap_or_default();
    match name.strip_prefix('<') {
        Some(name) => format!("the {}", name.trim_end_matches('>').to_lowercase()),
        None => name.trim_end_matches('>').to_string(),
    }
}

/// Returns the message about a missing option, or about a missing choice of several.
fn missing_option(error: &clap::Error) -> Option<String> {
    if error.kind() != ErrorKind::MissingRequiredArgument {
        return None;
    }
    let Some(ContextValue::Strings(missing)) = error.get(ContextKind::InvalidArg) else { return None };
    let names = |text: &String| {
        // a choice is `<--task <NAME>|--all|--resume <DIR>>`
        let text = text.strip_prefix('<').filter(|rest| rest.starts_with("--")).unwrap_or(text);
        let all: Vec<_> = text.split('|').map(option_name).collect();
        // the earlier name of --png is hidden
        let is_shown = |name: &&String| all.len() == 1 || *name != "--frames";
        all.iter().filter(is_shown).cloned().collect::<Vec<_>>().join(" or ")
    };
    let missing: Vec<_> = missing.iter().map(names).collect();
    let verb = if missing.len() == 1 { "is" } else { "are" };
    Some(format!("{} {verb} missing", missing.join(", ")))
}

/// Returns the message about an option whose value is not one that the option takes; `None` for every other error.
fn wrong_value(error: &clap::Error) -> Option<String> {
    let option = option_name(context(error, ContextKind::InvalidArg)?);
    let value = context(error, ContextKind::InvalidValue)?;
    if value.is_empty() && error.source().is_none() {
        return Some(format!("{option} has no value"));
    }
    let wrong = |expected: &str| Some(format!("{option} is `{}`, expected {expected}", shortened(value)));
    if let Some(ContextValue::Strings(names)) = error.get(ContextKind::ValidValue) {
        let names: Vec<_> = names.iter().map(String::as_str).collect();
        return wrong(&format!("one of: {}{}", names.join(", "), aviary::did_you_mean(value, &names)));
    }
    let source = error.source()?;
    if source.is::<ParseFloatError>() {
        return wrong("a number");
    }
    if let Some(error) = source.downcast_ref::<ParseIntError>() {
        return match error.kind() {
            // the error does not have the limit of the option
            IntErrorKind::PosOverflow => wrong("a smaller whole number"),
            IntErrorKind::Zero => wrong("a positive whole number"),
            _ => wrong("a whole number, zero or positive"),
        };
    }
    let message = source.to_string();
    if let Some((_, range)) = message.split_once(" is not in ") {
        let (low, high) = range.split_once("..=")?;
        return wrong(&format!("a whole number from {low} to {high}"));
    }
    // the parsers of this program
    message.strip_prefix("expected ").and_then(wrong)
}
