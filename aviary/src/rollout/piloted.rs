//! Policy that flies some drones by the sticks of a person.

use std::collections::BTreeMap;

use super::{Policy, PolicySnapshot, RolloutError};
use crate::action::{ActionDecoder, ActionLimits, ActionType};
use crate::control::ControllerKind;
use crate::env::{DroneEnv, EnvError};
use crate::names::named_enum;
use crate::simulation::SimulationError;

named_enum! {
    "pilot mode"
    /// Meaning of the four sticks of a person, each from −1 to 1. A stick of ±1 is the bound of the component of the
    /// [action type](PilotMode::action_type).
    ///
    /// | mode | sticks |
    /// | --- | --- |
    /// | `ctbr` | collective thrust as a normalized motor speed; body rates about x, y, z |
    /// | `attitude` | collective thrust as a normalized motor speed; roll, pitch; yaw rate |
    /// | `vel` | velocity x (forward), y (left), z (up) in the heading frame; yaw rate |
    ///
    /// ```
    /// use aviary::action::ActionType;
    /// use aviary::rollout::PilotMode;
    ///
    /// assert_eq!("vel".parse::<PilotMode>()?.action_type(), ActionType::Vel);
    /// # Ok::<(), aviary::UnknownName>(())
    /// ```
    #[derive(Default)]
    pub enum PilotMode {
        /// Collective thrust and body rates: acrobatic flight.
        Ctbr = "ctbr",
        /// Collective thrust, roll, pitch and yaw rate: the drone levels when the sticks are released.
        Attitude = "attitude",
        /// Velocity and yaw rate: the drone stops when the sticks are released.
        #[default]
        Vel = "vel",
    }
}

impl PilotMode {
    /// Returns the action type that has the meaning, the bounds and the control loops of the sticks.
    pub fn action_type(self) -> ActionType {
        match self {
            Self::Ctbr => ActionType::Ctbr,
            Self::Attitude => ActionType::Attitude,
            Self::Vel => ActionType::Vel,
        }
    }
}

/// A drone that a person flies.
#[derive(Debug, Clone)]
struct Pilot {
    mode: PilotMode,
    sticks: [f64; 4],
    /// Decoder from sticks to motor speeds with the state of its control loops, after the first control step in an
    /// environment that needs it.
    decoder: Option<ActionDecoder>,
}

/// Flies chosen drones by the sticks of a person, and all others by another policy.
///
/// In an environment whose actions command single motors ([`ActionType::Rpm`], [`ActionType::RawRpm`],
/// [`ActionType::Duty`]), the policy runs the control loops of the mode's action type on the nominal parameters of the
/// airframe, as an environment with that action type does. In an environment with the action type of the mode itself,
/// the policy writes the scaled sticks.
///
/// The inner policy also computes the drones that a person flies, and its actions for them are replaced. Its actions
/// for the other drones are bit-identical to those without a person. If a person flies all drones, the inner policy is
/// not called. When a person [releases](Self::release) a drone, [`Policy::reset_drone`] clears the inner policy's
/// state of this drone, so that no integral of the meantime acts.
///
/// ```
/// use aviary::control::ControllerKind;
/// use aviary::env::{DroneEnv, Env};
/// use aviary::rollout::{ControllerPolicy, PilotMode, PilotedPolicy, Rollout};
/// use aviary::tasks::MultiHover;
///
/// let env = MultiHover::builder().num_drones(2).build()?;
/// let policy = PilotedPolicy::new(ControllerPolicy::new(ControllerKind::Geometric, &env));
/// let mut rollout = Rollout::start(env, policy, Some(1))?;
/// for _ in 0..96 {
///     rollout.step()?;
/// }
/// // forwards with a tenth of the largest speed
/// rollout.policy_mut().take(1, PilotMode::Vel);
/// rollout.policy_mut().set_command(1, [0.1, 0.0, 0.0, 0.0]);
/// for _ in 0..48 {
///     rollout.step()?;
/// }
/// assert!(rollout.env().simulation().states()[1].velocity.x > 0.1);
/// // the controller flies the drone to its target again
/// rollout.policy_mut().release(1);
/// assert!(rollout.finish(|_| {})?.success);
/// # Ok::<(), aviary::rollout::RolloutError>(())
/// ```
#[derive(Debug)]
pub struct PilotedPolicy<P> {
    inner: P,
    /// Piloted drones by index.
    pilots: BTreeMap<usize, Pilot>,
    /// Drones whose state in the inner policy is cleared before the next action.
    released: Vec<usize>,
    /// True if the inner policy must be reset before the next action.
    replaced: bool,
    limits: ActionLimits,
    controller: ControllerKind,
    /// Motor speeds of all drones, rpm; a scratch buffer.
    speeds: Vec<[f64; 4]>,
    /// Action of the motor speeds; a scratch buffer.
    action: Vec<f64>,
}

/// Internal state in a snapshot.
#[derive(Debug)]
struct State {
    inner: PolicySnapshot,
    pilots: BTreeMap<usize, Pilot>,
    released: Vec<usize>,
    replaced: bool,
}

impl<P> PilotedPolicy<P> {
    /// Creates a policy in which `inner` flies all drones.
    pub fn new(inner: P) -> Self {
        Self {
            inner,
            pilots: BTreeMap::new(),
            released: Vec::new(),
            replaced: false,
            limits: ActionLimits::default(),
            controller: ControllerKind::default(),
            speeds: Vec::new(),
            action: Vec::new(),
        }
    }

    /// Sets the angles and rates of a full stick, see [`ActionLimits`]. In an environment with the action type of the
    /// mode, the bounds of its action space apply instead.
    ///
    /// # Errors
    /// [`EnvError::Option`] that names the first invalid limit.
    pub fn action_limits(mut self, limits: ActionLimits) -> Result<Self, EnvError> {
        limits.validate()?;
        self.limits = limits;
        Ok(self)
    }

    /// Sets the controller that follows the velocities of [`PilotMode::Vel`]; default [`ControllerKind::Pid`].
    #[must_use]
    pub fn controller(mut self, controller: ControllerKind) -> Self {
        self.controller = controller;
        self
    }

    /// Lets a person fly a drone from the next control step on, with sticks at zero. A drone that is already piloted
    /// in another mode keeps its sticks and starts new control loops; in the same mode nothing changes. The drone stays
    /// piloted in later episodes.
    ///
    /// [`act`](Policy::act) returns [`SimulationError::NoDrone`] for an index out of range.
    pub fn take(&mut self, drone: usize, mode: PilotMode) {
        self.released.retain(|released| *released != drone);
        if self.piloted(drone) != Some(mode) {
            let sticks = self.command(drone).unwrap_or_default();
            self.pilots.insert(drone, Pilot { mode, sticks, decoder: None });
        }
    }

    /// Returns a drone to the inner policy from the next control step on. Nothing changes if it is not piloted.
    pub fn release(&mut self, drone: usize) {
        if self.pilots.remove(&drone).is_some() {
            self.released.push(drone);
        }
    }

    /// Sets the four sticks of a piloted drone, which stay until they are set again. Nothing changes if the drone is
    /// not piloted. The policy clips sticks to −1 and 1; [`act`](Policy::act) returns [`EnvError::Option`] for one that
    /// is not finite.
    pub fn set_command(&mut self, drone: usize, sticks: [f64; 4]) {
        if let Some(pilot) = self.pilots.get_mut(&drone) {
            pilot.sticks = sticks;
        }
    }

    /// Returns the mode in which a person flies a drone; `None` if the inner policy flies it.
    pub fn piloted(&self, drone: usize) -> Option<PilotMode> {
        Some(self.pilots.get(&drone)?.mode)
    }

    /// Returns the sticks of a piloted drone as they were set.
    pub fn command(&self, drone: usize) -> Option<[f64; 4]> {
        Some(self.pilots.get(&drone)?.sticks)
    }

    /// Returns the inner policy.
    pub fn inner(&self) -> &P {
        &self.inner
    }

    /// Returns the inner policy mutably, for example to change gains.
    pub fn inner_mut(&mut self) -> &mut P {
        &mut self.inner
    }

    /// Replaces the inner policy during a flight and returns the old one. The new policy is
    /// [reset](Policy::reset) before its first action, from the states at that time. With a `Box<dyn Policy>`, the new
    /// policy can be of another kind; a snapshot of the old kind cannot be restored then.
    pub fn set_inner(&mut self, inner: P) -> P {
        self.replaced = true;
        self.released.clear();
        std::mem::replace(&mut self.inner, inner)
    }
}

/// Returns an error unless the sticks are finite numbers and the drone exists.
fn check(env: &dyn DroneEnv, drone: usize, sticks: &[f64; 4]) -> Result<(), EnvError> {
    let drones = env.simulation().num_drones();
    if drone >= drones {
        return Err(SimulationError::NoDrone { got: drone, drones }.into());
    }
    match sticks.iter().position(|stick| !stick.is_finite()) {
        Some(index) => Err(EnvError::Option {
            option: "command",
            got: format!("{} for stick {index} of drone {drone}", crate::number(sticks[index])),
            expected: "finite numbers from -1 to 1",
        }),
        None => Ok(()),
    }
}

impl Pilot {
    /// Returns the sticks within their bounds.
    fn clipped(&self) -> [f64; 4] {
        self.sticks.map(|stick| stick.clamp(-1.0, 1.0))
    }

    /// Returns the motor speeds (rpm) of the sticks.
    fn motor_speeds(
        &mut self,
        env: &dyn DroneEnv,
        drone: usize,
        limits: &ActionLimits,
        controller: ControllerKind,
    ) -> Result<[f64; 4], EnvError> {
        let (simulation, kind) = (env.simulation(), self.mode.action_type());
        // as an environment of the action type, also if the simulated parameters are randomized
        let params = &simulation.world().drones[drone].params;
        let mut command = self.clipped();
        for (stick, [_, high]) in command.iter_mut().zip(kind.bounds(params, limits)) {
            *stick *= high;
        }
        let decoder = match &mut self.decoder {
            Some(decoder) => decoder,
            none => none.insert(ActionDecoder::new(kind, controller, params, limits)?),
        };
        Ok(decoder.motor_speeds(simulation.control_period(), &simulation.states()[drone], &command))
    }
}

impl<P: Policy> PilotedPolicy<P> {
    /// Resets what has changed in the inner policy since the last action.
    fn update_inner(&mut self, env: &dyn DroneEnv) -> Result<(), RolloutError> {
        if self.replaced {
            self.inner.reset(env)?;
            self.replaced = false;
        }
        while let Some(&drone) = self.released.last() {
            self.inner.reset_drone(env, drone)?;
            self.released.pop();
        }
        Ok(())
    }

    /// Replaces the actions of the piloted drones.
    fn fly(&mut self, env: &dyn DroneEnv, action: &mut [f64]) -> Result<(), EnvError> {
        let (action_type, count) = (env.action_type(), env.simulation().num_drones());
        let size = action_type.size();
        let mut decoded = None;
        self.speeds.clear();
        self.speeds.resize(count, [0.0; 4]);
        for (&drone, pilot) in &mut self.pilots {
            if pilot.mode.action_type() == action_type {
                let high = &env.action_space().high()[size * drone..];
                let part = action[size * drone..].iter_mut().zip(high);
                part.zip(pilot.clipped()).for_each(|((out, high), stick)| *out = stick * high);
            } else {
                decoded = Some(pilot.mode);
                self.speeds[drone] = pilot.motor_speeds(env, drone, &self.limits, self.controller)?;
            }
        }
        let Some(mode) = decoded else { return Ok(()) };
        self.action.resize(action.len(), 0.0);
        if let Err(error) = env.action_of_motor_speeds(&self.speeds, &mut self.action) {
            return Err(match error {
                EnvError::Option { option: "action_type", .. } => EnvError::Option {
                    option: "action_type",
                    got: format!("{action_type} for a drone that a person flies in the mode {mode}"),
                    expected: "rpm, raw_rpm or duty, which command single motors, or the action type of the mode",
                },
                other => other,
            });
        }
        for (&drone, pilot) in &self.pilots {
            if pilot.mode.action_type() != action_type {
                let part = size * drone..size * (drone + 1);
                action[part.clone()].copy_from_slice(&self.action[part]);
            }
        }
        Ok(())
    }
}

impl<P: Policy> Policy for PilotedPolicy<P> {
    /// Resets the inner policy and the control loops of the piloted drones, which stay piloted with their sticks.
    ///
    /// # Errors
    /// The errors of the inner policy.
    fn reset(&mut self, env: &dyn DroneEnv) -> Result<(), RolloutError> {
        self.inner.reset(env)?;
        self.released.clear();
        self.replaced = false;
        self.pilots.values_mut().for_each(|pilot| pilot.decoder = None);
        Ok(())
    }

    /// Writes the action: of the inner policy, and of the sticks for piloted drones.
    ///
    /// # Errors
    /// The errors of the inner policy; [`EnvError::Option`] for an action type that commands neither single motors nor
    /// the mode of a piloted drone, and for sticks that are not finite; [`SimulationError::NoDrone`] for a drone that
    /// does not exist.
    fn act(&mut self, env: &dyn DroneEnv, action: &mut [f64]) -> Result<(), RolloutError> {
        for (&drone, pilot) in &self.pilots {
            check(env, drone, &pilot.sticks)?;
        }
        self.update_inner(env)?;
        if self.pilots.len() < env.simulation().num_drones() {
            self.inner.act(env, action)?;
        }
        if !self.pilots.is_empty() {
            self.fly(env, action)?;
        }
        Ok(())
    }

    /// Clears the state of one drone in the inner policy, or the control loops of a piloted drone.
    ///
    /// # Errors
    /// The errors of the inner policy.
    fn reset_drone(&mut self, env: &dyn DroneEnv, drone: usize) -> Result<(), RolloutError> {
        match self.pilots.get_mut(&drone) {
            Some(pilot) => {
                pilot.decoder = None;
                Ok(())
            }
            None => self.inner.reset_drone(env, drone),
        }
    }

    /// Returns the state of the inner policy, the piloted drones with their modes and sticks, and the state of their
    /// control loops.
    fn snapshot(&self) -> PolicySnapshot {
        PolicySnapshot::new(State {
            inner: self.inner.snapshot(),
            pilots: self.pilots.clone(),
            released: self.released.clone(),
            replaced: self.replaced,
        })
    }

    fn restore(&mut self, snapshot: &PolicySnapshot) -> Result<(), RolloutError> {
        let State { inner, pilots, released, replaced } = snapshot.own()?;
        self.inner.restore(inner)?;
        self.pilots.clone_from(pilots);
        self.released.clone_from(released);
        self.replaced = *replaced;
        Ok(())
    }
}
