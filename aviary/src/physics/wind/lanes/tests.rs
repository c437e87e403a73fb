use super::*;
use crate::engine::flight::Width;
use crate::physics::wind::{DrydenFilter, WindConfig, WindModel};
use crate::state::DroneState;
use nalgebra::Vector3;
use proptest::prelude::*;
use pulp::WithSimd;

const DT: f64 = 1.0 / 240.0;

/// Heights and velocities of the drones, and the results: force and velocity of the air.
#[derive(Debug, Clone, Default)]
struct Rows {
    height: Row,
    velocity: [Row; 3],
    force: [Row; 3],
    air: [Row; 3],
}

struct Step<'a> {
    lanes: &'a mut WindLanes,
    rows: &'a mut Rows,
    steps: u32,
}

impl WithSimd for Step<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { lanes, rows, steps } = self;
        for index in 0..LANES / S::F64_LANES {
            for _ in 0..steps {
                let height = Pack::load(simd, &rows.height, index);
                let [x, y, z] = &rows.velocity;
                let velocity =
                    V3::new(Pack::load(simd, x, index), Pack::load(simd, y, index), Pack::load(simd, z, index));
                let (force, air) = lanes.advance(simd, index, height, velocity);
                for (rows, v) in [(&mut rows.force, force), (&mut rows.air, air)] {
                    let [x, y, z] = rows;
                    v.x.store(x, index);
                    v.y.store(y, index);
                    v.z.store(z, index);
                }
            }
        }
    }
}

fn config() -> impl Strategy<Value = Option<WindConfig>> {
    let number = |max: f64| prop_oneof![1 => Just(0.0), 4 => 0.0..max];
    let parts = (
        prop::sample::select(&WindModel::ALL[..]),
        prop::array::uniform3(prop_oneof![1 => Just(0.0), 1 => Just(-0.0), 4 => -15.0..15.0]),
        (number(1.0), 0.01..1.0f64, prop_oneof![number(20.0), Just(1000.0)]),
        number(20.0),
        prop::sample::select(&DrydenFilter::ALL[..]),
        (number(0.1), number(30.0)),
        (prop::option::of(number(0.05)), any::<bool>()),
    );
    let config = parts.prop_map(|(model, velocity, gust, turbulence, filter, sinusoidal, drag)| WindConfig {
        model,
        velocity,
        gust_force: gust.0,
        gust_duration: gust.1,
        gust_rate: gust.2,
        turbulence,
        filter,
        sinusoidal_force: sinusoidal.0,
        sinusoidal_frequency: sinusoidal.1,
        drag_area: drag.0,
        still_air_drag: drag.1,
        ..WindConfig::default()
    });
    prop_oneof![1 => Just(None), 6 => config.prop_map(Some)]
}

fn bits(v: Vector3<f64>) -> [u64; 3] {
    [v.x.to_bits(), v.y.to_bits(), v.z.to_bits()]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    /// The wind in a lane is bit-identical to the wind of a single environment, for any wind in the other lanes, with
    /// every instruction set, from any time on.
    #[test]
    fn lanes_are_bit_identical_to_single_winds(
        configs in prop::collection::vec((config(), any::<u64>(), 0..3_usize, 0..40_u32), LANES),
        ceiling in prop::sample::select(&[2.0, 8.0, 400.0][..]), dt in prop::sample::select(&[DT, 0.02, 2.0][..]),
    ) {
        let state = |lane: usize, step: u32| {
            let phase = 0.7 * lane as f64 + 0.03 * f64::from(step);
            let velocity = Vector3::new(4.0 * phase.cos(), -2.0 * (2.0 * phase).sin(), (3.0 * phase).sin());
            DroneState { velocity, ..DroneState::at_rest(Vector3::z() * ceiling * phase.sin().abs(), Vector3::zeros()) }
        };
        let start = |(lane, (config, seed, drone, before)): (usize, &(Option<WindConfig>, u64, usize, u32))| {
            let mut field = WindField::of_areas((*config)?, (1..=drone + 1).map(|i| 0.01 * i as f64)).unwrap();
            field.reset(*seed, &vec![state(lane, 0); drone + 1]);
            for step in 0..*before {
                (0..=*drone).for_each(|drone| { field.advance(dt, drone, &state(lane, step)); });
            }
            Some(field)
        };
        let fields: Vec<Option<WindField>> = configs.iter().enumerate().map(start).collect();
        for width in Width::available() {
            let (mut fields, mut lanes) = (fields.clone(), WindLanes::new(dt));
            for (lane, field) in fields.iter().enumerate() {
                match field {
                    Some(field) => lanes.set(lane, field, configs[lane].2),
                    None => lanes.clear(lane),
                }
            }
            prop_assert_eq!(lanes.is_windy(), fields.iter().any(Option::is_some));
            let mut rows = Rows::default();
            for step in 40..340 {
                for lane in 0..LANES {
                    let state = state(lane, step);
                    rows.height[lane] = state.position.z;
                    (0..3).for_each(|i| rows.velocity[i][lane] = state.velocity[i]);
                }
                width.run(LANES, Step { lanes: &mut lanes, rows: &mut rows, steps: 1 });
                for (lane, field) in fields.iter_mut().enumerate() {
                    let drone = configs[lane].2;
                    let wind = field.as_mut().map(|field| {
                        let state = state(lane, step);
                        (0..drone).for_each(|drone| { field.advance(dt, drone, &state); });
                        field.advance(dt, drone, &state)
                    });
                    let (force, air) = wind.unwrap_or_default();
                    let row = |rows: &[Row; 3]| Vector3::from(std::array::from_fn(|i| rows[i][lane]));
                    prop_assert_eq!(bits(row(&rows.force)), bits(force), "{} {} {}", width, lane, step);
                    prop_assert_eq!(bits(row(&rows.air)), bits(air), "{} {} {}", width, lane, step);
                }
            }
            for (lane, field) in fields.iter().enumerate() {
                if let Some(field) = field {
                    let mut read = field.clone();
                    lanes.read(lane, &mut read, configs[lane].2);
                    prop_assert_eq!(format!("{read:?}"), format!("{field:?}"));
                }
            }
        }
    }
}

#[test]
fn the_number_of_lanes_is_that_of_the_flight_kernel() {
    assert_eq!(LANES, crate::engine::flight::LANES);
}

/// Prints the time of a physics step of the wind at eight drones. Run it with `--release -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement"]
#[allow(clippy::print_stdout)]
fn the_time_of_a_step_in_lanes() {
    let dryden = WindConfig::new(WindModel::Dryden);
    let combined = WindConfig { model: WindModel::Combined, ..dryden };
    for (name, height, config) in [
        ("constant", 1.0, WindConfig::new(WindModel::Constant)),
        ("gust", 1.0, WindConfig::new(WindModel::Gust)),
        ("sinusoidal", 1.0, WindConfig::new(WindModel::Sinusoidal)),
        ("dryden", 1.0, dryden),
        ("dryden at 10 m", 10.0, dryden),
        ("mil_f_8785c", 1.0, WindConfig { filter: DrydenFilter::MilF8785c, ..dryden }),
        ("combined", 1.0, combined),
    ] {
        let mut fields: Vec<_> =
            (0..LANES).map(|_| WindField::of_areas(config, std::iter::once(0.01)).unwrap()).collect();
        let mut best = std::collections::BTreeMap::new();
        for _ in 0..20 {
            for width in Width::available() {
                let mut lanes = WindLanes::new(DT);
                for (lane, field) in fields.iter_mut().enumerate() {
                    field.reset(lane as u64, &[]);
                    lanes.set(lane, field, 0);
                }
                let mut rows = Rows { height: [height; LANES], ..Rows::default() };
                let start = std::time::Instant::now();
                width.run(LANES, Step { lanes: &mut lanes, rows: &mut rows, steps: 4000 });
                let ns = start.elapsed().as_secs_f64() * 1e9 / 4000.0;
                std::hint::black_box(&rows);
                let best = best.entry(width.to_string()).or_insert(f64::INFINITY);
                *best = ns.min(*best);
            }
            let start = std::time::Instant::now();
            let state = DroneState::at_rest(Vector3::new(0.0, 0.0, height), Vector3::zeros());
            for _ in 0..1000 {
                for field in &mut fields {
                    std::hint::black_box(field.advance(DT, 0, &state));
                }
            }
            let ns = start.elapsed().as_secs_f64() * 1e9 / 1000.0;
            let best = best.entry("scalar, 8 drones".to_owned()).or_insert(f64::INFINITY);
            *best = ns.min(*best);
        }
        println!("{name}: {best:.0?} ns");
    }
}
