//! Actions of the drones in a benchmark.

/// Returns the initial position of a drone in a swarm, m.
pub(super) fn place(drone: usize) -> [f64; 3] {
    [(drone % 4) as f64, (drone / 4) as f64, 0.5 + 0.1 * drone as f64]
}

/// Linear policy with noise that flies a Crazyflie to a height of 1 m, or to its place in a swarm.
pub(super) struct LinearPolicy {
    actions: Vec<f32>,
    noise: u64,
    drones: usize,
    block: usize,
    gains: Gains,
}

/// Gains of a linear policy.
#[derive(Clone, Copy)]
struct Gains {
    /// Position and velocity to roll and pitch.
    level: [f32; 2],
    /// Roll and pitch, and their rates, to differences of the motors.
    tilt: [f32; 2],
}

impl LinearPolicy {
    pub(super) fn new(seed: u64, environments: usize, drones: usize, block: usize) -> Self {
        Self {
            actions: vec![0.0; 4 * environments * drones],
            // xorshift needs a state other than 0
            noise: seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1,
            drones,
            block,
            gains: Gains { level: [0.2, 0.2], tilt: [0.12, 0.03] },
        }
    }

    /// Selects gains that are low enough for lag and latencies, and high enough for unequal motors: the drones of the
    /// default randomization fly to the end of their episodes.
    pub(super) fn gentle(self) -> Self {
        Self { gains: Gains { level: [0.06, 0.1], tilt: [0.05, 0.01] }, ..self }
    }

    /// Samples a number uniformly from ±1 (Marsaglia's xorshift).
    fn uniform(&mut self) -> f32 {
        self.noise ^= self.noise << 13;
        self.noise ^= self.noise >> 7;
        self.noise ^= self.noise << 17;
        (self.noise >> 40) as f32 / (1 << 23) as f32 - 1.0
    }

    /// Returns actions to cycle through. Their noise cancels out, so that no drone sinks to the floor.
    pub(super) fn climb(&mut self) -> [Vec<f32>; 8] {
        const LIFT: f32 = 0.006;
        let mut all: [Vec<f32>; 8] = std::array::from_fn(|_| self.actions.clone());
        for drone in 0..self.actions.len() / 4 {
            for turn in 0..4 {
                let noise = 0.02 * self.uniform();
                all[2 * turn][4 * drone..][..4].fill(LIFT + noise);
                all[2 * turn + 1][4 * drone..][..4].fill(LIFT - noise);
            }
        }
        all
    }

    pub(super) fn random(&mut self) -> &[f32] {
        for index in 0..self.actions.len() {
            self.actions[index] = self.uniform();
        }
        &self.actions
    }

    pub(super) fn act(&mut self, observations: &[f32]) -> &[f32] {
        for index in 0..self.actions.len() / 4 {
            let o = &observations[self.block * index..][..12];
            let [x, y, height] =
                if self.drones == 1 { [0.0, 0.0, 1.0] } else { place(index % self.drones).map(|x| x as f32) };
            let Gains { level: [p, v], tilt: [angle, rate] } = self.gains;
            let roll = p * (o[1] - y) + v * o[7];
            let pitch = -p * (o[0] - x) - v * o[6];
            let lift = 0.5 * (height - o[2]) - 0.4 * o[8];
            let about_x = angle * (roll - o[3]) - rate * o[9];
            let about_y = angle * (pitch - o[4]) - rate * o[10];
            let about_z = -0.05 * o[5] - 0.05 * o[11];
            for (motor, [x, y, z]) in
                [[1.0, -1.0, -1.0], [1.0, 1.0, 1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]].into_iter().enumerate()
            {
                let noise = 0.02 * self.uniform();
                self.actions[4 * index + motor] = lift + x * about_x + y * about_y + z * about_z + noise;
            }
        }
        &self.actions
    }
}
