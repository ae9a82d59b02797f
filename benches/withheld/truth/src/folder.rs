//! A case as a folder that a diagnosis reads: recording.toml, one table per kind of signal, system.toml.

use crate::TruthError;
use crate::case::{Case, Run};
use std::fmt::Write as _;
use std::path::Path;

fn save(path: &Path, text: &str) -> Result<(), TruthError> {
    std::fs::write(path, text).map_err(|source| TruthError::Write { path: path.to_owned(), source })
}

/// Writes the folder; nothing in it depends on the cause but the readings and, under feedback, the commands.
pub(crate) fn write(case: &Case, run: &Run, folder: &Path) -> Result<(), TruthError> {
    let system = case.system;
    std::fs::create_dir_all(folder)
        .map_err(|source| TruthError::Write { path: folder.to_owned(), source })?;
    let mut recording = format!("format = 1\ntitle = \"{}\"\n", system.name);
    let mut signal = |name: &str, role: &str, unit: &str, file: &str| {
        let _ = write!(
            recording,
            "\n[[signal]]\nname = \"{name}\"\nrole = \"{role}\"\nunit = \"{unit}\"\nfile = \"{file}\"\ntime = \"t\"\nvalue = \"{name}\"\n"
        );
    };
    let mut table = String::from("t");
    for i in system.inputs {
        signal(i.signal, "command", i.unit, "commands.csv");
        let _ = write!(table, ",{}", i.signal);
    }
    for (k, u) in run.commands.iter().enumerate() {
        let _ = write!(table, "\n{:.6}", k as f64 / system.command_rate);
        for u in &u[..system.inputs.len()] {
            let _ = write!(table, ",{u:.7}");
        }
    }
    table.push('\n');
    save(&folder.join("commands.csv"), &table)?;
    let mut equations = system.equations.to_owned();
    for (o, readings) in system.outputs.iter().zip(&run.readings) {
        let file = format!("{}.csv", o.name);
        signal(o.name, "measurement", o.unit, &file);
        let mut table = format!("t,{}\n", o.name);
        for (t, y) in readings {
            let _ = writeln!(table, "{t:.6},{y:.8}");
        }
        save(&folder.join(file), &table)?;
    }
    for (o, noise) in system.outputs.iter().zip(&run.noise) {
        let stated = if run.declared { format!(", noise = {noise:.3e}") } else { String::new() };
        equations = equations.replace(&format!("@{}@", o.name), &stated);
    }
    save(&folder.join("recording.toml"), &recording)?;
    let mut text = format!("format = 1\nname = \"{}\"\n[parameters]\n", system.name);
    for p in system.parameters {
        let bounds =
            p.bounds.map_or(String::new(), |(low, high)| format!(", calibrate = [{low:?}, {high:?}]"));
        let _ = writeln!(text, "{} = {{ value = {:?}, unit = \"{}\"{bounds} }}", p.name, p.value, p.unit);
    }
    text.push_str(&equations);
    save(&folder.join("system.toml"), &text)
}
