use clap::Args;

use crate::failure::Failure;
use crate::fly::{FlightCommand, InWindow};
use crate::rerun::RerunOptions;

/// Fly a task in a window, in real time, and change the flight while it runs
///
/// The mouse turns the camera, selects and pushes drones. Panels and keys pause, rewind and
/// restart the flight, set wind, motors and controller, and fly a drone by hand; H lists the
/// keys. The window stays open after the episode. Closing it prints the results of the last
/// episode and writes the files of --out.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary view --task hover
  aviary view --task race --drone race
  aviary view --task formation --num-drones 5 --wind constant
  aviary view --task hover --obstacles forest --out out/mine")]
pub struct View {
    #[command(flatten)]
    flight: FlightCommand,
}

impl View {
    pub fn run(&self) -> Result<(), Failure> {
        self.flight.run(InWindow::Changed, &RerunOptions::default())
    }
}
