use rand::SeedableRng as _;

use super::{AgentMap, ParallelEnv, ParallelStep};
use crate::env::{CheckFailure, EndReason, EnvError, ObservationSpace, Rng};
use crate::observation::Observation;

/// Checks that an environment satisfies the contract of [`ParallelEnv`], similar to PettingZoo's parallel API test.
/// The check runs `episodes` episodes under random actions.
///
/// - All possible agents are live after a reset. No agent rejoins during an episode.
/// - The five maps of a step cover exactly the agents that were live before it.
/// - Observations and actions are contained in the spaces of the agent, in single precision as well. Rewards are
///   finite.
/// - An agent leaves exactly when it is terminated or truncated, and its info holds the reason.
/// - A missing action and an action for an unknown agent are errors that change nothing.
/// - Episodes with the same seed are bit-identical.
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
/// [`CheckFailure`] with the first requirement that the environment violates.
pub fn check_parallel_env(env: &mut dyn ParallelEnv, episodes: u64) -> Result<(), CheckFailure> {
    let task = env.name();
    let check = |good: bool, what: &str| {
        if good { Ok(()) } else { Err(CheckFailure::Broken { task, what: what.into() }) }
    };
    check(!env.possible_agents().is_empty(), "possible_agents is empty")?;
    check(env.action_space("nobody").is_none(), "action_space returns a space for an unknown agent")?;
    for seed in 0..episodes.max(1) {
        let first = episode(env, seed)?;
        check(first == episode(env, seed)?, "two episodes with one seed differ")?;
    }
    Ok(())
}

/// Failure of an observation outside its space.
const OUTSIDE: &str = "an observation is outside the agent's observation space";

/// Returns true if a space contains an observation, in single precision as well.
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
    check(env.agents() == env.possible_agents(), "not all possible agents are live after reset")?;
    check(
        observations.agents().eq(env.agents()) && infos.agents().eq(env.agents()),
        "reset does not return an observation and an info for every agent",
    )?;
    for (agent, observation) in observations.iter() {
        let space = env.observation_space(agent);
        check(space.is_some_and(|space| holds(space, observation)), OUTSIDE)?;
    }
    let mut steps = Vec::new();
    while !env.agents().is_empty() && steps.len() < 400 {
        let before = env.agents().to_vec();
        let mut actions = Vec::new();
        for agent in &before {
            let Some(space) = env.action_space(agent) else {
                return check(false, "a live agent has no action space").map(|()| steps);
            };
            check(space.size() > 0, "the action space of an agent is empty")?;
            actions.push((agent.clone(), space.sample(&mut rng)));
        }
        if steps.is_empty() {
            let nobody = actions.iter().cloned().chain([("nobody".into(), vec![0.0; 4])]).collect();
            check(matches!(env.step(&nobody), Err(EnvError::Agent { .. })), "step accepts an unknown agent's action")?;
            let missing = actions[1..].iter().cloned().collect();
            check(matches!(env.step(&missing), Err(EnvError::Agent { .. })), "step accepts a missing action")?;
            let mut bad = actions.clone();
            bad[0].1[0] = f64::NAN;
            let bad = bad.into_iter().collect();
            check(env.step(&bad).is_err(), "step accepts an action that is not finite")?;
            check(env.simulation().control_steps() == 0, "a rejected action advances the simulation")?;
        }
        let actions: AgentMap<_> = actions.into_iter().collect();
        let step = env.step(&actions).map_err(failed)?;
        let about_all = step.observations.agents().eq(&before)
            && step.rewards.agents().eq(&before)
            && step.terminated.agents().eq(&before)
            && step.truncated.agents().eq(&before)
            && step.infos.agents().eq(&before);
        check(about_all, "the maps of a step do not cover exactly the agents that were live before it")?;
        for agent in &before {
            let space = env.observation_space(agent);
            let (seen, reward) = (step.observations.get(agent), step.rewards.get(agent));
            check(space.zip(seen).is_some_and(|(space, seen)| holds(space, seen)), OUTSIDE)?;
            check(reward.is_some_and(|reward| reward.is_finite()), "a reward is not finite")?;
            let over = step.terminated.get(agent) == Some(&true) || step.truncated.get(agent) == Some(&true);
            check(over != env.agents().contains(agent), "an agent is live after its end, or left before its end")?;
            let reason = step.infos.get(agent).and_then(|info| info.end);
            check(over == reason.is_some(), "an agent leaves without a reason, or has a reason and stays")?;
            let cut_off = step.terminated.get(agent) == Some(&false) && over;
            check(!over || (reason == Some(EndReason::TimeLimit)) == cut_off, "an agent leaves for the wrong reason")?;
        }
        check(env.agents().iter().all(|agent| before.contains(agent)), "an agent rejoined the episode")?;
        steps.push(step);
    }
    if env.agents().is_empty() {
        let nothing = AgentMap::default();
        check(matches!(env.step(&nothing), Err(EnvError::NeedsReset { .. })), "step succeeds without live agents")?;
    }
    Ok(steps)
}
