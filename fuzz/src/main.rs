//! Runs a fuzz target for a given time.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context as _;
use clap::Parser;
use fuzz::targets::{self, Target};

/// Mutates the corpus of a target and reports the first input that panics, crashes or hangs
#[derive(Debug, Parser)]
#[command(version)]
struct Options {
    /// Target, or `all` for each in turn
    #[arg(value_parser = clap::builder::PossibleValuesParser::new(targets::names().chain(["all"])))]
    target: String,
    /// Time for each target, s
    #[arg(long, default_value_t = 60)]
    seconds: u64,
    /// Seed of the mutations: case i of a seed is the same in every run
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Time after which a case counts as a hang, s
    #[arg(long, default_value_t = 20)]
    hang: u64,
    /// Run one file instead of mutations
    #[arg(long)]
    input: Option<PathBuf>,
    /// Directory of findings and of the running input (`TARGET.current`, which remains after a crash)
    #[arg(long, default_value = "out/fuzz")]
    out: PathBuf,
}

fn main() -> anyhow::Result<()> {
    let options = Options::parse();
    std::fs::create_dir_all(&options.out).with_context(|| format!("{}", options.out.display()))?;
    let chosen = targets::ALL.iter().filter(|target| options.target == "all" || options.target == target.name);
    for target in chosen {
        match &options.input {
            Some(path) => {
                let input = std::fs::read(path).with_context(|| format!("{}", path.display()))?;
                say(&format!("{}: {:?}", target.name, (target.run)(&input)));
            }
            None => campaign(target, &options)?,
        }
    }
    Ok(())
}

#[allow(clippy::print_stdout)]
fn say(line: &str) {
    println!("{line}");
}

/// Aborts the process if a case takes too long, because C code cannot be interrupted.
fn watch(case_start: Arc<AtomicU64>, begin: Instant, hang: Duration, message: String) {
    std::thread::spawn(move || {
        loop {
            std::thread::sleep(Duration::from_millis(200));
            let started = Duration::from_millis(case_start.load(Ordering::Relaxed));
            if begin.elapsed().saturating_sub(started) > hang {
                say(&message);
                std::process::abort();
            }
        }
    });
}

fn campaign(target: &Target, options: &Options) -> anyhow::Result<()> {
    let corpus = fuzz::corpus(target).with_context(|| format!("the corpus of {}", target.name))?;
    let current = options.out.join(format!("{}.current", target.name));
    let (begin, case_start) = (Instant::now(), Arc::new(AtomicU64::new(0)));
    let hang = Duration::from_secs(options.hang);
    let message = format!("{}: a case hangs; its input is {}", target.name, current.display());
    // after the end of a target, the start time lies in the future
    watch(Arc::clone(&case_start), begin, hang, message);
    let limit = Duration::from_secs(options.seconds);
    let mut failed = None;
    let report = fuzz::run(target, &corpus, options.seed, |_, input| {
        if begin.elapsed() >= limit || failed.is_some() {
            return false;
        }
        case_start.store(begin.elapsed().as_millis() as u64, Ordering::Relaxed);
        // a crash in C ends the process, and this file then contains its input
        failed = std::fs::write(&current, input).err();
        true
    });
    case_start.store(u64::MAX, Ordering::Relaxed);
    if let Some(error) = failed {
        return Err(error).with_context(|| format!("{}", current.display()));
    }
    std::fs::remove_file(&current).ok();
    say(&format!(
        "{}: {} cases in {:.0} s, {} accepted, {} different answers, slowest {:.3} s (case {})",
        target.name,
        report.cases,
        begin.elapsed().as_secs_f64(),
        report.accepted,
        report.answers,
        report.slowest.0.as_secs_f64(),
        report.slowest.1,
    ));
    if let Some(finding) = report.finding {
        let path = options.out.join(format!("{}.{}.{}", target.name, options.seed, finding.case.unwrap_or(0)));
        std::fs::write(&path, &finding.input).with_context(|| format!("{}", path.display()))?;
        anyhow::bail!("{} panics on {}: {}", target.name, path.display(), finding.message);
    }
    Ok(())
}
