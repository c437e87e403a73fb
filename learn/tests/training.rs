//! Integration tests of training: reproducibility, checkpoints, configurations, agents.

use aviary::env::{Env as _, EnvConfig};
use aviary::multi_agent::{AgentMap, make_parallel};
use aviary::policy::{Activation, Mlp, PolicyInfo, PolicyNetwork};
use aviary::tasks::Hover;
use aviary::vector::{Autoreset, OnFault, VecConfig, make_vec};
use learn::{Agents as _, Batch, Next, Outcome, Stop, Success, Swarm, Terms, TrainConfig, Trainer};

/// Returns the configuration of a short run.
fn small(task: &str) -> TrainConfig {
    let mut config = TrainConfig::of_task(task).unwrap();
    config.seed = 7;
    config.steps = 5 * 64 * 16;
    (config.ppo.environments, config.ppo.horizon, config.ppo.minibatch) = (64, 16, 256);
    config.ppo.hidden = vec![16, 16];
    (config.evaluate_every, config.episodes, config.checkpoint_every) = (3, 3, 2);
    config.episode_seconds = Some(1.0);
    config
}

fn bytes(policy: &PolicyNetwork) -> Vec<u8> {
    policy.to_bytes().unwrap()
}

fn finish(trainer: &mut Trainer) {
    while trainer.stop().is_none() {
        trainer.advance().unwrap();
    }
}

#[test]
fn a_resumed_run_is_bit_identical_to_an_uninterrupted_one() {
    for (task, recurrent) in [("hover", 0), ("multi_hover", 0), ("race", 0), ("hover", 8)] {
        let small = |task| {
            let mut config = small(task);
            config.ppo.recurrent = recurrent;
            config
        };
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("checkpoint");
        let mut whole = Trainer::new(small(task), "a test").unwrap();
        finish(&mut whole);
        assert_eq!((whole.stop(), whole.curve().len()), (Some(Stop::Steps), if task == "multi_hover" { 3 } else { 5 }));

        let mut killed = Trainer::new(small(task), "a test").unwrap();
        killed.advance().unwrap();
        killed.advance().unwrap();
        assert!(killed.is_checkpoint());
        std::fs::write(&path, killed.checkpoint().unwrap()).unwrap();
        killed.advance().unwrap();
        drop(killed);

        let mut resumed = Trainer::resume(&path).unwrap();
        assert_eq!(resumed.curve().len(), 2);
        finish(&mut resumed);
        assert_eq!(resumed.curve(), whole.curve(), "{task}");
        assert_eq!(bytes(&resumed.policy().unwrap()), bytes(&whole.policy().unwrap()), "{task}");
        assert_eq!(bytes(resumed.best()), bytes(whole.best()), "{task}");
    }
}

#[test]
fn a_run_starts_with_the_networks_of_another() {
    for recurrent in [0, 8] {
        let config = |seconds: f64| {
            let mut config = small("hover");
            config.ppo.recurrent = recurrent;
            (config.episode_seconds, config.ppo.gamma) = (Some(seconds), 0.98);
            config
        };
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("checkpoint");
        let mut first = Trainer::new(config(1.0), "a test").unwrap();
        first.advance().unwrap();
        first.advance().unwrap();
        std::fs::write(&path, first.checkpoint().unwrap()).unwrap();

        let start = || {
            let mut trainer = Trainer::new(config(0.5), "a test").unwrap();
            trainer.start_from(&path).unwrap();
            trainer
        };
        let (mut second, learned) = (start(), first.policy().unwrap());
        assert!(second.curve().is_empty() && second.config().episode_seconds == Some(0.5));
        for policy in [&second.policy().unwrap(), second.best()] {
            assert_eq!((policy.net(), policy.recurrent()), (learned.net(), learned.recurrent()));
            assert_eq!(policy.normalization(), learned.normalization());
        }
        assert!(second.start_from(directory.path().join("none")).unwrap_err().to_string().contains("none"));
        finish(&mut second);
        assert_ne!(second.policy().unwrap().net(), learned.net());
        assert!(second.start_from(&path).unwrap_err().to_string().contains("start_from is iteration 5"));

        let mut again = start();
        again.advance().unwrap();
        again.advance().unwrap();
        std::fs::write(&path, again.checkpoint().unwrap()).unwrap();
        let mut resumed = Trainer::resume(&path).unwrap();
        finish(&mut resumed);
        assert_eq!(bytes(&resumed.policy().unwrap()), bytes(&second.policy().unwrap()));

        let refused =
            |config: TrainConfig| Trainer::new(config, "a test").unwrap().start_from(&path).unwrap_err().to_string();
        let mut wide = config(1.0);
        wide.ppo.hidden = vec![32];
        let error = refused(wide);
        assert!(
            error.contains("its networks are ") && error.contains("-16-16-4 (Relu") && error.contains(", expected "),
            "{error}"
        );
        let mut actions = config(1.0);
        actions.action_type = aviary::action::ActionType::OneDRpm;
        assert!(refused(actions).contains("`parameters` has"));
        let mut other = config(1.0);
        other.action_type = aviary::action::ActionType::Vel;
        assert!(refused(other).contains("its actions are rpm (per_drone = false), expected vel"));
    }
}

#[test]
fn results_depend_on_the_seed_and_not_on_the_number_of_threads() {
    let run = |threads: usize, seed: u64, recurrent: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            // several blocks of rows, several shards of a minibatch
            let mut config = TrainConfig { seed, steps: 3 * 300 * 16, ..small("hover") };
            (config.ppo.environments, config.ppo.minibatch, config.ppo.recurrent) = (300, 1700, recurrent);
            let mut trainer = Trainer::new(config, "a test").unwrap();
            finish(&mut trainer);
            let policy = trainer.policy().unwrap();
            let recurrent = policy.recurrent().map(|layer| layer.parameters().to_vec());
            (trainer.curve().to_vec(), policy.net().parameters().to_vec(), recurrent)
        })
    };
    for recurrent in [0, 16] {
        let one = run(1, 7, recurrent);
        assert_eq!(one, run(3, 7, recurrent));
        assert_ne!(one.1, run(1, 8, recurrent).1);
    }
}

#[test]
fn a_recurrent_policy_reproduces_the_trainers_evaluation() {
    let mut config = small("hover");
    (config.success, config.ppo.recurrent) = (Success::Done, 8);
    let mut trainer = Trainer::new(config.clone(), "a test").unwrap();
    finish(&mut trainer);
    assert!(trainer.policy().unwrap().info().version == PolicyInfo::RECURRENT_VERSION);
    let policy = PolicyNetwork::from_bytes(&bytes(trainer.best())).unwrap();
    let mut env = config.environment().unwrap();
    for episode in trainer.fly(40, 5).unwrap() {
        let (mut action, mut memory, mut reward) = ([0.0; 4], [0.0; 8], 0.0);
        env.reset(Some(episode.seed)).unwrap();
        while env.info().end.is_none() {
            policy.forward_with(&env.observation().vector.clone(), &mut memory, &mut action);
            reward += env.step(&action).unwrap().reward;
        }
        assert_eq!((reward, env.info().success), (episode.reward, episode.success));
    }
}

#[test]
fn a_policy_reproduces_the_trainers_evaluation() {
    let mut config = small("hover");
    config.success = Success::Done;
    let mut trainer = Trainer::new(config.clone(), "a test").unwrap();
    finish(&mut trainer);
    let policy = PolicyNetwork::from_bytes(&bytes(trainer.best())).unwrap();
    let mut env = config.environment().unwrap();
    for episode in trainer.fly(40, 5).unwrap() {
        // the episode without the trainer
        let mut action = [0.0; 4];
        let (mut reward, mut steps) = (0.0, 0);
        env.reset(Some(episode.seed)).unwrap();
        while env.info().end.is_none() {
            policy.forward(&env.observation().vector.clone(), &mut action);
            reward += env.step(&action).unwrap().reward;
            steps += 1;
        }
        assert_eq!((reward, env.info().success), (episode.reward, episode.success));
        assert!((f64::from(steps) / 48.0 - episode.seconds).abs() < 1e-9);
    }
}

#[test]
fn invalid_checkpoints_are_errors_with_the_path() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("checkpoint");
    let refused = |path: &std::path::Path| Trainer::resume(path).unwrap_err().to_string();
    assert!(refused(&path).contains("checkpoint"));
    let trainer = Trainer::new(small("hover"), "a test").unwrap();
    std::fs::write(&path, trainer.checkpoint().unwrap()).unwrap();
    assert!(Trainer::resume(&path).is_ok());
    let whole = std::fs::read(&path).unwrap();
    for length in [0, 7, 100, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&path, &whole[..length]).unwrap();
        assert!(refused(&path).contains("not a checkpoint"), "{length}");
    }
    // a changed byte of the header is an error, or changes a value to another valid one
    let head = whole.len().min(3000);
    for place in (8..head).step_by(3) {
        let mut damaged = whole.clone();
        damaged[place] ^= 0x15;
        std::fs::write(&path, &damaged).unwrap();
        if let Ok(mut trainer) = Trainer::resume(&path) {
            let _ = trainer.policy().unwrap();
            trainer.extend(None, false).unwrap();
        }
    }
    trainer.best().save(&path).unwrap();
    assert!(refused(&path).contains("has no `training`"));
}

/// Returns a checkpoint with one changed value of its state, or one changed number of a tensor.
fn changed(checkpoint: &[u8], key: &str, value: &serde_json::Value) -> Vec<u8> {
    let tensors = safetensors::SafeTensors::deserialize(checkpoint).unwrap();
    let (_, head) = safetensors::SafeTensors::read_metadata(checkpoint).unwrap();
    let mut state: serde_json::Value = serde_json::from_str(&head.metadata().as_ref().unwrap()["training"]).unwrap();
    let mut parts: Vec<_> =
        tensors.iter().map(|(name, view)| (name.to_string(), view.dtype(), view.data().to_vec())).collect();
    if let Some((_, kind, data)) = parts.iter_mut().find(|(name, ..)| name == key) {
        match kind {
            safetensors::Dtype::F32 => data[8..12].copy_from_slice(&(value.as_f64().unwrap() as f32).to_le_bytes()),
            _ => *data = value.to_string().into_bytes(),
        }
    } else {
        *state.pointer_mut(key).unwrap() = value.clone();
    }
    let views = parts.iter().map(|(name, kind, data)| {
        let size = if *kind == safetensors::Dtype::F32 { 4 } else { 1 };
        (name, safetensors::tensor::TensorView::new(*kind, vec![data.len() / size], data).unwrap())
    });
    let metadata = [("training".to_string(), state.to_string())].into();
    safetensors::serialize(views, Some(metadata)).unwrap()
}

#[test]
fn every_number_of_a_checkpoint_is_validated() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("checkpoint");
    let mut trainer = Trainer::new(small("hover"), "a test").unwrap();
    trainer.advance().unwrap();
    trainer.advance().unwrap();
    let whole = trainer.checkpoint().unwrap();
    let time = serde_json::json!(32);
    std::fs::write(&path, changed(&whole, "/time", &time)).unwrap();
    Trainer::resume(&path).unwrap().advance().unwrap();
    let mut curve = serde_json::to_value(trainer.curve()).unwrap();
    curve[1]["steps"] = 7.into();
    for (key, value, wanted) in [
        // two iterations of four epochs of four minibatches
        ("/time", u64::MAX.into(), "`time` is 18446744073709551615, expected up to 32"),
        ("/time", 33.into(), "`time` is 33, expected up to 32"),
        ("/iteration", u64::MAX.into(), "`iteration` is 18446744073709551615, expected 2"),
        ("/rate", (-0.1).into(), "`rate` is -0.1, expected above 0 and up to 0.0015"),
        ("/rate", 0.5.into(), "`rate` is 0.5"),
        ("/observations/count", (-1.0).into(), "`observations`"),
        ("/observations/squares/3", (-1.0).into(), "`observations`"),
        ("/rewards/sums/count", (-1.0).into(), "`rewards`"),
        ("/config/task", "race".into(), "a checkpoint"),
        ("moments.second", (-1.0).into(), "entry 2 of `moments.second` is -1"),
        ("moments.first", 1e60.into(), "entry 2 of `moments.first` is inf"),
        ("parameters", 1e60.into(), "entry 2 of `parameters` is inf"),
        ("curve", curve, "entry 2 of `curve` is iteration 2 with 7 steps, expected 2 with 2048"),
    ] {
        std::fs::write(&path, changed(&whole, key, &value)).unwrap();
        let error = Trainer::resume(&path).unwrap_err().to_string();
        assert!(error.contains(wanted), "{key}: {error}");
    }
}

#[test]
fn the_late_error_covers_the_last_five_seconds_of_the_episode() {
    let mut lengths = Vec::new();
    for thrust in [0.3, 0.02] {
        let info = PolicyInfo::of_task("hover");
        // climbs past 1 m and out of the task's bounds
        let mut weights = vec![0.0; 12 * 4 + 4];
        weights[12 * 4..].fill(thrust);
        let net = Mlp::new(&[12, 4], Activation::Relu, &weights).unwrap();
        let mut env = Hover::builder().task(|hover| hover.max_height = 1.2).episode_seconds(30.0).build().unwrap();
        let spaces = (env.observation_space().vector.clone(), env.action_space().clone());
        let policy = PolicyNetwork::new(info, net, spaces.0, spaces.1).unwrap();
        let mut errors = Vec::new();
        let mut look = |env: &dyn aviary::env::DroneEnv| errors.push(env.info().position_error);
        let flown = learn::fly(&mut env, &mut policy.pilot(), Success::Done, 1, &mut look).unwrap();
        // the first error precedes the first step
        let late = errors[1..].iter().rev().take(5 * 48).copied().fold(0.0, f64::max);
        assert_eq!((flown.end, flown.late_position_error), ("out_of_bounds", late));
        assert_eq!(flown.final_position_error, errors[errors.len() - 1]);
        assert!(flown.seconds < 25.0 && late > flown.final_position_error + 0.3, "{flown:?}");
        lengths.push(flown.seconds);
    }
    assert!(lengths[0] < 5.0, "{lengths:?}");
}

#[test]
fn a_policy_contains_its_training_configuration() {
    let mut config = small("hover");
    config.read_toml("physics = \"mjc_drag\"\n[randomization.body]\nmass = [0.8, 1.2]").unwrap();
    let policy = Trainer::new(config.clone(), "a test").unwrap().policy().unwrap();
    let mut read = TrainConfig { seed: config.seed, ..TrainConfig::of_task("hover").unwrap() };
    read.read_toml(policy.info().training.as_ref().unwrap()).unwrap();
    assert_eq!(read, config);
}

#[test]
fn invalid_configurations_are_errors_with_the_setting() {
    let refused = |text: &str| {
        let mut config = TrainConfig::of_task("hover").unwrap();
        config
            .read_toml(text)
            .and_then(|()| config.validate())
            .and_then(|()| config.options().map(drop))
            .unwrap_err()
            .to_string()
    };
    for (text, wanted) in [
        ("[ppo]\nclip_rang = 0.1", "did you mean `clip_range`"),
        ("[ppo]\nclip_range = -1.0", "clip_range is -1, expected 0.001 to 10"),
        ("[ppo]\nenvironments = 0", "environments is 0"),
        ("[ppo]\nrecurrent = 300", "recurrent is 300, expected 0 to 256 units"),
        ("[ppo]\nenvironments = 1000000\nhorizon = 1000", "environments × horizon"),
        ("[ppo]\nlearning_rate = nan", "learning_rate is NaN"),
        ("drone = \"cf2y\"", "did you mean `cf2x`"),
        ("physics = \"mjc_drg\"", "did you mean `mjc_drag`"),
        ("episodes = 0", "episodes is 0"),
        ("success = { held = { seconds = -1.0 } }", "success"),
        ("[wind]\nmodel = \"constant\"\nvelocity = [nan, 0, 0]", "velocity"),
        ("[randomization.body]\nmass = [2.0, 1.0]", "mass"),
        ("steps = ", "line 1"),
        ("steps = 0", "steps is 0"),
        ("[ppo]\nhidden = [9223372036854775807]", "up to 7 layers of 1 to 256"),
        ("out_of_bounds = nan", "out_of_bounds is NaN"),
        ("[[training_starts]]\nseconds = -3.0", "-3 s"),
        ("[course]\npoint = 1.0\ndistance = 1.0\nspeed = 1.0", "course is set for hover"),
    ] {
        assert!(refused(text).contains(wanted), "{text}: {}", refused(text));
    }
    assert!(TrainConfig::of_task("hoover").unwrap_err().to_string().contains("did you mean `hover`"));
}

/// Policies of earlier versions contain the settings of their training under these names.
#[test]
fn hyperparameters_are_also_read_under_their_earlier_names() {
    let read = |text: &str| {
        let mut config = TrainConfig::of_task("hover").unwrap();
        config.read_toml(text).map(|()| config)
    };
    let values = "0.5 0.6 0.7 0.25 0.8 0.01 2.0 0.4";
    let with = |names: &str| {
        let pairs = names.split(' ').zip(values.split(' '));
        pairs.fold("[ppo]\n".to_string(), |text, (name, value)| format!("{text}{name} = {value}\n"))
    };
    let now = with("target_kl gamma gae_lambda clip_range value_coef entropy_coef max_grad_norm initial_std");
    let before = with("divergence discount lambda clip value entropy max_gradient deviation");
    let (now, before) = (read(&now).unwrap(), read(&before).unwrap());
    assert_eq!(now, before);
    assert_eq!((now.ppo.gamma, now.ppo.clip_range, now.ppo.initial_std), (0.6, 0.25, 0.4));
    assert!(read("[ppo]\nclip = 0.1\nclip_range = 0.1\n").unwrap_err().to_string().contains("duplicate"));
}

#[test]
fn every_tasks_configuration_round_trips_through_toml() {
    for task in aviary::tasks::NAMES {
        let config = TrainConfig::of_task(task).unwrap();
        config.validate().unwrap();
        let mut read = TrainConfig { conditions: Default::default(), ..TrainConfig::of_task("hover").unwrap() };
        (read.task, read.course, read.num_drones) = (task.into(), None, None);
        read.read_toml(&config.to_toml().unwrap()).unwrap();
        assert_eq!(read, config, "{task}");
    }
}

#[test]
fn agents_of_a_swarm_match_the_parallel_environment() {
    let options = || EnvConfig::default().num_drones(3).episode_seconds(0.5);
    let make = |stream| make_parallel("multi_hover", options().stream(stream));
    let mut swarm = Swarm::new(2, Terms::default(), make).unwrap();
    let mut alone = [make(0).unwrap(), make(1).unwrap()];
    let mut outcome = Outcome::new(6, 13);
    swarm.reset(5, &mut outcome.observations).unwrap();
    for (world, env) in alone.iter_mut().enumerate() {
        let (seen, _) = env.reset(Some(5)).unwrap();
        for (agent, (_, seen)) in seen.iter().enumerate() {
            let row = 3 * world + agent;
            let written: Vec<f32> = seen.vector.iter().map(|&x| x as f32).collect();
            assert_eq!(outcome.observations[13 * row..13 * (row + 1)], written);
        }
    }
    // the second drone of the second environment falls, all others climb
    let mut actions = vec![0.3; 6 * 4];
    actions[4 * 4..5 * 4].fill(-1.0);
    let mut ends = 0;
    for step in 0..24 {
        swarm.step(&actions, &mut outcome).unwrap();
        for (world, env) in alone.iter_mut().enumerate() {
            let agent_actions: AgentMap<Vec<f64>> = (env.agents().iter().enumerate())
                .map(|(agent, name)| {
                    let own = &actions[4 * (3 * world + agent)..][..4];
                    (name.clone(), own.iter().map(|&x| f64::from(x)).collect())
                })
                .collect();
            let flown = env.step(&agent_actions).unwrap();
            for (agent, (_, reward)) in flown.rewards.iter().enumerate() {
                let row = 3 * world + agent;
                assert_eq!(outcome.rewards[row], *reward as f32);
                let name = format!("drone{agent}");
                let (terminated, truncated) = (flown.terminated.get(&name), flown.truncated.get(&name));
                let anybody = flown.terminated.iter().any(|(_, end)| *end);
                let next = match (terminated, truncated) {
                    (Some(true), _) => Next::Terminated,
                    (_, Some(true)) => Next::Truncated,
                    _ if anybody => Next::Truncated,
                    _ => Next::Running,
                };
                assert_eq!(outcome.next[row], next, "step {step}, environment {world}, agent {agent}");
                if next.is_end() {
                    ends += 1;
                    let last: Vec<f32> =
                        flown.observations.get(&name).unwrap().vector.iter().map(|&x| x as f32).collect();
                    assert_eq!(outcome.finals[13 * row..13 * (row + 1)], last);
                }
            }
            if flown.terminated.iter().any(|(_, end)| *end) || env.agents().is_empty() {
                env.reset(None).unwrap();
            }
        }
    }
    assert!(ends >= 6, "{ends}");
}

#[test]
fn batches_that_do_not_fit_the_trainer_are_refused() {
    let batch = |autoreset, kind: &str| {
        let options = EnvConfig::default().observation_type(kind.parse().unwrap());
        let config = VecConfig { autoreset, ..VecConfig::new(2) };
        Batch::new(make_vec("hover", options, config).unwrap(), Terms::default()).map(|_| ()).map_err(|e| e.to_string())
    };
    assert_eq!(batch(Autoreset::SameStep, "kin"), Ok(()));
    for autoreset in [Autoreset::NextStep, Autoreset::Disabled] {
        assert!(batch(autoreset, "kin").unwrap_err().contains("resets in the step that ends an episode"));
    }
    assert!(batch(Autoreset::SameStep, "kin_ranges").unwrap_err().contains("vector alone"));
}

#[test]
fn terms_add_a_penalty_for_leaving_the_bounds_and_limit_episodes_by_environment() {
    let batch = |terms: Terms| {
        let config = VecConfig { autoreset: Autoreset::SameStep, on_fault: OnFault::Truncate, ..VecConfig::new(2) };
        Batch::new(make_vec("hover", EnvConfig::default(), config).unwrap(), terms).unwrap()
    };
    let mut penalized = batch(Terms { out_of_bounds: 50.0, lengths: vec![Some(10), None] });
    let mut free = batch(Terms::default());
    assert_eq!((penalized.longest(0), penalized.longest(1), free.longest(1)), (10, 480, 480));
    let mut outcomes = [Outcome::new(2, 12), Outcome::new(2, 12)];
    penalized.reset(1, &mut outcomes[0].observations).unwrap();
    free.reset(1, &mut outcomes[1].observations).unwrap();
    loop {
        let [first, second] = &mut outcomes;
        penalized.step(&[1.0; 8], first).unwrap();
        free.step(&[1.0; 8], second).unwrap();
        if second.next[0] == Next::Terminated {
            break;
        }
        assert_eq!(first.rewards, second.rewards);
    }
    assert_eq!(outcomes[0].rewards[0], outcomes[1].rewards[0] - 50.0, "above 3 m");
}
