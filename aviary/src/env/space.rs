use rand::RngExt as _;

use crate::observation::{Observation, ObservationType};
use crate::random::normal;
use crate::vision::ImageSize;
use crate::world::World;

/// Vectors within bounds, one pair per entry; infinite where there is no bound.
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
}

impl BoxSpace {
    /// From one pair `[low, high]` per entry.
    ///
    /// # Panics
    /// If a bound is NaN or a pair is the wrong way round: spaces are made by tasks, not from input.
    pub fn new(bounds: impl IntoIterator<Item = [f64; 2]>) -> Self {
        let (low, high): (Vec<_>, Vec<_>) = bounds.into_iter().map(|[low, high]| (low, high)).unzip();
        assert!(low.iter().zip(&high).all(|(low, high)| low <= high), "a space whose bounds are the wrong way round");
        Self { low, high }
    }

    /// The same bounds so many times, one after the other.
    #[must_use]
    pub fn repeated(&self, times: usize) -> Self {
        Self { low: self.low.repeat(times), high: self.high.repeat(times) }
    }

    /// How many entries a vector has.
    pub fn size(&self) -> usize {
        self.low.len()
    }

    /// Least values.
    pub fn low(&self) -> &[f64] {
        &self.low
    }

    /// Greatest values.
    pub fn high(&self) -> &[f64] {
        &self.high
    }

    /// Whether a vector is of this space: right length, every entry a number within its bounds.
    pub fn contains(&self, vector: &[f64]) -> bool {
        vector.len() == self.size()
            && vector.iter().zip(&self.low).zip(&self.high).all(|((x, low), high)| low <= x && x <= high)
    }

    /// A random vector: uniform where both bounds are finite, standard normal beyond them (shifted to a single
    /// bound where there is one).
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

/// What observations look like: the vector's space, and the shapes of the pictures that there are.
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
    /// The task's vector; of size 0 where the observation type has none.
    pub vector: BoxSpace,
    /// Which parts there are.
    pub kind: ObservationType,
    /// Onboard cameras, one for each drone that it is about.
    pub cameras: usize,
    /// Columns of the adjacency: all drones.
    pub neighbours: usize,
    /// Rays of a drone, and how far they see, m.
    pub rays: (usize, f64),
    /// Size of their pictures.
    pub camera_size: ImageSize,
}

impl ObservationSpace {
    /// Shape of the colour pictures, `[cameras, height, width, 4]`, each number in 0 to 255.
    pub fn rgb_shape(&self) -> Option<[usize; 4]> {
        let [cameras, height, width] = self.picture_shape();
        self.kind.rgb.then_some([cameras, height, width, 4])
    }

    /// Shape of the depth pictures, `[cameras, height, width]`, each number in 0 to 100 m.
    pub fn depth_shape(&self) -> Option<[usize; 3]> {
        self.kind.depth.then_some(self.picture_shape())
    }

    /// Shape of the object pictures, `[cameras, height, width, 2]`.
    pub fn segmentation_shape(&self) -> Option<[usize; 4]> {
        let [cameras, height, width] = self.picture_shape();
        self.kind.segmentation.then_some([cameras, height, width, 2])
    }

    /// Shape of the adjacency matrix, `[drones it is about, all drones]`, each entry true or false.
    pub fn adjacency_shape(&self) -> Option<[usize; 2]> {
        self.kind.adjacency.then_some([self.cameras, self.neighbours])
    }

    /// Every part by name, with its shape, type and bounds: the dictionary that Gymnasium would have.
    pub fn parts(&self) -> Vec<Part> {
        let far = World::CLIP_PLANES[1];
        let mut parts = Vec::new();
        let mut add = |name, shape: Option<Vec<usize>>, dtype, bounds| {
            parts.extend(shape.map(|shape| Part { name, shape, dtype, bounds }));
        };
        let least = self.vector.low().iter().copied().fold(f64::INFINITY, f64::min);
        let most = self.vector.high().iter().copied().fold(f64::NEG_INFINITY, f64::max);
        add("vector", self.kind.kinematic.then(|| vec![self.vector.size()]), Dtype::F64, [least, most]);
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

    /// A random observation of this space.
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

    fn picture_shape(&self) -> [usize; 3] {
        [self.cameras, self.camera_size.height as usize, self.camera_size.width as usize]
    }

    /// Whether an observation is of this space.
    pub fn contains(&self, observation: &Observation) -> bool {
        let far = World::CLIP_PLANES[1] as f32 * 1.001;
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

/// The type of the numbers in a part of an observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Dtype {
    /// Double precision.
    F64,
    /// Single precision.
    F32,
    /// Bytes.
    U8,
    /// Whole numbers.
    I32,
    /// True or false.
    Bool,
}

/// A part of an observation, by name.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// The field of [`Observation`].
    pub name: &'static str,
    /// Lengths of its dimensions.
    pub shape: Vec<usize>,
    /// The type of its numbers.
    pub dtype: Dtype,
    /// The least and the greatest number of all; a vector's entries have bounds of their own.
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

    #[test]
    fn vectors_outside_are_not_contained() {
        let space = BoxSpace::new([[-1.0, 1.0]; 2]);
        assert!(space.contains(&[1.0, -1.0]));
        assert!(!space.contains(&[1.1, 0.0]) && !space.contains(&[0.0]) && !space.contains(&[f64::NAN, 0.0]));
    }
}
