//! Battery of an airframe.

use serde::{Deserialize, Serialize};

use super::DroneError;
use crate::math::{Real, exp_of_negative, polynomial};

/// Battery of an airframe: the table `[battery]` of its file. Without it, the voltage is constant
/// ([`MotorParams::voltage`](super::MotorParams::voltage)).
///
/// The voltage at the motors is the open-circuit voltage minus `resistance` times the current. The open-circuit voltage
/// falls with the charge, see [`open_circuit_voltage`](Self::open_circuit_voltage). The current is the mechanical power
/// of the four rotors, k_m·n²·(2π/60)·n each, divided by `efficiency` and by the voltage, plus `idle_current`. An empty
/// battery supplies no voltage. Charge, voltage and current change once per control step.
///
/// The voltage limits every command, whatever the action type: no motor is commanded to turn faster than at full duty,
/// [`MotorParams::speed`](super::MotorParams::speed)(1, voltage). The
/// [gains](crate::physics::actuators::ActuatorParams::gains) of an environment multiply the speeds of its motors after
/// this limit.
///
/// ```
/// use aviary::drone::{BatteryParams, DroneModel, DroneParams, MotorParams};
/// use aviary::simulation::Simulation;
///
/// // a Crazyflie with one LiPo cell of 250 mAh
/// let battery = BatteryParams { capacity: 0.25, resistance: 0.1, efficiency: 0.3, ..BatteryParams::default() };
/// let motors = MotorParams { speed_per_volt: 6000.0, ..MotorParams::default() };
/// let torque_coefficient = 1.9e-12;
/// let params = DroneParams { motors, torque_coefficient, battery: Some(battery), ..DroneModel::Cf2x.params() };
/// let hover = params.hover_rpm();
/// let mut simulation = Simulation::builder(params).initial_positions([[0.0, 0.0, 1.0]]).build()?;
/// let full = simulation.battery(0).expect("a battery");
/// assert!(full.charge == 1.0 && (full.voltage - 4.1).abs() < 0.01);
/// for _ in 0..48 {
///     simulation.step(&[[hover; 4]])?;
/// }
/// let later = simulation.battery(0).expect("a battery");
/// // one second of hover
/// assert!((full.charge - later.charge - later.current / (0.25 * 3600.0)).abs() < 1e-4);
/// assert!(later.voltage < full.voltage && later.current > 1.0);
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BatteryParams {
    /// Charge of the full battery, A·h (1 A·h is 3600 C); from the label, or from a discharge.
    pub capacity: f64,
    /// Number of lithium-polymer cells in series; default 1.
    #[serde(default = "one_cell", skip_serializing_if = "is_one_cell")]
    pub cells: u32,
    /// Internal resistance of the whole battery with its leads, Ω; from the voltage at two currents.
    pub resistance: f64,
    /// Mechanical power of the rotors over the electric power of the motors, 0 to 1; from a test stand.
    pub efficiency: f64,
    /// Current that does not drive the motors, A: that of the electronics; default 0.
    #[serde(default, skip_serializing_if = "super::motors::is_zero")]
    pub idle_current: f64,
    /// Charge at the start of an episode as a fraction of `capacity`, 0 to 1; default 1.
    #[serde(default = "full", skip_serializing_if = "is_full")]
    pub initial_charge: f64,
}

fn one_cell() -> u32 {
    1
}

#[allow(clippy::trivially_copy_pass_by_ref)] // serde passes a reference
fn is_one_cell(cells: &u32) -> bool {
    *cells == 1
}

fn full() -> f64 {
    1.0
}

#[allow(clippy::trivially_copy_pass_by_ref)] // serde passes a reference
fn is_full(charge: &f64) -> bool {
    *charge == 1.0
}

/// One full cell of 1 A·h without resistance, idle current or losses; a base for struct update syntax.
impl Default for BatteryParams {
    fn default() -> Self {
        Self { capacity: 1.0, cells: 1, resistance: 0.0, efficiency: 1.0, idle_current: 0.0, initial_charge: 1.0 }
    }
}

impl BatteryParams {
    /// Largest number of cells.
    pub const MAX_CELLS: u32 = 1000;

    pub(super) fn validate(&self) -> Result<(), DroneError> {
        super::check_ranges(&[
            ("battery.capacity", self.capacity, 1e-6, 1e6, "1e-6 to 1e6 A·h"),
            ("battery.cells", f64::from(self.cells), 1.0, f64::from(Self::MAX_CELLS), "1 to 1000"),
            ("battery.resistance", self.resistance, 0.0, 1e3, "0 to 1000 Ω"),
            ("battery.efficiency", self.efficiency, 1e-3, 1.0, "0.001 to 1"),
            ("battery.idle_current", self.idle_current, 0.0, 1e4, "0 to 1e4 A"),
            ("battery.initial_charge", self.initial_charge, 0.0, 1.0, "0 to 1"),
        ])?;
        // the electronics alone must leave some voltage until the battery is empty
        if self.idle_current * self.resistance >= 0.9 * self.open_circuit_voltage(0.0) {
            let expected =
                "a current that the resistance lets pass: below 90 % of the lowest voltage over the resistance";
            return Err(DroneError::Parameter { field: "battery.idle_current", got: self.idle_current, expected });
        }
        Ok(())
    }

    /// Returns the open-circuit voltage at a charge, as a fraction of the capacity, V: the number of cells times
    /// −1.031·e^(−35·s) + 3.685 + 0.2156·s − 0.1178·s² + 0.3201·s³.
    ///
    /// The curve of a lithium-polymer cell is from M. Chen and G. A. Rincón-Mora, *Accurate Electrical Battery Model
    /// Capable of Predicting Runtime and I–V Performance*, IEEE Transactions on Energy Conversion 21 (2006). It falls
    /// from 4.10 V to 3.80 V at half charge and, steeply below a tenth, to 2.65 V.
    ///
    /// ```
    /// use aviary::drone::BatteryParams;
    ///
    /// let three_cells = BatteryParams { cells: 3, ..BatteryParams::default() };
    /// for (charge, voltage) in [(1.0, 12.31), (0.5, 11.41), (0.0, 7.96)] {
    ///     assert!((three_cells.open_circuit_voltage(charge) - voltage).abs() < 0.005);
    /// }
    /// ```
    pub fn open_circuit_voltage(&self, charge: f64) -> f64 {
        f64::from(self.cells) * cell_voltage(charge)
    }
}

/// Returns the open-circuit voltage of a cell, V; see [`BatteryParams::open_circuit_voltage`].
#[inline(always)]
pub(crate) fn cell_voltage<R: Real>(charge: R) -> R {
    polynomial(charge, [0.3201, -0.1178, 0.2156, 3.685]) - exp_of_negative(charge * -35.0) * 1.031
}
