//! Event files of TensorBoard.
//!
//! An event file is a sequence of records of TensorFlow (length, checksum, content, checksum), whose contents are
//! protocol buffers of the type `Event`. The crates that write them are without releases for years or need a protocol
//! buffer compiler at build time.

use std::fs::File;
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use prost::Message as _;

use crate::Point;

/// Writer of the event file of a run, with one event per number and iteration.
///
/// ```
/// use learn::{TensorboardWriter, TrainConfig, Trainer};
///
/// let directory = tempfile::tempdir()?;
/// let mut events = TensorboardWriter::create(directory.path())?;
/// let mut config = TrainConfig::of_task("hover")?;
/// (config.steps, config.ppo.environments, config.ppo.horizon, config.episodes) = (512, 16, 16, 2);
/// let mut trainer = Trainer::new(config, "a test")?;
/// while trainer.stop().is_none() {
///     events.write(trainer.advance()?)?;
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct TensorboardWriter {
    file: File,
    path: PathBuf,
}

impl TensorboardWriter {
    /// Name of the file. TensorBoard reads the files whose names contain `tfevents`.
    pub const NAME: &'static str = "events.out.tfevents.aviary";

    /// Creates the event file of a run in its directory, and replaces an earlier one.
    ///
    /// # Errors
    /// Those of the system.
    pub fn create(directory: impl AsRef<Path>) -> io::Result<Self> {
        let path = directory.as_ref().join(Self::NAME);
        let mut file = File::create(&path)?;
        let version = Event { wall_time: now(), file_version: Some("brain.Event:2".into()), ..Event::default() };
        file.write_all(&record(&version.encode_to_vec()))?;
        Ok(Self { file, path })
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Appends the numbers of an iteration, with the environment steps so far as their step. The names of the numbers
    /// are those of Stable-Baselines3.
    ///
    /// # Errors
    /// Those of the system.
    pub fn write(&mut self, point: &Point) -> io::Result<()> {
        let report = &point.report;
        let score = point.score;
        let numbers = [
            ("rollout/ep_rew_mean", report.mean_return),
            ("rollout/step_rew_mean", Some(report.mean_reward)),
            ("train/approx_kl", Some(report.approx_kl)),
            ("train/clip_fraction", Some(report.clip_fraction)),
            ("train/explained_variance", Some(report.explained_variance)),
            ("train/learning_rate", Some(point.rate)),
            ("train/loss", Some(report.loss)),
            ("train/std", Some(report.action_std)),
            ("eval/mean_reward", score.map(|score| score.reward)),
            ("eval/success_rate", score.map(|score| score.success)),
            ("eval/progress", score.map(|score| score.progress)),
        ];
        let (mut records, wall_time, step) = (Vec::new(), now(), point.steps as i64);
        for (tag, number) in numbers {
            if let Some(number) = number {
                let value = SummaryValue { tag: tag.into(), simple_value: Some(number as f32) };
                let event =
                    Event { wall_time, step, summary: Some(Summary { value: vec![value] }), file_version: None };
                records.extend(record(&event.encode_to_vec()));
            }
        }
        // whole records, so that a concurrent reader never sees a part of one
        self.file.write_all(&records)
    }
}

/// The fields of TensorFlow's `Event` that a scalar has.
#[derive(Clone, PartialEq, prost::Message)]
struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
}

/// TensorFlow's `Summary`.
#[derive(Clone, PartialEq, prost::Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<SummaryValue>,
}

/// TensorFlow's `Summary.Value`.
#[derive(Clone, PartialEq, prost::Message)]
struct SummaryValue {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

/// Returns the seconds since 1970.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |time| time.as_secs_f64())
}

/// Returns content as a record.
fn record(content: &[u8]) -> Vec<u8> {
    let length = (content.len() as u64).to_le_bytes();
    [&length[..], &masked(&length), content, &masked(content)].concat()
}

/// Returns the checksum of TensorFlow: a rotated CRC-32C, so that the checksum of a checksum differs from it.
fn masked(bytes: &[u8]) -> [u8; 4] {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Report, Score};

    /// Reads the records of a file and checks their checksums.
    fn records(bytes: &[u8]) -> Vec<Vec<u8>> {
        let (mut records, mut left) = (Vec::new(), bytes);
        while !left.is_empty() {
            let (header, rest) = left.split_at(12);
            let length = u64::from_le_bytes(header[..8].try_into().unwrap()) as usize;
            assert_eq!(header[8..], masked(&header[..8]));
            let (content, rest) = rest.split_at(length);
            assert_eq!(rest[..4], masked(content));
            records.push(content.to_vec());
            left = &rest[4..];
        }
        records
    }

    #[test]
    fn checksums_are_those_of_tensorflow() {
        // CRC-32C of 32 zeros is 0x8a9136aa (RFC 3720, appendix B.4)
        assert_eq!(crc32c::crc32c(&[0; 32]), 0x8a91_36aa);
        // rotated by 15 bits, plus 0xa282ead8
        assert_eq!(masked(&[0; 32]), 0x0fd7_fffa_u32.to_le_bytes());
    }

    #[test]
    fn events_have_tag_number_and_step() {
        let directory = tempfile::tempdir().unwrap();
        let mut events = TensorboardWriter::create(directory.path()).unwrap();
        let score = Some(Score { success: 0.75, reward: -3.0, progress: 1.0 });
        let report = Report { mean_return: None, loss: 2.5, ..Report::default() };
        events.write(&Point { iteration: 1, steps: 300, report, score, rate: 1e-3 }).unwrap();
        let found = records(&std::fs::read(events.path()).unwrap());
        // the version, and every number but the return, which the iteration does not have
        assert_eq!(found.len(), 11);
        let events: Vec<Event> = found.iter().map(|record| Event::decode(&record[..]).unwrap()).collect();
        assert_eq!(events[0].file_version.as_deref(), Some("brain.Event:2"));
        for (tag, number) in [("train/loss", 2.5_f32), ("eval/success_rate", 0.75), ("eval/mean_reward", -3.0)] {
            let of_tag = |event: &&Event| event.summary.as_ref().is_some_and(|summary| summary.value[0].tag == tag);
            let event = events.iter().find(of_tag).unwrap();
            assert_eq!((event.step, event.summary.as_ref().unwrap().value[0].simple_value), (300, Some(number)));
            assert!(event.wall_time > 1.7e9);
        }
        // the bytes that TensorBoard reads: the step 300 as a varint in field 2, the number in field 2 of the value
        let loss = found.iter().find(|event| event.windows(10).any(|part| part == b"train/loss")).unwrap();
        assert_eq!((loss[0], &loss[9..12], loss[12]), (0x09, &[0x10, 0xac, 0x02][..], 0x2a));
        assert!(loss.ends_with(&[&[0x15][..], &2.5_f32.to_le_bytes()].concat()));
    }
}
