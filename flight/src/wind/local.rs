//! Wind at one drone.

use super::dryden::{MAX_SIGMAS, Scales, SecondOrder};
use crate::math::{Bits as _, Real, V3, decay, ln, sin_cos_of_turns};
use crate::random::{Key, Noise, NormalPair, Purpose, Sampled, uniform};

/// Settings of the wind at one drone. A part that is off has factors of zero, so that drones with different winds run
/// the same code.
#[derive(Debug, Clone, Copy, Default)]
pub struct WindParams<R> {
    /// Mean wind of the turbulence, world frame, m/s.
    pub mean: [R; 3],
    /// Velocity of the constant wind, world frame, m/s.
    pub constant: [R; 3],
    /// Horizontal longitudinal axis of the turbulence.
    pub along: [R; 2],
    /// Vertical standard deviation of the turbulence, m/s.
    pub sigma: R,
    /// 1 for the second-order filters, 0 for the first-order ones.
    pub second_order: R,
    /// Coefficient ½·ρ·C_d·A of the drag law, kg/m.
    pub drag: R,
    /// Maximum amplitude of a gust, N.
    pub gust_force: R,
    /// −ln(1 − p) for a gust that starts with probability p in a physics step.
    pub gust_hazard: R,
    /// Length of a physics step over the duration of a gust.
    pub gust_share: R,
    /// Amplitude of the sinusoidal force, N.
    pub sinusoidal_force: R,
    /// Turns of the sinusoidal force in a physics step.
    pub sinusoidal_turns: R,
}

/// State of the wind at one drone.
#[derive(Debug, Clone, Copy)]
pub struct WindState<R> {
    /// Longitudinal, lateral and vertical velocity of the turbulence, m/s. The second-order filters replace the
    /// lateral and the vertical component.
    pub turbulence: [R; 3],
    /// Second-order filters of the lateral and the vertical component: their two numbers.
    pub filters: [[R; 2]; 2],
    /// Amplitude of the gust, world frame, N.
    pub peak: [R; 3],
    /// Elapsed fraction of the gust, 0 to 1; 1 between gusts.
    pub elapsed: R,
    /// Sum of the `gust_hazard` of all calm steps until the next gust.
    pub calm: R,
}

/// Parts of the wind that a drone, or any drone in a set of lanes, needs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct WindParts {
    /// Dryden turbulence.
    pub turbulence: bool,
    /// Second-order filters of the turbulence.
    pub second_order: bool,
    /// Gusts.
    pub gusts: bool,
    /// Sinusoidal force.
    pub sinusoidal: bool,
}

impl WindParts {
    /// Returns the parts that either needs.
    pub fn or(self, other: Self) -> Self {
        Self {
            turbulence: self.turbulence || other.turbulence,
            second_order: self.second_order || other.second_order,
            gusts: self.gusts || other.gusts,
            sinusoidal: self.sinusoidal || other.sinusoidal,
        }
    }
}

impl WindParams<f64> {
    /// Returns the parts that have an effect. The others have factors of zero.
    pub fn parts(&self) -> WindParts {
        WindParts {
            turbulence: self.sigma > 0.0,
            second_order: self.second_order > 0.0,
            gusts: self.gust_hazard > 0.0,
            sinusoidal: self.sinusoidal_force > 0.0,
        }
    }
}

impl<R> WindParams<R> {
    /// Applies a function to every number.
    #[inline(always)]
    pub fn map<T>(&self, f: impl Fn(&R) -> T) -> WindParams<T> {
        WindParams {
            mean: [f(&self.mean[0]), f(&self.mean[1]), f(&self.mean[2])],
            constant: [f(&self.constant[0]), f(&self.constant[1]), f(&self.constant[2])],
            along: [f(&self.along[0]), f(&self.along[1])],
            sigma: f(&self.sigma),
            second_order: f(&self.second_order),
            drag: f(&self.drag),
            gust_force: f(&self.gust_force),
            gust_hazard: f(&self.gust_hazard),
            gust_share: f(&self.gust_share),
            sinusoidal_force: f(&self.sinusoidal_force),
            sinusoidal_turns: f(&self.sinusoidal_turns),
        }
    }

    /// Applies a function to every number and its counterpart.
    #[inline(always)]
    pub fn update<T: Copy>(&mut self, from: &WindParams<T>, f: impl Fn(&mut R, T)) {
        let Self { mean, constant, along, .. } = self;
        (0..3).for_each(|i| f(&mut mean[i], from.mean[i]));
        (0..3).for_each(|i| f(&mut constant[i], from.constant[i]));
        (0..2).for_each(|i| f(&mut along[i], from.along[i]));
        f(&mut self.sigma, from.sigma);
        f(&mut self.second_order, from.second_order);
        f(&mut self.drag, from.drag);
        f(&mut self.gust_force, from.gust_force);
        f(&mut self.gust_hazard, from.gust_hazard);
        f(&mut self.gust_share, from.gust_share);
        f(&mut self.sinusoidal_force, from.sinusoidal_force);
        f(&mut self.sinusoidal_turns, from.sinusoidal_turns);
    }
}

impl Default for WindState<f64> {
    /// State without turbulence and gusts.
    fn default() -> Self {
        Self { turbulence: [0.0; 3], filters: [[0.0; 2]; 2], peak: [0.0; 3], elapsed: 1.0, calm: 0.0 }
    }
}

impl<R: Sampled> WindState<R> {
    /// Samples the state at the start of an episode: the turbulence from its stationary distribution, and the time
    /// until the first gust.
    #[inline(always)]
    pub fn start(params: &WindParams<R>, key: Key<R::Integer>, height: R) -> Self {
        let (zero, one) = (height.all(0.0), height.all(1.0));
        let noise = key.at(key.0[0].all(0));
        let [a, b, c, _] = noise.normals::<R>(Purpose::WindStart, 0);
        let sideways = params.sigma * Scales::at(height).sideways;
        let [d, e, f, g] = noise.normals::<R>(Purpose::WindStart, 1);
        let filters = [[d, e], [f, g]].map(|noise| {
            let SecondOrder { p, r } = SecondOrder::stationary(noise);
            [p, r]
        });
        let [calm, ..] = noise.block(Purpose::WindStart, 2);
        Self {
            // adding zero removes the sign of a zero
            turbulence: [a * sideways + 0.0, b * sideways + 0.0, c * params.sigma + 0.0],
            filters,
            peak: [zero; 3],
            elapsed: one,
            calm: -ln(uniform::<R>(calm)),
        }
    }
}

impl<R> WindState<R> {
    /// Applies a function to every number.
    #[inline(always)]
    pub fn map<T>(&self, f: impl Fn(&R) -> T) -> WindState<T> {
        let [[a, b], [c, d]] = &self.filters;
        WindState {
            turbulence: [f(&self.turbulence[0]), f(&self.turbulence[1]), f(&self.turbulence[2])],
            filters: [[f(a), f(b)], [f(c), f(d)]],
            peak: [f(&self.peak[0]), f(&self.peak[1]), f(&self.peak[2])],
            elapsed: f(&self.elapsed),
            calm: f(&self.calm),
        }
    }

    /// Applies a function to every number and its counterpart.
    #[inline(always)]
    pub fn update<T: Copy>(&mut self, from: &WindState<T>, f: impl Fn(&mut R, T)) {
        let [[a, b], [c, d]] = &mut self.filters;
        f(&mut self.turbulence[0], from.turbulence[0]);
        f(&mut self.turbulence[1], from.turbulence[1]);
        f(&mut self.turbulence[2], from.turbulence[2]);
        f(a, from.filters[0][0]);
        f(b, from.filters[0][1]);
        f(c, from.filters[1][0]);
        f(d, from.filters[1][1]);
        f(&mut self.peak[0], from.peak[0]);
        f(&mut self.peak[1], from.peak[1]);
        f(&mut self.peak[2], from.peak[2]);
        f(&mut self.elapsed, from.elapsed);
        f(&mut self.calm, from.calm);
    }
}

/// Returns a number, or the limit with its sign if the magnitude is larger.
#[inline(always)]
fn limited<R: Real>(x: R, limit: R) -> R {
    R::choose(limit.less(x.abs()), limit.with_sign_of(x), x)
}

impl<R: Sampled> WindState<R> {
    /// Minimum airspeed of the turbulence filters, m/s: at zero airspeed the turbulence would stay constant.
    const MIN_AIRSPEED: f64 = 0.5;

    /// Advances the wind by a physics step of `dt` seconds and returns the force on the airframe (world frame, N) and
    /// the velocity of the air (world frame, m/s).
    ///
    /// `parts` may contain parts that this drone does not need; they do not change any bit of its wind. The step of
    /// `noise` is the number of physics steps since the start of the episode, below 2⁵². `height` (m) and `velocity`
    /// (world frame, m/s) are those of the drone.
    #[inline(always)]
    pub fn advance(
        &mut self,
        parts: WindParts,
        dt: f64,
        params: &WindParams<R>,
        noise: Noise<R::Integer>,
        height: R,
        velocity: V3<R>,
    ) -> (V3<R>, V3<R>) {
        let [x, y, z] = params.constant;
        let mut air = V3::new(x, y, z);
        if parts.turbulence {
            let [along, across, up] = self.advance_turbulence(parts, dt, params, noise, height, velocity);
            let [x, y] = params.along;
            air = air + V3::new(x * along - y * across, y * along + x * across, up);
        }
        let relative = air - velocity;
        // the drag law is not linear, so that velocities are added before it
        let mut force = relative * (params.drag * relative.norm());
        // a part that is off adds a zero, which must not change the sign of a zero
        force = V3::new(force.x + 0.0, force.y + 0.0, force.z + 0.0);
        if parts.gusts {
            force = force + self.advance_gust(params, noise);
        }
        if parts.sinusoidal {
            let (sin, cos) = sin_cos_of_turns(params.sinusoidal_turns * R::from_integer(noise.step));
            force = force + V3::new(sin, cos, sin * cos * 0.6) * params.sinusoidal_force;
        }
        (force, air)
    }

    /// Advances the turbulence and returns its longitudinal, lateral and vertical velocity, m/s.
    #[inline(always)]
    fn advance_turbulence(
        &mut self,
        parts: WindParts,
        dt: f64,
        params: &WindParams<R>,
        noise: Noise<R::Integer>,
        height: R,
        velocity: V3<R>,
    ) -> [R; 3] {
        let [x, y, z] = params.mean;
        let airspeed = (V3::new(x, y, z) - velocity).norm();
        let distance = airspeed.greater(airspeed.all(Self::MIN_AIRSPEED)) * dt;
        let Scales { sideways, inverse_lengths: [level, upwards] } = Scales::at(height);
        // time constants per step, and the factors by which the turbulence decays
        let (level, upwards) = (distance * level, distance * upwards);
        let (level_decay, upwards_decay) = (decay(level), decay(upwards));
        let lost = |decay: R| (-decay + 1.0) * (decay + 1.0);
        let sigma = [params.sigma * sideways, params.sigma];
        let [a, b, c, d] = noise.block(Purpose::Turbulence, 0);
        let (first, second) = (NormalPair::<R>::new(a, b), NormalPair::<R>::new(c, d));

        // the recursion x ← α·x + σ·√(1 − α²)·ξ
        let spread = sigma[0] * (lost(level_decay) * first.square).sqrt();
        let along = level_decay * self.turbulence[0] + spread * first.first;
        let across = level_decay * self.turbulence[1] + spread * first.second;
        let spread = sigma[1] * (lost(upwards_decay) * second.square).sqrt();
        let up = upwards_decay * self.turbulence[2] + spread * second.first;
        let limits = [sigma[0] * MAX_SIGMAS, sigma[1] * MAX_SIGMAS];
        let (along, across, up) = (limited(along, limits[0]), limited(across, limits[0]), limited(up, limits[1]));
        if !parts.second_order {
            self.turbulence = [along, across, up];
            return self.turbulence;
        }

        let is_second_order = level.all(0.0).less(params.second_order);
        let [e, f, ..] = noise.block(Purpose::Turbulence, 1);
        let [[_, b], [c, d], [e, _]] = [first.samples(), second.samples(), NormalPair::<R>::new(e, f).samples()];
        let [lateral, vertical] = self.filters.map(|[p, r]| SecondOrder { p, r });
        let next = [lateral.advance(level, level_decay, [b, c]), vertical.advance(upwards, upwards_decay, [d, e])];
        for (old, next) in self.filters.iter_mut().zip(next) {
            *old = [R::choose(is_second_order, next.p, old[0]), R::choose(is_second_order, next.r, old[1])];
        }
        self.turbulence = [
            along,
            R::choose(is_second_order, self.turbulence[1], across),
            R::choose(is_second_order, self.turbulence[2], up),
        ];
        [
            along,
            R::choose(is_second_order, limited(sigma[0] * next[0].output(), limits[0]), across),
            R::choose(is_second_order, limited(sigma[1] * next[1].output(), limits[1]), up),
        ]
    }

    /// Advances the gust, or the time until the next one, and returns the force, N.
    ///
    /// A gust starts in a calm step with probability p. The number of calm steps is therefore geometric: it is the
    /// number of times that −ln(1 − p) fits into an exponential random number. One random number per gust replaces one
    /// per step.
    #[inline(always)]
    fn advance_gust(&mut self, params: &WindParams<R>, noise: Noise<R::Integer>) -> V3<R> {
        let (zero, one) = (self.calm.all(0.0), self.calm.all(1.0));
        let is_calm = !self.elapsed.less(one);
        let starts = is_calm & self.calm.less(params.gust_hazard);
        self.elapsed = R::choose(is_calm, one, (self.elapsed + params.gust_share).lesser(one));
        self.calm = R::choose(is_calm, self.calm - params.gust_hazard, self.calm);
        if R::any(starts) {
            let [a, b, c, d] = noise.block(Purpose::Gust, 0);
            // height and azimuth are uniform for a uniform direction on the sphere
            let up = uniform::<R>(a) * 2.0 - 1.0;
            let (sin, cos) = sin_cos_of_turns(uniform::<R>(b));
            let level = (-(up * up) + 1.0).sqrt();
            let force = params.gust_force * uniform::<R>(c);
            let peak = [level * cos * force, level * sin * force, up * force];
            for (old, new) in self.peak.iter_mut().zip(peak) {
                *old = R::choose(starts, new, *old);
            }
            self.elapsed = R::choose(starts, zero, self.elapsed);
            self.calm = R::choose(starts, -ln(uniform::<R>(d)), self.calm);
        }
        let blows = self.elapsed.less(one);
        if !R::any(blows) {
            return V3::new(zero, zero, zero);
        }
        let (sin, _) = sin_cos_of_turns(self.elapsed * 0.5);
        let sin = R::choose(blows, sin, zero);
        let [x, y, z] = self.peak;
        V3::new(x * sin, y * sin, z * sin)
    }
}
