//! Running means and standard deviations, for the normalization of observations and rewards.

use serde::{Deserialize, Serialize};

/// Running mean and variance of vectors, updated by batches (Chan, Golub & LeVeque 1983).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Running {
    count: f64,
    mean: Vec<f64>,
    /// Sum of the squared distances from the mean.
    squares: Vec<f64>,
}

impl Running {
    /// Limits the weight of the vectors so far to that of a number of vectors. Mean and deviation stay.
    pub fn limit(&mut self, count: f64) {
        if self.count > count {
            let share = count / self.count;
            self.squares.iter_mut().for_each(|sum| *sum *= share);
            self.count = count;
        }
    }

    /// Returns the number of entries of a vector.
    pub fn size(&self) -> usize {
        self.mean.len()
    }

    /// Creates the statistics of no vectors with a number of entries.
    pub fn new(size: usize) -> Self {
        Self { count: 0.0, mean: vec![0.0; size], squares: vec![0.0; size] }
    }

    /// Creates the statistics of `count` vectors from the mean and the variance of every entry.
    pub fn of(count: f64, mean: Vec<f64>, variance: &[f64]) -> Self {
        Self { count, mean, squares: variance.iter().map(|variance| variance * count).collect() }
    }

    /// Returns the number of vectors.
    pub fn count(&self) -> f64 {
        self.count
    }

    /// Returns the means in double precision.
    pub fn means(&self) -> &[f64] {
        &self.mean
    }

    /// Returns the variances; 0 without vectors.
    pub fn variances(&self) -> Vec<f64> {
        self.squares.iter().map(|squares| if self.count > 0.0 { squares / self.count } else { 0.0 }).collect()
    }

    /// Adds rows of vectors.
    pub fn take(&mut self, rows: &[f32]) {
        let size = self.mean.len();
        let count = (rows.len() / size) as f64;
        if count == 0.0 {
            return;
        }
        let mut sums = vec![0.0; size];
        for row in rows.chunks_exact(size) {
            for (sum, &x) in sums.iter_mut().zip(row) {
                *sum += f64::from(x);
            }
        }
        let means: Vec<f64> = sums.iter().map(|sum| sum / count).collect();
        let mut squares = vec![0.0; size];
        for row in rows.chunks_exact(size) {
            for ((square, mean), &x) in squares.iter_mut().zip(&means).zip(row) {
                *square += (f64::from(x) - mean).powi(2);
            }
        }
        let total = self.count + count;
        for index in 0..size {
            let apart = means[index] - self.mean[index];
            self.mean[index] += apart * count / total;
            self.squares[index] += squares[index] + apart * apart * self.count * count / total;
        }
        self.count = total;
    }

    /// Returns true if no row has been added yet.
    pub fn is_empty(&self) -> bool {
        self.count == 0.0
    }

    /// Returns true if the vectors have this size and valid numbers.
    pub fn is_of(&self, size: usize) -> bool {
        let sane = |x: &f64| x.is_finite();
        (self.mean.len(), self.squares.len()) == (size, size)
            && self.count >= 0.0
            && self.count.is_finite()
            && self.mean.iter().all(sane)
            && self.squares.iter().all(|x| sane(x) && *x >= 0.0)
    }

    /// Returns the means.
    pub fn mean(&self) -> Vec<f32> {
        self.mean.iter().map(|&x| x as f32).collect()
    }

    /// Returns the standard deviations; 1 for fewer than two rows.
    pub fn deviation(&self) -> Vec<f32> {
        let of = |&squares: &f64| if self.count > 1.0 { (squares / self.count).sqrt() as f32 } else { 1.0 };
        self.squares.iter().map(of).collect()
    }
}

impl Running {
    /// Returns mean and standard deviation for the normalization of observations.
    pub(crate) fn normalization(&self) -> (Vec<f32>, Vec<f32>) {
        // a lower bound keeps observations that were constant so far from being amplified
        (self.mean(), self.deviation().iter().map(|deviation| deviation.max(1e-2)).collect())
    }
}

/// Scale of rewards: the standard deviation of the running discounted sum of rewards (Engstrom et al. 2020, after
/// OpenAI's `VecNormalize`).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct RewardScale {
    sums: Running,
    /// Current discounted sum of every row.
    #[serde(skip)]
    current: Vec<f32>,
}

impl RewardScale {
    pub fn new() -> Self {
        Self { sums: Running::new(1), current: Vec::new() }
    }

    /// Creates the scale from statistics of discounted sums.
    pub fn of(sums: Running) -> Self {
        Self { sums, current: Vec::new() }
    }

    /// Returns the statistics of the discounted sums.
    pub fn sums(&self) -> &Running {
        &self.sums
    }

    /// Returns true if all numbers are valid.
    pub fn is_sane(&self) -> bool {
        self.sums.is_of(1)
    }

    /// Resets the sums of all rows.
    pub fn restart(&mut self, rows: usize) {
        self.current = vec![0.0; rows];
    }

    /// Adds the rewards of a step.
    pub fn take(&mut self, rewards: &[f32], ended: impl Fn(usize) -> bool, discount: f32) {
        for (sum, reward) in self.current.iter_mut().zip(rewards) {
            *sum = discount * *sum + reward;
        }
        self.sums.take(&self.current);
        for (row, sum) in self.current.iter_mut().enumerate() {
            if ended(row) {
                *sum = 0.0;
            }
        }
    }

    /// Returns the divisor of rewards.
    pub fn divisor(&self) -> f32 {
        self.sums.deviation()[0].max(1e-4)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn batches_give_the_mean_and_deviation_over_all_rows(
            rows in proptest::collection::vec([-50.0_f32..50.0, 1000.0..1001.0], 2..60),
            cut in 0..60_usize,
        ) {
            let flat: Vec<f32> = rows.iter().flatten().copied().collect();
            let (first, rest) = flat.split_at(2 * cut.min(rows.len()));
            let mut running = Running::new(2);
            running.take(first);
            running.take(rest);
            for entry in 0..2 {
                let column: Vec<f64> = rows.iter().map(|row| f64::from(row[entry])).collect();
                let mean = column.iter().sum::<f64>() / column.len() as f64;
                let variance = column.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / column.len() as f64;
                prop_assert!((f64::from(running.mean()[entry]) - mean).abs() < 1e-3);
                prop_assert!((f64::from(running.deviation()[entry]) - variance.sqrt()).abs() < 1e-3);
            }
        }
    }

    #[test]
    fn rewards_are_divided_by_the_deviation_of_their_discounted_sums() {
        let mut scale = RewardScale::new();
        scale.restart(2);
        assert_eq!(scale.divisor(), 1.0);
        scale.take(&[1.0, 3.0], |row| row == 1, 0.5);
        // row 1 has ended, so that its sum restarts at zero
        scale.take(&[1.0, 2.0], |_| false, 0.5);
        let sums = [1.0_f32, 3.0, 1.5, 2.0];
        let mean = sums.iter().sum::<f32>() / 4.0;
        let variance = sums.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / 4.0;
        assert!((scale.divisor() - variance.sqrt()).abs() < 1e-6);
    }
}
