use super::*;
use crate::drone::DroneModel;
use crate::engine::flight::Width;
use crate::env::randomization::{Randomization, SensorRanges};
use crate::env::workspace::Measured;
use crate::simulation::Simulation;
use crate::state::{DroneState, wxyz};
use nalgebra::Vector3;
use proptest::prelude::*;
use pulp::WithSimd;

/// Measurement of all lanes. The thirteen rows of `state` are position, attitude, velocity and angular velocity, the
/// three rows of `rpy` roll, pitch and yaw.
struct Measure<'a> {
    lanes: &'a SensorLanes,
    steps: &'a Row<u64>,
    state: &'a mut [Row; 13],
    rpy: &'a mut [Row; 3],
}

impl WithSimd for Measure<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { lanes, steps, state, rpy } = self;
        for index in 0..LANES / S::F64_LANES {
            let load = |row: &Row| Pack::load(simd, row, index);
            let load3 = |rows: &[Row]| V3::new(load(&rows[0]), load(&rows[1]), load(&rows[2]));
            let truth = Sensed {
                position: load3(&state[0..3]),
                attitude: Turn { w: load(&state[3]), v: load3(&state[4..7]) },
                rpy: load3(&rpy[..]),
                velocity: load3(&state[7..10]),
                rate: load3(&state[10..13]),
            };
            let Sensed { position, attitude, rpy: angles, velocity, rate } = lanes.measure(simd, index, steps, &truth);
            attitude.w.store(&mut state[3], index);
            for (first, v) in [(0, position), (4, attitude.v), (7, velocity), (10, rate)] {
                v.x.store(&mut state[first], index);
                v.y.store(&mut state[first + 1], index);
                v.z.store(&mut state[first + 2], index);
            }
            angles.x.store(&mut rpy[0], index);
            angles.y.store(&mut rpy[1], index);
            angles.z.store(&mut rpy[2], index);
        }
    }
}

fn numbers(state: &DroneState) -> [f64; 13] {
    let ([w, x, y, z], p, v, r) = (wxyz(&state.attitude), state.position, state.velocity, state.angular_velocity);
    [p.x, p.y, p.z, w, x, y, z, v.x, v.y, v.z, r.x, r.y, r.z]
}

/// Returns a simulation and a randomizer of an episode.
fn episode(sensors: Option<SensorRanges>, drones: usize, seed: u64) -> (Simulation, Randomizer) {
    use rand::SeedableRng as _;
    let mut simulation = Simulation::builder(DroneModel::Cf2x).num_drones(drones).build().unwrap();
    let config = Randomization { sensors, ..Randomization::NONE };
    let mut randomizer = Randomizer::new(config, simulation.view(), None).unwrap();
    let Simulation { model, data, .. } = &mut simulation;
    randomizer.begin(model, data, &mut crate::random::Rng::seed_from_u64(seed), false).unwrap();
    (simulation, randomizer)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// The measured state in a lane is bit-identical to that of a single environment, for any sensors in the other
    /// lanes, and its angles are those of its attitude.
    #[test]
    fn lanes_are_bit_identical_to_single_measurements(
        sigmas in prop::collection::vec(
            prop::option::weighted(0.8, prop::array::uniform5(prop_oneof![1 => Just(0.0), 4 => 0.0..2.0])), LANES),
        rpys in prop::collection::vec(prop::array::uniform3(-3.1..3.1f64), LANES), seed in any::<u64>(),
    ) {
        let mut lanes = SensorLanes::default();
        let mut single = Vec::new();
        for (lane, sigmas) in sigmas.iter().enumerate() {
            let sensors = sigmas.map(|[position, velocity, attitude, angular_velocity, bias]| SensorRanges {
                position, velocity, attitude, angular_velocity, bias, gyro_bias: None, latency: [0.0; 2],
            });
            let drone = lane % 2;
            let (mut simulation, randomizer) = episode(sensors, drone + 1, seed.wrapping_add(lane as u64));
            let mut states = simulation.states().to_vec();
            states[drone] = DroneState::at_rest(Vector3::new(0.3, -0.2, 1.0 + lane as f64), rpys[lane].into());
            simulation.reset_to(&states).unwrap();
            lanes.set(lane, &randomizer, drone);
            single.push((simulation, randomizer, drone));
        }
        prop_assert_eq!(lanes.is_inexact(), sigmas.iter().any(Option::is_some));
        for step in 0..20_u64 {
            let (mut state, mut rpy) = ([[0.0; LANES]; 13], [[0.0; LANES]; 3]);
            for (lane, (simulation, _, drone)) in single.iter().enumerate() {
                let truth = &simulation.states()[*drone];
                numbers(truth).iter().zip(&mut state).for_each(|(x, row)| row[lane] = *x);
                truth.rpy().iter().zip(&mut rpy).for_each(|(x, row)| row[lane] = *x);
            }
            let mut expected = Vec::new();
            for (simulation, randomizer, drone) in &mut single {
                let truth = simulation.states()[*drone];
                let mut out = Measured::default();
                let measured = randomizer.measure(simulation.view().data(), &mut out);
                let (state, rpy) =
                    measured.map_or((truth, truth.rpy()), |(states, rpys)| (states[*drone], rpys[*drone]));
                // the angles come from the sensors or from the attitude; near the vertical, rounding is magnified
                prop_assert!((state.rpy() - rpy).norm() < 1e-9, "{:?} {:?}", state.rpy(), rpy);
                expected.push((numbers(&state), rpy));
            }
            for width in Width::available() {
                let (mut state, mut rpy) = (state, rpy);
                let steps = [step; LANES];
                width.run(LANES, Measure { lanes: &lanes, steps: &steps, state: &mut state, rpy: &mut rpy });
                for (lane, (numbers, angles)) in expected.iter().enumerate() {
                    let got: Vec<_> = state.iter().chain(&rpy).map(|row| row[lane].to_bits()).collect();
                    let expected: Vec<_> = numbers.iter().chain(angles).map(|x| x.to_bits()).collect();
                    prop_assert_eq!(got, expected, "{} {} {}", width, lane, step);
                }
            }
            for (simulation, _, drone) in &mut single {
                simulation.step(&vec![[12_000.0, 12_500.0, 12_000.0, 12_500.0]; *drone + 1]).unwrap();
            }
        }
    }
}

/// A separate bias of the angular velocity changes no other bias of the same seed.
#[test]
fn gyro_bias_replaces_the_bias_of_the_angular_velocity() {
    let ranges = SensorRanges::default();
    let biases = |ranges| episode(Some(ranges), 1, 3).1.draw.drones[0].bias;
    let plain = biases(ranges);
    let strong = biases(SensorRanges { gyro_bias: Some(4.0 * ranges.bias * ranges.angular_velocity), ..ranges });
    assert_eq!(strong[..3], plain[..3]);
    assert!((strong[3] - 4.0 * plain[3]).norm() < 1e-12 && plain[3].norm() > 0.0);
    assert_eq!(biases(SensorRanges { gyro_bias: Some(0.0), ..ranges })[3], Vector3::zeros());
}

/// Prints the time of a measurement of eight drones. Run it with `--release -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement"]
#[allow(clippy::print_stdout)]
fn the_time_of_a_measurement_in_lanes() {
    let mut lanes = SensorLanes::default();
    for lane in 0..LANES {
        lanes.set(lane, &episode(Some(SensorRanges::default()), 1, lane as u64).1, 0);
    }
    let (mut simulation, randomizer) = episode(Some(SensorRanges::default()), 1, 0);
    let (mut best, mut out) = (std::collections::BTreeMap::new(), Measured::default());
    for _ in 0..20 {
        for width in Width::available() {
            let (mut state, mut rpy) = ([[0.0; LANES]; 13], [[0.0; LANES]; 3]);
            state[3] = [1.0; LANES];
            let start = std::time::Instant::now();
            for step in 0..2000 {
                let steps = [step; LANES];
                width.run(LANES, Measure { lanes: &lanes, steps: &steps, state: &mut state, rpy: &mut rpy });
            }
            let best = best.entry(width.to_string()).or_insert(f64::INFINITY);
            *best = (start.elapsed().as_secs_f64() * 1e9 / 2000.0).min(*best);
        }
        simulation.reset().unwrap();
        let start = std::time::Instant::now();
        for _ in 0..8 * 500 {
            std::hint::black_box(randomizer.measure(simulation.view().data(), &mut out));
        }
        let best = best.entry("scalar, 8 drones".to_owned()).or_insert(f64::INFINITY);
        *best = (start.elapsed().as_secs_f64() * 1e9 / 500.0).min(*best);
    }
    println!("{best:.0?} ns");
}
