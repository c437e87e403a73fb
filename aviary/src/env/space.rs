use rand::RngExt as _;

use crate::observation::{Observation, ObservationType};
use crate::random::normal;
use crate::vision::ImageSize;
use crate::world::World;

/// Space of vectors with one pair of bounds per entry; infinite for an unbounded entry.
///
/// ```
/// use aviary::env::{BoxSpace, Rng};
/// use rand::SeedableRng as _;
///
/// let space = BoxSpace::new([[-1.0, 1.0], [0.0, f64::INFINITY]]);
/// assert!(space.contains(&[0.5, 1e6]) && !space.contains(&[0.5, -1e-9]));
/// assert!(space.contains(&space.sample(&mut Rng::seed_from_u64(1))));
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct BoxSpace {
    low: Vec<f64>,
    high: Vec<f64>,
    outward: Vec<Outward>,
}

/// A bound that single precision rounds to a value outside the space, and the nearest value inside.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Outward {
    entry: usize,
    rounded: f32,
    inside: f32,
}

/// Returns the largest number of single precision that does not exceed a bound.
fn largest_below(bound: f64) -> f32 {
    let rounded = bound as f32;
    if f64::from(rounded) > bound { rounded.next_down() } else { rounded }
}

/// Returns the smallest number of single precision that is not below a bound.
fn smallest_above(bound: f64) -> f32 {
    -largest_below(-bound)
}

impl BoxSpace {
    /// Creates a space from one pair `[low, high]` per entry.
    ///
    /// # Panics
    /// If a bound is NaN or `low` exceeds `high`. Bounds come from tasks, not from user input.
    pub fn new(bounds: impl IntoIterator<Item = [f64; 2]>) -> Self {
        let (low, high): (Vec<_>, Vec<_>) = bounds.into_iter().map(|[low, high]| (low, high)).unzip();
        assert!(low.iter().zip(&high).all(|(low, high)| low <= high), "a lower bound exceeds its upper bound");
        Self::of(low, high)
    }

    fn of(low: Vec<f64>, high: Vec<f64>) -> Self {
        let mut outward = Vec::new();
        for (entry, (&low, &high)) in low.iter().zip(&high).enumerate() {
            let inside = [smallest_above(low), largest_below(high)];
            // bounds that are almost equal have no number of single precision between them
            if inside[0] <= inside[1] {
                let rounded = [low as f32, high as f32].into_iter().zip(inside);
                outward.extend(
                    rounded.filter(|(rounded, inside)| rounded != inside).map(|(rounded, inside)| Outward {
                        entry,
                        rounded,
                        inside,
                    }),
                );
            }
        }
        Self { low, high, outward }
    }

    /// Returns the space of `times` concatenated vectors.
    #[must_use]
    pub fn repeated(&self, times: usize) -> Self {
        Self::of(self.low.repeat(times), self.high.repeat(times))
    }

    /// Returns the bounds in single precision, rounded into the space.
    pub fn bounds_f32(&self) -> (Vec<f32>, Vec<f32>) {
        (self.low.iter().map(|&x| smallest_above(x)).collect(), self.high.iter().map(|&x| largest_below(x)).collect())
    }

    /// Copies a vector into a buffer of single precision. A number within its bounds stays within them: if the
    /// nearest number of single precision is outside, the next one inside is written.
    ///
    /// ```
    /// use std::f64::consts::PI;
    ///
    /// use aviary::env::BoxSpace;
    ///
    /// let space = BoxSpace::new([[-PI, PI]; 3]);
    /// let mut row = [0.0; 3];
    /// space.write_f32(&[PI, -PI, 0.1], &mut row);
    /// // π in single precision is larger than π
    /// assert!(f64::from(PI as f32) > PI && !space.contains(&[PI as f32; 3]));
    /// assert!(space.contains(&row) && row[2] == 0.1);
    /// ```
    ///
    /// # Panics
    /// If the vector or the buffer has another length than the space.
    pub fn write_f32(&self, vector: &[f64], out: &mut [f32]) {
        assert_eq!([vector.len(), out.len()], [self.size(); 2], "a vector and a buffer of the space");
        out.iter_mut().zip(vector).for_each(|(out, &x)| *out = x as f32);
        self.round_inside(out);
    }

    /// Moves numbers that rounding to single precision has put outside the space back into it.
    #[inline]
    pub(crate) fn round_inside(&self, row: &mut [f32]) {
        for bound in &self.outward {
            let x = &mut row[bound.entry];
            if *x == bound.rounded {
                *x = bound.inside;
            }
        }
    }

    /// Returns the entries that [`round_inside`](Self::round_inside) may change, with the smallest and the largest
    /// number that single precision keeps inside the space. Clamping to them before the rounding has the same result.
    pub(crate) fn bounds_before_rounding(&self) -> Vec<(usize, f64, f64)> {
        let limits = |bound: &Outward| {
            let inside = f64::from(bound.inside);
            if bound.inside < bound.rounded {
                (bound.entry, f64::NEG_INFINITY, inside)
            } else {
                (bound.entry, inside, f64::INFINITY)
            }
        };
        self.outward.iter().map(limits).collect()
    }

    /// Returns the number of entries.
    pub fn size(&self) -> usize {
        self.low.len()
    }

    /// Returns the lower bounds.
    pub fn low(&self) -> &[f64] {
        &self.low
    }

    /// Returns the upper bounds.
    pub fn high(&self) -> &[f64] {
        &self.high
    }

    /// Returns true if a vector of double or single precision has the right length and every entry is within its
    /// bounds.
    pub fn contains<X: Copy + Into<f64>>(&self, vector: &[X]) -> bool {
        vector.len() == self.size()
            && vector.iter().zip(&self.low).zip(&self.high).all(|((&x, &low), &high)| (low..=high).contains(&x.into()))
    }

    /// Returns a random vector. Entries with two finite bounds are uniform, entries with one are half-normal from it,
    /// and unbounded entries are standard normal.
    pub fn sample(&self, rng: &mut super::Rng) -> Vec<f64> {
        (self.low.iter().zip(&self.high))
            .map(|(&low, &high)| match (low.is_finite(), high.is_finite()) {
                (true, true) => low + (high - low) * rng.random::<f64>(),
                (true, false) => low + normal(rng).abs(),
                (false, true) => high - normal(rng).abs(),
                (false, false) => normal(rng),
            })
            .collect()
    }
}

/// Space of observations: the space of the vector, and the shapes of the images.
///
/// ```
/// use aviary::env::Env;
/// use aviary::observation::ObservationType;
/// use aviary::tasks::MultiHover;
///
/// let env = MultiHover::builder().observation_type(ObservationType::KIN_ADJACENCY).build()?;
/// let space = env.observation_space();
/// assert_eq!((space.vector.size(), space.adjacency_shape()), (2 * 13, Some([2, 2])));
/// let names: Vec<_> = space.parts().iter().map(|part| part.name).collect();
/// assert_eq!(names, ["vector", "adjacency"]);
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct ObservationSpace {
    /// Space of the task's vector; size 0 if the observation type has no vector.
    pub vector: BoxSpace,
    /// Parts of the observation.
    pub kind: ObservationType,
    /// Number of onboard cameras: one per observed drone.
    pub cameras: usize,
    /// Number of columns of the adjacency matrix: all drones.
    pub neighbours: usize,
    /// Number of rays per drone, and their maximum range, m.
    pub rays: (usize, f64),
    /// Size of the images.
    pub camera_size: ImageSize,
}

impl ObservationSpace {
    /// Returns the shape of the colour images, `[cameras, height, width, 4]`, each number in 0 to 255.
    pub fn rgb_shape(&self) -> Option<[usize; 4]> {
        let [cameras, height, width] = self.image_shape();
        self.kind.rgb.then_some([cameras, height, width, 4])
    }

    /// Returns the shape of the depth images, `[cameras, height, width]`, each number in 0 to 100 m.
    pub fn depth_shape(&self) -> Option<[usize; 3]> {
        self.kind.depth.then_some(self.image_shape())
    }

    /// Returns the shape of the segmentation images, `[cameras, height, width, 2]`.
    pub fn segmentation_shape(&self) -> Option<[usize; 4]> {
        let [cameras, height, width] = self.image_shape();
        self.kind.segmentation.then_some([cameras, height, width, 2])
    }

    /// Returns the shape of the adjacency matrix, `[observed drones, all drones]`, each entry true or false.
    pub fn adjacency_shape(&self) -> Option<[usize; 2]> {
        self.kind.adjacency.then_some([self.cameras, self.neighbours])
    }

    /// Returns the parts with name, shape, type and bounds, like the items of Gymnasium's `Dict` space.
    pub fn parts(&self) -> Vec<Part> {
        let far = World::CLIP_PLANES[1];
        let mut parts = Vec::new();
        let mut add = |name, shape: Option<Vec<usize>>, dtype, bounds| {
            parts.extend(shape.map(|shape| Part { name, shape, dtype, bounds }));
        };
        let min = self.vector.low().iter().copied().fold(f64::INFINITY, f64::min);
        let max = self.vector.high().iter().copied().fold(f64::NEG_INFINITY, f64::max);
        add("vector", self.kind.kinematic.then(|| vec![self.vector.size()]), Dtype::F64, [min, max]);
        add("rgb", self.rgb_shape().map(Vec::from), Dtype::U8, [0.0, 255.0]);
        add("depth", self.depth_shape().map(Vec::from), Dtype::F32, [0.0, far]);
        add("segmentation", self.segmentation_shape().map(Vec::from), Dtype::I32, [-1.0, f64::from(i32::MAX)]);
        let far = Observation::FAR;
        add("obstacle", self.kind.obstacle.then(|| vec![self.cameras]), Dtype::F64, [f64::NEG_INFINITY, far]);
        let (rays, range) = self.rays;
        add("ranges", self.kind.ranges.then(|| vec![self.cameras, rays]), Dtype::F64, [0.0, range]);
        add("adjacency", self.adjacency_shape().map(Vec::from), Dtype::Bool, [0.0, 1.0]);
        parts
    }

    /// Returns the space of an environment's row in a [batch](crate::vector::VecEnv): the vector, then the observed
    /// ones of obstacle distances, ranges and adjacency.
    ///
    /// ```
    /// use aviary::env::Env;
    /// use aviary::observation::ObservationType;
    /// use aviary::tasks::Hover;
    /// use aviary::vector::{VecAviary, VecBuffers, VecConfig, VecEnv};
    ///
    /// let builder = Hover::builder().observation_type(ObservationType::KIN_RANGES);
    /// let mut env = VecAviary::new(builder, VecConfig::new(4))?;
    /// let (space, mut buffers) = (env.observation_space().row(), VecBuffers::new(&env));
    /// env.reset(Some(1), &mut buffers.observations)?;
    /// assert!(buffers.observations.chunks_exact(env.observation_size()).all(|row| space.contains(row)));
    /// # Ok::<(), aviary::env::EnvError>(())
    /// ```
    pub fn row(&self) -> BoxSpace {
        let (rays, range) = self.rays;
        let count = |on: bool, count: usize| if on { count } else { 0 };
        let vector = self.vector.low.iter().zip(&self.vector.high).map(|(&low, &high)| [low, high]);
        let obstacle =
            std::iter::repeat_n([f64::NEG_INFINITY, Observation::FAR], count(self.kind.obstacle, self.cameras));
        let ranges = std::iter::repeat_n([0.0, range], count(self.kind.ranges, self.cameras * rays));
        let adjacency = std::iter::repeat_n([0.0, 1.0], count(self.kind.adjacency, self.cameras * self.neighbours));
        BoxSpace::new(vector.chain(obstacle).chain(ranges).chain(adjacency))
    }

    /// Returns a random observation.
    pub fn sample(&self, rng: &mut super::Rng) -> Observation {
        let (rays, range) = self.rays;
        let mut sample = Observation::with_sizes(self.kind, self.vector.size(), self.cameras, self.camera_size, rays);
        sample.obstacle.fill_with(|| rng.random_range(0.0..=Observation::FAR));
        sample.ranges.fill_with(|| rng.random_range(0.0..=range));
        sample.vector = self.vector.sample(rng);
        sample.adjacency.resize(self.adjacency_shape().map_or(0, |shape| shape.iter().product()), false);
        sample.rgb.fill_with(|| rng.random());
        sample.depth.fill_with(|| rng.random_range(0.0..=World::CLIP_PLANES[1] as f32));
        sample.segmentation.fill_with(|| [rng.random_range(-1..10), rng.random_range(-1..10)]);
        sample.adjacency.fill_with(|| rng.random());
        sample
    }

    fn image_shape(&self) -> [usize; 3] {
        [self.cameras, self.camera_size.height as usize, self.camera_size.width as usize]
    }

    /// Returns true if all parts of an observation have the right length and lie within their bounds.
    pub fn contains(&self, observation: &Observation) -> bool {
        let far = largest_below(World::CLIP_PLANES[1]);
        let pixels = |on: bool| if on { self.cameras * self.camera_size.pixels() } else { 0 };
        self.vector.contains(&observation.vector)
            && observation.rgb.len() == 4 * pixels(self.kind.rgb)
            && observation.depth.len() == pixels(self.kind.depth)
            && observation.segmentation.len() == pixels(self.kind.segmentation)
            && observation.adjacency.len() == if self.kind.adjacency { self.cameras * self.neighbours } else { 0 }
            && observation.obstacle.len() == if self.kind.obstacle { self.cameras } else { 0 }
            && observation.obstacle.iter().all(|&x| x <= Observation::FAR)
            && observation.ranges.len() == if self.kind.ranges { self.cameras * self.rays.0 } else { 0 }
            && observation.ranges.iter().all(|x| (0.0..=self.rays.1).contains(x))
            && observation.depth.iter().all(|z| (0.0..=far).contains(z))
            && observation.segmentation.iter().flatten().all(|&number| number >= -1)
    }
}

/// Type of the numbers in a part of an observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Dtype {
    /// Double precision.
    F64,
    /// Single precision.
    F32,
    /// Bytes.
    U8,
    /// 32-bit signed integers.
    I32,
    /// True or false.
    Bool,
}

/// A named part of an observation.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Field of [`Observation`].
    pub name: &'static str,
    /// Length of each dimension.
    pub shape: Vec<usize>,
    /// Type of the numbers.
    pub dtype: Dtype,
    /// Smallest and largest number of the whole part. Entries of the vector have individual bounds.
    pub bounds: [f64; 2],
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng as _;

    #[test]
    fn samples_are_contained_and_spread_over_the_space() {
        let inf = f64::INFINITY;
        let space = BoxSpace::new([[-1.0, 1.0], [2.0, inf], [-inf, -3.0], [-inf, inf]]);
        let mut rng = super::super::Rng::seed_from_u64(5);
        let mut seen = [[inf, -inf]; 4];
        for _ in 0..1000 {
            let sample = space.sample(&mut rng);
            assert!(space.contains(&sample));
            for (range, x) in seen.iter_mut().zip(sample) {
                *range = [range[0].min(x), range[1].max(x)];
            }
        }
        assert!(seen[0][0] < -0.9 && seen[0][1] > 0.9 && seen[3][0] < -2.0 && seen[3][1] > 2.0);
    }

    /// Numbers within their bounds stay within them, and are rounded to nearest if the nearest number is inside.
    #[test]
    fn numbers_of_single_precision_stay_within_their_bounds() {
        use std::f64::consts::{FRAC_PI_2, PI};
        let bounds =
            [[-PI, PI], [-FRAC_PI_2, FRAC_PI_2], [0.1, 0.7], [-1.0, 1e-60], [-1e300, f64::INFINITY], [0.3, 0.3]];
        let space = BoxSpace::new(bounds);
        let mut rng = super::super::Rng::seed_from_u64(6);
        let mut row = [0.0; 6];
        for share in 0..2000 {
            let vector = bounds.map(|[low, high]: [f64; 2]| match share {
                0 => low,
                1 => high.min(1e300),
                // near one of the two bounds
                _ => {
                    let off = rng.random::<f64>() * 10f64.powi(-rng.random_range(0..17));
                    if rng.random() { (low + off).min(high) } else { (high.min(1e300) - off).max(low) }
                }
            });
            space.write_f32(&vector, &mut row);
            for (entry, ((&x, &y), [low, high])) in vector.iter().zip(&row).zip(bounds).enumerate() {
                // no number of single precision equals 0.3
                assert!(entry == 5 || (low..=high).contains(&f64::from(y)), "{x:?} in {low} to {high} becomes {y:?}");
                let nearest = f64::from(x as f32);
                assert!(entry == 5 || !(low..=high).contains(&nearest) || f64::from(y) == nearest, "{x:?} {y:?}");
            }
        }
        let (low, high) = space.bounds_f32();
        assert!((0..5).all(|i| bounds[i][0] <= f64::from(low[i]) && f64::from(high[i]) <= bounds[i][1]));
        // NaN and numbers outside their bounds stay so
        space.write_f32(&[3.2, -1.6, f64::NAN, 1.0, 0.0, 0.3], &mut row);
        assert!(!space.contains(&row) && row[0] == 3.2 && row[1] == -1.6 && row[2].is_nan());
    }

    #[test]
    fn vectors_outside_are_not_contained() {
        let space = BoxSpace::new([[-1.0, 1.0]; 2]);
        assert!(space.contains(&[1.0, -1.0]));
        assert!(!space.contains(&[1.1, 0.0]) && !space.contains(&[0.0]) && !space.contains(&[f64::NAN, 0.0]));
    }
}
