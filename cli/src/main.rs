//! The command line of mujoco-drones-gym: parses, calls, prints.

mod airframe;
mod bench;
mod capture;
mod completions;
mod doctor;
mod failure;
mod film;
mod fly;
mod interrupt;
mod options;
mod output;
mod parse;
mod pilot;
mod play;
mod render;
mod replay;
mod tasks;
mod train;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Quadrotors on MuJoCo.
#[derive(Debug, Parser)]
#[command(name = "aviary", version, about)]
#[command(after_help = "Examples:
  aviary fly --task hover
  aviary fly --task race --drone race --out out/race --plot --gif out/race.gif --overlay trails
  aviary capture --task fly_through --frames 100 --out out/frames
  aviary train --task hover --until-success --out out/hover
  aviary play --policy out/hover/policy.safetensors --episodes 20
  aviary bench --quick

`aviary COMMAND --help` shows every option of a command.")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Fly a task with a built-in controller and report how well
    Fly(fly::Fly),
    /// Write camera observations of a flight: colour, depth, objects and states
    Capture(capture::Capture),
    /// Draw one picture of a task's scene
    Render(render::Render),
    /// Fly recorded motor speeds and write the states
    Replay(replay::Replay),
    /// Train a policy, or one for every task
    Train(Box<train::Train>),
    /// Fly a trained policy and report how well
    Play(Box<play::Play>),
    /// Measure steps per second of the engines, one environment and many
    Bench(bench::Bench),
    /// List the tasks
    Tasks(tasks::Tasks),
    /// Print derived numbers of an airframe and warn where one is implausible
    Airframe(airframe::Airframe),
    /// Check what the program needs from this machine
    Doctor(doctor::Doctor),
    /// Print what a shell needs to complete commands and names
    Completions(completions::Completions),
}

fn main() -> ExitCode {
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .with_env_filter(
            tracing_subscriber::EnvFilter::builder()
                .with_default_directive(tracing_subscriber::filter::LevelFilter::WARN.into())
                .from_env_lossy(),
        )
        .without_time()
        .with_target(false)
        .init();
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => return failure::usage(&error),
    };
    output::clean_up_when_interrupted();
    let done = match &cli.command {
        Command::Fly(command) => command.run(),
        Command::Capture(command) => command.run(),
        Command::Render(command) => command.run(),
        Command::Replay(command) => command.run(),
        Command::Train(command) => command.run(),
        Command::Play(command) => command.run(),
        Command::Bench(command) => command.run(),
        Command::Tasks(command) => command.run(),
        Command::Airframe(command) => command.run(),
        Command::Doctor(command) => command.run(),
        Command::Completions(command) => command.run(),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failure::report(&error),
    }
}
