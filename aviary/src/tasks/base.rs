use nalgebra::Vector3;

use super::UNBOUNDED;
use crate::action::ActionType;
use crate::control::{ControllerKind, Reference};
use crate::drone::DroneParams;
use crate::env::{AviaryBuilder, BoxSpace, EndReason, Rng, Task, TaskDefaults};
use crate::observation::{KIN_SIZE, kinematic};
use crate::simulation::{SimView, default_positions};

/// Environment without a task (paper, §3.4 `BaseAviary`): motor speeds in, states out.
///
/// | | |
/// | --- | --- |
/// | Start | drones in a row along x at z = 0.1 m, level, at rest |
/// | Action | 4 motor speeds per drone, rpm ([`ActionType::RawRpm`]) |
/// | Reward | 0 |
/// | Terminated | never |
/// | Truncated | after `episode_seconds`; default 10⁷ s |
///
/// | Observation, per drone | | Unit, frame |
/// | --- | --- | --- |
/// | 0–2 | position | m, world |
/// | 3–6 | quaternion w, x, y, z | body to world |
/// | 7–9 | roll, pitch, yaw | rad |
/// | 10–12 | velocity | m/s, world |
/// | 13–15 | angular velocity | rad/s, body |
/// | 16–19 | commanded motor speeds of the last step | rpm |
///
/// ```
/// use aviary::env::{DroneEnv, Env};
/// use aviary::tasks::Base;
///
/// let mut env = Base::builder().num_drones(2).build()?;
/// env.reset(Some(1))?;
/// let hover = env.simulation().params(0).hover_rpm();
/// let step = env.step(&[hover; 8])?;
/// assert_eq!((step.observation.vector.len(), step.observation.vector[16], step.reward), (40, hover, 0.0));
/// # Ok::<(), aviary::env::EnvError>(())
/// ```
#[derive(Debug, Clone, Default, serde::Serialize, serde::Deserialize)]
pub struct Base {}

impl Base {
    /// Creates a builder for the environment without a task.
    pub fn builder() -> AviaryBuilder<Self> {
        AviaryBuilder::new(Self::default())
    }
}

impl Task for Base {
    fn name(&self) -> &'static str {
        super::BASE
    }

    fn defaults(&self) -> TaskDefaults {
        TaskDefaults { num_drones: 1, episode_seconds: 1e7, controller: ControllerKind::Pid }
    }

    fn action_type(&self) -> ActionType {
        ActionType::RawRpm
    }

    fn initial_positions(&self, drones: &[DroneParams]) -> Vec<[f64; 3]> {
        default_positions(drones)
    }

    fn observation_space(&self) -> BoxSpace {
        let mut bounds = [UNBOUNDED; KIN_SIZE];
        bounds[3..7].fill([-1.0, 1.0]);
        bounds[7..10].copy_from_slice(&super::STATE_BOUNDS[3..6]);
        bounds[16..].fill([0.0, f64::INFINITY]);
        BoxSpace::new(bounds)
    }

    fn reset(&mut self, _simulation: SimView<'_>, _rng: &mut Rng) {}

    fn update(&mut self, _simulation: SimView<'_>) {}

    fn end(&self, _simulation: SimView<'_>, _drone: usize) -> Option<EndReason> {
        None
    }

    fn reward(&self, _simulation: SimView<'_>, _drone: usize, _end: Option<EndReason>) -> f64 {
        0.0
    }

    fn observe(&self, simulation: SimView<'_>, drone: usize, out: &mut [f64]) {
        out.copy_from_slice(&kinematic(&simulation.states()[drone], &simulation.motor_speeds()[drone]));
        // the norm of a quaternion is 1 except for rounding
        for component in &mut out[3..7] {
            *component = component.clamp(-1.0, 1.0);
        }
    }

    fn success(&self, _simulation: SimView<'_>, _drone: usize) -> bool {
        false
    }

    fn reference(&self, simulation: SimView<'_>, drone: usize) -> Reference {
        let start = &simulation.initial_states()[drone];
        Reference::hover(start.position, start.yaw())
    }

    fn extent(&self, simulation: SimView<'_>, drone: usize, _seconds: f64) -> Vec<Vector3<f64>> {
        vec![simulation.initial_states()[drone].position]
    }

    fn may_be_constant(&self, _entry: usize) -> bool {
        true
    }

    super::saved_by_serde!();
}
