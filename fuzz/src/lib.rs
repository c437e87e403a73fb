//! Fuzz targets over every kind of input that the simulator reads, and a driver that runs on stable Rust.
//!
//! A target must not panic, crash or hang on any input. The driver mutates the files of `fuzz/corpus/TARGET`. An
//! input with a new answer (another error message, ignoring numbers and names) is added to the pool for the rest of
//! the run. Case i of a seed is the same input in every run.
//!
//! A run of one hour:
//!
//! ```text
//! cargo run --release -p fuzz -- airframe --seconds 3600
//! ```

pub mod mutate;
pub mod targets;

use std::collections::HashSet;
use std::panic::AssertUnwindSafe;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;

pub use targets::Target;

/// Largest number of inputs in the pool.
const MAX_POOL: usize = 4096;

/// Returns the directory of the corpora.
pub fn corpus_directory() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus")
}

/// Returns the initial inputs of a target, sorted by path: the files of `fuzz/corpus/TARGET`, and the repository
/// files that the target lists.
///
/// # Errors
/// Errors of reading the files.
pub fn corpus(target: &Target) -> std::io::Result<Vec<Vec<u8>>> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let own = corpus_directory().join(target.name);
    // a target may use repository files only
    let mut paths: Vec<_> = match std::fs::read_dir(&own) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound && !target.more.is_empty() => Vec::new(),
        entries => entries?.map(|entry| entry.map(|entry| entry.path())).collect::<Result<_, _>>()?,
    };
    paths.extend(target.more.iter().map(|path| root.join(path)));
    paths.sort();
    paths.iter().map(std::fs::read).collect()
}

/// Input on which a target panicked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// Number of the case; `None` for an input of the corpus.
    pub case: Option<u64>,
    /// Input of the case.
    pub input: Vec<u8>,
    /// Message of the panic.
    pub message: String,
}

/// Outcome of a run.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Report {
    /// Number of cases, without the corpus.
    pub cases: u64,
    /// Number of cases that the target accepted; the others were errors.
    pub accepted: u64,
    /// Number of distinct answers.
    pub answers: usize,
    /// Longest time of a case, and the number of the case.
    pub slowest: (Duration, u64),
    /// Panic that ended the run, if one did.
    pub finding: Option<Finding>,
}

/// Returns an answer without its variable parts: digits, and text in quotes.
fn signature(answer: &Result<(), String>) -> String {
    let Err(message) = answer else { return "accepted".into() };
    let mut quoted = false;
    let kept = |c: &char| {
        if matches!(c, '`' | '"') {
            quoted = !quoted;
        }
        !quoted && !c.is_ascii_digit()
    };
    message.chars().filter(kept).take(120).collect()
}

/// Runs a target on an input; an outer error is the message of a panic.
fn answer(target: &Target, input: &[u8]) -> Result<Result<(), String>, String> {
    std::panic::catch_unwind(AssertUnwindSafe(|| (target.run)(input))).map_err(|panic| {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("a panic without a message").to_string()
    })
}

/// Runs a target on its corpus and then on mutations, until `go_on` returns false or a case panics.
///
/// `go_on` is called before every input with the number of its case, 0 for inputs of the corpus.
pub fn run(target: &Target, corpus: &[Vec<u8>], seed: u64, mut go_on: impl FnMut(u64, &[u8]) -> bool) -> Report {
    let (mut report, mut seen, mut pool) = (Report::default(), HashSet::new(), corpus.to_vec());
    for input in corpus {
        if !go_on(0, input) {
            return report;
        }
        match answer(target, input) {
            Ok(answer) => drop(seen.insert(signature(&answer))),
            Err(message) => {
                report.finding = Some(Finding { case: None, input: input.clone(), message });
                return report;
            }
        }
    }
    for case in 0.. {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(case);
        let input = mutate::mutate(&mut rng, &pool);
        if !go_on(case, &input) {
            break;
        }
        let start = Instant::now();
        let answer = answer(target, &input);
        report.slowest = report.slowest.max((start.elapsed(), case));
        report.cases += 1;
        match answer {
            Ok(answer) => {
                report.accepted += u64::from(answer.is_ok());
                if seen.insert(signature(&answer)) && pool.len() < MAX_POOL {
                    pool.push(input);
                }
            }
            Err(message) => {
                report.finding = Some(Finding { case: Some(case), input, message });
                break;
            }
        }
    }
    report.answers = seen.len();
    report
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_is_reported_with_its_input_and_runs_are_reproducible() {
        let fragile = Target {
            name: "fragile",
            about: "",
            more: &[],
            run: |input| {
                assert!(!input.contains(&b'9'), "a nine");
                if input.len() > 8 { Err(format!("{} bytes", input.len())) } else { Ok(()) }
            },
        };
        let corpus = [b"1 2 3\n".to_vec()];
        let report = run(&fragile, &corpus, 5, |case, _| case < 10_000);
        let finding = report.finding.clone().unwrap();
        assert!(finding.message.contains("a nine") && finding.input.contains(&b'9'), "{finding:?}");
        assert_eq!(finding.case, Some(report.cases - 1));
        let again = run(&fragile, &corpus, 5, |_, _| true);
        assert_eq!((again.finding, again.accepted), (report.finding, report.accepted));
    }

    #[test]
    fn answers_that_differ_only_in_numbers_and_names_count_once() {
        let of = |text: &str| signature(&Err(text.into()));
        assert_eq!(of("line 3: `mas` is 7, expected 8"), of("line 12: `x` is 1, expected 8"));
        assert_ne!(of("line 3: too short"), of("line 3: too long"));
        assert_ne!(signature(&Ok(())), of(""));
    }
}
