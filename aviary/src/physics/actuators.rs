//! Motor dynamics: lag, latency, gains and saturation, from the settings of an environment and from the airframe. All
//! of them are off by default.

use flight::motors;

use crate::drone::DroneParams;
use crate::error::OptionError;

/// Parameters of the motors of a drone.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::actuators::ActuatorParams;
/// use aviary::simulation::Simulation;
///
/// // a step from hover speed to full speed, after one time constant
/// let motors = ActuatorParams { lag: 0.05, ..ActuatorParams::default() };
/// let mut simulation = Simulation::builder(DroneModel::Cf2x).actuators(motors).ctrl_freq(20).build()?;
/// let (hover, full) = (simulation.params(0).hover_rpm(), simulation.params(0).max_rpm());
/// simulation.step(&[[full; 4]])?;
/// let share = (simulation.rotor_speeds(0)[0] - hover) / (full - hover);
/// assert!((share - (1.0 - (-1.0_f64).exp())).abs() < 1e-9);
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ActuatorParams {
    /// Time constant τ of the first-order lag of the rotor speed, s; 0 for that of the airframe, which has none by
    /// default (see [`MotorParams`](crate::drone::MotorParams)).
    pub lag: f64,
    /// Delay of a command, s, in addition to that of the airframe. The sum is rounded to whole physics steps.
    pub latency: f64,
    /// Factor on each motor's commanded speed, after the voltage has limited it: a motor with a gain of 1.05 turns 5 %
    /// faster at every duty, also at full duty.
    pub gains: [f64; 4],
    /// Factor on `MAX_RPM`, the speed at which the rotors saturate.
    pub saturation: f64,
}

impl Default for ActuatorParams {
    fn default() -> Self {
        Self { lag: 0.0, latency: 0.0, gains: [1.0; 4], saturation: 1.0 }
    }
}

impl ActuatorParams {
    /// Largest gain.
    pub const MAX_GAIN: f64 = 1e3;

    /// Longest latency, s.
    pub const MAX_LATENCY: f64 = 1.0;

    /// Checks every setting.
    ///
    /// # Errors
    /// [`OptionError`] that names the first setting out of range.
    pub fn validate(&self) -> Result<(), OptionError> {
        OptionError::check("actuators.lag", self.lag, 0.0..=1e3, "0 to 1000 s")?;
        OptionError::check("actuators.latency", self.latency, 0.0..=Self::MAX_LATENCY, "0 to 1 s")?;
        OptionError::check("actuators.saturation", self.saturation, 1e-3..=1e3, "a positive factor up to 1000")?;
        for gain in self.gains {
            OptionError::check("actuators.gains", gain, 0.0..=Self::MAX_GAIN, "a factor from 0 to 1000")?;
        }
        Ok(())
    }
}

/// Motors of one drone.
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::physics::actuators::{ActuatorParams, Actuators};
///
/// // commands that arrive two physics steps late
/// let params = DroneModel::Cf2x.params();
/// let late = ActuatorParams { latency: 2.0 / 240.0, ..ActuatorParams::default() };
/// let mut motors = Actuators::new(&params, &late, 1.0 / 240.0);
/// let speeds = [12_000.0, 13_000.0, 14_000.0].map(|command| motors.advance(&[command; 4])[0]);
/// assert_eq!(speeds, [params.hover_rpm(), params.hover_rpm(), 12_000.0]);
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Actuators {
    gains: [f64; 4],
    max_rpm: f64,
    /// Rotor speed at the start of an episode, rpm.
    initial_rpm: f64,
    /// Fraction of the remaining speed difference that the lag closes in one physics step: 1 − exp(−dt/τ).
    share: f64,
    /// Fraction while the speed falls, if it is another one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fall_share: Option<f64>,
    /// Ring buffer of delayed commands, one per physics step of latency.
    queue: Vec<[f64; 4]>,
    next: usize,
    rpm: [f64; 4],
}

impl Actuators {
    /// Creates the motors of a drone for physics steps of `dt` seconds.
    ///
    /// Motors with lag, latency or rotor inertia turn at hover speed when an episode begins, because a drone that
    /// starts in the air was already flying.
    pub fn new(params: &DroneParams, actuators: &ActuatorParams, dt: f64) -> Self {
        Self::with_queue(params, actuators, dt, Vec::new())
    }

    /// Replaces the parameters and resets the motors; reuses the allocated queue.
    pub(crate) fn set(&mut self, params: &DroneParams, actuators: &ActuatorParams, dt: f64) {
        let queue = std::mem::take(&mut self.queue);
        *self = Self::with_queue(params, actuators, dt, queue);
    }

    fn with_queue(params: &DroneParams, actuators: &ActuatorParams, dt: f64, mut queue: Vec<[f64; 4]>) -> Self {
        let motors = &params.motors;
        let times = if actuators.lag > 0.0 { [actuators.lag; 2] } else { [motors.rise_time, motors.fall_time] };
        let [share, fall_share] = times.map(|time| if time > 0.0 { -(-dt / time).exp_m1() } else { 1.0 });
        let steps = ((actuators.latency + motors.latency) / dt).round() as usize;
        let has_memory = times != [0.0; 2] || steps > 0 || motors.rotor_inertia > 0.0;
        let max_rpm = params.max_rpm() * actuators.saturation;
        let initial_rpm = if has_memory { params.hover_rpm().min(max_rpm) } else { 0.0 };
        queue.clear();
        queue.resize(steps, [initial_rpm; 4]);
        Self {
            gains: actuators.gains,
            max_rpm,
            initial_rpm,
            share,
            fall_share: (fall_share != share).then_some(fall_share),
            queue,
            next: 0,
            rpm: [initial_rpm; 4],
        }
    }

    /// Reserves queue capacity for a latency of `steps` physics steps.
    pub(crate) fn reserve(&mut self, steps: usize) {
        self.queue.reserve(steps.saturating_sub(self.queue.len()));
    }

    /// Resets the motors to the start of an episode.
    pub fn reset(&mut self) {
        self.queue.fill([self.initial_rpm; 4]);
        self.next = 0;
        self.rpm = [self.initial_rpm; 4];
    }

    /// Returns true if the queue index is in range and every number is finite and not negative.
    pub(crate) fn is_valid(&self) -> bool {
        let numbers = [self.max_rpm, self.initial_rpm, self.share, self.fall_share()].into_iter();
        let mut numbers = numbers.chain(self.gains).chain(self.rpm).chain(self.queue.iter().flatten().copied());
        numbers.all(|x| x.is_finite() && x >= 0.0) && (self.next == 0 || self.next < self.queue.len())
    }

    /// Returns the rotor speeds, rpm.
    #[inline]
    pub fn rpm(&self) -> &[f64; 4] {
        &self.rpm
    }

    /// Returns the maximum rotor speed, rpm.
    #[inline]
    pub fn max_rpm(&self) -> f64 {
        self.max_rpm
    }

    /// Returns the commands that arrive in the next physics steps, as many as the latency.
    pub(crate) fn queued(&self) -> impl ExactSizeIterator<Item = [f64; 4]> {
        let count = self.queue.len();
        (0..count).map(move |index| self.queue[(self.next + index) % count])
    }

    /// Replaces the commands that arrive in the next physics steps.
    pub(crate) fn set_queue(&mut self, queue: impl Iterator<Item = [f64; 4]>) {
        self.next = 0;
        self.queue.iter_mut().zip(queue).for_each(|(own, command)| *own = command);
    }

    /// Returns the factors on the commanded speeds.
    pub(crate) fn gains(&self) -> &[f64; 4] {
        &self.gains
    }

    /// Replaces the factors on the commanded speeds. Rotor speeds and delayed commands stay the same.
    pub(crate) fn set_gains(&mut self, gains: &[f64; 4]) {
        self.gains = *gains;
    }

    /// Returns the fraction of the remaining speed difference that the lag closes in one physics step while the speed
    /// rises; 1 without lag.
    #[inline]
    pub fn share(&self) -> f64 {
        self.share
    }

    /// Returns the fraction of the remaining speed difference that the lag closes in one physics step while the speed
    /// falls; 1 without lag.
    #[inline]
    pub fn fall_share(&self) -> f64 {
        self.fall_share.unwrap_or(self.share)
    }

    /// Returns true if the speed follows a command with a lag.
    pub(crate) fn has_lag(&self) -> bool {
        self.share.min(self.fall_share()) < 1.0
    }

    /// Returns true if the motors have no latency.
    pub fn is_prompt(&self) -> bool {
        self.queue.is_empty()
    }

    /// Returns the rotor speeds (rpm) that the motors approach under a command: the command times the gains, clamped
    /// to 0 to [`max_rpm`](Self::max_rpm).
    #[inline]
    pub fn target(&self, command: &[f64; 4]) -> [f64; 4] {
        let mut target = *command;
        for (target, gain) in target.iter_mut().zip(self.gains) {
            *target = motors::target(*target, gain, self.max_rpm);
        }
        target
    }

    /// Sets the rotor speeds, rpm.
    pub(crate) fn set_rpm(&mut self, rpm: &[f64; 4]) {
        self.rpm = *rpm;
    }

    /// Advances the motors by one physics step under a command (rpm) and returns the rotor speeds (rpm) of that step:
    /// n += (n_cmd − n)·(1 − exp(−dt/τ)), with the τ of a rising speed for n_cmd > n and that of a falling one
    /// otherwise.
    #[inline]
    pub fn advance(&mut self, command: &[f64; 4]) -> &[f64; 4] {
        let mut arrived = *command;
        if let Some(slot) = self.queue.get_mut(self.next) {
            std::mem::swap(slot, &mut arrived);
            self.next = (self.next + 1) % self.queue.len();
        }
        let targets = self.target(&arrived);
        let (rise, fall) = (self.share, self.fall_share());
        for (rpm, target) in self.rpm.iter_mut().zip(targets) {
            *rpm = motors::follow(*rpm, target, motors::share(*rpm, target, rise, fall));
        }
        &self.rpm
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drone::DroneModel;
    use proptest::prelude::*;

    const DT: f64 = 1.0 / 240.0;

    fn motors(params: ActuatorParams) -> Actuators {
        params.validate().unwrap();
        Actuators::new(&DroneModel::Cf2x.params(), &params, DT)
    }

    #[test]
    fn by_default_rotor_speeds_are_bit_identical_to_clamped_commands() {
        let mut motors = motors(ActuatorParams::default());
        for command in [[0.1, 1.0 / 3.0, 14_000.1, 21_000.0], [0.0; 4]] {
            assert_eq!(*motors.advance(&command), command);
        }
        let max = DroneModel::Cf2x.params().max_rpm();
        assert_eq!(*motors.advance(&[-5.0, 1e9, 0.0, max]), [0.0, max, 0.0, max]);
    }

    #[test]
    fn the_lag_is_exponential() {
        for lag in [0.005, 0.05, 0.0123] {
            let mut motors = motors(ActuatorParams { lag, ..ActuatorParams::default() });
            let start = motors.rpm()[0];
            let steps = 40;
            for _ in 0..steps {
                motors.advance(&[20_000.0; 4]);
            }
            let wanted = start + (20_000.0 - start) * (1.0 - (-f64::from(steps) * DT / lag).exp());
            assert!((motors.rpm()[0] - wanted).abs() < 1e-6, "{lag}");
        }
    }

    #[test]
    fn commands_arrive_after_their_latency_in_whole_physics_steps() {
        for (latency, steps) in [(0.0, 0), (0.4 * DT, 0), (0.6 * DT, 1), (5.0 * DT, 5), (0.05, 12)] {
            let mut motors = motors(ActuatorParams { latency, ..ActuatorParams::default() });
            let before = motors.rpm()[0];
            for step in 0..20 {
                let rpm = motors.advance(&[1000.0 + f64::from(step); 4])[0];
                let wanted = if step < steps { before } else { 1000.0 + f64::from(step - steps) };
                assert_eq!(rpm, wanted, "latency {latency}, step {step}");
            }
            motors.reset();
            assert_eq!(motors.rpm()[0], before);
        }
    }

    #[test]
    fn gains_and_saturation_apply_per_motor_and_out_of_range_settings_are_errors() {
        let mut motors =
            motors(ActuatorParams { gains: [1.0, 0.5, 2.0, 0.0], saturation: 0.5, ..ActuatorParams::default() });
        let max = 0.5 * DroneModel::Cf2x.params().max_rpm();
        assert_eq!(*motors.advance(&[8000.0; 4]), [8000.0, 4000.0, max, 0.0]);
        for bad in [
            ActuatorParams { lag: -1.0, ..ActuatorParams::default() },
            ActuatorParams { latency: f64::NAN, ..ActuatorParams::default() },
            ActuatorParams { saturation: 0.0, ..ActuatorParams::default() },
            ActuatorParams { gains: [1.0, 1.0, -0.1, 1.0], ..ActuatorParams::default() },
        ] {
            assert!(bad.validate().unwrap_err().to_string().contains("expected"));
        }
    }

    proptest! {
        #[test]
        fn speeds_stay_within_the_motors_range(
            lag in 0.0..0.1, latency in 0.0..0.1, saturation in 0.1..2.0,
            commands in prop::collection::vec(prop::array::uniform4(-1e6..1e6), 1..50),
        ) {
            let mut motors = motors(ActuatorParams { lag, latency, saturation, ..ActuatorParams::default() });
            let max = DroneModel::Cf2x.params().max_rpm() * saturation;
            prop_assert!(motors.rpm()[0] <= max);
            for command in commands {
                prop_assert!(motors.advance(&command).iter().all(|n| (0.0..=max).contains(n)));
            }
        }
    }
}
