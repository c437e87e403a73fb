//! Flights of policies in a window.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError, TryLockError, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use aviary::env::DroneEnv;
use aviary::policy::PolicyNetwork;
use aviary::rollout::{NetworkPolicy, PilotedPolicy, Policy, Rollout, RolloutError};
use learn::{AnyEnv, TrainConfig, Trainer};
use viewer::{LiveFlight, PilotedRollout, Turn, Viewer, ViewerError, ViewerOptions};

use crate::failure::Failure;

/// Episodes of a policy.
struct PolicyFlight<P> {
    rollout: Rollout<Box<dyn DroneEnv>, PilotedPolicy<P>>,
    /// Environment steps of the training of the policy; `None` for the policy of another program.
    steps: Option<u64>,
}

/// Episodes of the policy of a training.
type TrainingFlight = PolicyFlight<NetworkPolicy<PolicyNetwork>>;

impl<P: Policy> PolicyFlight<P> {
    /// Starts the first episode.
    fn start(env: AnyEnv, policy: P, steps: Option<u64>, seed: u64) -> Result<Self, RolloutError> {
        let env: Box<dyn DroneEnv> = env;
        Ok(Self { rollout: Rollout::start(env, PilotedPolicy::new(policy), Some(seed))?, steps })
    }

    /// Opens the window.
    fn open(&self, in_background: bool) -> Result<Viewer, ViewerError> {
        let env = &**self.rollout.env();
        let title = format!("aviary: {} with a policy", env.name());
        Viewer::open(env, ViewerOptions { title, in_background, ..ViewerOptions::default() })
    }
}

impl<P: Policy> PilotedRollout for PolicyFlight<P> {
    type Policy = P;

    fn rollout(&self) -> &Rollout<Box<dyn DroneEnv>, PilotedPolicy<P>> {
        &self.rollout
    }

    fn rollout_mut(&mut self) -> &mut Rollout<Box<dyn DroneEnv>, PilotedPolicy<P>> {
        &mut self.rollout
    }

    fn name(&self) -> String {
        match self.steps {
            None => "policy of another program".into(),
            Some(steps) => format!("policy after {steps} steps"),
        }
    }
}

/// Flies a policy in a window until the person closes the window. The person can change the flight.
///
/// A display that ends or has ended is a warning. `steps` are those of the training, `None` for the policy of another
/// program.
pub fn fly(config: &TrainConfig, policy: Box<dyn Policy>, steps: Option<u64>, seed: u64) -> Result<(), Failure> {
    let env = config.environment().map_err(Failure::input)?;
    let mut flight = PolicyFlight::start(env, policy, steps, seed).map_err(Failure::work)?;
    let viewer = match flight.open(false) {
        Ok(viewer) => viewer,
        Err(error) => {
            tracing::warn!("{error}");
            return Ok(());
        }
    };
    let mut live = LiveFlight::new(viewer, Some(seed), true);
    let mut has_failed = false;
    loop {
        let is_over = has_failed || flight.rollout.is_over();
        match live.turn(&mut flight, is_over) {
            Ok(Turn::Step) => {
                if let Err(error) = flight.rollout.step() {
                    // the person may restart or rewind the flight
                    tracing::warn!("{error}; the episode ends");
                    has_failed = true;
                }
            }
            Ok(Turn::Restarted | Turn::Rewound) => has_failed = false,
            Ok(Turn::Closed) => return Ok(()),
            Err(error @ ViewerError::Recording { .. }) => return Err(Failure::work(error)),
            Err(error) => {
                tracing::warn!("{error}; the flight ends");
                return Ok(());
            }
        }
    }
}

/// Window in which the current policy of a training flies.
///
/// The window has its own environment and its own threads, which have the lowest priority. The training is
/// bit-identical to one without a window. The end of the value closes the window.
pub struct TrainingWindow {
    newest: Arc<Newest>,
    close: Box<dyn Fn()>,
    thread: Option<JoinHandle<()>>,
    /// Time of the last copy of the policy.
    copied: Instant,
}

/// Policy that the thread of the window takes.
#[derive(Default)]
struct Newest {
    policy: Mutex<Option<PolicyNetwork>>,
    /// True after the window was closed.
    is_closed: AtomicBool,
}

/// Shortest time between two copies of the policy.
const COPY_PERIOD: Duration = Duration::from_millis(500);

impl TrainingWindow {
    /// Opens the window and flies the current policy.
    pub fn open(trainer: &Trainer) -> Result<Self, Failure> {
        let env = trainer.config().environment().map_err(Failure::input)?;
        let policy = trainer.policy().map_err(Failure::work)?;
        let seed = trainer.config().seed;
        let newest = Arc::new(Newest::default());
        let (answer, answered) = mpsc::sync_channel(1);
        let of_thread = newest.clone();
        let run = move || {
            viewer::lower_priority();
            match begin(env, policy, seed) {
                Ok((mut flight, mut live)) => {
                    let _ = answer.send(Ok(live.viewer().closer()));
                    if let Err(error) = show(&mut flight, &mut live, &of_thread) {
                        tracing::warn!("{error}; the training goes on without a window");
                    }
                }
                Err(failure) => {
                    let _ = answer.send(Err(failure));
                }
            }
            of_thread.is_closed.store(true, Ordering::Relaxed);
        };
        let thread = std::thread::Builder::new().name("view".into()).spawn(run).map_err(Failure::work)?;
        let close = answered.recv().map_err(Failure::work)??;
        Ok(Self { newest, close: Box::new(close), thread: Some(thread), copied: Instant::now() })
    }

    /// Gives the window the current policy, if the last copy is old enough.
    pub fn update(&mut self, trainer: &Trainer) {
        if self.copied.elapsed() < COPY_PERIOD || self.newest.is_closed.load(Ordering::Relaxed) {
            return;
        }
        self.copied = Instant::now();
        // a policy that cannot fly ends the training in its own time
        let Ok(policy) = trainer.policy() else { return };
        // the training does not wait for a thread of the lowest priority
        let mut newest = match self.newest.policy.try_lock() {
            Ok(newest) => newest,
            Err(TryLockError::Poisoned(error)) => error.into_inner(),
            Err(TryLockError::WouldBlock) => return,
        };
        *newest = Some(policy);
    }
}

impl Drop for TrainingWindow {
    fn drop(&mut self) {
        (self.close)();
        if let Some(thread) = self.thread.take() {
            // a panic of the thread has been printed
            let _ = thread.join();
        }
    }
}

/// Starts the first episode in a window.
fn begin(
    env: AnyEnv,
    policy: PolicyNetwork,
    seed: u64,
) -> Result<(TrainingFlight, LiveFlight<<TrainingFlight as viewer::Flown>::Saved>), Failure> {
    let steps = Some(policy.info().steps);
    let flight = PolicyFlight::start(env, policy.into_pilot(), steps, seed).map_err(Failure::work)?;
    let viewer = flight.open(true).map_err(Failure::work)?;
    Ok((flight, LiveFlight::new(viewer, None, false)))
}

/// Flies episodes in real time, each control step with the newest policy, until the window is closed.
fn show(
    flight: &mut TrainingFlight,
    live: &mut LiveFlight<<TrainingFlight as viewer::Flown>::Saved>,
    newest: &Newest,
) -> anyhow::Result<()> {
    loop {
        if let Some(policy) = newest.policy.lock().unwrap_or_else(PoisonError::into_inner).take() {
            flight.steps = Some(policy.info().steps);
            flight.rollout.policy_mut().set_inner(policy.into_pilot());
        }
        match live.turn(flight, false)? {
            // an untrained policy may let the simulation diverge
            Turn::Step if flight.rollout.is_over() || flight.rollout.step().is_err() => {
                flight.rollout.restart(None)?;
            }
            Turn::Closed => return Ok(()),
            Turn::Step | Turn::Restarted | Turn::Rewound => {}
        }
    }
}
