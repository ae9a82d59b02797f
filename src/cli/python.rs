//! Nodes that are written in Python: each is a process of its own, in an interpreter with the package `parallax`.
//!
//! Nothing of Python is needed for graphs without such nodes, nor to read or replay a recording of one with them.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

use anyhow::anyhow;
use parallax_runtime::graph::GraphSpec;
use parallax_runtime::launch::LaunchSpec;
use parallax_runtime::node::NodeError;
use parallax_runtime::registry::{NodeKind, Registry};

use super::lockstep;

/// The kind of these nodes.
const PYTHON: &str = "python";
/// Where an interpreter for nodes is named.
const ADVICE: &str =
    "give one in the launch.toml, [defaults] interpreter = \"/path/to/python\", or activate its environment";
/// Finds the package without loading it.
const LOOK: &str = "import importlib.util, sys; sys.exit(importlib.util.find_spec('parallax') is None)";

/// Adds the kinds of the program that this command line is part of.
static OWN: OnceLock<fn(Registry) -> Registry> = OnceLock::new();

/// From now on there are these kinds, too. Only the first call counts.
pub(crate) fn add(own: fn(Registry) -> Registry) {
    let _ = OWN.set(own);
}

/// The kinds of node that come with Parallax, those of the program itself, and those written in Python.
pub(crate) fn registry() -> Registry {
    let kind = NodeKind::external(|_, _, _| {
        Err(NodeError::failed("it is written in Python, and runs in `parallax run` and `parallax sim` only"))
    });
    let kinds = parallax_nodes::registry().with(PYTHON, kind);
    match OWN.get() {
        Some(own) => own(kinds),
        None => kinds,
    }
}

/// The same, where nodes in Python are stepped by a simulated clock. The interpreter stands in the launch.toml beside the graph, or
/// is that of the active environment.
///
/// # Errors
///
/// As [`programs`], and when that launch.toml cannot be read.
pub(crate) fn simulated(spec: &GraphSpec, folder: Option<&Path>) -> anyhow::Result<Registry> {
    if spec.nodes.iter().all(|node| node.kind != PYTHON) {
        return Ok(registry());
    }
    let beside = folder.map(|folder| folder.join("launch.toml")).filter(|path| path.is_file());
    let launch = beside.map_or_else(|| Ok(LaunchSpec::default()), |path| LaunchSpec::read(&path))?;
    Ok(registry().with(PYTHON, lockstep::kind(programs(spec, &launch, folder)?)))
}

/// The commands that run the nodes of a graph that are written in Python. Modules are also looked for in `folder`.
///
/// # Errors
///
/// When there is no interpreter, or it has no package `parallax`.
pub(crate) fn programs(
    spec: &GraphSpec,
    launch: &LaunchSpec,
    folder: Option<&Path>,
) -> anyhow::Result<BTreeMap<String, Vec<String>>> {
    let mut programs = BTreeMap::new();
    let mut looked_at: Vec<PathBuf> = Vec::new();
    for node in spec.nodes.iter().filter(|node| node.kind == PYTHON) {
        let given = launch.nodes.get(&node.name).and_then(|own| own.interpreter.as_ref());
        let interpreter = interpreter(given.or(launch.defaults.interpreter.as_ref()));
        if !looked_at.contains(&interpreter) {
            check(&interpreter, &format!("node {} is written in Python", node.name), ADVICE)?;
            looked_at.push(interpreter.clone());
        }
        let mut command = vec![interpreter.display().to_string(), "-m".into(), "parallax.worker".into()];
        if let Some(folder) = folder {
            // The parent of a bare file name is empty.
            let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
            command.extend(["--path".into(), std::path::absolute(folder)?.display().to_string()]);
        }
        programs.insert(node.name.clone(), command);
    }
    Ok(programs)
}

/// The interpreter: the one that is asked for, that of the active virtual environment, or the system's.
pub(crate) fn interpreter(given: Option<&PathBuf>) -> PathBuf {
    let environment = || std::env::var_os("VIRTUAL_ENV").map(|path| PathBuf::from(path).join("bin/python"));
    given.cloned().or_else(environment).unwrap_or_else(|| "python3".into())
}

/// Whether an interpreter can be started and has the package.
///
/// # Errors
///
/// With `why` one is needed and `advice` where to name another, when it cannot be started or has no package `parallax`.
pub(crate) fn check(interpreter: &Path, why: &str, advice: &str) -> anyhow::Result<()> {
    let name = interpreter.display();
    let looked = Command::new(interpreter).args(["-c", LOOK]).stdin(Stdio::null()).output();
    match looked {
        Err(error) => Err(anyhow!("{why}, and {name} cannot be started ({error}); {advice}")),
        Ok(output) if !output.status.success() => {
            let said = String::from_utf8_lossy(&output.stderr);
            let said = said.trim().lines().last().map(|line| format!(" ({line})")).unwrap_or_default();
            Err(anyhow!(
                "{why}, and {name} has no package `parallax`{said}; install it there \
                 (pip install ./bindings), or {advice}"
            ))
        }
        Ok(_) => Ok(()),
    }
}
