//! The contract of environments and agents for all tasks, with wrappers and recordings.
//!
//! "The paper" is *MuJoCo-Drones-Gym* (Tayal).

mod common;

use common::{airframe_with_duty, assert_contract, no_gl};
use mujoco_drones_gym::control::{CollisionCone, ControllerKind};
use mujoco_drones_gym::env::{
    BoxSpace, EndReason, EnvConfig, ObservationSpace, TaskDefaults, check_env, check_independence,
};
use mujoco_drones_gym::multi_agent::{
    Agent, AgentInfo, AgentMap, MultiAgentAviary, ParallelAviary, ParallelEnv, ParallelStep, check_parallel_env,
};
use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::Recorded;
use mujoco_drones_gym::tasks::{self, Antipodal, FlyThrough, Formation, MultiHover, NAMES, Race, Velocity, make};
use mujoco_drones_gym::wrappers::SafetyWrapper;
use mujoco_drones_gym::{Rng, SeedableRng};
use nalgebra::Vector3;

/// Rows in single precision are elements of their space if an angle is at its bound, although π in single precision is
/// larger than π. The maximum range of 4.3 m is also larger in single precision.
#[test]
fn rows_in_single_precision_are_in_their_space_at_the_bounds_of_angles() {
    use mujoco_drones_gym::sensing::RangeConfig;
    use std::f64::consts::{FRAC_PI_2, PI};
    assert!(f64::from(PI as f32) > PI && f64::from(FRAC_PI_2 as f32) > FRAC_PI_2 && f64::from(4.3_f32) > 4.3);
    let mut at_bound = 0;
    for name in NAMES {
        let drones = make(name, EnvConfig::default()).unwrap().simulation().num_drones();
        for rpy in [[0.0, 0.0, PI], [PI, 0.0, 0.0], [0.0, FRAC_PI_2, PI], [0.0, -FRAC_PI_2, 0.3], [-PI, 0.0, -PI]] {
            let kind: ObservationType = "kin_ranges_obstacle_adjacency".parse().unwrap();
            let config = EnvConfig::default()
                .initial_rpys(vec![rpy; drones])
                .observation_type(kind)
                .rays(RangeConfig { max_range: 4.3, ..RangeConfig::default() });
            let mut env = make(name, config.clone()).unwrap();
            let space = env.observation_space().vector.clone();
            env.reset(Some(1)).unwrap();
            let mut row = vec![0.0; space.size()];
            let mut batch = make_vec(name, config, VecConfig { threads: 1, ..VecConfig::new(3) }).unwrap();
            let rows = batch.observation_space().row();
            assert_eq!(rows.size(), batch.observation_size());
            let mut buffers = VecBuffers::new(&*batch);
            batch.reset(Some(1), &mut buffers.observations).unwrap();
            for step in 0..4 {
                let vector = &env.observation().vector;
                at_bound += vector.iter().filter(|x| [PI, FRAC_PI_2].contains(&x.abs())).count();
                space.write_f32(vector, &mut row);
                assert!(space.contains(vector) && space.contains(&row), "{name} {rpy:?} {step}: {row:?}");
                assert!(row.iter().zip(vector).all(|(&y, &x)| (f64::from(y) - x).abs() <= 2e-7 * x.abs().max(1e-30)));
                for row in buffers.observations.chunks_exact(rows.size()) {
                    assert!(rows.contains(row), "{name} {rpy:?} {step}: {row:?}");
                }
                if env.info().end.is_none() {
                    env.step(&vec![0.0; env.action_space().size()]).unwrap();
                }
                batch.step(&vec![0.0; 3 * batch.action_size()], buffers.step()).unwrap();
            }
        }
    }
    assert!(at_bound > 30, "{at_bound} angles are at their bounds");
}

#[test]
fn every_task_keeps_the_contract_with_every_action_type_and_with_several_drones() {
    for name in tasks::NAMES {
        for action_type in ActionType::ALL {
            let config = EnvConfig::default().drone(airframe_with_duty()).action_type(action_type).episode_seconds(5.0);
            let mut env = make(name, config).unwrap();
            check_env(&mut *env).unwrap_or_else(|error| panic!("{action_type}: {error}"));
        }
        let drones = if name == "hover" { 1 } else { 4 };
        let config = || {
            EnvConfig::default()
                .num_drones(drones)
                .drone(DroneModel::Race)
                .physics(Physics::MjcGndDragDw)
                .sim_freq(300)
                .ctrl_freq(100)
                .episode_seconds(1.0)
                .observation_type(ObservationType::KIN_ADJACENCY)
                .neighbourhood_radius(1.0)
        };
        // four racers need a larger formation
        let build = || match name {
            "formation" => {
                Box::new(config().with_task(Formation::default()).task(|task| task.radius = 0.6).build().unwrap())
            }
            _ => make(name, config()).unwrap() as Box<dyn DroneEnv + Send>,
        };
        let report = check_env(&mut *build()).unwrap();
        assert!(report.episodes >= 5, "{name}: {report:?}");
        check_independence(&mut *build(), &mut *build()).unwrap();
    }
}

#[test]
fn environments_with_cameras_keep_the_contract() {
    if no_gl() {
        return;
    }
    let all = "kin_rgb_depth_segmentation_adjacency".parse::<ObservationType>().unwrap();
    let size = ImageSize { width: 16, height: 12 };
    let config = EnvConfig::default().observation_type(all).camera_size(size).episode_seconds(0.3);
    let mut env = make("race", config.clone().num_drones(2)).unwrap();
    check_env(&mut *env).unwrap();
    let names: Vec<_> = env.observation_space().parts().iter().map(|part| (part.name, part.shape.clone())).collect();
    assert_eq!(names[1], ("rgb", vec![2, 12, 16, 4]));
    assert_eq!(names[4], ("adjacency", vec![2, 2]));
    let multi = config.with_task(MultiHover::multi_agent()).build().unwrap();
    check_parallel_env(&mut ParallelAviary::new(multi), 1).unwrap();
}

#[test]
fn the_checker_finds_every_fault_of_a_task() {
    /// Task with one fault.
    #[derive(Debug, Default, Clone)]
    struct Faulty {
        fault: &'static str,
        episodes: f64,
    }
    impl Task for Faulty {
        fn name(&self) -> &'static str {
            "faulty"
        }
        fn defaults(&self) -> TaskDefaults {
            TaskDefaults { num_drones: 1, episode_seconds: 2.0, controller: ControllerKind::Pid }
        }
        fn initial_positions(&self, _: &[DroneParams]) -> Vec<[f64; 3]> {
            vec![[0.0, 0.0, 1.0]]
        }
        fn observation_space(&self) -> BoxSpace {
            BoxSpace::new([[-10.0, 10.0], [-1.0, 1.0]])
        }
        fn reset(&mut self, _: SimView<'_>, _: &mut Rng) {
            self.episodes += 1.0;
        }
        fn update(&mut self, _: SimView<'_>) {}
        fn end(&self, simulation: SimView<'_>, _: usize) -> Option<EndReason> {
            let low = simulation.states()[0].position.z < 0.5;
            low.then_some(if self.fault == "reason" { EndReason::TimeLimit } else { EndReason::FloorContact })
        }
        fn reward(&self, simulation: SimView<'_>, _: usize, _: Option<EndReason>) -> f64 {
            match self.fault {
                "memory" => self.episodes,
                "nan" if simulation.time() > 0.1 => f64::NAN,
                _ => 0.0,
            }
        }
        fn observe(&self, simulation: SimView<'_>, _: usize, out: &mut [f64]) {
            let state = &simulation.states()[0];
            out[0] = if self.fault == "bounds" { 11.0 * state.position.z } else { state.position.z };
            out[1] = if self.fault == "constant" { 0.3 } else { state.up().x };
        }
        fn success(&self, _: SimView<'_>, _: usize) -> bool {
            false
        }
        fn progress(&self, _: SimView<'_>, _: usize) -> f64 {
            if self.fault == "progress" { 1.5 } else { 0.0 }
        }
        fn reference(&self, _: SimView<'_>, _: usize) -> Reference {
            Reference::default()
        }
        fn may_be_constant(&self, _: usize) -> bool {
            false
        }
    }
    let mut valid = EnvConfig::default().with_task(Faulty::default()).build().unwrap();
    check_env(&mut valid).unwrap();
    for (fault, message) in [
        ("memory", "two episodes with one seed differ"),
        ("nan", "a reward is NaN"),
        ("bounds", "observation[0]"),
        ("constant", "observation[1] is always 0.3"),
        ("reason", "the end in info"),
        ("progress", "progress is 1.5"),
    ] {
        let task = Faulty { fault, ..Faulty::default() };
        let mut env = EnvConfig::default().with_task(task).build().unwrap();
        let error = check_env(&mut env).unwrap_err().to_string();
        assert!(error.contains(message), "{fault}: {error}");
    }
}

#[test]
fn the_safety_wrapper_keeps_the_contract_and_does_not_change_safe_actions() {
    for name in ["multi_hover", "antipodal", "formation"] {
        let build = || {
            let config = EnvConfig::default().action_type(ActionType::Vel).episode_seconds(2.0);
            SafetyWrapper::new(make(name, config).unwrap(), CollisionCone::new(0.2)).unwrap()
        };
        assert_contract(build);
    }
    let plain = || MultiHover::builder().num_drones(2).action_type(ActionType::Vel).build().unwrap();
    let mut bare = plain();
    let mut safe = SafetyWrapper::new(plain(), CollisionCone::new(0.2)).unwrap();
    bare.reset(Some(1)).unwrap();
    safe.reset(Some(1)).unwrap();
    for _ in 0..100 {
        let action = [0.1, 0.0, 0.2, 0.0, 0.1, 0.0, 0.2, 0.0];
        assert_eq!(bare.step(&action).unwrap(), safe.step(&action).unwrap());
    }
    assert_eq!(safe.interventions(), 0);
}

#[test]
fn equal_seeds_give_bit_identical_episodes_on_every_thread_and_other_seeds_differ() {
    let episode = |name: &str, seed: u64| {
        let mut env = make(name, EnvConfig::default().physics(Physics::MjcGndDragDw)).unwrap();
        env.reset(Some(seed)).unwrap();
        let mut rng = Rng::seed_from_u64(5);
        let mut bits = Vec::new();
        for _ in 0..60 {
            let action: Vec<_> = env.action_space().sample(&mut rng).iter().map(|x| 0.3 * x).collect();
            let step = env.step(&action).unwrap();
            bits.push(step.reward.to_bits());
            bits.extend(step.observation.vector.iter().map(|x| x.to_bits()));
            if step.terminated {
                break;
            }
        }
        bits
    };
    for name in tasks::NAMES {
        let here = episode(name, 4);
        let there = std::thread::scope(|scope| scope.spawn(|| episode(name, 4)).join().unwrap());
        assert_eq!(here, there, "{name}");
    }
    // the target velocity is the only random quantity of the paper's tasks
    assert_ne!(episode("velocity", 4), episode("velocity", 5));
    let mut env = Velocity::builder().build().unwrap();
    let mut targets = Vec::new();
    env.reset(Some(1)).unwrap();
    for _ in 0..200 {
        let observation = env.reset(None).unwrap().vector.clone();
        let (velocity, rate) = env.task().target(0);
        assert_eq!(
            (&observation[12..15], observation[15]),
            (velocity.as_slice(), rate),
            "the observation has the target of the reward"
        );
        assert!(velocity.amax() <= 0.5 && rate.abs() <= 0.25);
        targets.push(velocity.x);
    }
    assert!(targets.iter().any(|x| *x > 0.4) && targets.iter().any(|x| *x < -0.4));
}

#[test]
fn agents_keep_their_contract_in_every_task() {
    for drones in [1, 2, 3] {
        let multi = MultiHover::builder().num_drones(drones).episode_seconds(4.0).build().unwrap();
        check_parallel_env(&mut MultiAgentAviary::new(multi), 3).unwrap();
    }
    let config = || EnvConfig::default().num_drones(3).episode_seconds(3.0);
    check_parallel_env(&mut ParallelAviary::new(config().with_task(FlyThrough::default()).build().unwrap()), 2)
        .unwrap();
    check_parallel_env(&mut ParallelAviary::new(config().with_task(Race::default()).build().unwrap()), 2).unwrap();
    check_parallel_env(&mut ParallelAviary::new(config().with_task(Formation::default()).build().unwrap()), 2).unwrap();
    check_parallel_env(&mut ParallelAviary::new(config().with_task(Velocity::default()).build().unwrap()), 2).unwrap();
    let attitudes = config().action_type(ActionType::Attitude).with_task(Antipodal::default()).build().unwrap();
    check_parallel_env(&mut ParallelAviary::new(attitudes), 2).unwrap();
}

#[test]
fn an_agent_that_crashes_leaves_and_the_others_continue() {
    let mut env = MultiAgentAviary::new(MultiHover::builder().num_drones(3).build().unwrap());
    let (observations, infos) = env.reset(Some(1)).unwrap();
    assert!(observations.iter().all(|(_, observation)| observation.vector.len() == 13));
    assert!(infos.iter().all(|(_, info)| info.end.is_none()));
    assert_eq!(env.state().len(), 36);
    let mut pids: Vec<_> = (0..3).map(|_| PidControl::new(&DroneModel::Cf2x.params())).collect();
    let scale = mujoco_drones_gym::action::MotorScale::new(&DroneModel::Cf2x.params());
    let mut left = Vec::new();
    let mut sums = [0.0; 3];
    while !env.agents().is_empty() {
        let mut actions = Vec::new();
        for agent in env.agents() {
            let drone: usize = agent.trim_start_matches("drone").parse().unwrap();
            let state = env.simulation().states()[drone];
            let reference = Reference::hover(Vector3::new(drone as f64, 0.0, 0.7 + 0.25 * drone as f64), 0.0);
            let mut rpm = pids[drone].control(1.0 / 48.0, &state, &reference).rpm;
            if drone == 1 && env.simulation().time() > 2.0 {
                rpm = [0.0; 4];
            }
            actions.push((agent.clone(), rpm.map(|rpm| scale.command(rpm)).to_vec()));
        }
        let step = env.step(&actions.into_iter().collect::<AgentMap<_>>()).unwrap();
        for (agent, reward) in step.rewards.iter() {
            sums[agent.trim_start_matches("drone").parse::<usize>().unwrap()] += reward;
            if step.terminated.get(agent) == Some(&true) {
                left.push((agent.to_string(), step.infos.get(agent).unwrap().end.unwrap()));
                assert!(*reward < -90.0);
            }
        }
    }
    assert_eq!(left, [("drone1".to_string(), EndReason::FloorContact)]);
    assert_eq!(env.simulation().time(), 10.0);
    assert!(sums[0] > 0.0 && sums[2] > 0.0 && sums[1] < -90.0, "{sums:?}");
    assert!((env.simulation().states()[2].position.z - 1.2).abs() < 0.05);
}

#[test]
fn a_recorded_environment_behaves_the_same_and_writes_a_file_per_episode() {
    let directory = tempfile::tempdir().unwrap();
    let build = || Hover::builder().episode_seconds(1.0).build().unwrap();
    check_env(&mut Recorded::new(build(), directory.path().join("checked")).unwrap()).unwrap();
    let (mut plain, mut recorded) = (build(), Recorded::new(build(), directory.path()).unwrap());
    for _ in 0..3 {
        plain.reset(None).unwrap();
        recorded.reset(None).unwrap();
        while recorded.info().end.is_none() {
            assert_eq!(plain.step(&[0.1; 4]).unwrap(), recorded.step(&[0.1; 4]).unwrap());
        }
    }
    for episode in 0..3 {
        let text = std::fs::read_to_string(directory.path().join(format!("episode_000{episode}_drone0.csv"))).unwrap();
        assert_eq!(text.lines().count(), 1 + 1 + 48, "a header, the initial state and every step");
    }
}

#[test]
fn a_changed_task_is_validated_at_the_next_reset() {
    let mut env = FlyThrough::builder().build().unwrap();
    env.reset(Some(1)).unwrap();
    env.task_mut().waypoints.clear();
    assert!(matches!(env.step(&[0.0; 4]), Err(EnvError::NeedsReset { .. })));
    for _ in 0..2 {
        assert_eq!((env.info().success, env.info().position_error), (false, 0.0));
        assert!(env.reset(None).unwrap_err().to_string().contains("waypoints is 0 points, expected 1 to 198"));
        assert!(matches!(env.step(&[0.0; 4]), Err(EnvError::NeedsReset { .. })));
    }
    env.task_mut().waypoints.push([0.0, 0.0, 1.0]);
    env.reset(None).unwrap();
    env.step(&[0.0; 4]).unwrap();
}

#[test]
fn a_changed_task_has_no_plans_until_the_next_reset() {
    let mut env = Race::builder().num_drones(2).build().unwrap();
    env.reset(Some(1)).unwrap();
    assert!(env.plans().iter().all(Option::is_some));
    env.task_mut().laps = 1 << 40;
    let plans = env.plans();
    assert!(env.plan(0).is_none() && plans.len() == 2 && plans.iter().all(Option::is_none));
    assert!(env.reset(None).unwrap_err().to_string().contains("expected 1 to 198 over all laps"));
}

#[test]
fn the_checker_of_agents_reports_an_empty_action_space() {
    /// Agents whose actions have no components.
    struct WithoutActions(ParallelAviary<MultiHover>, BoxSpace);
    impl ParallelEnv for WithoutActions {
        fn name(&self) -> &'static str {
            self.0.name()
        }
        fn possible_agents(&self) -> &[Agent] {
            self.0.possible_agents()
        }
        fn agents(&self) -> &[Agent] {
            self.0.agents()
        }
        fn observation_space(&self, agent: &str) -> Option<&ObservationSpace> {
            self.0.observation_space(agent)
        }
        fn action_space(&self, agent: &str) -> Option<&BoxSpace> {
            self.0.action_space(agent).map(|_| &self.1)
        }
        fn reset(&mut self, seed: Option<u64>) -> Result<(AgentMap<Observation>, AgentMap<AgentInfo>), EnvError> {
            self.0.reset(seed)
        }
        fn step(&mut self, actions: &AgentMap<Vec<f64>>) -> Result<ParallelStep, EnvError> {
            let hover = actions.iter().map(|(agent, _)| (agent.clone(), vec![0.0; 4])).collect();
            self.0.step(&hover)
        }
        fn episode_steps(&self) -> u64 {
            self.0.episode_steps()
        }
        fn state(&self) -> Vec<f64> {
            self.0.state()
        }
        fn render(&mut self, view: View, size: ImageSize, rgb: &mut [u8]) -> Result<(), EnvError> {
            self.0.render(view, size, rgb)
        }
        fn simulation(&self) -> &Simulation {
            self.0.simulation()
        }
        fn drone_env(&self) -> &dyn DroneEnv {
            self.0.drone_env()
        }
        fn drone_env_mut(&mut self) -> &mut dyn DroneEnv {
            self.0.drone_env_mut()
        }
    }
    let agents = ParallelAviary::new(MultiHover::builder().build().unwrap());
    let error = check_parallel_env(&mut WithoutActions(agents, BoxSpace::new([])), 1).unwrap_err().to_string();
    assert!(error.contains("the action space of an agent is empty"), "{error}");
}
