//! The file that says what to identify.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, anyhow};
use parallax_runtime::delay::Delay;
use parallax_runtime::graph::{ConnectionSpec, Parameters};
use parallax_sim::compiled::Interpolation;
use parallax_sim::identify::{
    HiddenDelay, IdentifyError, Method, Output, Prior, Scatter, Simulated, Specification, Target, Term,
    Transform, Unknown,
};
use serde::Deserialize;
use toml::Spanned;

use crate::cli::failure::Failure;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Text {
    format: u32,
    #[serde(default)]
    from: f64,
    #[serde(default)]
    to: Option<f64>,
    #[serde(default)]
    hold_out: Option<f64>,
    #[serde(default)]
    nodes: BTreeMap<String, Spanned<Node>>,
    #[serde(default)]
    parameters: BTreeMap<String, Spanned<Number>>,
    #[serde(default)]
    initial: BTreeMap<String, Spanned<Number>>,
    #[serde(default)]
    delays: BTreeMap<String, Spanned<Hidden>>,
    #[serde(default)]
    connections: BTreeMap<String, Spanned<f64>>,
    #[serde(default)]
    outputs: BTreeMap<String, Spanned<Compared>>,
    #[serde(default)]
    solver: Method,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Node {
    #[serde(default)]
    kind: Option<String>,
    #[serde(default)]
    rate: Option<f64>,
    #[serde(default)]
    parameters: Option<Parameters>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Number {
    low: f64,
    high: f64,
    #[serde(default)]
    start: Option<f64>,
    #[serde(default)]
    scale: Option<Transform>,
    #[serde(default)]
    prior: Option<Prior>,
    #[serde(default)]
    unit: String,
    #[serde(default)]
    name: Option<String>,
    /// Further places that it sets.
    #[serde(default)]
    also: Vec<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Hidden {
    #[serde(default)]
    min: f64,
    #[serde(default)]
    max: Option<f64>,
    #[serde(default)]
    start: Option<f64>,
    #[serde(default)]
    prior: Option<Prior>,
    #[serde(default)]
    name: Option<String>,
    #[serde(default)]
    port: Option<String>,
    #[serde(default)]
    interpolation: Option<Between>,
    #[serde(default)]
    scatter: Option<Scatter>,
    #[serde(default)]
    window: Option<usize>,
}

#[derive(Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Between {
    Hold,
    Linear,
    Smooth,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Compared {
    #[serde(default)]
    noise: Option<f64>,
    #[serde(default)]
    wrap: Option<f64>,
    #[serde(default)]
    linear: BTreeMap<String, String>,
}

/// A file that was read.
pub(crate) struct File {
    pub(crate) specification: Specification,
    pub(crate) method: Method,
    name: String,
    /// The line of each entry, by what errors call it.
    lines: Vec<(String, usize)>,
}

impl File {
    /// Reads the file at `path`.
    pub(crate) fn read(path: &Path) -> Result<Self, Failure> {
        let name = path.display().to_string();
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("{name} cannot be read"))
            .map_err(Failure::input)?;
        let parsed: Text = toml::from_str(&text).with_context(|| name.clone()).map_err(Failure::input)?;
        if parsed.format != 1 {
            let found = parsed.format;
            return Err(Failure::input(anyhow!("{name}: this program reads format 1, not {found}")));
        }
        let mut file =
            Self { specification: Specification::default(), method: parsed.solver, name, lines: Vec::new() };
        let line = |at: usize| text[..at].matches('\n').count() + 1;
        let specification = &mut file.specification;
        specification.span = (parsed.from, parsed.to.unwrap_or(f64::INFINITY));
        if let Some(hold_out) = parsed.hold_out {
            specification.hold_out = hold_out;
        }
        let mut wrong: Option<(usize, String)> = None;
        let mut check = |line: usize, result: Result<(), String>| {
            if let Err(problem) = result {
                wrong.get_or_insert((line, problem));
            }
        };
        for (node, entry) in parsed.nodes {
            file.lines.push((format!("nodes.{node}"), line(entry.span().start)));
            let Node { kind, rate, parameters } = entry.into_inner();
            specification.nodes.push(Simulated { node, kind, parameters, rate });
        }
        for (state, numbers) in [(false, parsed.parameters), (true, parsed.initial)] {
            for (key, entry) in numbers {
                let at = line(entry.span().start);
                let entry = entry.into_inner();
                let name = entry.name.unwrap_or_else(|| key.clone());
                file.lines.push((format!("`{name}`"), at));
                let mut targets = Vec::new();
                for place in std::iter::once(&key).chain(&entry.also) {
                    check(
                        at,
                        split(place, '.').map(|(node, leaf)| {
                            targets.push(match state {
                                false => Target::Parameter { node, leaf },
                                true => Target::State { node, leaf },
                            });
                        }),
                    );
                }
                let Number { low, high, start, scale: transform, prior, unit, .. } = entry;
                specification.unknowns.push(Unknown {
                    name,
                    targets,
                    low,
                    high,
                    start,
                    transform,
                    prior,
                    unit,
                });
            }
        }
        for (key, entry) in parsed.delays {
            let at = line(entry.span().start);
            let Hidden { min, max, start, prior, name, port, interpolation, scatter, window } =
                entry.into_inner();
            let name = name.unwrap_or_else(|| key.clone());
            file.lines.push((format!("delays.\"{name}\""), at));
            let interpolation = interpolation.map(|between| match between {
                Between::Hold => Interpolation::Hold,
                Between::Linear => Interpolation::Linear,
                Between::Smooth => Interpolation::Smooth,
            });
            check(
                at,
                ends(&key).map(|(from, to)| {
                    specification.delays.push(HiddenDelay {
                        name,
                        from,
                        to,
                        port,
                        min,
                        max,
                        start,
                        prior,
                        interpolation,
                        scatter,
                        window,
                    });
                }),
            );
        }
        for (key, seconds) in parsed.connections {
            let at = line(seconds.span().start);
            check(
                at,
                ends(&key).map(|(from, to)| {
                    let delay = Delay::constant(seconds.into_inner());
                    specification.connections.push(ConnectionSpec { delay, ..ConnectionSpec::new(from, to) });
                }),
            );
        }
        for (key, entry) in parsed.outputs {
            let at = line(entry.span().start);
            file.lines.push((format!("outputs.\"{key}\""), at));
            let Compared { noise, wrap, linear } = entry.into_inner();
            check(
                at,
                split(&key, '.').map(|(node, leaf)| {
                    let linear = linear.into_iter().map(|(name, leaf)| {
                        // Leaves are those of the output's own node, with or without its name.
                        let short = leaf.strip_prefix(&format!("{node}.")).map(str::to_owned).unwrap_or(leaf);
                        Term { name, leaf: (short != "1").then_some(short) }
                    });
                    let linear = linear.collect();
                    specification.outputs.push(Output { node: node.clone(), leaf, noise, wrap, linear });
                }),
            );
        }
        match wrong {
            Some((line, problem)) => Err(Failure::input(anyhow!("{}:{line}: {problem}", file.name))),
            None => Ok(file),
        }
    }

    /// An error with the file and the line of the entry that it speaks of.
    pub(crate) fn failure(&self, error: IdentifyError) -> Failure {
        let whose = match &error {
            IdentifyError::Unknown { whose, .. } | IdentifyError::Value { whose, .. } => Some(whose.clone()),
            IdentifyError::NoData { output } => Some(format!("outputs.\"{output}\"")),
            _ => None,
        };
        let of = |whose: &String| {
            let named =
                |(name, _): &&(String, usize)| name == whose || name.starts_with(whose.trim_end_matches('"'));
            self.lines.iter().find(named).map(|(_, line)| *line)
        };
        let place = match whose.as_ref().and_then(of) {
            Some(line) => format!("{}:{line}", self.name),
            None => self.name.clone(),
        };
        match error {
            IdentifyError::Stopped => Failure::interrupted(error),
            IdentifyError::NotFinite => Failure::runtime(error),
            error => Err::<(), _>(error).context(place).map_err(Failure::input).expect_err("it is an error"),
        }
    }
}

/// `NODE.LEAF`
fn split(key: &str, at: char) -> Result<(String, String), String> {
    match key.split_once(at) {
        Some((node, leaf)) if !node.is_empty() && !leaf.is_empty() => Ok((node.into(), leaf.into())),
        _ => Err(format!("`{key}` has to be NODE.LEAF, such as \"camera.angle\"")),
    }
}

/// `FROM -> TO`
fn ends(key: &str) -> Result<(String, String), String> {
    match key.split_once("->") {
        Some((from, to)) if !from.trim().is_empty() && !to.trim().is_empty() => {
            Ok((from.trim().into(), to.trim().into()))
        }
        _ => Err(format!("`{key}` has to be \"FROM -> TO\", such as \"motor -> world\"")),
    }
}
