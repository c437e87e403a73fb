//! burn's Adam (Kingma & Ba 2015) over all parameters as one vector, with its state in plain numbers.

use burn::optim::{Adam, AdamConfig, AdamState, AdaptiveMomentumState, Optimizer as _};
use burn::tensor::{Device, Tensor, TensorData};

pub(crate) struct Optimizer {
    adam: Adam,
    device: Device,
    state: Option<AdamState<1>>,
}

impl std::fmt::Debug for Optimizer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Optimizer").finish_non_exhaustive()
    }
}

/// State of Adam: number of steps, first and second moments.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Moments {
    pub time: usize,
    pub first: Vec<f32>,
    pub second: Vec<f32>,
}

impl Optimizer {
    pub fn new() -> Self {
        Self { adam: AdamConfig::new().build(), device: Device::flex(), state: None }
    }

    fn tensor(&self, numbers: &[f32]) -> Tensor<1> {
        Tensor::from_data(TensorData::new(numbers.to_vec(), [numbers.len()]), &self.device)
    }

    /// Updates the parameters by one step against the gradient.
    pub fn step(&mut self, rate: f64, parameters: &mut [f32], gradient: &[f32]) {
        let (moved, state) = self.adam.step(rate, self.tensor(parameters), self.tensor(gradient), self.state.take());
        self.state = state;
        parameters.copy_from_slice(&numbers(moved));
    }

    /// Returns the state for a number of parameters; zeros before the first step.
    pub fn moments(&self, count: usize) -> Moments {
        match &self.state {
            None => Moments { time: 0, first: vec![0.0; count], second: vec![0.0; count] },
            Some(AdamState { momentum, .. }) => Moments {
                time: momentum.time,
                first: numbers(momentum.moment_1.clone()),
                second: numbers(momentum.moment_2.clone()),
            },
        }
    }

    pub fn restore(&mut self, Moments { time, first, second }: &Moments) {
        let state = || AdamState::new(AdaptiveMomentumState::new(*time, self.tensor(first), self.tensor(second)));
        self.state = (*time > 0).then(state);
    }
}

fn numbers(tensor: Tensor<1>) -> Vec<f32> {
    tensor.into_data().try_to_vec().unwrap_or_default()
}
