//! `parallax new node`: a node of your own, in Rust or in Python, with a graph that it plugs into.

use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::Args;

use super::graph::{GraphTemplate, fill, word};
use super::write_new;
use crate::cli::failure::{Failure, Outcome};
use crate::cli::output;

#[derive(Args)]
pub(super) struct Arguments {
    /// What it is called, such as my_agent.
    name: String,
    /// Write it in Python, as a module beside the graph, instead of a crate in Rust.
    #[arg(long)]
    python: bool,
    /// The folder to write; without it, one of the node's name.
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// The checkout of Parallax that the crate is built with; without it, the one that this program was built from.
    #[arg(long, value_name = "FOLDER", conflicts_with = "python")]
    parallax: Option<PathBuf>,
}

/// Where this program was built.
const BUILT_IN: &str = env!("CARGO_MANIFEST_DIR");
/// Words of Rust and Python, and names of crates that would be in the way.
const TAKEN: [&str; 70] = [
    "abstract", "and", "as", "assert", "async", "await", "become", "box", "break", "class", "const",
    "continue", "core", "crate", "def", "del", "do", "dyn", "elif", "else", "enum", "except", "extern",
    "false", "final", "finally", "fn", "for", "from", "gen", "global", "if", "impl", "import", "in", "is",
    "lambda", "let", "loop", "macro", "main", "match", "mod", "move", "mut", "nonlocal", "not", "or",
    "override", "parallax", "pass", "priv", "pub", "python", "raise", "ref", "return", "self", "serde",
    "static", "std", "struct", "super", "test", "trait", "true", "try", "type", "use", "while",
];

pub(super) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let name = arguments.name.as_str();
    word("node", name)?;
    let kinds = crate::cli::python::registry();
    if TAKEN.contains(&name) || kinds.get(name).is_some() {
        return Err(Failure::input(anyhow!(
            "`{name}` is taken (a word of the language, a crate, or a kind of node that comes along); choose another name"
        )));
    }
    let folder = arguments.out.clone().unwrap_or_else(|| PathBuf::from(name));
    let rust = !arguments.python;
    let program = if rust { "cargo run --release --" } else { "parallax" };
    let recording = format!("out/{name}/recording.mcap");
    let commands = [
        format!("{program} sim graph.toml --out out/{name}/sim.mcap"),
        format!("{program} run graph.toml --duration 10 --record"),
        format!("{program} diagnose {recording}"),
    ];
    let own = |text: &str| text.replace("my_agent", name).replace("MyAgent", &camel(name));
    let agent = |text: &str| text.replace("@name@", name).replace("@Name@", &camel(name));
    let at = |file: &str| folder.join(file);
    let graph = |agent: &str| fill(GraphTemplate::Pendulum, name, &commands, agent);
    let files = if rust {
        let manifest = manifest(name, arguments.parallax.as_deref())?;
        vec![
            (at("Cargo.toml"), manifest),
            (at(".gitignore"), "/target\n/out\n".into()),
            (at("src/main.rs"), own(include_str!("templates/node/main.rs"))),
            (at(&format!("src/{name}.rs")), own(include_str!("templates/node/my_agent.rs"))),
            (at("graph.toml"), graph(&agent(include_str!("templates/graph/rust.toml")))),
        ]
    } else {
        vec![
            (at(&format!("{name}.py")), own(include_str!("templates/node/my_agent.py"))),
            (at("graph.toml"), graph(&agent(include_str!("templates/graph/python.toml")))),
        ]
    };
    write_new(&files)?;
    for (path, _) in &files {
        output::line(format!("{} written", path.display()));
    }
    let first =
        if rust { String::new() } else { "  pip install ./bindings    # in a checkout, once\n".into() };
    output::line(format!("\nNext:\n{first}  cd {}\n  {}", folder.display(), commands.join("\n  ")));
    Ok(Outcome::Done)
}

/// The crate's Cargo.toml.
fn manifest(name: &str, checkout: Option<&Path>) -> Result<String, Failure> {
    let given = checkout.unwrap_or(Path::new(BUILT_IN));
    let is_parallax = std::fs::read_to_string(given.join("Cargo.toml"))
        .is_ok_and(|text| text.contains("\nname = \"parallax\"\n"));
    if !is_parallax {
        return Err(Failure::input(anyhow!(
            "{} is no checkout of Parallax; name the folder with its Cargo.toml by --parallax, so that the crate can be built",
            given.display()
        )));
    }
    let path = std::path::absolute(given).unwrap_or_else(|_| given.to_owned());
    // A string of TOML that may hold any path.
    let path = toml::Value::String(path.display().to_string());
    Ok(include_str!("templates/node/manifest.toml")
        .replace("@name@", name)
        .replace("@path@", &path.to_string()))
}

/// `my_agent` as `MyAgent`.
fn camel(name: &str) -> String {
    let parts = name.split('_').filter(|part| !part.is_empty());
    parts.map(|part| part[..1].to_ascii_uppercase() + &part[1..]).collect()
}
