use rand::SeedableRng as _;

use super::{AgentMap, ParallelEnv, ParallelStep};
use crate::env::{CheckFailure, EndReason, EnvError, ObservationSpace, Rng};
use crate::observation::Observation;

/// Checks that an environment keeps the contract of [`ParallelEnv`], in the spirit of PettingZoo's parallel API test: it
/// flies `episodes` episodes under random actions.
///
/// - after a reset all possible agents are live; nobody comes back within an episode
/// - the five maps of a step are about the agents that were live at its start, and nobody else
/// - observations, in single precision too, and actions are of the agent's spaces, rewards are numbers
/// - an agent leaves exactly when it is terminated or truncated, and its info says why
/// - an action that is missing or for nobody is an error that changes nothing
/// - the same seed gives the same episode to the bit
///
/// ```
/// use aviary::multi_agent::{ParallelAviary, check_parallel_env};
/// use aviary::tasks::MultiHover;
///
/// check_parallel_env(&mut ParallelAviary::new(MultiHover::builder().build()?), 2)?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// The first promise that was not kept.
pub fn check_parallel_env(env: &mut dyn ParallelEnv, episodes: u64) -> Result<(), CheckFailure> {
    let task = env.name();
    let check = |good: bool, what: &str| {
        if good { Ok(()) } else { Err(CheckFailure::Broken { task, what: what.into() }) }
    };
    check(!env.possible_agents().is_empty(), "there are no agents")?;
    check(env.action_space("nobody").is_none(), "an agent that cannot be has a space")?;
    for seed in 0..episodes.max(1) {
        let first = episode(env, seed)?;
        check(first == episode(env, seed)?, "two episodes with one seed differ")?;
    }
    Ok(())
}

/// Returns whether an observation is of a space, in single precision too.
fn holds(space: &ObservationSpace, observation: &Observation) -> bool {
    let mut row = vec![0.0; space.vector.size()];
    space.contains(observation) && {
        space.vector.write_f32(&observation.vector, &mut row);
        space.vector.contains(&row)
    }
}

fn episode(env: &mut dyn ParallelEnv, seed: u64) -> Result<Vec<ParallelStep>, CheckFailure> {
    let task = env.name();
    let check = |good: bool, what: &str| {
        if good { Ok(()) } else { Err(CheckFailure::Broken { task, what: what.into() }) }
    };
    let failed = |error| CheckFailure::Error { task, during: "an episode under random actions", error };
    let mut rng = Rng::seed_from_u64(seed);
    let (observations, infos) = env.reset(Some(seed)).map_err(failed)?;
    check(env.agents() == env.possible_agents(), "after a reset not all agents are live")?;
    check(
        observations.agents().eq(env.agents()) && infos.agents().eq(env.agents()),
        "a reset is not about all agents",
    )?;
    for (agent, observation) in observations.iter() {
        let space = env.observation_space(agent);
        check(space.is_some_and(|space| holds(space, observation)), "an observation is not of the agent's space")?;
    }
    let mut steps = Vec::new();
    while !env.agents().is_empty() && steps.len() < 400 {
        let before = env.agents().to_vec();
        let mut actions = Vec::new();
        for agent in &before {
            let Some(space) = env.action_space(agent) else {
                return check(false, "a live agent has no action space").map(|()| steps);
            };
            actions.push((agent.clone(), space.sample(&mut rng)));
        }
        if steps.is_empty() {
            let nobody = actions.iter().cloned().chain([("nobody".into(), vec![0.0; 4])]).collect();
            check(matches!(env.step(&nobody), Err(EnvError::Agent { .. })), "it takes an action for nobody")?;
            let missing = actions[1..].iter().cloned().collect();
            check(matches!(env.step(&missing), Err(EnvError::Agent { .. })), "it does not miss an action")?;
            let mut bad = actions.clone();
            bad[0].1[0] = f64::NAN;
            let bad = bad.into_iter().collect();
            check(env.step(&bad).is_err(), "it takes an action that is not a number")?;
            check(env.simulation().control_steps() == 0, "an action that is an error moves something")?;
        }
        let actions: AgentMap<_> = actions.into_iter().collect();
        let step = env.step(&actions).map_err(failed)?;
        let about_all = step.observations.agents().eq(&before)
            && step.rewards.agents().eq(&before)
            && step.terminated.agents().eq(&before)
            && step.truncated.agents().eq(&before)
            && step.infos.agents().eq(&before);
        check(about_all, "the maps of a step are not about the agents that were live")?;
        for agent in &before {
            let space = env.observation_space(agent);
            let (seen, reward) = (step.observations.get(agent), step.rewards.get(agent));
            check(
                space.zip(seen).is_some_and(|(space, seen)| holds(space, seen)),
                "an observation is not of the agent's space",
            )?;
            check(reward.is_some_and(|reward| reward.is_finite()), "a reward is not a number")?;
            let over = step.terminated.get(agent) == Some(&true) || step.truncated.get(agent) == Some(&true);
            check(over != env.agents().contains(agent), "an agent is live after its end, or gone before it")?;
            let reason = step.infos.get(agent).and_then(|info| info.end);
            check(over == reason.is_some(), "an agent leaves without a reason, or has one and stays")?;
            let cut_off = step.terminated.get(agent) == Some(&false) && over;
            check(!over || (reason == Some(EndReason::TimeLimit)) == cut_off, "an agent leaves for the wrong reason")?;
        }
        check(env.agents().iter().all(|agent| before.contains(agent)), "an agent came back")?;
        steps.push(step);
    }
    if env.agents().is_empty() {
        let nothing = AgentMap::default();
        check(matches!(env.step(&nothing), Err(EnvError::NeedsReset { .. })), "it takes a step without agents")?;
    }
    Ok(steps)
}
