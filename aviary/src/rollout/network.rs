//! Policies of trained networks.

use std::borrow::Borrow;

use super::{Policy, PolicySnapshot, RolloutError};
use crate::env::DroneEnv;
use crate::policy::PolicyNetwork;

/// Flies a trained network, and holds its memory. [`PolicyNetwork::pilot`] and [`PolicyNetwork::into_pilot`] create it.
///
/// A policy without memory depends only on the observation. The memory of a recurrent one is cleared when an episode
/// starts. A policy that is [`per_drone`](crate::policy::PolicyInfo::per_drone) has a memory for every drone. Threads
/// can share a network, each with its own pilot.
#[derive(Debug, Clone, PartialEq)]
pub struct NetworkPolicy<N> {
    network: N,
    /// Concatenated memories.
    memory: Vec<f32>,
}

impl PolicyNetwork {
    /// Returns a policy that flies this network with its own memory.
    ///
    /// ```
    /// use aviary::policy::PolicyNetwork;
    /// use aviary::rollout::fly_episode;
    /// use aviary::tasks::Hover;
    ///
    /// let policy = PolicyNetwork::load(concat!(env!("CARGO_MANIFEST_DIR"), "/../assets/policies/hover.safetensors"))?;
    /// let mut env = Hover::builder().build()?;
    /// let summary = fly_episode(&mut env, &mut policy.pilot(), Some(1))?;
    /// assert!(summary.steps == 480);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn pilot(&self) -> NetworkPolicy<&Self> {
        NetworkPolicy { network: self, memory: Vec::new() }
    }

    /// Returns a policy that owns this network.
    pub fn into_pilot(self) -> NetworkPolicy<Self> {
        NetworkPolicy { network: self, memory: Vec::new() }
    }
}

impl<N: Borrow<PolicyNetwork>> NetworkPolicy<N> {
    /// Returns the network.
    pub fn network(&self) -> &PolicyNetwork {
        self.network.borrow()
    }

    /// Returns the size of the memories for an environment.
    fn size(&self, env: &dyn DroneEnv) -> usize {
        let network = self.network();
        let count = if network.info().per_drone { env.simulation().num_drones() } else { 1 };
        count * network.memory_size()
    }
}

/// Snapshot of a memory.
struct Memory(Vec<f32>);

impl<N: Borrow<PolicyNetwork>> Policy for NetworkPolicy<N> {
    fn reset(&mut self, env: &dyn DroneEnv) -> Result<(), RolloutError> {
        self.network().check(env)?;
        let size = self.size(env);
        self.memory.clear();
        self.memory.resize(size, 0.0);
        Ok(())
    }

    fn act(&mut self, env: &dyn DroneEnv, action: &mut [f64]) -> Result<(), RolloutError> {
        if self.memory.len() != self.size(env) {
            // another environment, or none so far
            self.reset(env)?;
        }
        self.network.borrow().forward_with(&env.observation().vector, &mut self.memory, action);
        Ok(())
    }

    /// Clears the memory of one drone. A memory that several drones share stays as it is.
    fn reset_drone(&mut self, env: &dyn DroneEnv, drone: usize) -> Result<(), RolloutError> {
        let size = self.network().memory_size();
        if self.network().info().per_drone || env.simulation().num_drones() == 1 {
            for x in self.memory.iter_mut().skip(drone * size).take(size) {
                *x = 0.0;
            }
        }
        Ok(())
    }

    fn snapshot(&self) -> PolicySnapshot {
        match self.network().recurrent() {
            None => PolicySnapshot::default(),
            Some(_) => PolicySnapshot::new(Memory(self.memory.clone())),
        }
    }

    fn restore(&mut self, snapshot: &PolicySnapshot) -> Result<(), RolloutError> {
        let size = self.network().memory_size();
        if size == 0 {
            return if snapshot.is_empty() { Ok(()) } else { Err(RolloutError::Snapshot) };
        }
        let Memory(memory) = snapshot.own()?;
        if memory.len() % size != 0 || (memory.len() != self.memory.len() && !self.memory.is_empty()) {
            return Err(RolloutError::Snapshot);
        }
        self.memory.clone_from(memory);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::env::{Aviary, Env as _};
    use crate::policy::{Activation, Gru, Mlp, PolicyInfo};
    use crate::rollout::Rollout;
    use crate::tasks::{Hover, MultiHover};

    /// Returns a policy with four units for the observation and action sizes of one drone.
    fn recurrent(observation: usize, action: usize, per_drone: bool) -> PolicyNetwork {
        let version = PolicyInfo::RECURRENT_VERSION;
        let info = PolicyInfo { version, per_drone, ..PolicyInfo::of_task("hover") };
        let wave = |count: usize| (0..count).map(|k| 0.2 * (1.7 * k as f32).sin()).collect::<Vec<f32>>();
        let gru = Gru::new(observation, 4, &wave(Gru::count(observation, 4))).unwrap();
        let sizes = [observation + 4, action];
        let net = Mlp::new(&sizes, Activation::Relu, &wave(Mlp::count(&sizes))).unwrap();
        let space = |size| crate::env::BoxSpace::new(vec![[-1.0, 1.0]; size]);
        PolicyNetwork::new_recurrent(info, gru, net, space(observation), space(action)).unwrap()
    }

    fn states(rollout: &mut Rollout<Aviary<Hover>, NetworkPolicy<PolicyNetwork>>) -> Vec<crate::state::DroneState> {
        (0..5)
            .map(|_| {
                rollout.step().unwrap();
                rollout.env().simulation().states()[0]
            })
            .collect()
    }

    #[test]
    fn memories_start_at_zero_and_are_part_of_snapshots() {
        // the policy turns the drone over
        let upside_down = |hover: &mut Hover| hover.crash.max_tilt = std::f64::consts::PI;
        let env = Hover::builder().initial_positions([[0.0, 0.0, 2.0]]).task(upside_down).build().unwrap();
        let mut rollout = Rollout::start(env, recurrent(12, 4, false).into_pilot(), Some(1)).unwrap();
        let first = states(&mut rollout);
        let snapshot = rollout.snapshot();
        let second = states(&mut rollout);
        rollout.restore(&snapshot).unwrap();
        assert_eq!(states(&mut rollout), second);
        rollout.restart(Some(1)).unwrap();
        assert_eq!(states(&mut rollout), first);

        // the memory of another policy, or none
        let mut pilot = recurrent(12, 4, false).into_pilot();
        assert_eq!(pilot.restore(&PolicySnapshot::default()), Err(RolloutError::Snapshot));
        assert_eq!(pilot.restore(&PolicySnapshot::new(Memory(vec![0.0; 6]))), Err(RolloutError::Snapshot));
        assert_eq!(pilot.restore(&rollout.policy().snapshot()), Ok(()));
    }

    #[test]
    fn every_drone_of_a_shared_policy_has_its_own_memory() {
        let mut env = MultiHover::builder().num_drones(3).build().unwrap();
        let size = env.observation_space().vector.size() / 3;
        let network = recurrent(size, 4, true);
        let mut pilot = network.pilot();
        env.reset(Some(1)).unwrap();
        pilot.reset(&env).unwrap();
        let mut action = [0.0; 12];
        for _ in 0..3 {
            pilot.act(&env, &mut action).unwrap();
            env.step(&action).unwrap();
        }
        let before = pilot.memory.clone();
        assert_eq!(before.len(), 12);
        assert!(before.iter().all(|x| *x != 0.0));
        pilot.reset_drone(&env, 1).unwrap();
        assert_eq!(pilot.memory[4..8], [0.0; 4]);
        assert_eq!([&pilot.memory[..4], &pilot.memory[8..]], [&before[..4], &before[8..]]);
    }
}
