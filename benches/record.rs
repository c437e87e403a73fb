//! Cost of recording: Hover episodes of the PID with and without a recording, in one run.
//!
//! `cargo bench --bench record` prints the median ratio of alternating episodes, then criterion's timings.

use std::time::Instant;

use criterion::{Criterion, criterion_group};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::Recorded;

/// Flies an episode and returns its duration in wall-clock time, s.
fn episode(env: &mut impl DroneEnv) -> f64 {
    let mut pid = ControllerPolicy::new(ControllerKind::Pid, env);
    let start = Instant::now();
    fly_episode(env, &mut pid, Some(1)).expect("an episode");
    start.elapsed().as_secs_f64()
}

#[allow(clippy::print_stdout)]
fn ratio() {
    let directory = tempfile::tempdir().expect("a directory");
    // the same environment flies both episodes because the position of its memory changes the time by 1 %
    let mut env = Recorded::new(Hover::builder().build().expect("an environment"), directory.path()).expect("a record");
    let (mut ratios, mut times): (Vec<f64>, Vec<f64>) = (Vec::new(), Vec::new());
    for _ in 0..201 {
        let (alone, with) = (episode(env.inner_mut()), episode(&mut env));
        ratios.push(with / alone);
        times.push(1e6 * (with - alone) / 481.0);
    }
    let median = |values: &mut Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    println!(
        "time of a recorded Hover episode over an unrecorded one: {:.3}; {:.2} µs per row",
        median(&mut ratios),
        median(&mut times)
    );
}

fn timings(criterion: &mut Criterion) {
    let directory = tempfile::tempdir().expect("a directory");
    let mut plain = Hover::builder().build().expect("an environment");
    let mut recorded =
        Recorded::new(Hover::builder().build().expect("an environment"), directory.path()).expect("a record");
    criterion.bench_function("episode", |bencher| bencher.iter(|| episode(&mut plain)));
    criterion.bench_function("episode/recorded", |bencher| bencher.iter(|| episode(&mut recorded)));
}

criterion_group!(benches, timings);

fn main() {
    ratio();
    benches();
    Criterion::default().configure_from_args().final_summary();
}
