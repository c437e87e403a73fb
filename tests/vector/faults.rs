//! Faults of single environments of a batch, and unusual tasks.

use mujoco_drones_gym::Rng;
use mujoco_drones_gym::env::{AviaryBuilder, BoxSpace, EndReason, TaskDefaults};
use mujoco_drones_gym::prelude::*;

use super::common::{no_gl, reset_batch};
use super::{Wander, compare};

#[test]
fn a_non_finite_action_affects_its_own_environment_alone() {
    for (engine, poison) in
        [(EngineKind::Hybrid, f32::NAN), (EngineKind::Mujoco, f32::INFINITY), (EngineKind::Hybrid, f32::NEG_INFINITY)]
    {
        let builder = || Hover::builder().engine(engine).initial_positions([[0.0, 0.0, 1.0]]);
        let batch = |on_fault| reset_batch(builder(), VecConfig { on_fault, ..VecConfig::new(12) }, 1);
        let [(mut clean, first), (mut strict, second), (mut lenient, third)] =
            [OnFault::Error, OnFault::Error, OnFault::Truncate].map(batch);
        let mut buffers = [first, second, third];
        let mut wander = Wander::new(9, 12, 4);
        for step in 0..40 {
            let good = wander.next().to_vec();
            let mut bad = good.clone();
            if step == 20 {
                bad[4 * 5 + 2] = poison;
                // the refused step changes nothing
                let before = buffers[1].clone();
                let error = strict.step(&bad, buffers[1].step()).unwrap_err().to_string();
                assert!(error.starts_with("environment 5: action[2] is"), "{error}");
                assert_eq!(buffers[1], before);
            }
            clean.step(&good, buffers[0].step()).unwrap();
            strict.step(&good, buffers[1].step()).unwrap();
            lenient.step(&bad, buffers[2].step()).unwrap();
            assert_eq!(buffers[0], buffers[1]);
            for i in (0..12).filter(|&i| i != 5) {
                assert_eq!(buffers[0].observations[12 * i..][..12], buffers[2].observations[12 * i..][..12]);
                assert_eq!(buffers[0].rewards[i], buffers[2].rewards[i]);
            }
            if step == 20 {
                assert_eq!(lenient.faults().len(), 1);
                assert_eq!(lenient.faults()[0].0, 5);
                assert!(buffers[2].truncated[5] && !buffers[2].terminated[5] && buffers[2].rewards[5] == 0.0);
                assert_eq!(lenient.episode_summary(5).unwrap().end, Some(EndReason::Fault));
            } else {
                assert!(lenient.faults().is_empty());
            }
            if step == 21 {
                assert_eq!(buffers[2].observations[12 * 5 + 2], 1.0, "environment 5 has been reset");
            }
            if step == 20 {
                assert!(lenient.step(&good[1..], buffers[2].step()).is_err());
                assert!(lenient.faults().is_empty(), "a refused call has no faults");
            }
        }
    }
}

#[test]
fn invalid_calls_are_errors_that_change_nothing() {
    let make = |config| VecAviary::new(Hover::builder(), config);
    assert!(make(VecConfig::new(0)).unwrap_err().to_string().contains("environments is 0"));
    let mut batch = make(VecConfig { autoreset: Autoreset::Disabled, ..VecConfig::new(10) }).unwrap();
    let mut buffers = VecBuffers::new(&batch);
    let actions = vec![0.0; 40];
    let error = batch.step(&actions, buffers.step()).unwrap_err().to_string();
    assert!(error.contains("environment 0") && error.contains("reset"), "{error}");
    assert!(batch.reset(None, &mut [0.0; 7]).unwrap_err().to_string().contains("expected 120"));
    batch.reset(None, &mut buffers.observations).unwrap();
    assert!(batch.step(&actions[1..], buffers.step()).unwrap_err().to_string().contains("expected 40"));
    let falling = vec![-1.0; 40];
    let mut steps = 0;
    let error = loop {
        match batch.step(&falling, buffers.step()) {
            Ok(()) => steps += 1,
            Err(error) => break error.to_string(),
        }
    };
    assert!(steps > 3 && buffers.terminated[9] && error.contains("after the end"), "{steps} {error}");
    batch.reset_where(&[true; 10], None, &mut buffers.observations).unwrap();
    batch.step(&actions, buffers.step()).unwrap();
}

/// Hover with a function in `update`, invalid starts, and loads and commands in the reward.
#[derive(Debug, Clone)]
pub struct Odd {
    hover: Hover,
    /// Function that `update` calls.
    update: fn(SimView<'_>),
    /// Returns true if the n-th call of `start` gives an invalid state.
    pub impossible: fn(u32) -> bool,
    /// Calls of `start`.
    starts: u32,
}

impl Task for Odd {
    fn name(&self) -> &'static str {
        "odd"
    }

    fn defaults(&self) -> TaskDefaults {
        self.hover.defaults()
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        self.hover.initial_positions(drones)
    }

    fn observation_space(&self) -> BoxSpace {
        self.hover.observation_space()
    }

    fn start(&mut self, _: SimView<'_>, _: &mut Rng, states: &mut [DroneState]) -> bool {
        self.starts += 1;
        let impossible = (self.impossible)(self.starts);
        if impossible {
            states[0].position.z = f64::NAN;
        }
        impossible
    }

    fn reset(&mut self, simulation: SimView<'_>, rng: &mut Rng) {
        self.hover.reset(simulation, rng);
    }

    fn update(&mut self, simulation: SimView<'_>) {
        (self.update)(simulation);
        self.hover.update(simulation);
    }

    fn end(&self, simulation: SimView<'_>, drone: usize) -> Option<EndReason> {
        self.hover.end(simulation, drone)
    }

    fn reward(&self, simulation: SimView<'_>, drone: usize, _: Option<EndReason>) -> f64 {
        let load = &simulation.loads()[drone];
        load.rotors.thrust + load.external.force_world.z + simulation.motor_speeds()[drone][1]
    }

    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        self.hover.observe(simulation, drone, out);
    }

    fn success(&self, simulation: SimView<'_>, drone: usize) -> bool {
        self.hover.success(simulation, drone)
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        self.hover.reference(simulation, drone)
    }
}

/// Creates a builder with a function for `update` and valid starts.
pub fn odd(update: fn(SimView<'_>)) -> AviaryBuilder<Odd> {
    AviaryBuilder::new(Odd { hover: Hover::default(), update, impossible: |_| false, starts: 0 })
}

#[test]
fn a_task_may_use_rayon_and_read_loads_and_commands() {
    fn busy(simulation: SimView<'_>) {
        let (time, states) = (simulation.time(), simulation.states());
        let (a, b) = rayon::join(|| time + 0.0, || states[0].position.z);
        assert!(a + b > 0.0);
    }
    let config = VecConfig { threads: 2, ..VecConfig::new(600) };
    let builder = odd(busy).physics(Physics::MjcGndDragDw).initial_positions([[0.0, 0.0, 0.4]]);
    let (mut batch, mut buffers) = reset_batch(builder, config, 1);
    for _ in 0..20 {
        batch.step(&[0.01; 2400], buffers.step()).unwrap();
    }
    let builder = odd(busy).physics(Physics::MjcGndDragDw).initial_positions([[0.0, 0.0, 0.4]]);
    assert!(compare(&builder, VecConfig { threads: 2, ..VecConfig::new(17) }, 60) > 0);
}

#[test]
fn every_call_after_a_panic_of_a_task_is_an_error() {
    fn panics(simulation: SimView<'_>) {
        assert!(simulation.control_steps() < 3, "on purpose");
    }
    let (mut batch, mut buffers) = reset_batch(odd(panics), VecConfig { threads: 2, ..VecConfig::new(40) }, 1);
    let caught = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        for _ in 0..5 {
            batch.step(&[0.0; 160], buffers.step()).unwrap();
        }
    }));
    assert!(caught.is_err());
    assert_eq!(batch.reset(Some(1), &mut buffers.observations), Err(EnvError::Panicked));
    assert_eq!(batch.step(&[0.0; 160], buffers.step()), Err(EnvError::Panicked));
}

#[test]
fn divergence_in_a_batch_is_the_same_fault_as_in_a_single_environment() {
    use mujoco_drones_gym::world::Medium;
    // a fall in a dense liquid, where the drag of one step reverses the velocity
    let builder = |speed: f64| {
        Hover::builder()
            .medium(Medium { density: 1000.0, viscosity: 1.8e-5 })
            .initial_positions([[0.0, 0.0, 5.0]])
            .initial_velocities([[0.0, 0.0, -speed]])
            .task(|hover| hover.max_height = 1e9)
    };
    let mut failed = 0;
    for speed in [1.0, 4.0, 6.0, 8.0, 10.0, 12.0, 20.0] {
        let mut alone = builder(speed).engine(EngineKind::Hybrid).build().unwrap();
        let config = VecConfig { on_fault: OnFault::Truncate, ..VecConfig::new(3) };
        let (mut batch, mut buffers) = reset_batch(builder(speed), config, 1);
        alone.reset(Some(1)).unwrap();
        for _ in 0..20 {
            let outcome = alone.step(&[0.0; 4]).map(|step| step.terminated).map_err(|error| error.to_string());
            batch.step(&[0.0; 12], buffers.step()).unwrap();
            assert!(buffers.observations.iter().all(|x| x.is_finite()), "{speed}");
            match outcome {
                Ok(over) => {
                    assert_eq!(buffers.terminated, [over; 3]);
                    assert!(batch.faults().is_empty(), "{speed}");
                    if over {
                        break;
                    }
                }
                Err(error) => {
                    assert_eq!(batch.faults()[2].1.to_string(), error);
                    assert_eq!(buffers.truncated, [true; 3]);
                    failed += 1;
                    break;
                }
            }
        }
    }
    assert!(failed > 1, "{failed}");
}

#[test]
fn a_step_that_fails_to_start_an_episode_is_not_counted() {
    for autoreset in [Autoreset::SameStep, Autoreset::NextStep] {
        let config = VecConfig { autoreset, on_fault: OnFault::Truncate, ..VecConfig::new(9) };
        // episodes 2, 3 and 6 cannot start; each start is tried 20 times
        let impossible = |start| (2..42).contains(&start) || (44..64).contains(&start);
        let builder = odd(|_| {}).episode_seconds(0.25).task(move |odd| odd.impossible = impossible);
        let (mut batch, mut buffers) = reset_batch(builder, config, 1);
        let (mut ends, mut steps, mut faults) = (Vec::new(), 0, 0);
        for _ in 0..65 {
            // with `NextStep`, the step after an end starts the next episode
            let starts = autoreset == Autoreset::NextStep && batch.episode_summary(8).is_some();
            batch.step(&[0.01; 36], buffers.step()).unwrap();
            assert_eq!(batch.episode_summary(0), batch.episode_summary(8));
            faults += batch.faults().len();
            match batch.episode_summary(8) {
                Some(summary) => {
                    assert!(buffers.truncated[8] && !buffers.terminated[8]);
                    let kept = summary.end != Some(EndReason::Fault);
                    assert_eq!(batch.final_info(8).map(|info| info.end), kept.then_some(summary.end));
                    ends.push((summary.end.unwrap(), summary.steps));
                    steps += u32::from(summary.end != Some(EndReason::Fault));
                }
                None => {
                    assert!(!buffers.truncated[8]);
                    steps += u32::from(!starts);
                }
            }
        }
        let whole = (EndReason::TimeLimit, 12);
        let failed = (EndReason::Fault, 0);
        assert_eq!(ends[..7], [whole, failed, failed, whole, whole, failed, whole], "{autoreset:?}");
        assert_eq!(faults, 3 * 9);
        let running = batch.with(8, |env| env.simulation().control_steps()).unwrap() as u32;
        let wholes = ends.iter().filter(|end| **end == whole).count() as u32;
        assert_eq!(
            steps,
            12 * wholes + running,
            "{autoreset:?}: every step that starts no episode belongs to an episode"
        );
    }
}

#[test]
fn an_episode_that_cannot_start_has_no_images() {
    if no_gl() {
        return;
    }
    let config = VecConfig { autoreset: Autoreset::SameStep, on_fault: OnFault::Truncate, ..VecConfig::new(1) };
    // each start is tried 20 times
    let builder = odd(|_| {}).episode_seconds(0.04).observation_type(ObservationType::KIN_RGB);
    let builder = builder.task(|odd| odd.impossible = |start| (2..22).contains(&start));
    let (mut batch, mut buffers) = reset_batch(builder, config, 1);
    let mut ends = Vec::new();
    for _ in 0..4 {
        batch.step(&[0.01; 4], buffers.step()).unwrap();
        if let Some(summary) = batch.episode_summary(0) {
            ends.push((summary.end.unwrap(), batch.final_images(0).is_some()));
        }
    }
    assert_eq!(ends[..2], [(EndReason::TimeLimit, true), (EndReason::Fault, false)]);
}
