use std::io::Write;

use super::table::{FLOWN_COLUMNS, state_numbers, written};
use super::{COLUMNS, RecordError};
use crate::simulation::Simulation;

/// CSV log of a flight with one row per control step and drone. It has the [`COLUMNS`] up to the motor speeds.
///
/// Numbers read back bit-exactly, except that negative zero is written as zero.
pub struct CsvLog<W: Write> {
    writer: csv::Writer<W>,
}

impl<W: Write> CsvLog<W> {
    /// Creates a log and writes its header.
    ///
    /// # Errors
    /// [`RecordError::Write`] if the target cannot be written.
    pub fn new(target: W) -> Result<Self, RecordError> {
        let mut writer = csv::Writer::from_writer(target);
        writer.write_record(&COLUMNS[..FLOWN_COLUMNS])?;
        Ok(Self { writer })
    }

    /// Writes a row with the current state of every drone.
    ///
    /// # Errors
    /// [`RecordError::Write`] if the target cannot be written.
    pub fn record(&mut self, simulation: &Simulation) -> Result<(), RecordError> {
        let time = simulation.time();
        for (drone, (state, rpm)) in simulation.states().iter().zip(simulation.motor_speeds()).enumerate() {
            self.writer.write_field(time.to_string())?;
            self.writer.write_field(drone.to_string())?;
            let (rpy, numbers) = (state.rpy(), state_numbers(state));
            let numbers = numbers.iter().chain(&rpy).chain(rpm);
            self.writer.write_record(numbers.map(|&x| written(x).to_string()))?;
        }
        Ok(())
    }

    /// Completes the log and returns the target.
    ///
    /// # Errors
    /// [`RecordError::Flush`] if the target cannot be written.
    pub fn finish(self) -> Result<W, RecordError> {
        self.writer.into_inner().map_err(|error| RecordError::Flush(error.into_error()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use crate::state::wxyz;

    #[test]
    fn a_log_reads_back_bit_exactly() {
        let mut simulation = Simulation::builder(DroneModel::Cf2x)
            .num_drones(2)
            .initial_rpys([[0.1, 0.2, 0.3], [-0.3, 0.2, 3.0]])
            .build()
            .unwrap();
        let mut log = CsvLog::new(Vec::new()).unwrap();
        log.record(&simulation).unwrap();
        simulation.step(&[[14_000.0, 14_100.1, 1.0 / 3.0, 9e9]; 2]).unwrap();
        log.record(&simulation).unwrap();
        let bytes = log.finish().unwrap();

        let mut reader = csv::Reader::from_reader(&bytes[..]);
        assert_eq!(reader.headers().unwrap(), COLUMNS[..FLOWN_COLUMNS].to_vec());
        let rows: Vec<Vec<f64>> =
            reader.records().map(|row| row.unwrap().iter().map(|x| x.parse().unwrap()).collect()).collect();
        assert_eq!(rows.len(), 4);
        for (drone, state) in simulation.states().iter().enumerate() {
            let row = &rows[2 + drone];
            assert_eq!((row[0], row[1]), (1.0 / 48.0, drone as f64));
            assert_eq!(row[2..5], *state.position.as_slice());
            assert_eq!(row[5..9], wxyz(&state.attitude));
            assert_eq!(row[9..12], *state.velocity.as_slice());
            assert_eq!(row[12..15], *state.angular_velocity.as_slice());
            assert_eq!(row[18..], [14_000.0, 14_100.1, 1.0 / 3.0, simulation.params(drone).max_rpm()]);
        }
    }
}
