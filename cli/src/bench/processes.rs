//! Batches in processes of their own: the reference for the scaling of threads.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use aviary::engine::flight::Width;
use aviary::env::EnvConfig;
use aviary::env::EnvError;
use aviary::physics::Physics;
use aviary::vector::{VecBuffers, VecConfig, make_vec};

use super::Row;
use super::meter::Meter;
use super::policy::LinearPolicy;
use crate::failure::Failure;

/// Duration of a measurement.
const TURN: Duration = Duration::from_millis(60);

/// Serves measurements of a batch of hover on one thread: for each byte on the standard input, a line with the
/// number of environment steps and the seconds that they took.
pub(super) fn serve(size: usize, width: Width) -> Result<(), Failure> {
    let config = VecConfig { threads: 1, width, ..VecConfig::new(size) };
    let mut env = make_vec("hover", EnvConfig::default(), config).map_err(Failure::work)?;
    let mut buffers = VecBuffers::new(&*env);
    env.reset(Some(1), &mut buffers.observations).map_err(Failure::work)?;
    let actions = LinearPolicy::new(0, size, 1, env.observation_size()).climb();
    let mut turn = 0_usize;
    for byte in std::io::stdin().lock().bytes() {
        byte.map_err(Failure::work)?;
        let (start, before) = (Instant::now(), turn);
        while start.elapsed() < TURN {
            turn += 1;
            env.step(&actions[turn % actions.len()], buffers.step()).map_err(Failure::work)?;
        }
        let mut out = std::io::stdout().lock();
        writeln!(out, "{} {}", (turn - before) * size, start.elapsed().as_secs_f64()).map_err(Failure::work)?;
        out.flush().map_err(Failure::work)?;
    }
    Ok(())
}

/// A process that serves measurements.
struct Server {
    child: Child,
    input: Option<ChildStdin>,
    output: BufReader<ChildStdout>,
}

impl Server {
    fn start(size: usize, width: Width) -> std::io::Result<Self> {
        let mut child = Command::new(std::env::current_exe()?)
            .args(["bench", "--process", &size.to_string(), "--instructions", width.name()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let pipes = child.stdin.take().zip(child.stdout.take());
        let (input, output) = pipes.ok_or(std::io::ErrorKind::BrokenPipe)?;
        Ok(Self { child, input: Some(input), output: BufReader::new(output) })
    }

    fn begin(&mut self) -> std::io::Result<()> {
        let input = self.input.as_mut().ok_or(std::io::ErrorKind::BrokenPipe)?;
        input.write_all(b"x")?;
        input.flush()
    }

    /// Returns the environment steps per second of a measurement.
    fn end(&mut self) -> std::io::Result<f64> {
        let mut line = String::new();
        self.output.read_line(&mut line)?;
        let mut numbers = line.split_whitespace().filter_map(|word| word.parse::<f64>().ok());
        let (steps, seconds) = numbers.next().zip(numbers.next()).ok_or(std::io::ErrorKind::InvalidData)?;
        Ok(steps / seconds)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // the process ends with its input
        drop(self.input.take());
        let _ = self.child.wait();
    }
}

/// Measures batches of this size in `count` processes at the same time.
pub(super) fn row(meter: &mut Meter, size: usize, count: usize) -> Result<Row, EnvError> {
    let failure = |error: std::io::Error| EnvError::Option {
        option: "a process of the benchmark",
        got: error.to_string(),
        expected: "a process that measures",
    };
    let mut servers: Vec<_> =
        (0..count).map(|_| Server::start(size, meter.width)).collect::<Result<_, _>>().map_err(failure)?;
    let mut measured_rate = || -> std::io::Result<f64> {
        servers.iter_mut().try_for_each(Server::begin)?;
        servers.iter_mut().map(Server::end).sum()
    };
    let measured = meter.measure(|| {
        // a call counts as a million environment steps
        measured_rate().map(|rate| Duration::from_secs_f64(1e6 / rate)).map_err(failure)
    })?;
    let (per_call, substeps) = (1e6, 5.0);
    Ok(Row {
        name: format!("hover × {size} in each of {count} processes"),
        engine: "hybrid",
        task: "hover".into(),
        environments: size * count,
        drones: 1,
        physics: Physics::Mjc,
        threads: count,
        env_steps_per_second: measured.rate * per_call,
        physics_steps_per_second: measured.rate * per_call * substeps,
        ratio: measured.over_bare * per_call * substeps,
        spread: measured.spread,
        ratio_to_plain: None,
        mujoco_share: None,
        ratio_in_contact: None,
        bytes_per_environment: 0,
        resident_bytes: None,
        frames_per_second: None,
    })
}
