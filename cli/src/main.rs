//! The command line of mujoco-drones-gym: parses, calls, prints.

mod airframe;
mod animation;
mod bench;
mod benchmark;
mod capture;
mod compare;
mod completions;
mod convert;
mod doctor;
mod export;
mod failure;
mod fly;
mod identify;
mod interrupt;
mod options;
mod output;
mod parse;
mod pilot;
mod play;
mod policy_file;
mod render;
mod replay;
mod rerun;
mod tasks;
mod threads;
mod train;
mod view;
mod window;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::filter::LevelFilter;

/// Fly, train and benchmark quadrotors on MuJoCo
#[derive(Debug, Parser)]
#[command(name = "aviary", version)]
#[command(after_help = "Examples:
  aviary fly --task hover
  aviary fly --task race --drone race --out out/race --plot --gif out/race.gif --overlay trails
  aviary capture --task fly_through --frames 100 --out out/frames
  aviary train --task hover --until-success --out out/hover
  aviary play --policy out/hover/policy.safetensors --episodes 20
  aviary export --policy out/hover/policy.safetensors --format onnx --out out/hover.onnx
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
    Export(export::Export),
    Bench(bench::Bench),
    Benchmark(benchmark::Benchmark),
    Compare(compare::Compare),
    Convert(convert::Convert),
    Identify(identify::Identify),
    Tasks(tasks::Tasks),
    Airframe(airframe::Airframe),
    Doctor(doctor::Doctor),
    Completions(completions::Completions),
}

/// Returns the filter of the messages on standard error: RUST_LOG, or warnings.
///
/// The libraries of the window warn about every display without a desktop, which draws no less correctly. Rerun prints
/// the errors that it also returns.
fn messages() -> EnvFilter {
    let asked = std::env::var("RUST_LOG").unwrap_or_default();
    let default = "warn,winit=error,sctk=error,smithay_client_toolkit=error,smithay_clipboard=error,arboard=error,\
                   egui_winit=error,egui_glow=error,re_sdk=off,re_grpc_client=off";
    let builder = EnvFilter::builder().with_default_directive(LevelFilter::WARN.into());
    builder.parse_lossy(if asked.trim().is_empty() { default } else { &asked })
}

fn main() -> ExitCode {
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .with_env_filter(messages())
        // without a message about a standard error that cannot be written: its message would fail as well, and panic
        .log_internal_errors(false)
        .without_time()
        .with_target(false)
        .init();
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => return failure::usage(&error),
    };
    let done = output::clean_up_when_interrupted().and_then(|()| match &cli.command {
        Command::Fly(command) => command.run(),
        Command::View(command) => command.run(),
        Command::Capture(command) => command.run(),
        Command::Render(command) => command.run(),
        Command::Replay(command) => command.run(),
        Command::Train(command) => command.run(),
        Command::Play(command) => command.run(),
        Command::Export(command) => command.run(),
        Command::Bench(command) => command.run(),
        Command::Benchmark(command) => command.run(),
        Command::Compare(command) => command.run(),
        Command::Convert(command) => command.run(),
        Command::Identify(command) => command.run(),
        Command::Tasks(command) => command.run(),
        Command::Airframe(command) => command.run(),
        Command::Doctor(command) => command.run(),
        Command::Completions(command) => command.run(),
    });
    let status = done.map_or_else(|error| failure::report(&error), |()| 0);
    if viewer::has_thread() {
        // without the destructors of OpenGL, which crash while a window without its display draws
        signal_hook::low_level::exit(status.into());
    }
    status.into()
}
