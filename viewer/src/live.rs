//! Flights in real time that the person at the window can change.

mod clock;
mod history;
mod piloted;

use std::time::{Duration, Instant};

use aviary::control::ControllerKind;
use aviary::physics::wind::WindConfig;
use aviary::rollout::PilotMode;
use nalgebra::Vector3;

use crate::command::Command;
use crate::error::ViewerError;
use crate::frame::{Frame, Source};
use crate::shared::FlightStatus;
use crate::viewer::Viewer;
use clock::Clock;
use history::History;
pub use piloted::PilotedRollout;

/// A flight that a [`LiveFlight`] can change: an environment with the policy that flies it.
///
/// Errors are messages for the person at the window. The flight continues unchanged after an error.
pub trait Flown {
    /// State of the environment and of the policy, to continue from.
    type Saved;

    /// Returns the environment or the simulation.
    fn source(&self) -> Source<'_>;

    /// Returns the position that a drone follows (world frame, m), if it follows one.
    fn reference(&self, drone: usize) -> Option<Vector3<f64>> {
        self.source().reference(drone)
    }

    /// Returns the name of the controller or the policy.
    fn pilot(&self) -> String;

    /// Returns the present state.
    fn save(&self) -> Self::Saved;

    /// Restores a state. The flight then continues bit-identically.
    ///
    /// # Errors
    /// The message of the environment or the policy.
    fn restore(&mut self, saved: &Self::Saved) -> Result<(), String>;

    /// Starts an episode; without a seed, the random numbers continue.
    ///
    /// # Errors
    /// The message of the environment or the policy.
    fn restart(&mut self, seed: Option<u64>) -> Result<(), String>;

    /// Sets a force on a drone from the next control step on (world frame, N).
    ///
    /// # Errors
    /// The message of the environment.
    fn set_force(&mut self, drone: usize, force: Vector3<f64>) -> Result<(), String>;

    /// Sets the wind from now on.
    ///
    /// # Errors
    /// The message of the environment.
    fn set_wind(&mut self, wind: Option<WindConfig>) -> Result<(), String>;

    /// Draws a new layout of the obstacles.
    ///
    /// # Errors
    /// The message of the environment.
    fn new_obstacles(&mut self, seed: u64) -> Result<(), String>;

    /// Sets the gain of a motor.
    ///
    /// # Errors
    /// The message of the environment.
    fn set_motor_gain(&mut self, drone: usize, motor: usize, gain: f64) -> Result<(), String>;

    /// Flies all drones with another controller.
    ///
    /// # Errors
    /// A message if the flight has another kind of policy.
    fn set_controller(&mut self, kind: ControllerKind) -> Result<(), String>;

    /// Flies a drone by hand; `None` returns it to its policy.
    ///
    /// # Errors
    /// A message if the drone cannot be flown by hand.
    fn take(&mut self, drone: usize, mode: Option<PilotMode>) -> Result<(), String>;

    /// Sets the sticks of a drone that is flown by hand.
    fn set_sticks(&mut self, drone: usize, sticks: [f64; 4]);
}

/// Next action of the loop of a flight.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Turn {
    /// Makes a control step.
    Step,
    /// Begins its records again: another episode has started.
    Restarted,
    /// Removes from its records everything after the present control step: the flight continues from an earlier
    /// state.
    Rewound,
    /// Ends: the window was closed.
    Closed,
}

/// A flight in real time in a window.
///
/// The loop of the flight calls [`turn`](Self::turn) before every control step, and after the last one. The call
/// shows the state, waits until the step is due, and executes the commands of the person at the window.
#[derive(Debug)]
pub struct LiveFlight<S> {
    viewer: Viewer,
    clock: Clock,
    history: History<S>,
    status: FlightStatus,
    /// Points that drones are pulled to, world frame, m.
    pulls: Vec<Option<Vector3<f64>>>,
    forces: Vec<Vector3<f64>>,
    /// Single control steps that a paused flight is to make.
    steps: u32,
    /// Wind before the first change of the wind in the episode, if there was a change.
    wind_before: Option<Option<WindConfig>>,
    /// Number of layouts of the obstacles that were drawn, for their seeds.
    layouts: u64,
    /// Sticks of the drone that is flown by hand, and their meaning.
    sticks: [f64; 4],
    mode: Option<PilotMode>,
}

/// Stiffness of a pull per mass, 1/s². The pull is critically damped.
const STIFFNESS: f64 = 60.0;
/// Largest pull, as a multiple of the weight.
const MAX_PULL: f64 = 4.0;
/// Longest time that the end of a flight waits for the image of its last state.
const LAST_IMAGE: Duration = Duration::from_secs(1);

impl<S> LiveFlight<S> {
    /// Creates a flight in a window. `is_interactive` is false for a flight that the person may pause but not change.
    pub fn new(viewer: Viewer, seed: Option<u64>, is_interactive: bool) -> Self {
        let status = FlightStatus { is_interactive, is_paced: true, seed, ..FlightStatus::default() };
        Self {
            viewer,
            clock: Clock::default(),
            history: History::default(),
            status,
            pulls: Vec::new(),
            forces: Vec::new(),
            steps: 0,
            wind_before: None,
            layouts: 0,
            sticks: [0.0; 4],
            mode: None,
        }
    }

    /// Returns the window.
    pub fn viewer(&self) -> &Viewer {
        &self.viewer
    }

    /// Returns the state of the flight.
    pub fn status(&self) -> &FlightStatus {
        &self.status
    }

    /// Shows the state and waits until the next control step is due. `is_over` is true after the end of the episode,
    /// and after a control step that failed: the call then returns only when the person restarts or rewinds the flight
    /// or closes the window.
    ///
    /// # Errors
    /// [`ViewerError`] if the window fails. Later calls return [`Turn::Closed`].
    pub fn turn(&mut self, flown: &mut dyn Flown<Saved = S>, is_over: bool) -> Result<Turn, ViewerError> {
        self.status.pilot = flown.pilot();
        // the state after a failed control step would replace the one before it
        if self.status.is_interactive && !is_over {
            self.history.keep(flown);
        }
        self.show(flown)?;
        let period = flown.source().simulation().control_period();
        loop {
            if !self.viewer.is_open()? {
                return Ok(Turn::Closed);
            }
            while let Some(command) = self.viewer.shared().next_command() {
                let is_drag = matches!(command, Command::Push { .. } | Command::Sticks(_));
                let is_change = matches!(
                    command,
                    Command::Wind(_)
                        | Command::NewObstacles
                        | Command::Controller(_)
                        | Command::MotorGain { .. }
                        | Command::Pilot { .. }
                );
                let done = match command {
                    Command::Step if is_over => Ok(None),
                    command => self.execute(command, flown),
                };
                match done {
                    Ok(Some(turn)) => {
                        self.status.message = None;
                        self.clock.restart();
                        self.show(flown)?;
                        return Ok(turn);
                    }
                    Ok(None) if is_change => {
                        self.status.message = None;
                        // the flight from this state has the change
                        if !is_over {
                            self.history.keep(flown);
                        }
                        self.show(flown)?;
                    }
                    Ok(None) if is_drag => {}
                    Ok(None) => self.status.message = None,
                    Err(message) => self.status.message = Some(message),
                }
                self.viewer.set_flight_status(self.status.clone());
            }
            if is_over || self.status.is_paused && self.steps == 0 {
                self.clock.restart();
                self.viewer.shared().wait(None);
            } else if self.status.is_paused {
                self.steps -= 1;
                self.pull(flown);
                return Ok(Turn::Step);
            } else {
                let now = Instant::now();
                let due = self.clock.due(now, period / self.status.speed);
                if due <= now {
                    self.clock.count(now, due);
                    self.status.measured_speed = self.clock.rate() * period;
                    self.pull(flown);
                    return Ok(Turn::Step);
                }
                self.viewer.shared().wait(Some(due));
            }
        }
    }

    /// Shows the state after the last control step, for a loop that ends with the episode. Returns when the window has
    /// drawn the state, after 1 s at the latest, or when the window is closed.
    ///
    /// # Errors
    /// As for [`turn`](Self::turn).
    pub fn show_end(&mut self, flown: &dyn Flown<Saved = S>) -> Result<(), ViewerError> {
        let step = flown.source().simulation().control_steps();
        self.show(flown)?;
        let begin = Instant::now();
        while self.viewer.is_open()? && self.viewer.status().step != step && begin.elapsed() < LAST_IMAGE {
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(())
    }

    /// Shows the present state.
    fn show(&mut self, flown: &dyn Flown<Saved = S>) -> Result<(), ViewerError> {
        let forces = &self.forces;
        let edit = |frame: &mut Frame| {
            for (drone, force) in frame.drones.iter_mut().zip(forces) {
                drone.push = *force;
            }
        };
        self.viewer.sync_with(flown.source(), |drone| flown.reference(drone), edit)?;
        self.viewer.set_flight_status(self.status.clone());
        Ok(())
    }

    /// Sets the forces of the mouse for the next control step.
    fn pull(&mut self, flown: &mut dyn Flown<Saved = S>) {
        let count = flown.source().simulation().num_drones();
        self.pulls.resize(count, None);
        self.forces.resize(count, Vector3::zeros());
        for drone in 0..count {
            let simulation = flown.source().simulation();
            let force = match self.pulls[drone] {
                Some(target) => {
                    let (state, mass) = (&simulation.states()[drone], simulation.params(drone).mass);
                    let acceleration = STIFFNESS * (target - state.position) - 2.0 * STIFFNESS.sqrt() * state.velocity;
                    (mass * acceleration).cap_magnitude(MAX_PULL * mass * 9.81)
                }
                None => Vector3::zeros(),
            };
            if force == self.forces[drone] {
                continue;
            }
            match flown.set_force(drone, force) {
                Ok(()) => self.forces[drone] = force,
                Err(message) => self.status.message = Some(message),
            }
        }
    }

    fn execute(&mut self, command: Command, flown: &mut dyn Flown<Saved = S>) -> Result<Option<Turn>, String> {
        match command {
            Command::Pause(is_paused) => {
                self.status.is_paused = is_paused;
                self.steps = 0;
                self.clock.restart();
                return Ok(None);
            }
            Command::Step if self.status.is_paused => {
                self.steps = self.steps.saturating_add(1);
                return Ok(None);
            }
            Command::Step => return Ok(None),
            Command::Speed(speed) => {
                self.status.speed = if speed.is_finite() { speed.clamp(1.0 / 64.0, 64.0) } else { 1.0 };
                self.clock.restart();
                return Ok(None);
            }
            _ if !self.status.is_interactive => return Err("this flight cannot be changed".into()),
            _ => {}
        }
        match command {
            Command::Restart { next_seed } => {
                let seed = self.status.seed.map(|seed| if next_seed { seed.wrapping_add(1) } else { seed });
                if let Some(wind) = self.wind_before {
                    // an environment that samples its wind refuses it, and samples a wind for the new episode
                    let _ = flown.set_wind(wind);
                }
                flown.restart(seed)?;
                self.status.seed = seed;
                self.begin();
                Ok(Some(Turn::Restarted))
            }
            Command::Rewind { step } => {
                let reached = self.history.rewind(flown, step)?;
                self.viewer.rewind(reached);
                self.pulls.fill(None);
                self.forces.fill(Vector3::zeros());
                self.steps = 0;
                // the person lets go of the drones, and flies those of the present by hand
                for drone in 0..flown.source().simulation().num_drones() {
                    flown.set_force(drone, Vector3::zeros())?;
                    let mode = self.mode.filter(|_| self.status.piloted == Some(drone));
                    flown.take(drone, mode)?;
                    if mode.is_some() {
                        flown.set_sticks(drone, self.sticks);
                    }
                }
                Ok(Some(Turn::Rewound))
            }
            Command::Push { drone, target } => {
                let count = flown.source().simulation().num_drones();
                self.pulls.resize(count, None);
                match self.pulls.get_mut(drone) {
                    Some(pull) => *pull = target.filter(|target| target.iter().all(|x| x.is_finite())),
                    None => return Err(format!("drone {drone} cannot be pushed, expected one of {count} drones")),
                }
                Ok(None)
            }
            Command::Wind(wind) => {
                let before = flown.source().simulation().wind().copied();
                flown.set_wind(wind)?;
                self.wind_before.get_or_insert(before);
                Ok(None)
            }
            Command::NewObstacles => {
                self.layouts += 1;
                flown.new_obstacles(self.status.seed.unwrap_or(0).wrapping_add(1000 * self.layouts)).map(|()| None)
            }
            Command::Controller(kind) => {
                flown.set_controller(kind)?;
                self.status.pilot = flown.pilot();
                Ok(None)
            }
            Command::MotorGain { drone, motor, gain } => flown.set_motor_gain(drone, motor, gain).map(|()| None),
            Command::Pilot { drone, mode } => {
                flown.take(drone, mode)?;
                if let Some(before) = self.status.piloted.filter(|&before| before != drone) {
                    flown.take(before, None)?;
                }
                (self.mode, self.sticks) = (mode, [0.0; 4]);
                self.status.piloted = mode.map(|_| drone);
                if mode.is_some() {
                    flown.set_sticks(drone, self.sticks);
                }
                Ok(None)
            }
            Command::Sticks(sticks) => {
                self.sticks = sticks;
                if let Some(drone) = self.status.piloted {
                    flown.set_sticks(drone, sticks);
                }
                Ok(None)
            }
            Command::Pause(_) | Command::Step | Command::Speed(_) => Ok(None),
        }
    }

    /// Clears what belongs to the last episode.
    fn begin(&mut self) {
        self.history = History::default();
        self.pulls.clear();
        self.forces.clear();
        self.wind_before = None;
        self.layouts = 0;
        self.steps = 0;
    }
}

#[cfg(test)]
mod tests {
    use aviary::env::{DroneEnv, EnvConfig};
    use aviary::physics::wind::WindModel;
    use aviary::rollout::{ControllerPolicy, PilotedPolicy, Rollout};
    use aviary::state::DroneState;
    use aviary::tasks::make;

    use super::*;

    type Piloted = Rollout<Box<dyn DroneEnv>, PilotedPolicy<ControllerPolicy>>;

    struct Flight(Piloted);

    impl PilotedRollout for Flight {
        type Policy = ControllerPolicy;

        fn rollout(&self) -> &Piloted {
            &self.0
        }

        fn rollout_mut(&mut self) -> &mut Piloted {
            &mut self.0
        }

        fn name(&self) -> String {
            "dsl".into()
        }
    }

    fn wind(x: f64) -> WindConfig {
        WindConfig { velocity: [x, 0.5, 0.0], ..WindConfig::new(WindModel::Constant) }
    }

    /// Returns the wind and the states of ten control steps after a command.
    fn after(
        command: Option<Command>,
        live: &mut LiveFlight<<Flight as Flown>::Saved>,
        flight: &mut Flight,
    ) -> (Option<WindConfig>, Vec<DroneState>) {
        if let Some(command) = command {
            live.viewer.shared().send(command);
        }
        let mut states = Vec::new();
        while states.len() < 10 {
            if live.turn(flight, false).unwrap() == Turn::Step {
                flight.0.step().unwrap();
                states.push(flight.0.env().simulation().states()[0]);
            }
        }
        (flight.0.env().simulation().wind().copied(), states)
    }

    /// The wind that a person sets lasts until the restart, which is bit-identical to the first episode.
    #[test]
    fn a_restart_has_the_wind_of_the_flight() {
        for own in [None, Some(wind(1.0))] {
            let config = EnvConfig::default();
            let config = if let Some(own) = own { config.wind(own) } else { config };
            let env: Box<dyn DroneEnv> = make("hover", config).unwrap();
            let policy = PilotedPolicy::new(ControllerPolicy::new(ControllerKind::Dsl, &env));
            let mut flight = Flight(Rollout::start(env, policy, Some(3)).unwrap());
            let viewer = Viewer::without_window(flight.source());
            let mut live = LiveFlight::new(viewer, Some(3), true);
            live.status.speed = 64.0;
            let first = after(None, &mut live, &mut flight);
            assert_eq!(first.0, own);
            for changed in [Some(wind(3.0)), Some(wind(4.0)), None] {
                assert_eq!(after(Some(Command::Wind(changed)), &mut live, &mut flight).0, changed);
                // a rewind does not end the change of the person
                after(Some(Command::Rewind { step: 10 }), &mut live, &mut flight);
                assert_eq!(after(Some(Command::Wind(changed)), &mut live, &mut flight).0, changed);
                assert_eq!(after(Some(Command::Restart { next_seed: false }), &mut live, &mut flight), first);
            }
        }
    }
}
