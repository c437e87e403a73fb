//! Steps and resets of a batch with tensors of burn, which share the memory of the batch.

use aviary::vector::{Autoreset, VecEnv as _};
use burn_cubecl::kernel::into_contiguous;
use burn_cubecl::tensor::CubeTensor;
use burn_cubecl::{CubeBackend, CubeDevice};
use burn_tensor::{Bool, DType, Device, FloatDType, Int, Tensor};
use cubecl::server::Handle;

use super::{GpuAviary, Precision};
use crate::environment::end;
use crate::error::GpuError;

/// Results of [`GpuAviary::step_on_device`], in the memory of the device. They keep their values after the next
/// [`step_on_device`](GpuAviary::step_on_device) and [`reset_on_device`](GpuAviary::reset_on_device). The functions
/// with host buffers write into the memory of the last ones.
#[derive(Debug, Clone)]
pub struct DeviceStep {
    /// Observations: a row per environment, single precision. Where an episode ended with [`Autoreset::SameStep`], the
    /// row is the first observation of the next episode.
    pub observations: Tensor<2>,
    /// Last observations of the episodes that ended in this step, in the rows of their environments; other rows are
    /// the present observations. `None` unless the autoreset is [`Autoreset::SameStep`].
    pub last_observations: Option<Tensor<2>>,
    /// Reward of each environment, single precision.
    pub rewards: Tensor<1>,
    /// End of each environment, see [`terminated`](Self::terminated), [`truncated`](Self::truncated) and
    /// [`success`](Self::success).
    ends: Tensor<1, Int>,
}

impl DeviceStep {
    /// Returns true for each environment whose task ended the episode in this step.
    pub fn terminated(&self) -> Tensor<1, Bool> {
        self.has(end::TERMINATED)
    }

    /// Returns true for each environment whose episode was cut off in this step: by the time limit, or by a fault such
    /// as an action that is not finite.
    pub fn truncated(&self) -> Tensor<1, Bool> {
        self.has(end::TRUNCATED)
    }

    /// Returns true for each environment whose episode ended in this step with a success.
    pub fn success(&self) -> Tensor<1, Bool> {
        self.has(end::SUCCESS)
    }

    fn has(&self, bit: u32) -> Tensor<1, Bool> {
        self.ends.clone().bitwise_and_scalar(bit).not_equal_elem(0)
    }
}

impl GpuAviary {
    /// Returns the device of the batch for tensors of burn.
    pub fn burn_device(&self) -> Device {
        self.cube_device().into()
    }

    /// Starts an episode in every environment, as [`reset`](aviary::vector::VecEnv::reset), and returns the
    /// observations as a tensor with a row per environment.
    ///
    /// Errors of the device appear where results are read.
    pub fn reset_on_device(&mut self, seed: Option<u64>) -> Tensor<2> {
        let all = vec![true; self.num_envs()];
        self.batch.renew_outputs();
        self.faults.clear();
        self.select(&all, |_| seed);
        self.ahead = false;
        self.rows(&self.batch.observations)
    }

    /// Advances every environment by one control step with the actions of a tensor, a row per environment, without
    /// copies between host and device. The call returns before the device has computed the step.
    ///
    /// The tensor must be on [`burn_device`](Self::burn_device), without automatic differentiation. burn must not have
    /// its feature `fusion`, whose tensors have no memory before they are read.
    ///
    /// Episodes that end are visible in the result alone: [`episode_summary`](aviary::vector::VecEnv::episode_summary)
    /// is `None`, and [`faults`](aviary::vector::VecEnv::faults) is empty. [`step`](aviary::vector::VecEnv::step)
    /// continues these episodes, with a sum of rewards that begins again.
    ///
    /// ```
    /// # use aviary::env::EnvConfig;
    /// # use aviary::vector::VecConfig;
    /// # use aviary_gpu::{GpuAviary, GpuDevice, GpuError, Precision};
    /// use burn_tensor::Tensor;
    ///
    /// # let device = match GpuDevice::open(None) {
    /// #     Err(GpuError::NoAdapter { .. }) => return Ok(()), // no GPU on this machine
    /// #     device => device?,
    /// # };
    /// # let (options, config) = (EnvConfig::default(), VecConfig::new(1000));
    /// let mut env = GpuAviary::make("hover", options, config, &device, Precision::Single)?;
    /// let mut observations = env.reset_on_device(Some(1));
    /// for _ in 0..10 {
    ///     let height = observations.slice([0..1000, 2..3]);
    ///     let actions = (height - 1.0).mul_scalar(-0.1).expand([1000, 4]);
    ///     observations = env.step_on_device(actions)?.observations;
    /// }
    /// # Ok::<(), GpuError>(())
    /// ```
    ///
    /// # Errors
    /// [`GpuError::Actions`] for actions of another shape or on another device. [`GpuError::Env`] if an environment has
    /// not been reset, or with [`Autoreset::Disabled`], whose environments stop at the end of their episode. Errors of
    /// the device appear where results are read.
    pub fn step_on_device(&mut self, actions: Tensor<2>) -> Result<DeviceStep, GpuError> {
        self.check_runs_on_device()?;
        let count = self.num_envs();
        let shape = [count, self.action_size()];
        if actions.dims() != shape {
            let (got, expected) = (format!("{:?}", actions.dims()), format!("of the shape {shape:?}"));
            return Err(GpuError::Actions { got, expected });
        }
        let precision = match self.precision() {
            Precision::Single => FloatDType::F32,
            Precision::Double => FloatDType::F64,
        };
        let primitive = actions.cast(precision).try_into_primitive::<CubeBackend>().map_err(|error| {
            let expected = "of a backend of cubecl, without automatic differentiation".into();
            GpuError::Actions { got: format!("{error:?}"), expected }
        })?;
        let device = self.cube_device();
        if primitive.device != device {
            let (got, expected) = (format!("on {:?}", primitive.device), format!("on {device:?}"));
            return Err(GpuError::Actions { got, expected });
        }
        let tensor = into_contiguous(primitive);
        self.batch.actions = tensor.handle;
        self.batch.renew_outputs();
        self.batch.step();
        self.left_behind(1);
        let batch = &self.batch;
        let keeps_last = self.config.autoreset == Autoreset::SameStep;
        Ok(DeviceStep {
            observations: self.rows(&batch.observations),
            last_observations: keeps_last.then(|| self.rows(&batch.last_observations)),
            rewards: Tensor::from_primitive::<CubeBackend>(self.tensor(&batch.rewards, [count], DType::F32)),
            ends: Tensor::from_primitive::<CubeBackend>(self.tensor(&batch.ends, [count], DType::U32)),
        })
    }

    /// Returns a buffer of observations as a tensor.
    fn rows(&self, handle: &Handle) -> Tensor<2> {
        let shape = [self.num_envs(), self.observation_size()];
        Tensor::from_primitive::<CubeBackend>(self.tensor(handle, shape, DType::F32))
    }

    /// Returns a buffer as a tensor of a shape. Operations of burn do not write into it: the batch has it, too.
    fn tensor<const D: usize>(&self, handle: &Handle, shape: [usize; D], dtype: DType) -> CubeTensor {
        let client = self.batch.device.client().clone();
        CubeTensor::new_contiguous(client, self.cube_device(), shape.into(), handle.clone(), dtype)
    }

    fn cube_device(&self) -> CubeDevice {
        self.batch.device.cube()
    }
}
