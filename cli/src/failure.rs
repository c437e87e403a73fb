//! Exit codes and error lines, in one place.

use std::io::Write as _;
use std::process::ExitCode;

use clap::error::ErrorKind;

/// Why a command did not do its work.
#[derive(Debug)]
pub enum Failure {
    /// The command line or an input file is wrong: status 2.
    Input(anyhow::Error),
    /// The work itself failed: status 1.
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
        Failure::Work(error) => (error, 1),
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
    // nobody is left to tell when standard error is closed
    let _ = writeln!(std::io::stderr(), "error: {message}");
}

/// What clap has to say: help and version as they are, everything else on one line.
pub fn usage(error: &clap::Error) -> ExitCode {
    match error.kind() {
        ErrorKind::DisplayHelp | ErrorKind::DisplayVersion => {
            let _ = write!(std::io::stdout(), "{error}");
            ExitCode::SUCCESS
        }
        ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => {
            line("no command given; `aviary --help` lists them");
            ExitCode::from(2)
        }
        _ => {
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
