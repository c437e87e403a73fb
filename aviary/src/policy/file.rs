//! Policies as safetensors files: the parameters as tensors, and the metadata as JSON under the key `policy`.

use std::collections::HashMap;
use std::io::Write as _;
use std::path::Path;

use safetensors::{Dtype, SafeTensors, tensor::TensorView};

use super::{Activation, Gru, Mlp, PolicyError, PolicyInfo, PolicyNetwork};
use crate::SystemError;

/// Key of the metadata. A single key keeps the bytes of a file deterministic, because a map has no order.
const KEY: &str = "policy";

/// Content of the metadata.
#[derive(serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    info: PolicyInfo,
    activation: Activation,
}

fn bytes(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|x| x.to_le_bytes()).collect()
}

fn wrong(message: impl std::fmt::Display) -> PolicyError {
    PolicyError::Format { message: message.to_string() }
}

/// Returns the values and the shape of a tensor.
fn numbers(tensors: &SafeTensors<'_>, name: &str) -> Result<(Vec<f32>, Vec<usize>), PolicyError> {
    let view = tensors.tensor(name).map_err(|_| wrong(format_args!("it has no tensor `{name}`")))?;
    if view.dtype() != Dtype::F32 {
        return Err(wrong(format_args!("the tensor `{name}` has the type {:?}, expected F32", view.dtype())));
    }
    let numbers = view.data().chunks_exact(4).map(|x| f32::from_le_bytes([x[0], x[1], x[2], x[3]])).collect();
    Ok((numbers, view.shape().to_vec()))
}

fn vector(tensors: &SafeTensors<'_>, name: &str) -> Result<Vec<f32>, PolicyError> {
    Ok(numbers(tensors, name)?.0)
}

/// Reads the recurrent layer; `None` if no tensor belongs to one.
fn recurrent(tensors: &SafeTensors<'_>) -> Result<Option<Gru>, PolicyError> {
    if !tensors.names().iter().any(|name| name.starts_with("gru.")) {
        return Ok(None);
    }
    let weights = |name: &str| {
        let (weights, shape) = numbers(tensors, name)?;
        match shape[..] {
            [rows, columns] if columns > 0 && columns % 3 == 0 => Ok((weights, rows, columns / 3)),
            _ => Err(wrong(format_args!("the tensor `{name}` has the shape {shape:?}, expected rows of three gates"))),
        }
    };
    let (mut parameters, inputs, units) = weights("gru.input.weight")?;
    parameters.extend(vector(tensors, "gru.input.bias")?);
    let (state_weights, rows, columns) = weights("gru.state.weight")?;
    if (rows, columns) != (units, units) {
        let shape = [rows, 3 * columns];
        return Err(wrong(format_args!(
            "the tensor `gru.state.weight` has the shape {shape:?}, expected {units} units"
        )));
    }
    let biases = vector(tensors, "gru.state.bias")?;
    if biases.len() != 3 * units {
        return Err(wrong(format_args!("`gru.state.bias` has {} numbers, expected {}", biases.len(), 3 * units)));
    }
    parameters.extend(state_weights);
    parameters.extend(biases);
    Ok(Some(Gru::new(inputs, units, &parameters)?))
}

impl PolicyNetwork {
    /// Returns the policy as the bytes of a safetensors file. Equal policies have equal bytes.
    ///
    /// # Errors
    /// [`PolicyError::Value`] if the metadata exceeds the limit of 100 MB for a safetensors header.
    pub fn to_bytes(&self) -> Result<Vec<u8>, PolicyError> {
        let mut tensors: Vec<(String, Vec<usize>, Vec<u8>)> = Vec::new();
        let mut add = |name: &str, shape: &[usize], numbers: &[f32]| {
            tensors.push((name.into(), shape.to_vec(), bytes(numbers)));
        };
        add("observation.mean", &[self.mean.len()], &self.mean);
        add("observation.deviation", &[self.deviation.len()], &self.deviation);
        add("action.low", &[self.low.len()], &self.low);
        add("action.high", &[self.high.len()], &self.high);
        if let Some(gru) = &self.gru {
            let (inputs, units) = (gru.inputs(), gru.units());
            add("gru.input.weight", &[inputs, 3 * units], gru.input_weights());
            add("gru.input.bias", &[3 * units], gru.input_biases());
            add("gru.state.weight", &[units, 3 * units], gru.state_weights());
            add("gru.state.bias", &[3 * units], gru.state_biases());
        }
        let mut left = self.net.parameters();
        for (layer, pair) in self.net.sizes().windows(2).enumerate() {
            let (weights, rest) = left.split_at(pair[0] * pair[1]);
            let (biases, rest) = rest.split_at(pair[1]);
            left = rest;
            add(&format!("layer{layer}.weight"), pair, weights);
            add(&format!("layer{layer}.bias"), &pair[1..], biases);
        }
        let header = Header { info: self.info.clone(), activation: self.net.activation() };
        let header = serde_json::to_string(&header).map_err(wrong)?;
        let size = header.len();
        let views = tensors.iter().filter_map(|(name, shape, data)| {
            TensorView::new(Dtype::F32, shape.clone(), data).ok().map(|view| (name.clone(), view))
        });
        let metadata = HashMap::from([(KEY.to_string(), header)]);
        safetensors::serialize(views, Some(metadata)).map_err(|error| PolicyError::Value {
            what: "the policy's metadata",
            got: format!("{size} bytes of JSON ({error})"),
            expected: "up to 100 MB in a safetensors header".into(),
        })
    }

    /// Reads a policy from the bytes of a safetensors file.
    ///
    /// # Errors
    /// [`PolicyError::Format`] for bytes that are not a policy, and an error of [`new`](Self::new),
    /// [`normalized`](Self::normalized) or [`Mlp::new`] for invalid values.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, PolicyError> {
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(wrong)?;
        let tensors = SafeTensors::deserialize(bytes).map_err(wrong)?;
        let header = metadata.metadata().as_ref().and_then(|metadata| metadata.get(KEY));
        let header = header.ok_or_else(|| wrong("its metadata has no `policy`"))?;
        // the version comes first, because a later one may have keys that are unknown here
        let json: serde_json::Value = serde_json::from_str(header).map_err(wrong)?;
        if let Some(version) =
            json["info"]["version"].as_u64().filter(|&version| version > PolicyInfo::RECURRENT_VERSION.into())
        {
            let latest = PolicyInfo::RECURRENT_VERSION;
            return Err(wrong(format_args!("its version is {version}, expected up to {latest}")));
        }
        let Header { info, activation } = serde_json::from_str(header).map_err(wrong)?;
        let (mut sizes, mut parameters) = (Vec::new(), Vec::new());
        for layer in 0..=Mlp::MAX_LAYERS {
            let name = format!("layer{layer}.weight");
            if layer > 0 && tensors.tensor(&name).is_err() {
                break;
            }
            let (weights, shape) = numbers(&tensors, &name)?;
            let &[inputs, outputs] = &shape[..] else {
                return Err(wrong(format_args!(
                    "the tensor `{name}` has the shape {shape:?}, expected two dimensions"
                )));
            };
            if let Some(before) = sizes.last()
                && *before != inputs
            {
                return Err(wrong(format_args!(
                    "the tensor `{name}` has the shape {shape:?}, expected {before} inputs"
                )));
            }
            if sizes.is_empty() {
                sizes.push(inputs);
            }
            sizes.push(outputs);
            let biases = vector(&tensors, &format!("layer{layer}.bias"))?;
            if biases.len() != outputs {
                return Err(wrong(format_args!(
                    "`layer{layer}.bias` has {} numbers, expected {outputs}",
                    biases.len()
                )));
            }
            parameters.extend(weights);
            parameters.extend(biases);
        }
        let net = Mlp::new(&sizes, activation, &parameters)?;
        let gru = recurrent(&tensors)?;
        let scale = [vector(&tensors, "observation.mean")?, vector(&tensors, "observation.deviation")?];
        let bounds = [vector(&tensors, "action.low")?, vector(&tensors, "action.high")?];
        Self::from_parts(info, gru, net, scale, bounds)
    }

    /// Writes the policy to a file, atomically.
    ///
    /// # Errors
    /// [`PolicyError::File`], with the file unchanged.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<(), PolicyError> {
        let path = path.as_ref();
        let in_file = |error| PolicyError::File { path: path.into(), error: Box::new(error) };
        let bytes = self.to_bytes().map_err(in_file)?;
        write_whole(path, &bytes).map_err(|error| in_file(SystemError::from(error).into()))
    }

    /// Reads a policy from a file.
    ///
    /// # Errors
    /// [`PolicyError::File`] with the path, around an error of [`from_bytes`](Self::from_bytes) or of the system.
    pub fn load(path: impl AsRef<Path>) -> Result<Self, PolicyError> {
        let path = path.as_ref();
        let in_file = |error| PolicyError::File { path: path.into(), error: Box::new(error) };
        let bytes = std::fs::read(path).map_err(|error| in_file(SystemError::from(error).into()))?;
        Self::from_bytes(&bytes).map_err(in_file)
    }
}

/// Writes a file atomically: it is renamed into place when it is complete.
fn write_whole(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let directory = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    // the permissions of a regular new file, reduced by the umask
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt as _;
        builder.permissions(std::fs::Permissions::from_mode(0o666));
    }
    let mut file = builder.tempfile_in(directory)?;
    file.write_all(bytes)?;
    file.persist(path)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn policy() -> PolicyNetwork {
        let info = PolicyInfo {
            version: 2,
            task: "hover".into(),
            drone: "cf2x".into(),
            num_drones: 1,
            per_drone: false,
            action_type: "rpm".into(),
            sim_freq: 240,
            ctrl_freq: 48,
            seed: 7,
            steps: 1000,
            command: "aviary train --task hover".into(),
            made_by: "a test".into(),
            training: Some("physics = \"mjc\"\n".into()),
        };
        let sizes = [3, 5, 2];
        let parameters: Vec<f32> = (0..Mlp::count(&sizes)).map(|k| (k as f32).sin()).collect();
        let net = Mlp::new(&sizes, Activation::Softsign, &parameters).unwrap();
        let bounds = [vec![-1.0, f32::NEG_INFINITY], vec![3.0, f32::INFINITY]];
        PolicyNetwork::from_parts(info, None, net, [vec![0.1, 0.2, 0.3], vec![1.0, 2.0, 3.0]], bounds).unwrap()
    }

    /// The policy with a recurrent layer of four units.
    fn recurrent_policy() -> PolicyNetwork {
        let PolicyNetwork { info, mean, deviation, low, high, .. } = policy();
        let wave = |count: usize| (0..count).map(|k| (1.7 * k as f32).sin()).collect::<Vec<f32>>();
        let gru = Gru::new(3, 4, &wave(Gru::count(3, 4))).unwrap();
        let net = Mlp::new(&[7, 5, 2], Activation::Softsign, &wave(Mlp::count(&[7, 5, 2]))).unwrap();
        let info = PolicyInfo { version: PolicyInfo::RECURRENT_VERSION, ..info };
        PolicyNetwork::from_parts(info, Some(gru), net, [mean, deviation], [low, high]).unwrap()
    }

    #[test]
    fn recurrent_policies_round_trip_and_act_by_their_memory() {
        let policy = recurrent_policy();
        assert_eq!(PolicyNetwork::from_bytes(&policy.to_bytes().unwrap()).unwrap(), policy);
        // two drones at once and one after the other
        let observations = [0.3, -0.2, 0.5, 1.0, 2.0, -1.0];
        let (mut both, mut actions) = ([0.0; 8], [0.0; 4]);
        for _ in 0..3 {
            policy.forward_with(&observations, &mut both, &mut actions);
        }
        for drone in 0..2 {
            let (mut memory, mut action, mut first) = ([0.0; 4], [0.0; 2], None);
            for _ in 0..3 {
                policy.forward_with(&observations[3 * drone..][..3], &mut memory, &mut action);
                first.get_or_insert(action);
            }
            assert_eq!((&memory[..], &action[..]), (&both[4 * drone..][..4], &actions[2 * drone..][..2]));
            assert_ne!(first, Some(action), "the action does not depend on the memory");
        }
        // the network reads the normalized observation and then the next state
        let (mut state, mut features) = ([0.0; 4], [0.2, -0.2, 0.2 / 3.0, 0.0, 0.0, 0.0, 0.0]);
        policy.recurrent().unwrap().forward(&features[..3], &mut state);
        features[3..].copy_from_slice(&state);
        let (mut plain, mut memory, mut action) = ([0.0; 2], [0.0; 4], [0.0; 2]);
        policy.net().forward(&features, &mut plain);
        policy.forward_with(&observations[..3], &mut memory, &mut action);
        assert!((action[1] - f64::from(plain[1])).abs() < 1e-6, "{action:?} {plain:?}");
    }

    #[test]
    fn damaged_recurrent_layers_are_errors() {
        let bytes = recurrent_policy().to_bytes().unwrap();
        let text = |bytes: &[u8]| PolicyNetwork::from_bytes(bytes).unwrap_err().to_string();
        // a name of equal length in the header
        for name in ["gru.input.weight", "gru.input.bias", "gru.state.weight", "gru.state.bias"] {
            let place = bytes.windows(name.len()).position(|part| part == name.as_bytes()).unwrap();
            let mut damaged = bytes.clone();
            damaged[place + 4] = b'_';
            assert!(text(&damaged).contains(&format!("no tensor `{name}`")), "{}", text(&damaged));
        }
    }

    #[test]
    fn policies_round_trip_with_equal_bytes() {
        let policy = policy();
        let bytes = policy.to_bytes().unwrap();
        assert_eq!(bytes, policy.clone().to_bytes().unwrap());
        assert_eq!(PolicyNetwork::from_bytes(&bytes).unwrap(), policy);
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("policy.safetensors");
        policy.save(&path).unwrap();
        assert_eq!(PolicyNetwork::load(&path).unwrap(), policy);
        let error = policy.save(directory.path().join("nowhere/policy")).unwrap_err().to_string();
        assert!(error.contains("nowhere"), "{error}");
    }

    #[test]
    fn actions_are_scaled_to_finite_bounds_and_clipped() {
        let policy = policy();
        let mut action = [0.0; 2];
        policy.forward(&[0.5, -0.4, 1.0], &mut action);
        let mut plain = [0.0; 2];
        policy.net.forward(&[0.4, -0.3, 0.7 / 3.0], &mut plain);
        assert!((action[0] - f64::from((1.0 + 2.0 * plain[0]).clamp(-1.0, 3.0))).abs() < 1e-6);
        assert!((action[1] - f64::from(plain[1])).abs() < 1e-6);
        // normalized observations are clipped
        policy.forward(&[1e30, -1e30, 0.0], &mut action);
        assert!(action[0] >= -1.0 && action[0] <= 3.0 && action[1].is_finite());
    }

    #[test]
    fn numbers_of_drones_that_no_simulation_has_are_errors() {
        let policy = policy();
        for num_drones in [0, 257, usize::MAX] {
            let info = PolicyInfo { num_drones, ..policy.info.clone() };
            let bytes = PolicyNetwork { info, ..policy.clone() }.to_bytes().unwrap();
            let error = PolicyNetwork::from_bytes(&bytes).unwrap_err().to_string();
            assert_eq!(error, format!("the number of drones is {num_drones}, expected 1 to 256"));
        }
    }

    #[test]
    fn errors_name_the_missing_or_invalid_part() {
        let refused = |bytes: &[u8]| PolicyNetwork::from_bytes(bytes).unwrap_err().to_string();
        assert!(refused(b"").starts_with("not a policy"));
        assert!(refused(b"{\"task\": \"hover\"}").starts_with("not a policy"));
        let data = bytes(&[1.0, 2.0]);
        let view = TensorView::new(Dtype::F32, vec![2], &data).unwrap();
        let other = safetensors::serialize([("weights", view)], None).unwrap();
        assert!(refused(&other).contains("its metadata has no `policy`"));
        let later = PolicyNetwork { info: PolicyInfo { version: 4, ..policy().info }, ..policy() };
        assert!(refused(&later.to_bytes().unwrap()).contains("its version is 4, expected up to 3"));
        // a program that knows versions up to 2 must refuse a recurrent policy
        for (version, policy) in [(3, policy()), (2, recurrent_policy())] {
            let other = PolicyNetwork { info: PolicyInfo { version, ..policy.info.clone() }, ..policy };
            assert!(refused(&other.to_bytes().unwrap()).contains("the version is"), "{version}");
        }
        let flat = PolicyNetwork { deviation: vec![1.0, 0.0, 1.0], ..policy() };
        assert!(refused(&flat.to_bytes().unwrap()).contains("a deviation is 0, expected a positive number"));
        let short = PolicyNetwork { mean: vec![0.0; 2], deviation: vec![1.0; 2], ..policy() };
        let short = refused(&short.to_bytes().unwrap());
        assert!(short.contains("network"), "{short}");
    }

    #[test]
    fn policies_of_version_1_round_trip() {
        let old = PolicyNetwork { info: PolicyInfo { version: 1, training: None, ..policy().info }, ..policy() };
        let bytes = old.to_bytes().unwrap();
        assert!(!String::from_utf8_lossy(&bytes).contains("training"), "no key that version 1 does not know");
        assert_eq!(PolicyNetwork::from_bytes(&bytes).unwrap(), old);
    }

    #[test]
    fn metadata_larger_than_a_header_is_an_error() {
        let command = "x".repeat(100_000_001);
        let large = PolicyNetwork { info: PolicyInfo { command, ..policy().info }, ..policy() };
        let error = large.to_bytes().unwrap_err().to_string();
        assert!(error.contains("the policy's metadata") && error.contains("up to 100 MB"), "{error}");
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("policy.safetensors");
        assert!(large.save(&path).unwrap_err().to_string().contains("policy.safetensors"));
        assert!(!path.exists());
    }

    proptest! {
        #[test]
        fn damaged_files_are_errors_or_valid_policies(
            changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..4),
            length in any::<prop::sample::Index>(),
            cut in any::<bool>(),
            has_memory in any::<bool>(),
        ) {
            let mut bytes = if has_memory { recurrent_policy() } else { policy() }.to_bytes().unwrap();
            for (place, byte) in changes {
                let place = place.index(bytes.len());
                bytes[place] = byte;
            }
            if cut {
                bytes.truncate(length.index(bytes.len()));
            }
            if let Ok(policy) = PolicyNetwork::from_bytes(&bytes) {
                // huge parameters can give NaN actions, which environments reject
                let mut action = vec![0.0; policy.action_size()];
                let mut memory = vec![0.0; policy.memory_size()];
                policy.forward_with(&vec![0.5; policy.observation_size()], &mut memory, &mut action);
                prop_assert_eq!(PolicyNetwork::from_bytes(&policy.to_bytes().unwrap()).unwrap(), policy);
            }
        }
    }
}
