//! Checks of configurations.

use aviary::policy::{Gru, Mlp};

use super::TrainConfig;
use super::course::course_of;
use crate::TrainError;
use crate::evaluation::Success;
use crate::ppo::PpoConfig;

impl TrainConfig {
    /// Validates all settings.
    ///
    /// # Errors
    /// [`TrainError::Option`] with the first invalid setting.
    pub fn validate(&self) -> Result<(), TrainError> {
        let PpoConfig {
            environments,
            horizon,
            epochs,
            minibatch,
            learning_rate,
            target_kl,
            gamma,
            gae_lambda,
            clip_range,
            value_coef,
            entropy_coef,
            max_grad_norm,
            initial_std,
            ..
        } = &self.ppo;
        // TOML has no larger integers
        let largest = i64::MAX as u64;
        let counts: [(&str, u64, u64); 9] = [
            ("environments", *environments as u64, 1 << 20),
            ("horizon", *horizon as u64, 1 << 16),
            ("epochs", *epochs as u64, 1000),
            ("minibatch", *minibatch as u64, 1 << 24),
            ("evaluate_every", self.evaluate_every, largest),
            ("episodes", self.episodes as u64, 1 << 20),
            ("checkpoint_every", self.checkpoint_every, largest),
            ("steps", self.steps, largest),
            ("ctrl_freq", self.ctrl_freq.into(), largest),
        ];
        for (option, got, max) in counts {
            if !(1..=max).contains(&got) {
                return Err(TrainError::Option {
                    option,
                    got: got.to_string(),
                    expected: "a positive number that fits in memory",
                });
            }
        }
        if environments.saturating_mul(*horizon) > 1 << 26 {
            let got = format!("{environments} × {horizon}");
            return Err(TrainError::Option { option: "environments × horizon", got, expected: "up to 67,108,864" });
        }
        for (option, got, low, high, expected) in [
            ("learning_rate", *learning_rate, 1e-9, 1.0, "1e-9 to 1"),
            ("target_kl", *target_kl, 0.0, 10.0, "0 to 10"),
            ("gamma", *gamma, 0.0, 1.0, "0 to 1"),
            ("gae_lambda", *gae_lambda, 0.0, 1.0, "0 to 1"),
            ("clip_range", *clip_range, 1e-3, 10.0, "0.001 to 10"),
            ("value_coef", *value_coef, 0.0, 1e3, "0 to 1000"),
            ("entropy_coef", *entropy_coef, 0.0, 1e3, "0 to 1000"),
            ("max_grad_norm", *max_grad_norm, 1e-6, 1e9, "a positive number"),
            ("initial_std", *initial_std, 1e-4, 10.0, "0.0001 to 10"),
        ] {
            if !(low..=high).contains(&got) {
                return Err(TrainError::Option { option, got: aviary::number(got), expected });
            }
        }
        for &width in &self.ppo.hidden {
            if !(1..=Mlp::MAX_WIDTH).contains(&width) || self.ppo.hidden.len() >= Mlp::MAX_LAYERS {
                let got = format!("{:?}", self.ppo.hidden);
                return Err(TrainError::Option {
                    option: "hidden",
                    got,
                    expected: "up to 7 layers of 1 to 256 neurons",
                });
            }
        }
        if self.ppo.recurrent > Gru::MAX_WIDTH {
            let got = self.ppo.recurrent.to_string();
            return Err(TrainError::Option { option: "recurrent", got, expected: "0 to 256 units" });
        }
        let positive = |x: f64| x > 0.0 && x <= 1e6;
        if let Some(seconds) = self.training_starts.iter().filter_map(|start| start.seconds).find(|&x| !positive(x)) {
            let got = format!("{} s", aviary::number(seconds));
            return Err(TrainError::Option {
                option: "training_starts.seconds",
                got,
                expected: "a positive number of seconds",
            });
        }
        if !(0.0..=1e6).contains(&self.out_of_bounds) {
            let got = aviary::number(self.out_of_bounds.into());
            return Err(TrainError::Option { option: "out_of_bounds", got, expected: "0 to 1,000,000" });
        }
        if self.course.is_some_and(|rewards| self.per_drone || course_of(&self.task, rewards).is_none()) {
            let got = format!("set for {}", self.task);
            return Err(TrainError::Option {
                option: "course",
                got,
                expected: "fly_through or race, without per_drone",
            });
        }
        let (seconds, within) = match self.success {
            Success::Near { seconds, within } => (seconds, within),
            Success::Held { seconds } => (seconds, 1.0),
            Success::Done => (1.0, 1.0),
        };
        if !(positive(seconds) && within > 0.0) {
            let got = format!("{:?}", self.success);
            return Err(TrainError::Option {
                option: "success",
                got,
                expected: "positive numbers of seconds and metres",
            });
        }
        Ok(())
    }
}
