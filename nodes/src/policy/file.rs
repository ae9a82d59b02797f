//! Reads a policy from a safetensors file, and says what is wrong with one that is none.

use std::collections::HashMap;
use std::io;
use std::path::{Path, PathBuf};

use parallax_model::system::Suggestion;
use parallax_runtime::node::Layout;
use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors, TensorView};

use super::network::{Activation, Layer, Network, Scaling};

/// What stands under the key `format`.
const FORMAT: &str = "parallax-policy-1";

/// Every key of the metadata.
const KEYS: [&str; 14] = [
    "format",
    "activation",
    "output_activation",
    "observations",
    "actions",
    "past_observations",
    "past_actions",
    "observation_mean",
    "observation_std",
    "observation_clip",
    "action_scale",
    "action_offset",
    "action_low",
    "action_high",
];

/// Why a file holds no policy for these messages.
#[derive(Debug, thiserror::Error)]
pub enum PolicyError {
    /// It cannot be read.
    #[error("the policy {path} cannot be read: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's answer.
        source: io::Error,
    },
    /// It is no safetensors file, or a damaged one.
    #[error("{path} is no safetensors file: {source}")]
    Container {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: SafeTensorError,
    },
    /// Its metadata do not say what a policy needs, or not so that it can be understood.
    #[error("the policy {path}: its metadata's `{key}` {problem}")]
    Metadata {
        /// The file.
        path: PathBuf,
        /// The key.
        key: String,
        /// What is wrong, and what should stand there.
        problem: String,
    },
    /// A tensor is missing or does not fit.
    #[error("the policy {path}: the tensor `{tensor}` {problem}")]
    Tensor {
        /// The file.
        path: PathBuf,
        /// Its name.
        tensor: String,
        /// What is wrong, and what should be there.
        problem: String,
    },
}

/// What is in a file.
pub(super) struct Contents {
    pub(super) network: Network,
    pub(super) observations: Box<[Source]>,
    pub(super) actions: Box<[usize]>,
    pub(super) past_observations: usize,
    pub(super) past_actions: usize,
}

/// Where an observation comes from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Source {
    Leaf(usize),
    Sine(usize),
    Cosine(usize),
}

impl Source {
    #[inline]
    pub(super) fn value(self, leaves: &[f64]) -> f64 {
        match self {
            Self::Leaf(leaf) => leaves[leaf],
            Self::Sine(leaf) => leaves[leaf].sin(),
            Self::Cosine(leaf) => leaves[leaf].cos(),
        }
    }

    pub(super) fn describe(self, layout: &Layout) -> String {
        match self {
            Self::Leaf(leaf) => layout.leaves[leaf].clone(),
            Self::Sine(leaf) => format!("sin({})", layout.leaves[leaf]),
            Self::Cosine(leaf) => format!("cos({})", layout.leaves[leaf]),
        }
    }

    fn from_name(name: &str, layout: &Layout) -> Option<Self> {
        let inside = |function: &str| name.strip_prefix(function)?.strip_prefix('(')?.strip_suffix(')');
        match (inside("sin"), inside("cos")) {
            (Some(leaf), _) => layout.leaf(leaf.trim()).map(Self::Sine),
            (_, Some(leaf)) => layout.leaf(leaf.trim()).map(Self::Cosine),
            _ => layout.leaf(name).map(Self::Leaf),
        }
    }
}

/// A file being read.
struct Reader<'a> {
    path: &'a Path,
    tensors: SafeTensors<'a>,
    metadata: HashMap<String, String>,
}

pub(super) fn read(path: &Path, observed: &Layout, sent: &Layout) -> Result<Contents, PolicyError> {
    let bytes = std::fs::read(path).map_err(|source| PolicyError::Io { path: path.into(), source })?;
    let container = |source| PolicyError::Container { path: path.into(), source };
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(container)?;
    let metadata = header.metadata().clone().unwrap_or_default();
    let tensors = SafeTensors::deserialize(&bytes).map_err(container)?;
    Reader { path, tensors, metadata }.contents(observed, sent)
}

impl Reader<'_> {
    fn metadata(&self, key: &str, problem: impl Into<String>) -> PolicyError {
        PolicyError::Metadata { path: self.path.into(), key: key.into(), problem: problem.into() }
    }

    fn tensor(&self, tensor: &str, problem: impl Into<String>) -> PolicyError {
        PolicyError::Tensor { path: self.path.into(), tensor: tensor.into(), problem: problem.into() }
    }

    fn contents(&self, observed: &Layout, sent: &Layout) -> Result<Contents, PolicyError> {
        match self.metadata.get("format").map(String::as_str) {
            Some(FORMAT) => {}
            Some(other) => {
                return Err(self.metadata("format", format!("is `{other}`; this program reads `{FORMAT}`")));
            }
            None => return Err(self.metadata("format", format!("is missing; it should be `{FORMAT}`"))),
        }
        let mut unknown: Vec<&String> =
            self.metadata.keys().filter(|key| !KEYS.contains(&key.as_str())).collect();
        unknown.sort();
        if let Some(key) = unknown.first() {
            let suggestion = Suggestion::nearest(key, KEYS);
            return Err(self.metadata(key, format!("is nothing that is known here{suggestion}")));
        }
        let layers = self.layers()?;
        let (inputs, outputs) = match (layers.first(), layers.last()) {
            (Some(first), Some(last)) => (first.inputs, last.outputs),
            _ => return Err(self.tensor("layers.0.weight", "is missing")),
        };
        let observations = self.observations(observed)?;
        if observations.is_empty() {
            return Err(self.metadata("observations", "names nothing: a policy has to see something"));
        }
        let actions = self.actions(sent)?;
        let (past_observations, past_actions) =
            (self.count("past_observations")?, self.count("past_actions")?);
        // A history that no network could be as wide as must not wrap around either.
        let expected = observations
            .len()
            .saturating_mul(past_observations.saturating_add(1))
            .saturating_add(actions.len().saturating_mul(past_actions));
        if expected != inputs {
            let names: Vec<String> = observations.iter().map(|source| source.describe(observed)).collect();
            let past = match (past_observations, past_actions) {
                (0, 0) => String::new(),
                _ => format!(
                    "; with {past_observations} past ones and {past_actions} past actions that makes {expected}"
                ),
            };
            return Err(self.tensor(
                "layers.0.weight",
                format!(
                    "has {inputs} inputs, and there are {} observations: {}{past}",
                    names.len(),
                    names.join(", ")
                ),
            ));
        }
        if actions.len() != outputs {
            let names: Vec<&str> = actions.iter().map(|leaf| sent.leaves[*leaf].as_str()).collect();
            let last = format!("layers.{}.weight", layers.len() - 1);
            return Err(self.tensor(
                &last,
                format!("has {outputs} outputs, and there are {} actions: {}", names.len(), names.join(", ")),
            ));
        }
        let (before, behind) = (self.before(inputs)?, self.behind(outputs)?);
        let network = Network::new(layers, before, behind);
        Ok(Contents {
            network,
            observations: observations.into(),
            actions: actions.into(),
            past_observations,
            past_actions,
        })
    }

    /// A whole number; zero where there is none.
    fn count(&self, key: &str) -> Result<usize, PolicyError> {
        let Some(text) = self.metadata.get(key) else { return Ok(0) };
        text.parse()
            .map_err(|_| self.metadata(key, format!("is `{text}`; it should be a whole number, such as 4")))
    }

    fn activation(&self, key: &str, absent: Option<Activation>) -> Result<Activation, PolicyError> {
        let known = || Activation::NAMES.map(|(name, _)| name).join(", ");
        match (self.metadata.get(key), absent) {
            (None, Some(absent)) => Ok(absent),
            (None, None) => Err(self.metadata(key, format!("is missing; it is one of: {}", known()))),
            (Some(name), _) => Activation::from_name(name)
                .ok_or_else(|| self.metadata(key, format!("is `{name}`; it is one of: {}", known()))),
        }
    }

    fn layers(&self) -> Result<Vec<Layer>, PolicyError> {
        let (hidden, last) = (
            self.activation("activation", None)?,
            self.activation("output_activation", Some(Activation::None))?,
        );
        let mut names = self.tensors.names();
        names.sort_unstable();
        let mut layers: Vec<Layer> = Vec::new();
        loop {
            let name = format!("layers.{}.weight", layers.len());
            let Ok(weight) = self.tensors.tensor(&name) else { break };
            let &[outputs, inputs] = weight.shape() else {
                return Err(self.tensor(
                    &name,
                    format!("has the shape {:?}; it should be outputs × inputs", weight.shape()),
                ));
            };
            if inputs == 0 || outputs == 0 {
                return Err(self.tensor(&name, "is empty"));
            }
            if let Some(before) = layers.last()
                && before.outputs != inputs
            {
                return Err(self.tensor(
                    &name,
                    format!("has {inputs} inputs, and the layer before it {} outputs", before.outputs),
                ));
            }
            let rows = self.numbers(&name, &weight)?;
            let columns = (0..inputs).flat_map(|i| (0..outputs).map(move |o| (o, i)));
            let columns = columns.map(|(o, i)| rows[o * inputs + i]).collect();
            let name = format!("layers.{}.bias", layers.len());
            let bias = match self.tensors.tensor(&name) {
                Err(_) => vec![0.0; outputs],
                Ok(bias) if bias.shape() == [outputs] => self.numbers(&name, &bias)?,
                Ok(bias) => {
                    let problem =
                        format!("has the shape {:?}; its layer has {outputs} outputs", bias.shape());
                    return Err(self.tensor(&name, problem));
                }
            };
            layers.push(Layer { inputs, outputs, columns, bias: bias.into(), activation: hidden });
        }
        if layers.is_empty() {
            let problem = format!("is missing; the file has: {}", names.join(", "));
            return Err(self.tensor("layers.0.weight", problem));
        }
        let used = |name: &str| {
            (0..layers.len()).any(|layer| {
                name == format!("layers.{layer}.weight") || name == format!("layers.{layer}.bias")
            })
        };
        if let Some(unused) = names.iter().find(|name| !used(name)) {
            let problem =
                format!("belongs to none of the {} layers found; are they counted from 0?", layers.len());
            return Err(self.tensor(unused, problem));
        }
        if let Some(layer) = layers.last_mut() {
            layer.activation = last;
        }
        Ok(layers)
    }

    fn numbers(&self, name: &str, tensor: &TensorView<'_>) -> Result<Vec<f64>, PolicyError> {
        let data = tensor.data();
        let numbers: Vec<f64> = match tensor.dtype() {
            Dtype::F32 => {
                data.as_chunks().0.iter().map(|bytes| f64::from(f32::from_le_bytes(*bytes))).collect()
            }
            Dtype::F64 => data.as_chunks().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect(),
            other => return Err(self.tensor(name, format!("holds {other:?}; save it as F32 or F64"))),
        };
        match numbers.iter().position(|number| !number.is_finite()) {
            Some(at) => Err(self.tensor(name, format!("holds {} at place {at}", numbers[at]))),
            None => Ok(numbers),
        }
    }

    fn names(&self, key: &str) -> Result<Option<Vec<String>>, PolicyError> {
        let parse = |text: &String| {
            serde_json::from_str(text).map_err(|error| {
                self.metadata(key, format!("is no JSON list of names, such as [\"angle\"]: {error}"))
            })
        };
        self.metadata.get(key).map(parse).transpose()
    }

    fn observations(&self, layout: &Layout) -> Result<Vec<Source>, PolicyError> {
        let Some(names) = self.names("observations")? else {
            let leaves = layout.leaves.iter().enumerate().filter(|(_, leaf)| *leaf != "stamp");
            return Ok(leaves.map(|(leaf, _)| Source::Leaf(leaf)).collect());
        };
        let source = |name: &String| {
            Source::from_name(name, layout).ok_or_else(|| self.no_leaf("observations", name, layout))
        };
        names.iter().map(source).collect()
    }

    fn actions(&self, layout: &Layout) -> Result<Vec<usize>, PolicyError> {
        let Some(names) = self.names("actions")? else { return Ok((0..layout.leaves.len()).collect()) };
        let mut actions = Vec::new();
        for name in &names {
            let leaf = layout.leaf(name).ok_or_else(|| self.no_leaf("actions", name, layout))?;
            if actions.contains(&leaf) {
                return Err(self.metadata("actions", format!("names `{name}` twice")));
            }
            actions.push(leaf);
        }
        Ok(actions)
    }

    fn no_leaf(&self, key: &str, name: &str, layout: &Layout) -> PolicyError {
        let suggestion = Suggestion::nearest(name, layout.leaves.iter().map(String::as_str));
        self.metadata(key, format!("names `{name}`, which is no leaf of {layout}{suggestion}"))
    }

    /// A list of so many numbers; `absent` where there is none.
    fn list(&self, key: &str, count: usize, absent: f64) -> Result<Vec<f64>, PolicyError> {
        let Some(text) = self.metadata.get(key) else { return Ok(vec![absent; count]) };
        let numbers: Vec<f64> = serde_json::from_str(text).map_err(|error| {
            self.metadata(key, format!("is no JSON list of numbers, such as [0.5, 1.0]: {error}"))
        })?;
        if numbers.len() != count {
            let problem = format!("has {} numbers, and the network {count} there", numbers.len());
            return Err(self.metadata(key, problem));
        }
        Ok(numbers)
    }

    fn before(&self, count: usize) -> Result<Vec<Scaling>, PolicyError> {
        let (mean, std) =
            (self.list("observation_mean", count, 0.0)?, self.list("observation_std", count, 1.0)?);
        if let Some(bad) = std.iter().find(|std| **std <= 0.0) {
            return Err(self.metadata("observation_std", format!("holds {bad}; a spread is positive")));
        }
        let clip = match self.metadata.get("observation_clip") {
            None => f64::INFINITY,
            Some(text) => text.parse().ok().filter(|clip| *clip > 0.0).ok_or_else(|| {
                self.metadata("observation_clip", format!("is `{text}`; it should be a positive number"))
            })?,
        };
        let scaling = |(mean, std): (f64, f64)| Scaling {
            shift: mean,
            factor: 1.0 / std,
            low: -clip,
            high: clip,
            ..Scaling::NONE
        };
        Ok(mean.into_iter().zip(std).map(scaling).collect())
    }

    fn behind(&self, count: usize) -> Result<Vec<Scaling>, PolicyError> {
        let (factor, offset) =
            (self.list("action_scale", count, 1.0)?, self.list("action_offset", count, 0.0)?);
        let low = self.list("action_low", count, f64::NEG_INFINITY)?;
        let high = self.list("action_high", count, f64::INFINITY)?;
        let mut scalings = Vec::with_capacity(count);
        for index in 0..count {
            let (low, high) = (low[index], high[index]);
            if low > high {
                return Err(
                    self.metadata("action_low", format!("holds {low}, above the {high} of `action_high`"))
                );
            }
            scalings.push(Scaling {
                factor: factor[index],
                offset: offset[index],
                low,
                high,
                ..Scaling::NONE
            });
        }
        Ok(scalings)
    }
}
