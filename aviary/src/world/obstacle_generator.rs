use crate::error::OptionError;
use nalgebra::Vector3;
use rand::{RngExt as _, SeedableRng as _};
use serde::{Deserialize, Deserializer, Serialize};

use super::{Obstacle, SceneError, Shape};
use crate::error::{triple, triples};
use crate::names::named_enum;
use crate::random::Rng;

named_enum! {
    "kind of obstacles"
    /// Kinds of generated obstacles (*MuJoCo-Drones-Gym*, Tayal, §3.5.2).
    pub enum ObstacleKind {
        /// Tree trunks.
        Forest = "forest",
        /// Buildings of different heights.
        Urban = "urban",
        /// Room with walls around the arena, furniture, and partitions with doorways where the arena is long enough.
        Indoor = "indoor",
        /// Boxes, spheres, cylinders and capsules in the air, with random attitudes.
        Random = "random",
        /// Square gates of four bars each.
        Gates = "gates",
        /// List of the user's obstacles.
        Custom = "custom",
    }
}

impl ObstacleKind {
    /// Returns the default number of obstacles: 20 trees, 4 gates, 8 of the other kinds, which fit into the default
    /// arena; 0 for a custom list.
    pub fn default_count(self) -> usize {
        match self {
            Self::Forest => 20,
            Self::Gates => 4,
            Self::Urban | Self::Indoor | Self::Random => 8,
            Self::Custom => 0,
        }
    }
}

/// Configuration of obstacles that are placed at random around the origin.
///
/// Every setting has a default that depends on the kind, in Rust ([`new`](Self::new)) and for missing keys in TOML.
///
/// ```
/// use aviary::env::Rng;
/// use aviary::world::{ObstacleConfig, ObstacleKind};
/// use rand::SeedableRng as _;
///
/// let config = ObstacleConfig::new(ObstacleKind::Forest);
/// let trees = config.generate(&[[0.0, 0.0, 0.1]], &mut Rng::seed_from_u64(1))?;
/// assert_eq!(trees.len(), 20);
/// # Ok::<(), aviary::world::ObstacleGeneratorError>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(from = "Fields")]
pub struct ObstacleConfig {
    /// Kind of obstacles; default forest.
    pub kind: ObstacleKind,
    /// Number of trees, buildings, pieces of furniture, floating objects or gates; default
    /// [`ObstacleKind::default_count`]. For a custom list it must be 0 or the length of the list.
    pub count: usize,
    /// Lengths along x, y and z of the arena, which is centred on the origin and stands on the floor, m; default 3 ×
    /// 3 × 2.
    pub arena: [f64; 3],
    /// Smallest distance between two obstacles, m; default 0.2. The walls of a room may meet.
    pub spacing: f64,
    /// Radius of the sphere around the start of every drone that stays free of obstacles, m; default 0.3.
    pub safe_zone: f64,
    /// Centres of further spheres of this radius that stay free of obstacles, such as goals, world frame, m; default
    /// none.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub safe_zone_centers: Vec<[f64; 3]>,
    /// True to generate a new layout for every episode; default false.
    pub new_layout: bool,
    /// Seed of the layout; default 0. With a new layout per episode it is the seed of the first layout, which
    /// replaces a later layout that does not fit. On the command line the default is `--seed`, except in `train` and
    /// `play`, where it is 0, so that every seed trains and flies among the same obstacles.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// Obstacles of the kind [`Custom`](ObstacleKind::Custom). In TOML `[[custom]]` with `shape` (`box`, `sphere`,
    /// `cylinder`, `capsule`), `size` (half sizes; radius; radius and half height), `position`, `euler` (roll, pitch,
    /// yaw, rad) and `rgba`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub custom: Vec<Obstacle>,
}

impl Default for ObstacleConfig {
    fn default() -> Self {
        Self::new(ObstacleKind::Forest)
    }
}

/// Configuration in TOML before missing keys take the defaults of the kind.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Fields {
    kind: Option<ObstacleKind>,
    count: Option<usize>,
    #[serde(default, deserialize_with = "optional_triple")]
    arena: Option<[f64; 3]>,
    spacing: Option<f64>,
    safe_zone: Option<f64>,
    #[serde(default, deserialize_with = "triples")]
    safe_zone_centers: Vec<[f64; 3]>,
    new_layout: Option<bool>,
    seed: Option<u64>,
    #[serde(default)]
    custom: Vec<Obstacle>,
}

impl From<Fields> for ObstacleConfig {
    fn from(fields: Fields) -> Self {
        let defaults = Self::new(fields.kind.unwrap_or(ObstacleKind::Forest));
        Self {
            kind: defaults.kind,
            count: fields.count.unwrap_or(defaults.count),
            arena: fields.arena.unwrap_or(defaults.arena),
            spacing: fields.spacing.unwrap_or(defaults.spacing),
            safe_zone: fields.safe_zone.unwrap_or(defaults.safe_zone),
            safe_zone_centers: fields.safe_zone_centers,
            new_layout: fields.new_layout.unwrap_or(defaults.new_layout),
            seed: fields.seed,
            custom: fields.custom,
        }
    }
}

fn optional_triple<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<[f64; 3]>, D::Error> {
    triple(deserializer).map(Some)
}

/// Error of the obstacle generator.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ObstacleGeneratorError {
    /// An option out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// Two settings that contradict each other.
    #[error("obstacles.{0}")]
    Contradiction(String),
    /// An invalid obstacle of the custom list.
    #[error(transparent)]
    Custom(#[from] SceneError),
    /// An arena that is too small for the number of obstacles.
    #[error(
        "{placed} of {asked} obstacles fit into {arena:?} m with {} m between them and {} m around every drone",
        crate::number(*spacing),
        crate::number(*safe_zone)
    )]
    Full {
        /// Largest number of obstacles placed in any attempt.
        placed: usize,
        /// Requested number of obstacles.
        asked: usize,
        /// Size of the arena, m.
        arena: [f64; 3],
        /// Distance between two obstacles, m.
        spacing: f64,
        /// Radius of the free sphere around every drone, m.
        safe_zone: f64,
    },
    /// A wall too close to the start of a drone or to the centre of another free sphere.
    #[error("a wall of the room is {got:.3} m from {place}, expected at least {expected} m")]
    Wall {
        /// Start or centre, for example `the start of drone 0`.
        place: String,
        /// Distance of the wall from it, m.
        got: f64,
        /// Radius of the safe zone, m.
        expected: f64,
    },
}

fn uniform(rng: &mut Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

/// Bounding sphere of a placed obstacle.
struct Placed {
    middle: Vector3<f64>,
    radius: f64,
}

/// Walls of an indoor arena, and the passages that furniture must leave free.
#[derive(Debug, Default)]
struct Room {
    walls: Vec<Obstacle>,
    /// Boxes in front of and behind the doorways, of the width of a doorway.
    passages: Vec<Obstacle>,
}

impl ObstacleConfig {
    /// Depth of the passage in front of and behind a doorway, m.
    const PASSAGE: f64 = 0.4;

    /// Largest [`count`](Self::count) of randomly placed obstacles.
    pub const MAX_COUNT: usize = 2000;

    /// Largest length of a custom list; the most obstacles of any other kind, gates of four bars each, fit into it.
    pub const MAX_CUSTOM: usize = 4 * Self::MAX_COUNT;

    /// Creates the default configuration of a kind.
    pub fn new(kind: ObstacleKind) -> Self {
        Self {
            kind,
            count: kind.default_count(),
            arena: [3.0, 3.0, 2.0],
            spacing: 0.2,
            safe_zone: 0.3,
            safe_zone_centers: Vec::new(),
            new_layout: false,
            seed: None,
            custom: Vec::new(),
        }
    }

    /// Checks every setting.
    ///
    /// # Errors
    /// [`ObstacleGeneratorError`] that names the first invalid setting.
    pub fn validate(&self) -> Result<(), ObstacleGeneratorError> {
        let custom = self.kind == ObstacleKind::Custom;
        let (max, range) = if custom { (Self::MAX_CUSTOM, "0 to 8000") } else { (Self::MAX_COUNT, "0 to 2000") };
        OptionError::check("obstacles.count", self.count as f64, 0.0..=max as f64, range)?;
        for side in self.arena {
            OptionError::check("obstacles.arena", side, 0.5..=1e3, "sides of 0.5 to 1000 m")?;
        }
        OptionError::check("obstacles.spacing", self.spacing, 0.0..=1e3, "0 to 1000 m")?;
        OptionError::check("obstacles.safe_zone", self.safe_zone, 0.0..=1e3, "0 to 1000 m")?;
        for &got in self.safe_zone_centers.iter().flatten() {
            OptionError::check("obstacles.safe_zone_centers", got, -1e5..=1e5, "coordinates within ±100,000 m")?;
        }
        let centers = self.safe_zone_centers.len();
        OptionError::check("the number of obstacles.safe_zone_centers", centers as f64, 0.0..=1e4, "up to 10,000")?;
        if custom {
            OptionError::check(
                "the number of entries of obstacles.custom",
                self.custom.len() as f64,
                0.0..=max as f64,
                range,
            )?;
        }
        for (index, obstacle) in self.custom.iter().enumerate() {
            obstacle.validate(&format!("custom obstacle {index}"))?;
        }
        let contradiction = |message: String| Err(ObstacleGeneratorError::Contradiction(message));
        match (self.kind, self.custom.len()) {
            (ObstacleKind::Custom, length) => {
                if self.count != 0 && self.count != length {
                    return contradiction(format!("count is {}, but the custom list has {length} entries", self.count));
                }
                if self.new_layout {
                    return contradiction("new_layout is true, expected false for a custom list".into());
                }
            }
            (_, 0) => {}
            (kind, _) => {
                let kind = kind.name();
                return contradiction(format!("kind is {kind}, expected custom, because there is a custom list"));
            }
        }
        Ok(())
    }

    /// Generates obstacles around drones that start at these positions (world frame, m). The shapes and their order
    /// do not depend on the random numbers.
    ///
    /// # Errors
    /// [`ObstacleGeneratorError`] if a setting is invalid or the arena has too little room.
    pub fn generate(&self, starts: &[[f64; 3]], rng: &mut Rng) -> Result<Vec<Obstacle>, ObstacleGeneratorError> {
        self.validate()?;
        let drones = starts.len();
        let starts: Vec<_> = starts.iter().chain(&self.safe_zone_centers).map(|&start| Vector3::from(start)).collect();
        if self.kind == ObstacleKind::Custom {
            return Ok(self.custom.clone());
        }
        let mut room = Room::default();
        if self.kind == ObstacleKind::Indoor {
            room = self.room(&starts, drones, rng)?;
        }
        let mut best = 0;
        // in a full arena another first obstacle may succeed
        for _ in 0..30 {
            match self.scatter(&starts, &room, rng) {
                Ok(obstacles) => return Ok(room.walls.into_iter().chain(obstacles).collect()),
                Err(placed) => best = best.max(placed),
            }
        }
        Err(ObstacleGeneratorError::Full {
            placed: best,
            asked: self.count,
            arena: self.arena,
            spacing: self.spacing,
            safe_zone: self.safe_zone,
        })
    }

    /// Generates the layout of the [`seed`](Self::seed) around drones that start at these positions (world frame, m).
    /// It is the first layout of an environment with these initial positions.
    ///
    /// # Errors
    /// Returns the errors of [`generate`](Self::generate).
    pub fn first_layout(&self, starts: &[[f64; 3]]) -> Result<Vec<Obstacle>, ObstacleGeneratorError> {
        self.generate(starts, &mut Rng::seed_from_u64(self.seed.unwrap_or(0)))
    }

    /// Places the obstacles one after another; returns the number of placed obstacles if the next one has no room.
    fn scatter(&self, starts: &[Vector3<f64>], room: &Room, rng: &mut Rng) -> Result<Vec<Obstacle>, usize> {
        let mut placed: Vec<Placed> = Vec::with_capacity(self.count);
        let mut obstacles = Vec::new();
        for index in 0..self.count {
            let mut found = None;
            for _ in 0..100 {
                let (parts, middle, radius) = self.sample(index, rng);
                let apart = |other: &Placed| {
                    let offset = middle - other.middle;
                    // only floating obstacles may stand above each other
                    let distance = if self.kind == ObstacleKind::Random { offset.norm() } else { offset.xy().norm() };
                    distance >= radius + other.radius + self.spacing
                };
                let clear_of =
                    |start: &Vector3<f64>| parts.iter().all(|part: &Obstacle| part.distance(start) >= self.safe_zone);
                let off_walls = |wall: &Obstacle| wall.distance(&middle) >= radius + self.spacing;
                let off_passages = |passage: &Obstacle| passage.distance(&middle) >= radius;
                if placed.iter().all(apart)
                    && starts.iter().all(clear_of)
                    && room.walls.iter().all(off_walls)
                    && room.passages.iter().all(off_passages)
                {
                    placed.push(Placed { middle, radius });
                    found = Some(parts);
                    break;
                }
            }
            match found {
                Some(parts) => obstacles.extend(parts),
                None => return Err(index),
            }
        }
        Ok(obstacles)
    }

    /// Samples an obstacle of the kind in the arena: its parts, its centre and its radius (horizontal for obstacles
    /// on the floor).
    fn sample(&self, index: usize, rng: &mut Rng) -> (Vec<Obstacle>, Vector3<f64>, f64) {
        let [length, width, height] = self.arena;
        let shade = uniform(rng, 0.85, 1.15);
        let tint = |rgb: [f64; 3]| {
            let [r, g, b] = rgb.map(|x| (x * shade).min(1.0));
            [r, g, b, 1.0]
        };
        let place = |reach: f64, rng: &mut Rng| {
            let (x, y) = ((0.5 * length - reach).max(0.0), (0.5 * width - reach).max(0.0));
            [uniform(rng, -x, x), uniform(rng, -y, y)]
        };
        let solid = |shape, position: Vector3<f64>, rpy, rgba| Obstacle { shape, position, rpy, rgba };
        match self.kind {
            ObstacleKind::Forest => {
                let radius = uniform(rng, 0.03, 0.08);
                let half_height = 0.5 * height * uniform(rng, 0.7, 1.0);
                let [x, y] = place(radius, rng);
                let middle = Vector3::new(x, y, half_height);
                let trunk = Shape::Cylinder { radius, half_height };
                (vec![solid(trunk, middle, Vector3::zeros(), tint([0.42, 0.29, 0.18]))], middle, radius)
            }
            ObstacleKind::Urban | ObstacleKind::Indoor => {
                let indoor = self.kind == ObstacleKind::Indoor;
                let (min, max) = if indoor { (0.08, 0.2) } else { (0.1, 0.25) };
                let half = [uniform(rng, min, max), uniform(rng, min, max)];
                let half_height = 0.5 * height * if indoor { uniform(rng, 0.1, 0.45) } else { uniform(rng, 0.3, 1.0) };
                let radius = half[0].hypot(half[1]);
                let [x, y] = place(radius, rng);
                let middle = Vector3::new(x, y, half_height);
                let yaw = if indoor { uniform(rng, -3.0, 3.0) } else { 0.0 };
                let block = Shape::Box { half_size: [half[0], half[1], half_height] };
                let colour = if indoor { tint([0.55, 0.42, 0.3]) } else { tint([0.6, 0.62, 0.66]) };
                (vec![solid(block, middle, Vector3::new(0.0, 0.0, yaw), colour)], middle, radius)
            }
            ObstacleKind::Gates => {
                // half of the opening of half a metre, and half of the thickness of a bar, m
                let (inside, bar) = (0.25, 0.02);
                let outside = inside + 2.0 * bar;
                let radius = outside + bar;
                let [x, y] = place(radius, rng);
                let middle = Vector3::new(x, y, uniform(rng, outside, (height - outside).max(outside)));
                let yaw = uniform(rng, -3.0, 3.0);
                let left = Vector3::new(-f64::sin(yaw), f64::cos(yaw), 0.0);
                let rpy = Vector3::new(0.0, 0.0, yaw);
                let reach = inside + bar;
                let bars = [
                    (left * reach, [bar, bar, outside]),
                    (left * -reach, [bar, bar, outside]),
                    (Vector3::z() * reach, [bar, inside, bar]),
                    (Vector3::z() * -reach, [bar, inside, bar]),
                ];
                let colour = tint([0.85, 0.35, 0.12]);
                let parts = bars
                    .map(|(offset, half_size)| solid(Shape::Box { half_size }, middle + offset, rpy, colour))
                    .to_vec();
                (parts, middle, radius)
            }
            ObstacleKind::Random | ObstacleKind::Custom => {
                let size = uniform(rng, 0.06, 0.15);
                let (shape, colour) = match index % 4 {
                    0 => (
                        Shape::Box { half_size: [size, uniform(rng, 0.06, 0.15), uniform(rng, 0.06, 0.15)] },
                        [0.2, 0.45, 0.7],
                    ),
                    1 => (Shape::Sphere { radius: size }, [0.8, 0.3, 0.25]),
                    2 => (Shape::Cylinder { radius: size, half_height: uniform(rng, 0.06, 0.2) }, [0.3, 0.6, 0.35]),
                    _ => (Shape::Capsule { radius: size, half_height: uniform(rng, 0.05, 0.15) }, [0.8, 0.65, 0.2]),
                };
                let radius = shape.reach();
                let [x, y] = place(radius, rng);
                let middle = Vector3::new(x, y, uniform(rng, radius, (height - radius).max(radius)));
                let rpy = Vector3::from_fn(|_, _| uniform(rng, -3.0, 3.0));
                (vec![solid(shape, middle, rpy, tint(colour))], middle, radius)
            }
        }
    }

    /// Samples the walls around the arena, and partitions across it, one per 1.5 m of length, with doorways of 0.8 m.
    /// The first `drones` of the `starts` are those of drones.
    fn room(&self, starts: &[Vector3<f64>], drones: usize, rng: &mut Rng) -> Result<Room, ObstacleGeneratorError> {
        const THICKNESS: f64 = 0.03;
        const DOORWAY: f64 = 0.8;
        let [length, width, height] = self.arena;
        let wall = |x: f64, y: f64, half: [f64; 2]| Obstacle {
            shape: Shape::Box { half_size: [half[0], half[1], 0.5 * height] },
            position: Vector3::new(x, y, 0.5 * height),
            rpy: Vector3::zeros(),
            rgba: [0.8, 0.78, 0.72, 1.0],
        };
        let (out_x, out_y) = (0.5 * length + THICKNESS, 0.5 * width + THICKNESS);
        let mut walls = vec![
            wall(out_x, 0.0, [THICKNESS, out_y]),
            wall(-out_x, 0.0, [THICKNESS, out_y]),
            wall(0.0, out_y, [out_x, THICKNESS]),
            wall(0.0, -out_y, [out_x, THICKNESS]),
        ];
        let near = |walls: &[Obstacle], start: &Vector3<f64>| {
            walls.iter().map(|wall| wall.distance(start)).fold(f64::INFINITY, f64::min)
        };
        let check = |walls: &[Obstacle]| {
            let distances = starts.iter().map(|start| near(walls, start)).enumerate();
            match distances.into_iter().find(|(_, got)| *got < self.safe_zone) {
                Some((index, got)) => {
                    let place = match index.checked_sub(drones) {
                        None => format!("the start of drone {index}"),
                        Some(index) => format!("safe_zone_centers[{index}]"),
                    };
                    Err(ObstacleGeneratorError::Wall { place, got, expected: self.safe_zone })
                }
                None => Ok(()),
            }
        };
        check(&walls)?;
        let rooms = ((length / 1.5) as usize).clamp(1, 6);
        let wide = width > DOORWAY + 0.4;
        let mut passages = Vec::new();
        for partition in 1..if wide { rooms } else { 1 } {
            let mut pair = Vec::new();
            let mut passage = Vector3::zeros();
            for attempt in 0..200 {
                // the range around the even spacing grows with the number of failed attempts
                let spread = 0.1 + 0.4 * f64::from(attempt) / 200.0;
                let x = length * (partition as f64 / rooms as f64 - 0.5) + uniform(rng, -spread, spread);
                let door = uniform(rng, -0.5 * width + 0.2, 0.5 * width - 0.2 - DOORWAY);
                passage = Vector3::new(x, door + 0.5 * DOORWAY, 0.5 * height);
                let (below, above) = (door + 0.5 * width, 0.5 * width - door - DOORWAY);
                pair = vec![
                    wall(x, -0.5 * width + 0.5 * below, [THICKNESS, 0.5 * below]),
                    wall(x, 0.5 * width - 0.5 * above, [THICKNESS, 0.5 * above]),
                ];
                if starts.iter().all(|start| near(&pair, start) >= self.safe_zone) {
                    break;
                }
            }
            check(&pair)?;
            walls.extend(pair);
            let half_size = [THICKNESS + Self::PASSAGE, 0.5 * DOORWAY, 0.5 * height];
            passages.push(Obstacle::new(Shape::Box { half_size }, passage));
        }
        Ok(Room { walls, passages })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn safe_zone_centers_stay_free_as_the_starts_do() {
        for kind in [ObstacleKind::Forest, ObstacleKind::Urban, ObstacleKind::Random, ObstacleKind::Gates] {
            let center = [0.9, -0.8, 0.5];
            let free = ObstacleConfig {
                count: 3,
                safe_zone: 0.5,
                safe_zone_centers: vec![center],
                ..ObstacleConfig::new(kind)
            };
            let plain = ObstacleConfig { safe_zone_centers: Vec::new(), ..free.clone() };
            let mut met = false;
            for seed in 0..30 {
                let nearest = |config: &ObstacleConfig, starts: &[[f64; 3]]| {
                    let obstacles = config.generate(starts, &mut Rng::seed_from_u64(seed)).unwrap();
                    obstacles.iter().map(|o| o.distance(&center.into())).fold(f64::INFINITY, f64::min)
                };
                assert!(nearest(&free, &[]) >= 0.5, "{kind}");
                assert_eq!(nearest(&free, &[]), nearest(&plain, &[center]), "{kind}");
                met |= nearest(&plain, &[]) < 0.5;
            }
            assert!(met, "no {kind} needs the zone");
        }
        let safe_zone_centers = vec![[1.4, 0.0, 1.0]];
        let room = ObstacleConfig { safe_zone_centers, ..ObstacleConfig::new(ObstacleKind::Indoor) };
        let error = room.first_layout(&[]).unwrap_err().to_string();
        assert!(error.contains("from safe_zone_centers[0], expected at least 0.3 m"), "{error}");
        let error = room.first_layout(&[[1.4, 0.0, 1.0]]).unwrap_err().to_string();
        assert!(error.contains("from the start of drone 0"), "{error}");
    }
}
