//! The command line of mujoco-drones-gym: parses, calls, prints.

mod airframe;
mod animation;
mod bench;
mod capture;
mod compare;
mod completions;
mod convert;
mod doctor;
mod failure;
mod fly;
mod identify;
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
mod view;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Fly, train and benchmark quadrotors on MuJoCo
#[derive(Debug, Parser)]
#[command(name = "aviary", version)]
#[command(after_help = "Examples:
  aviary fly --task hover
  aviary fly --task race --drone race --out out/race --plot --gif out/race.gif --overlay trails
  aviary capture --task fly_through --frames 100 --out out/frames
  aviary train --task hover --until-success --out out/hover
  aviary play --policy out/hover/policy.safetensors --episodes 20
  aviary bench --quick

`aviary COMMAND -h` lists the options of a command, `aviary COMMAND --help` explains them.")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

// no doc comments on the variants: they would replace the descriptions of the commands, details included
#[derive(Debug, Subcommand)]
enum Command {
    Fly(fly::Fly),
    View(view::View),
    Capture(capture::Capture),
    Render(render::Render),
    Replay(replay::Replay),
    Train(Box<train::Train>),
    Play(Box<play::Play>),
    Bench(bench::Bench),
    Compare(compare::Compare),
    Convert(convert::Convert),
    Identify(identify::Identify),
    Tasks(tasks::Tasks),
    Airframe(airframe::Airframe),
    Doctor(doctor::Doctor),
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
        Command::View(command) => command.run(),
        Command::Capture(command) => command.run(),
        Command::Render(command) => command.run(),
        Command::Replay(command) => command.run(),
        Command::Train(command) => command.run(),
        Command::Play(command) => command.run(),
        Command::Bench(command) => command.run(),
        Command::Compare(command) => command.run(),
        Command::Convert(command) => command.run(),
        Command::Identify(command) => command.run(),
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
