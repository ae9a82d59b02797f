//! Any bytes are the log of another program (CSV, Parquet, a bag), or an error; so is a folder with any `recording.toml`.

#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use parallax_runtime::import::folder;
use parallax_runtime::import::foreign::{Choice, Dialect, Plan, convert, read};
use parallax_runtime::recording::log::Role;

/// A folder in memory.
static FOLDER: LazyLock<PathBuf> = LazyLock::new(|| {
    let path = PathBuf::from(format!("/dev/shm/parallax_fuzz_{}", std::process::id()));
    std::fs::create_dir_all(path.join("log")).expect("there is /dev/shm");
    path
});
const MANIFEST: &str = "format = 1\ntitle = \"x\"\n[[signal]]\nname = \"a\"\nrole = \"command\"\nunit = \"V\"\nfile = \"x.csv\"\n\
                        time = \"t\"\nvalue = \"a\"\n";

fuzz_target!(|bytes: &[u8]| {
    let path = FOLDER.join("log.csv");
    std::fs::write(&path, bytes).expect("there is room");
    match read(&path, &Dialect::default(), &mut |_| {}) {
        Ok(found) => {
            let choices = found.series().map(|(_, series)| Choice {
                series: series.name.clone(),
                name: series.name.clone(),
                role: Role::Measurement,
                unit: None,
                scale: 1.0,
            });
            let plan = Plan { choices: choices.collect(), ..Plan::default() };
            let _ = convert(std::slice::from_ref(&found), &plan).map_err(|error| error.to_string());
        }
        Err(error) => drop(error.to_string()),
    }
    // A log of our own form: the same bytes as its table, and as its manifest.
    std::fs::write(FOLDER.join("log/x.csv"), bytes).expect("there is room");
    std::fs::write(FOLDER.join("log/recording.toml"), MANIFEST).expect("there is room");
    let _ = folder(&FOLDER.join("log")).map_err(|error| error.to_string());
    std::fs::write(FOLDER.join("log/recording.toml"), bytes).expect("there is room");
    let _ = folder(&FOLDER.join("log")).map_err(|error| error.to_string());
});
