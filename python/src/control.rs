//! Controllers.

use aviary::control::{
    AnyController, AttitudeGains, Bandwidths, Controller as _, ControllerKind, GeometricControl, Integrals, PidGains,
    PositionGains, Reference,
};
use aviary::drone::{DroneError, DroneModel, DroneParams, GRAVITY};
use aviary::state::{DroneState, attitude_from_rpy, attitude_from_wxyz, wxyz};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use numpy::{PyArray1, PyReadonlyArray1};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString};

use crate::conditions::{python_of, section};
use crate::error::{guard, system_error, value_error};

/// Adds the classes and functions of this file to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add_class::<Controller>()?;
    module.add_function(wrap_pyfunction!(airframe_constants, module)?)?;
    module.add_function(wrap_pyfunction!(quaternion_of_rpy, module)?)
}

/// Returns the quaternion (w, x, y, z) of roll, pitch and yaw (rad).
#[pyfunction]
fn quaternion_of_rpy<'py>(py: Python<'py>, rpy: PyReadonlyArray1<'py, f64>) -> PyResult<Bound<'py, PyArray1<f64>>> {
    let attitude = attitude_from_rpy(vector("rpy", &rpy)?.into());
    Ok(PyArray1::from_slice(py, &wxyz(&attitude)))
}

/// Reads an airframe: the name of a built-in one, the path of a TOML file, or a dict with the keys of such a file.
pub fn airframe(value: &Bound<'_, PyAny>) -> PyResult<DroneParams> {
    let params = match value.cast::<PyString>() {
        Ok(name) => {
            let name: String = name.extract()?;
            match name.parse::<DroneModel>() {
                Ok(model) => model.params(),
                Err(_) if name.ends_with(".toml") => DroneParams::from_file(&name).map_err(airframe_error)?,
                Err(error) => return Err(value_error(format_args!("drone_model: {error}"))),
            }
        }
        Err(_) => section("drone_model", value)?,
    };
    params.validate().map_err(|error| value_error(format_args!("drone_model: {error}")))?;
    Ok(params)
}

/// Converts an error of an airframe file.
fn airframe_error(error: DroneError) -> PyErr {
    let message = format!("drone_model: {error}");
    if let DroneError::File { error, .. } = &error
        && let DroneError::System(system) = &**error
    {
        return system_error(system.kind(), message);
    }
    value_error(message)
}

/// Returns the parameters of an airframe and the constants derived from them.
#[pyfunction]
fn airframe_constants<'py>(value: &Bound<'py, PyAny>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyDict>)> {
    let (py, params) = (value.py(), airframe(value)?);
    let constants = PyDict::new(py);
    constants.set_item("gravity", GRAVITY)?;
    constants.set_item("weight", params.weight())?;
    constants.set_item("hover_rpm", params.hover_rpm())?;
    constants.set_item("max_rpm", params.max_rpm())?;
    constants.set_item("max_thrust", params.max_thrust())?;
    constants.set_item("drag_area", params.drag_area())?;
    Ok((python_of(py, &params)?, constants))
}

/// Reads an array of N finite numbers.
pub fn vector<const N: usize>(name: &str, array: &PyReadonlyArray1<'_, f64>) -> PyResult<[f64; N]> {
    let array = array.as_array();
    if array.len() != N {
        let count = aviary::count(array.len(), "number");
        return Err(value_error(format_args!("{name} has {count}, expected {N}")));
    }
    let numbers: [f64; N] = std::array::from_fn(|i| array[i]);
    match numbers.iter().position(|x| !x.is_finite()) {
        Some(i) => Err(value_error(format_args!("{name}[{i}] is {}, expected a finite number", numbers[i]))),
        None => Ok(numbers),
    }
}

/// Reads a quaternion `[w, x, y, z]`. One of length 1 keeps its bits.
fn attitude(name: &str, array: &PyReadonlyArray1<'_, f64>) -> PyResult<UnitQuaternion<f64>> {
    let [w, x, y, z] = vector(name, array)?;
    let quaternion = Quaternion::new(w, x, y, z);
    let norm = quaternion.norm();
    if !(norm > 1e-6 && norm.is_finite()) {
        return Err(value_error(format_args!(
            "{name} has the length {}, expected a quaternion (w, x, y, z) of length 1",
            aviary::number(norm)
        )));
    }
    if (norm - 1.0).abs() < 1e-12 {
        return Ok(attitude_from_wxyz([w, x, y, z]));
    }
    Ok(UnitQuaternion::new_normalize(quaternion))
}

type Output<'py> = (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>, f64);

/// A controller of one drone.
#[pyclass(module = "mujoco_drones_gym._native")]
struct Controller {
    control: AnyController,
}

#[pymethods]
impl Controller {
    /// Creates a controller of a kind for an airframe. `bandwidths` are those of the kind `geometric`.
    #[new]
    #[pyo3(signature = (kind, airframe_of, bandwidths=None))]
    fn new(kind: &str, airframe_of: &Bound<'_, PyAny>, bandwidths: Option<&Bound<'_, PyAny>>) -> PyResult<Self> {
        let (kind, params) = (kind.parse::<ControllerKind>().map_err(value_error)?, airframe(airframe_of)?);
        let control = match bandwidths {
            None => kind.build(&params),
            Some(given) => {
                let given: GivenBandwidths = section("bandwidths", given)?;
                let bandwidths = given.complete(&Bandwidths::for_airframe(&params));
                check_bandwidths(&bandwidths)?;
                AnyController::Geometric(GeometricControl::with_bandwidths(&params, bandwidths))
            }
        };
        Ok(Self { control })
    }

    /// Clears the internal state.
    fn reset(&mut self) {
        self.control.reset();
    }

    /// Returns the motor speeds (rpm), the position error (m) and the yaw error (rad).
    #[pyo3(signature = (dt, position, attitude_wxyz, velocity, angular_velocity, target_position, target_velocity,
        target_acceleration, yaw, yaw_rate))]
    #[allow(clippy::too_many_arguments)]
    fn compute<'py>(
        &mut self,
        py: Python<'py>,
        dt: f64,
        position: PyReadonlyArray1<'py, f64>,
        attitude_wxyz: PyReadonlyArray1<'py, f64>,
        velocity: PyReadonlyArray1<'py, f64>,
        angular_velocity: PyReadonlyArray1<'py, f64>,
        target_position: PyReadonlyArray1<'py, f64>,
        target_velocity: PyReadonlyArray1<'py, f64>,
        target_acceleration: PyReadonlyArray1<'py, f64>,
        yaw: f64,
        yaw_rate: f64,
    ) -> PyResult<Output<'py>> {
        if !(1e-6..=10.0).contains(&dt) {
            let got = aviary::number(dt);
            return Err(value_error(format_args!("control_timestep is {got}, expected 1e-6 to 10 s")));
        }
        for (name, got) in [("target_rpy", yaw), ("target_rpy_rates", yaw_rate)] {
            if !got.is_finite() {
                return Err(value_error(format_args!("{name}[2] is {got}, expected a finite number")));
            }
        }
        let state = DroneState {
            position: vector("cur_pos", &position)?.into(),
            attitude: attitude("cur_quat", &attitude_wxyz)?,
            velocity: vector("cur_vel", &velocity)?.into(),
            angular_velocity: vector("cur_ang_vel", &angular_velocity)?.into(),
        };
        let reference = Reference {
            velocity: vector("target_vel", &target_velocity)?.into(),
            acceleration: vector("target_acc", &target_acceleration)?.into(),
            yaw_rate,
            ..Reference::hover(vector("target_pos", &target_position)?.into(), yaw)
        };
        let output = guard(|| Ok(self.control.control(dt, &state, &reference)))?;
        let array = |numbers: &[f64]| PyArray1::from_slice(py, numbers);
        Ok((array(&output.rpm), array(output.position_error.as_slice()), output.yaw_error))
    }

    /// Returns the integrals of the position and attitude errors.
    #[allow(clippy::type_complexity)]
    fn integrals<'py>(&self, py: Python<'py>) -> (Bound<'py, PyArray1<f64>>, Bound<'py, PyArray1<f64>>) {
        let Integrals { position, attitude } = self.control.integrals();
        (PyArray1::from_slice(py, position.as_slice()), PyArray1::from_slice(py, attitude.as_slice()))
    }

    /// Replaces the integrals of the position and attitude errors.
    fn set_integrals(
        &mut self,
        position: PyReadonlyArray1<'_, f64>,
        attitude: PyReadonlyArray1<'_, f64>,
    ) -> PyResult<()> {
        let position = vector("integral_pos_e", &position)?.into();
        let attitude = vector("integral_rpy_e", &attitude)?.into();
        self.control.set_integrals(&Integrals { position, attitude });
        Ok(())
    }

    /// Returns the gains of a cascade, one dict for each loop; `None` for the kind `geometric`.
    fn gains<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyAny>>> {
        self.control.gains().map(|gains| python_of(py, &gains)).transpose()
    }

    /// Replaces the gains of a cascade.
    fn set_gains(&mut self, gains: &Bound<'_, PyAny>) -> PyResult<()> {
        let gains: PidGains = section("gains", gains)?;
        check_gains(&gains)?;
        if self.control.set_gains(gains) {
            Ok(())
        } else {
            Err(value_error("a geometric controller has no gains, expected bandwidths"))
        }
    }

    /// Returns the complete state as text.
    fn to_json(&self) -> PyResult<String> {
        serde_json::to_string(&self.control).map_err(value_error)
    }

    /// Restores a state of [`to_json`](Self::to_json).
    #[staticmethod]
    fn from_json(text: &str) -> PyResult<Self> {
        Ok(Self { control: serde_json::from_str(text).map_err(value_error)? })
    }
}

/// Bandwidths of which any can be missing.
#[derive(Default, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
struct GivenBandwidths {
    horizontal: Option<f64>,
    vertical: Option<f64>,
    tilt: Option<f64>,
    yaw: Option<f64>,
    integral: Option<f64>,
}

impl GivenBandwidths {
    /// Returns the bandwidths with those of an airframe in place of missing ones.
    fn complete(&self, default: &Bandwidths) -> Bandwidths {
        Bandwidths {
            horizontal: self.horizontal.unwrap_or(default.horizontal),
            vertical: self.vertical.unwrap_or(default.vertical),
            tilt: self.tilt.unwrap_or(default.tilt),
            yaw: self.yaw.unwrap_or(default.yaw),
            integral: self.integral.unwrap_or(default.integral),
        }
    }
}

/// Returns an error for bandwidths that give no motor speeds.
fn check_bandwidths(bandwidths: &Bandwidths) -> PyResult<()> {
    let Bandwidths { horizontal, vertical, tilt, yaw, integral } = *bandwidths;
    for (name, got) in [("horizontal", horizontal), ("vertical", vertical), ("tilt", tilt), ("yaw", yaw)] {
        if !(1e-6..=1e6).contains(&got) {
            let got = aviary::number(got);
            return Err(value_error(format_args!("{name} is {got}, expected a positive frequency in rad/s")));
        }
    }
    if !(0.0..=1.0).contains(&integral) {
        return Err(value_error(format_args!("integral is {}, expected 0 to 1", aviary::number(integral))));
    }
    Ok(())
}

/// Returns an error for gains with which a control law overflows, and for negative limits of the integrals.
fn check_gains(gains: &PidGains) -> PyResult<()> {
    let PositionGains { proportional: p, integral: i, derivative: d, integral_clamp } = gains.position;
    let AttitudeGains { proportional, integral, derivative, integral_clamp: clamp } = gains.attitude;
    let usual = |gain: &Vector3<f64>| gain.iter().all(|x| x.abs() <= 1e9);
    for (name, gain) in [
        ("P_COEFF_FOR", p),
        ("I_COEFF_FOR", i),
        ("D_COEFF_FOR", d),
        ("P_COEFF_TOR", proportional),
        ("I_COEFF_TOR", integral),
        ("D_COEFF_TOR", derivative),
    ] {
        if !usual(&gain) {
            let got = gain.as_slice();
            return Err(value_error(format_args!("{name} is {got:?}, expected three finite numbers from -1e9 to 1e9")));
        }
    }
    for (name, got) in [("INTEGRAL_POS_LIMIT", integral_clamp), ("INTEGRAL_RPY_LIMIT", clamp)] {
        if !(0.0..=1e9).contains(&got) {
            let got = aviary::number(got);
            return Err(value_error(format_args!("{name} is {got}, expected zero or a positive number")));
        }
    }
    Ok(())
}
