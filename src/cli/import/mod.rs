//! `parallax import`: a log that another program wrote becomes a folder that `diagnose` reads, or a recording.

mod ask;
mod chosen;
mod show;

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use clap::Args;
use parallax_runtime::import::foreign::{self, Converted, Dialect, Found, TimeUnit, convert, write_folder};
use parallax_runtime::import::{MANIFEST, folder, is_folder};
use parallax_runtime::recording::log::{Log, Role};
use parallax_runtime::recording::write;
use serde_json::json;

use super::args::make_parent;
use super::failure::{Failure, Outcome, Sort};
use super::output;

/// The files are only read. Without answers on the command line, and on a terminal, it asks.
#[derive(Args)]
pub(crate) struct Arguments {
    /// A CSV or Parquet file (or several), the folder of a ROS 2 bag, an MCAP file, or a folder with recording.toml.
    #[arg(required = true, value_name = "LOG")]
    logs: Vec<PathBuf>,
    /// Where to write: a folder with recording.toml and CSV files, or a recording (FILE.mcap). Otherwise a folder of the log's name.
    #[arg(long, value_name = "PLACE")]
    out: Option<PathBuf>,
    /// Only say what is in it.
    #[arg(long, conflicts_with_all = ["out", "yes"])]
    list: bool,
    /// Take what is suggested for all that no other option names, and ask nothing.
    #[arg(long, short)]
    yes: bool,
    /// A signal that the machine was told to follow (repeat, or separate by commas; so for the other roles).
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    command: Vec<String>,
    /// A signal that a sensor read.
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    measurement: Vec<String>,
    /// A circumstance that drives the machine, too, such as a battery's voltage.
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    context: Vec<String>,
    /// What a controller was aiming at.
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    reference: Vec<String>,
    /// A signal's unit; values in another one of the same kind (deg, rpm, mm, mA, …) are converted.
    #[arg(long, value_name = "NAME=UNIT")]
    unit: Vec<Pair>,
    /// What a signal's values are multiplied by.
    #[arg(long, value_name = "NAME=FACTOR")]
    scale: Vec<Pair>,
    /// Another name for a signal.
    #[arg(long, value_name = "OLD=NEW")]
    rename: Vec<Pair>,
    /// The column (or in a bag header.stamp, publish, log) that says when, for all signals or for one: `--time pos=t_meas`.
    #[arg(long, value_name = "[NAME=]COLUMN")]
    time: Vec<String>,
    /// The unit of times that are numbers: s, ms, us, ns.
    #[arg(long, value_name = "UNIT")]
    time_unit: Option<TimeUnit>,
    /// Rows a second, where no column says when they were true.
    #[arg(long, value_name = "HZ", value_parser = rate)]
    rate: Option<f64>,
    /// Only these rows, counted from 1.
    #[arg(long, value_name = "FIRST:LAST", value_parser = rows)]
    rows: Option<(usize, usize)>,
    /// Spread rows of one stamp over the time up to the next, for clocks that are coarser than the log.
    #[arg(long)]
    spread: bool,
    /// What separates the columns: a character, `tab` or `space`. Otherwise found out.
    #[arg(long, value_name = "CHARACTER", value_parser = delimiter)]
    delimiter: Option<char>,
    /// The decimal mark: `.` or `,`. Otherwise found out.
    #[arg(long, value_name = "MARK", value_parser = decimal)]
    decimal: Option<bool>,
    /// The line of the columns' names, from 1; 0 when there is none. Otherwise found out.
    #[arg(long, value_name = "LINE")]
    header: Option<usize>,
    /// A cell that stands for no value, beside the empty one, NaN, NA, null and the like.
    #[arg(long, value_name = "TEXT", allow_hyphen_values = true)]
    missing: Vec<String>,
    /// What was recorded, in a few words.
    #[arg(long, value_name = "TEXT")]
    title: Option<String>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// `NAME=VALUE`.
#[derive(Clone, Debug)]
struct Pair {
    name: String,
    value: String,
}

impl std::str::FromStr for Pair {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once('=') {
            Some((name, value)) if !name.is_empty() && !value.is_empty() => {
                Ok(Self { name: name.into(), value: value.into() })
            }
            _ => Err("it must look like NAME=VALUE".into()),
        }
    }
}

fn rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(rate) if rate > 0.0 && rate <= 1e9 => Ok(rate),
        _ => Err("it must be a number of rows a second, such as 100".into()),
    }
}

fn rows(text: &str) -> Result<(usize, usize), String> {
    let parts = text.split_once(':').and_then(|(first, last)| {
        let last = if last.is_empty() { Some(usize::MAX) } else { last.parse().ok() };
        Some((if first.is_empty() { 1 } else { first.parse().ok()? }, last?))
    });
    parts
        .filter(|(first, last)| *first >= 1 && last >= first)
        .ok_or_else(|| "it must look like 1:5000, or 5001: for all that follow".into())
}

fn delimiter(text: &str) -> Result<char, String> {
    match (text, text.chars().next()) {
        ("tab" | "\\t", _) => Ok('\t'),
        ("space", _) => Ok(' '),
        (text, Some(one)) if text.len() == 1 && one.is_ascii() => Ok(one),
        _ => Err("it must be one character, `tab` or `space`".into()),
    }
}

fn decimal(text: &str) -> Result<bool, String> {
    match text {
        "." => Ok(false),
        "," => Ok(true),
        _ => Err("it must be . or ,".into()),
    }
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    if let [tidy] = arguments.logs.as_slice()
        && is_tidy(tidy)
    {
        return of_folder(tidy, arguments);
    }
    let found = read(arguments)?;
    let named = chosen::plan(&found, arguments)?;
    if arguments.list {
        return show::list(&found, &named, arguments.json).map(|()| Outcome::Done);
    }
    let terminal = std::io::stdin().is_terminal() && std::io::stdout().is_terminal();
    let (mut plan, mut out) = (named, arguments.out.clone());
    if plan.choices.is_empty() && !arguments.yes {
        if !terminal || arguments.json {
            return Err(Failure::input(anyhow!("{}", show::how_to_answer(&found))));
        }
        show::list(&found, &plan, false)?;
        let Some(answered) = ask::plan(&found, plan, &mut ask::Terminal, &mut out)? else {
            return Err(Failure::interrupted(anyhow!("nothing was written")));
        };
        plan = answered;
    }
    let out = out.unwrap_or_else(|| chosen::place(&arguments.logs));
    let converted = convert(&found, &plan).input()?;
    if is_recording(&out) {
        make_parent(&out)?;
        write(&out, &converted.log.recording()).runtime()?;
    } else {
        write_folder(&out, &converted).input()?;
    }
    report(&converted, &out, arguments.json)?;
    Ok(Outcome::Done)
}

/// A log in the form that Parallax reads, or a path that is for its reader to complain of.
fn is_tidy(path: &Path) -> bool {
    let bag = || {
        let entries = path.read_dir().into_iter().flatten().flatten();
        entries
            .map(|entry| entry.path())
            .any(|file| file.extension().is_some_and(|extension| extension == "mcap" || extension == "db3"))
    };
    !path.exists() || (is_folder(path) && (path.is_file() || path.join(MANIFEST).exists() || !bag()))
}

fn is_recording(out: &Path) -> bool {
    out.extension().is_some_and(|extension| extension == "mcap")
}

fn of_folder(path: &Path, arguments: &Arguments) -> Result<Outcome, Failure> {
    let log = folder(path).input()?;
    let Some(out) = arguments.out.as_deref().filter(|out| is_recording(out)) else {
        return Err(Failure::input(anyhow!(
            "{} is a log that `info` and `diagnose` read as it is; to keep it in one file, give --out FILE.mcap",
            path.display()
        )));
    };
    make_parent(out)?;
    write(out, &log.recording()).runtime()?;
    written(&log, out, arguments.json)?;
    Ok(Outcome::Done)
}

fn written(log: &Log, out: &Path, as_json: bool) -> Result<(), Failure> {
    let (signals, samples) = (log.signals.len(), samples(log));
    if as_json {
        return output::json(&json!({ "out": out, "signals": signals, "samples": samples }));
    }
    output::line(format!("{samples} samples of {signals} signals written to {}", out.display()));
    Ok(())
}

fn samples(log: &Log) -> usize {
    log.signals.iter().map(|signal| signal.values.len()).sum()
}

fn read(arguments: &Arguments) -> Result<Vec<Found>, Failure> {
    let dialect = Dialect {
        delimiter: arguments.delimiter,
        decimal_comma: arguments.decimal,
        header: arguments.header,
        missing: arguments.missing.clone(),
    };
    let mut found = Vec::with_capacity(arguments.logs.len());
    for path in &arguments.logs {
        let bar = output::progress(&format!("reading {}", path.display()), foreign::size(path));
        found.push(foreign::read(path, &dialect, &mut |bytes| bar.set_position(bytes)).input()?);
        bar.finish_and_clear();
    }
    foreign::qualify(&mut found);
    Ok(found)
}

/// Says what was written, what a diagnosis will miss, and how to go on.
fn report(converted: &Converted, out: &Path, as_json: bool) -> Result<(), Failure> {
    let Converted { log, origin, .. } = converted;
    let place = out.display();
    let mut notes = log.notes.clone();
    if *origin != 0 {
        notes.push(format!("times count from {} s of the source", *origin as f64 / 1e9));
    }
    let has = |role: Role| log.signals.iter().any(|signal| signal.role == role);
    if !has(Role::Command) && !has(Role::Context) {
        notes.push("there is no command: a system has nothing to be driven by (--command NAME)".into());
    }
    if !has(Role::Measurement) {
        notes.push("there is no measurement: a diagnosis has nothing to compare (--measurement NAME)".into());
    }
    if as_json {
        return output::json(&json!({
            "out": out, "signals": log.signals.len(), "samples": samples(log), "notes": notes,
            "origin_s": *origin as f64 / 1e9,
        }));
    }
    written(log, out, false)?;
    for note in notes {
        output::line(format!("note: {note}"));
    }
    output::line(format!(
        "\nNext:\n  parallax info {place}\n  parallax new system --from {place} --out system.toml\n  \
         parallax diagnose --system system.toml {place}"
    ));
    Ok(())
}
