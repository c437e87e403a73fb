//! Device and flights of the tests of the GPU.

use std::io::Write as _;

use aviary_gpu::{GpuDevice, GpuError};

/// Opens the first adapter. Without one, reports that the test is skipped and returns `None`; fails if the environment
/// variable `AVIARY_REQUIRE_GPU` is set.
pub fn device(test: &str) -> Option<GpuDevice> {
    match GpuDevice::open(None) {
        Err(GpuError::NoAdapter { .. }) if std::env::var_os("AVIARY_REQUIRE_GPU").is_none() => {
            let _ = writeln!(std::io::stderr(), "{test}: skipped, because this machine has no adapter");
            None
        }
        device => Some(device.expect("an adapter that opens")),
    }
}

/// Deterministic numbers in [−1, 1].
#[allow(dead_code)]
#[derive(Debug, Clone)]
pub struct Noise(pub u64);

#[allow(dead_code)]
impl Noise {
    /// Returns the next number.
    pub fn next(&mut self) -> f64 {
        // splitmix64
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }
}

/// Returns normalized motor speeds of a Crazyflie (X frame) that hold a height (m), roll and pitch (rad) and a yaw rate
/// (rad/s). `row` is an observation.
#[allow(dead_code)]
pub fn attitude_law(row: &[f32], height: f32, roll: f32, pitch: f32, yaw_rate: f32) -> [f32; 4] {
    let collective = 0.4 * (height - row[2]) - 0.3 * row[8];
    let x = 0.12 * (roll - row[3]) - 0.025 * row[9];
    let y = 0.12 * (pitch - row[4]) - 0.025 * row[10];
    let z = 0.05 * (yaw_rate - row[11]);
    let signs = [[1.0, -1.0, -1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]];
    signs.map(|[a, b, c]| (collective.clamp(-0.5, 0.5) + a * x + b * y + c * z).clamp(-1.0, 1.0))
}
