//! Memory that a batch needs and that the process may use.

use std::fs;

use aviary::env::{EnvConfig, EnvError};
use aviary::vector::{VecConfig, VecEnv, make_vec};

/// Environments of the probe, one block. A batch of at most as many is created without a check.
const PROBE: usize = 8;

/// Returns an error message if the environments of a batch and the arrays of a step do not fit into the memory that is
/// available.
pub fn check(task: &str, config: &EnvConfig, batch: VecConfig) -> Result<Option<String>, EnvError> {
    if batch.environments <= PROBE {
        return Ok(None);
    }
    let probe = make_vec(task, config.clone(), VecConfig { threads: 1, environments: PROBE, ..batch })?;
    let bytes = probe.bytes_per_env() + bytes_of_results(&*probe);
    let Some(available) = available() else { return Ok(None) };
    let most = available / bytes as u64;
    if batch.environments as u64 <= most {
        return Ok(None);
    }
    Ok(Some(format!(
        "num_envs is {}, expected at most {most} for {:.1} GB of free memory: an environment takes {bytes} bytes",
        batch.environments,
        available as f64 / 1e9
    )))
}

/// Returns the bytes of the results of a step per environment.
fn bytes_of_results(env: &dyn VecEnv) -> usize {
    let space = env.observation_space();
    let entries = |shape: &[usize]| shape.iter().product::<usize>();
    let rgb = space.rgb_shape().map_or(0, |shape| entries(&shape));
    let depth = space.depth_shape().map_or(0, |shape| entries(&shape));
    let segmentation = space.segmentation_shape().map_or(0, |shape| entries(&shape));
    // numbers, reward and two flags
    4 * env.observation_size() + 6 + rgb + 4 * depth + 4 * segmentation
}

/// Returns the memory that the process can still allocate, bytes: the free memory of the machine, within the limits of
/// its control group and of its address space. Returns `None` if the system does not report it.
fn available() -> Option<u64> {
    let field = |path: &str, name: &str| -> Option<u64> {
        let text = fs::read_to_string(path).ok()?;
        let line = text.lines().find_map(|line| line.strip_prefix(name))?;
        line.split_whitespace().next()?.parse().ok()
    };
    let machine = field("/proc/meminfo", "MemAvailable:")? * 1024;
    let group = fs::read_to_string("/sys/fs/cgroup/memory.max").ok().and_then(|text| text.trim().parse().ok());
    let space = field("/proc/self/limits", "Max address space").map(|limit| {
        let used = field("/proc/self/status", "VmSize:").unwrap_or(0) * 1024;
        limit.saturating_sub(used)
    });
    [group, space].into_iter().flatten().chain([machine]).min()
}
