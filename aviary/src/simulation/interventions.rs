//! Interventions in a running simulation: external forces and gains of motors, which the next reset ends.

use nalgebra::Vector3;

use super::{SimData, SimView, Simulation, SimulationError};
use crate::error::OptionError;
use crate::physics::actuators::ActuatorParams;

impl SimData {
    /// Sets the external force on a drone; see
    /// [`Simulation::set_external_force`](super::Simulation::set_external_force).
    ///
    /// # Errors
    /// [`SimulationError::ExternalForce`] for a number that is not finite, [`SimulationError::NoDrone`] for an index
    /// out of range; the data is unchanged.
    pub fn set_external_force(&mut self, drone: usize, force: Vector3<f64>) -> Result<(), SimulationError> {
        self.check_drone(drone)?;
        if !force.iter().all(|x| x.is_finite()) {
            return Err(SimulationError::ExternalForce { drone, got: force.into() });
        }
        if force == self.external_force(drone) {
            return Ok(());
        }
        let none = || vec![Vector3::zeros(); self.states.len()].into_boxed_slice();
        let forces = self.external_forces.get_or_insert_with(none);
        forces[drone] = force;
        if forces.iter().all(|force| *force == Vector3::zeros()) {
            self.external_forces = None;
        }
        // the bound of the distance that the drone can travel contains the force
        self.changed = true;
        Ok(())
    }

    /// Returns the external force on a drone, world frame, N; zero unless one was set.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn external_force(&self, drone: usize) -> Vector3<f64> {
        assert!(drone < self.states.len(), "drone {drone} does not exist");
        self.external_forces.as_ref().map_or_else(Vector3::zeros, |forces| forces[drone])
    }

    /// Removes the external forces on all drones. Returns true if there were any.
    pub(crate) fn clear_external_forces(&mut self) -> bool {
        let pushed = self.external_forces.take().is_some();
        self.changed |= pushed;
        pushed
    }

    /// Sets the gain of a motor; see [`Simulation::set_motor_gain`](super::Simulation::set_motor_gain).
    ///
    /// # Errors
    /// [`SimulationError::NoDrone`] and [`SimulationError::Option`], which names the motor or the gain that is out of
    /// range; the data is unchanged.
    pub fn set_motor_gain(&mut self, drone: usize, motor: usize, gain: f64) -> Result<(), SimulationError> {
        self.check_drone(drone)?;
        let mut gains = *self.actuators[drone].gains();
        let Some(own) = gains.get_mut(motor) else {
            let error = OptionError { option: "motor", got: motor.to_string(), expected: "an index from 0 to 3" };
            return Err(error.into());
        };
        let range = 0.0..=ActuatorParams::MAX_GAIN;
        OptionError::check("motor_gain", gain, range, "a factor from 0 to 1000")?;
        *own = gain;
        self.actuators[drone].set_gains(&gains);
        Ok(())
    }
}

impl Simulation {
    /// Sets the external force on a drone (world frame, N), from the next step on. The force acts at the centre of
    /// mass in every physics step, in addition to all other forces, and stays constant until it is set again. A reset
    /// removes it. Zero is no force.
    ///
    /// ```
    /// use aviary::drone::DroneModel;
    /// use aviary::simulation::Simulation;
    /// use nalgebra::Vector3;
    ///
    /// let mut simulation = Simulation::builder(DroneModel::Cf2x).initial_positions([[0.0, 0.0, 1.0]]).build()?;
    /// let (mass, hover) = (simulation.params(0).mass, simulation.params(0).hover_rpm());
    /// simulation.set_external_force(0, Vector3::new(0.1 * mass, 0.0, 0.0))?;
    /// for _ in 0..48 {
    ///     simulation.step(&[[hover; 4]])?;
    /// }
    /// // 0.1 m/s² for one second
    /// assert!((simulation.states()[0].position.x - 0.05).abs() < 1e-12);
    /// simulation.reset()?;
    /// assert_eq!(simulation.external_force(0), Vector3::zeros());
    /// # Ok::<(), aviary::simulation::SimulationError>(())
    /// ```
    ///
    /// # Errors
    /// [`SimulationError::ExternalForce`] for a number that is not finite, [`SimulationError::NoDrone`] for an index
    /// out of range; the simulation is unchanged.
    pub fn set_external_force(&mut self, drone: usize, force: Vector3<f64>) -> Result<(), SimulationError> {
        self.data.set_external_force(drone, force)
    }

    /// Returns the external force on a drone, world frame, N; zero unless one was set.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn external_force(&self, drone: usize) -> Vector3<f64> {
        self.view().external_force(drone)
    }

    /// Sets the gain of a motor, a factor on its commanded speed from the next step on. A motor that has failed has
    /// the gain 0. Rotor speeds and delayed commands stay as they are, so that a motor with lag comes to rest
    /// gradually. A reset restores the [gains of the motor parameters](ActuatorParams::gains).
    ///
    /// ```
    /// use aviary::drone::DroneModel;
    /// use aviary::simulation::Simulation;
    ///
    /// let mut simulation = Simulation::builder(DroneModel::Cf2x).initial_positions([[0.0, 0.0, 1.0]]).build()?;
    /// simulation.set_motor_gain(0, 2, 0.0)?;
    /// simulation.step(&[[14_000.0; 4]])?;
    /// assert_eq!(simulation.rotor_speeds(0), &[14_000.0, 14_000.0, 0.0, 14_000.0]);
    /// simulation.reset()?;
    /// assert_eq!(simulation.motor_gains(0), &[1.0; 4]);
    /// # Ok::<(), aviary::simulation::SimulationError>(())
    /// ```
    ///
    /// # Errors
    /// [`SimulationError::NoDrone`], and [`SimulationError::Option`] for a motor that is not from 0 to 3 or a gain
    /// that is not from 0 to [`ActuatorParams::MAX_GAIN`]; the simulation is unchanged.
    pub fn set_motor_gain(&mut self, drone: usize, motor: usize, gain: f64) -> Result<(), SimulationError> {
        self.data.set_motor_gain(drone, motor, gain)
    }

    /// Returns the present factors on the commanded speeds of a drone's motors.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn motor_gains(&self, drone: usize) -> &[f64; 4] {
        self.view().motor_gains(drone)
    }
}

impl<'a> SimView<'a> {
    /// Returns the external force on a drone, world frame, N; zero unless one was set.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn external_force(self, drone: usize) -> Vector3<f64> {
        self.data().external_force(drone)
    }

    /// Returns the present factors on the commanded speeds of a drone's motors: those of its
    /// [motor parameters](Self::actuator_params), unless
    /// [`set_motor_gain`](super::Simulation::set_motor_gain) has changed them in this episode.
    ///
    /// # Panics
    /// If `drone` is out of range.
    pub fn motor_gains(self, drone: usize) -> &'a [f64; 4] {
        self.data().actuators[drone].gains()
    }
}
