use std::f64::consts::{FRAC_PI_2, PI};

use flight::clearance::CollisionCylinder as CylinderLanes;
use flight::tasks::crash::{CLEAR_OF_FLOOR, CrashLimits};
use flight::tasks::{CRASH, CRASH_PENALTY, RewardTerms};
use pulp::Simd;
use smallvec::SmallVec;

use crate::drone::DroneParams;
use crate::engine::Touched;
use crate::env::{EndReason, EnvError, LaneRows};
use crate::math::{Pack, Real};
use crate::simulation::SimView;
use crate::state::{DroneState, FlightState};
use crate::world::placement::CollisionCylinder;

/// Conditions under which a drone crashes. All are on by default.
///
/// ```
/// use std::f64::consts::PI;
///
/// use aviary::tasks::{CrashConditions, Hover};
///
/// // no limit on the tilt
/// let crash = CrashConditions::with_max_tilt(PI);
/// let env = Hover::builder().task(|hover| hover.crash = crash).build()?;
/// assert!(env.task().crash.floor_contact);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct CrashConditions {
    /// The centre of a drone is below z = 0, which only the `dyn` mode, without contacts, allows.
    pub below_floor: bool,
    /// A drone touches the floor after it was clear of it. With a solid floor, this replaces the paper's z < 0.
    pub floor_contact: bool,
    /// A drone touches an obstacle.
    pub obstacle_contact: bool,
    /// Two drones touch.
    pub drone_contact: bool,
    /// Maximum angle between body z and world z, rad; π or more for no limit.
    #[serde(with = "crate::serial::extended")]
    pub max_tilt: f64,
}

impl CrashConditions {
    /// Creates conditions that are all on, with this maximum tilt, rad.
    pub fn with_max_tilt(max_tilt: f64) -> Self {
        Self { below_floor: true, floor_contact: true, obstacle_contact: true, drone_contact: true, max_tilt }
    }
}

impl CrashConditions {
    /// Validates the maximum tilt.
    ///
    /// # Errors
    /// [`EnvError::Option`] for a maximum tilt that is not positive.
    pub fn validate(&self) -> Result<(), EnvError> {
        if self.max_tilt > 0.0 {
            return Ok(());
        }
        let (got, expected) =
            (format!("{} rad", crate::number(self.max_tilt)), "a positive angle (π or more for no limit)");
        Err(EnvError::Option { option: "max_tilt", got, expected })
    }
}

/// Completes the terms of a reward by the penalty that every task subtracts for a crash.
pub(super) fn with_crash<T: RewardTerms<f64>>(terms: T, end: Option<EndReason>) -> T {
    terms.minus(CRASH, if end.is_some_and(EndReason::is_crash) { CRASH_PENALTY } else { 0.0 })
}

/// Returns the height of the lowest point of a drone's collision cylinder above the floor, m.
fn clearance(params: &DroneParams, state: &DroneState) -> f64 {
    CollisionCylinder::from(params).floor_clearance(state)
}

/// Detector of crashes, for [`Task::end`](crate::env::Task::end).
///
/// ```
/// use aviary::drone::DroneModel;
/// use aviary::env::EndReason;
/// use aviary::simulation::Simulation;
/// use aviary::tasks::{CrashConditions, CrashWatch};
///
/// let mut simulation = Simulation::builder(DroneModel::Cf2x).initial_positions([[0.0, 0.0, 0.5]]).build()?;
/// let (conditions, mut watch) = (CrashConditions::with_max_tilt(1.5), CrashWatch::default());
/// watch.reset(simulation.view());
/// while watch.end(0).is_none() {
///     simulation.step(&[[0.0; 4]])?;
///     watch.update(&conditions, simulation.view());
/// }
/// assert_eq!(watch.end(0), Some(EndReason::FloorContact));
/// # Ok::<(), aviary::simulation::SimulationError>(())
/// ```
#[derive(Debug, Clone, Default, serde::Serialize, serde::Deserialize)]
pub struct CrashWatch {
    /// True for drones that have been clear of the floor since the start of the episode.
    airborne: SmallVec<[bool; 8]>,
    found: SmallVec<[Option<EndReason>; 8]>,
}

impl CrashWatch {
    /// Starts an episode.
    pub fn reset(&mut self, simulation: SimView<'_>) {
        let clear = |drone: usize| clearance(simulation.params(drone), &simulation.states()[drone]) > CLEAR_OF_FLOOR;
        self.airborne.clear();
        self.airborne.extend((0..simulation.num_drones()).map(clear));
        self.found.clear();
        self.found.resize(simulation.num_drones(), None);
    }

    /// Checks every drone after a control step.
    ///
    /// # Panics
    /// If [`reset`](Self::reset) was not called.
    pub fn update(&mut self, conditions: &CrashConditions, simulation: SimView<'_>) {
        for (drone, state) in simulation.states().iter().enumerate() {
            let mut found = None;
            let mut on_floor = false;
            for contact in simulation.contacts() {
                // a contact of two drones is reported once, for the first of them
                let reason = match contact.with {
                    Touched::Drone(other) if contact.drone == drone || other == drone => {
                        conditions.drone_contact.then_some(EndReason::DroneContact)
                    }
                    Touched::Floor if contact.drone == drone => {
                        on_floor = true;
                        (conditions.floor_contact && self.airborne[drone]).then_some(EndReason::FloorContact)
                    }
                    Touched::Obstacle(_) if contact.drone == drone => {
                        conditions.obstacle_contact.then_some(EndReason::ObstacleContact)
                    }
                    _ => None,
                };
                found = found.or(reason);
            }
            // a drone standing on the floor may have no contact point for a step
            if !self.airborne[drone] {
                self.airborne[drone] = !on_floor && clearance(simulation.params(drone), state) > CLEAR_OF_FLOOR;
            }
            if conditions.below_floor && state.position.z < 0.0 {
                found = found.or(Some(EndReason::BelowFloor));
            }
            // while the drone is upright, the tilt is below 90°, so only smaller limits need its angle
            if (state.up().z < 0.0 || conditions.max_tilt < FRAC_PI_2) && state.tilt() > conditions.max_tilt {
                found = found.or(Some(EndReason::Tilt));
            }
            self.found[drone] = found;
        }
    }

    /// Number of rows in lanes.
    pub(super) const ROWS: usize = 5;

    /// Writes the rows of a drone: whether it is airborne, radius and height of its collision cylinder, the
    /// height of the floor condition, and the limit of the world z component of body z.
    pub(super) fn write_rows(
        &self,
        conditions: &CrashConditions,
        simulation: SimView<'_>,
        drone: usize,
        rows: &mut [f64],
    ) {
        /// Margin for rounding.
        const SLACK: f64 = 1e-9;
        let cylinder = CollisionCylinder::from(simulation.params(drone));
        let airborne = self.airborne.get(drone).copied().unwrap_or_default();
        let lowest = if conditions.below_floor { 0.0 } else { f64::NEG_INFINITY };
        let upright = if conditions.max_tilt < PI { conditions.max_tilt.cos() + SLACK } else { f64::NEG_INFINITY };
        let airborne = f64::from(u8::from(airborne));
        rows.copy_from_slice(&[airborne, cylinder.0.radius, cylinder.0.height, lowest, upright]);
    }

    /// Reads the state of a drone from its rows, after steps without contacts.
    pub(super) fn read_rows(&mut self, drone: usize, rows: &[f64]) {
        (self.airborne[drone], self.found[drone]) = (rows[0] > 0.0, None);
    }

    /// Updates the rows of a drone in flight, and returns a number above 0 where it may have crashed.
    #[inline(always)]
    pub(super) fn update_rows<S: Simd>(state: &FlightState<Pack<S>>, rows: &mut LaneRows<'_, S>) -> Pack<S> {
        let airborne = rows.get(0);
        let (zero, one) = (airborne.all(0.0), airborne.all(1.0));
        let cylinder = CylinderLanes { radius: rows.get(1), height: rows.get(2) };
        let limits = CrashLimits { cylinder, lowest: rows.get(3), upright: rows.get(4) };
        rows.put(0, Real::choose(limits.is_clear(state), one, airborne));
        Real::choose(limits.are_exceeded(state), one, zero)
    }

    /// Returns how a drone crashed during the last control step, if it did; `None` if `drone` is out of range.
    pub fn end(&self, drone: usize) -> Option<EndReason> {
        self.found.get(drone).copied().flatten()
    }
}
