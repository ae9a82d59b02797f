//! `parallax latency`: how long messages and steps take on this machine, beside the raw floor.

use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};
use parallax_runtime::latency::{
    self, Aim, Carrier, Case, Delays, LatencyError, Options, Report, Verdict, Wait,
};
use parallax_runtime::launch::signals::Signals;
use serde_json::json;

use super::failure::{Failure, Outcome};
use super::output;
use crate::plot;

#[derive(Clone, Copy, Debug, PartialEq, ValueEnum)]
enum Waiting {
    /// Poll all the time.
    Spin,
    /// Poll shortly before and after a message is expected, sleep otherwise.
    SpinThenBlock,
    /// Sleep until woken.
    Block,
}

impl From<Waiting> for Wait {
    fn from(waiting: Waiting) -> Self {
        match waiting {
            Waiting::Spin => Wait::Spin,
            Waiting::SpinThenBlock => Wait::SpinThenBlock,
            Waiting::Block => Wait::Block,
        }
    }
}

const LONG_HELP: &str = "\
Runs a graph of two node processes and, in turns with it, what it could at best be made of: raw iceoryx2, a Unix socket,
a channel between two threads, a word of shared memory with a futex. Messages are paced (--rate) and both ends are alike,
so the numbers compare.

  one way     from the end of the sender's step to the begin of the receiver's
  round trip  from the send to the arrival of the answer
  in place    the message is written and read where it lies in shared memory; in a graph, messages of 4096 bytes and more

Percentiles that so few messages cannot show are left empty. An aim is undecided where the interval of its ratio, over
turns drawn anew, holds 1. Run it with nothing else on the machine; `parallax doctor`
says what disturbs it.";

#[derive(Args)]
#[command(long_about = LONG_HELP)]
pub(crate) struct Arguments {
    /// Time for each case.
    #[arg(long, value_name = "SECONDS", default_value_t = 2.0)]
    seconds: f64,
    /// Turns into which this time is cut; all cases take turns. From 8 on the comparisons have intervals.
    #[arg(long, default_value_t = 16)]
    rounds: usize,
    /// Messages a second; fewer where large ones are copied. No round number: in step with the kernel's timer, all messages or none
    /// would meet its interrupts.
    #[arg(long, default_value_t = 4931.0)]
    rate: f64,
    /// Sizes of a message in bytes.
    #[arg(
        long,
        value_name = "BYTES",
        value_delimiter = ',',
        default_value = "64,1024,65536,1048576,8388608"
    )]
    payload: Vec<usize>,
    /// How both ends wait; other payloads than the smallest are measured in the first way only.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "spin,spin-then-block,block")]
    wait: Vec<Waiting>,
    /// The cores of the two ends.
    #[arg(long, value_name = "A,B", value_delimiter = ',', num_args = 1)]
    cores: Vec<usize>,
    /// Every combination of payload, wait, pinned or not, real-time priority or not.
    #[arg(long)]
    full: bool,
    /// Draw the distributions (.html or .svg).
    #[arg(long, value_name = "FILE")]
    plot: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let (options, notes) = options(arguments)?;
    let bar = output::progress(&format!("measuring {} cases", options.cases.len()), 1000);
    let signals = Signals::watch().map_err(Failure::runtime)?;
    let measured = latency::measure(&options, |share| {
        bar.set_position((share * 1000.0) as u64);
        !signals.raised()
    });
    bar.finish_and_clear();
    let mut report = measured.map_err(|error| match error {
        LatencyError::Interrupted => Failure::interrupted(error),
        error => Failure::runtime(error),
    })?;
    report.warnings.splice(0..0, notes);
    let aims = latency::aims(&report);
    if let Some(path) = &arguments.plot {
        let lead = format!("{} messages a second, {} s a case", arguments.rate, arguments.seconds);
        plot::write(path, "Latency", &lead, vec![plot::latency::figure(&report)])?;
    }
    if arguments.json {
        output::json(&json!({
            "machine": machine(), "rate_hz": arguments.rate, "seconds": arguments.seconds,
            "cores": options.cores, "report": report, "aims": aims, "plot": arguments.plot,
        }))?;
    } else {
        print(&report, &aims);
        if let Some(path) = &arguments.plot {
            output::line(format!("written to {}", path.display()));
        }
    }
    let missed = aims.iter().any(|aim| aim.verdict == Verdict::Missed);
    Ok(if missed { Outcome::Negative } else { Outcome::Done })
}

fn options(arguments: &Arguments) -> Result<(Options, Vec<String>), Failure> {
    let wrong = |text: String| Failure::input(anyhow::anyhow!(text));
    if !(0.05..=86_400.0).contains(&arguments.seconds) || !(10.0..=50_000.0).contains(&arguments.rate) {
        return Err(wrong("--seconds must be 0.05 to 86400, and --rate 10 to 50000".into()));
    }
    if let Some(bytes) =
        arguments.payload.iter().find(|bytes| !(16..=1 << 28).contains(*bytes) || *bytes % 8 != 0)
    {
        return Err(wrong(format!(
            "--payload {bytes}: a message has 16 to 268435456 bytes, a multiple of 8"
        )));
    }
    let available = latency::cores();
    let mut notes = Vec::new();
    let cores = match &arguments.cores[..] {
        [] => match available[..] {
            [first, second, ..] => [first, second],
            [only] => {
                notes.push(
                    "there is one core: both ends share it, and polling waits for the other's turn".into(),
                );
                [only, only]
            }
            [] => [0, 0],
        },
        &[first, second] => [first, second],
        _ => return Err(wrong("--cores wants two, such as 2,3".into())),
    };
    if let Some(core) = cores.iter().find(|core| !available.contains(core)) {
        return Err(wrong(format!("--cores {core}: this program may run on {available:?} only")));
    }
    let mut cases = Vec::new();
    let mut add = |case: Case| {
        if !cases.contains(&case) {
            cases.push(case);
        }
    };
    let waits: Vec<Wait> = arguments.wait.iter().map(|wait| Wait::from(*wait)).collect();
    let (Some(&small), Some(&first)) = (arguments.payload.iter().min(), waits.first()) else {
        return Err(wrong("--payload and --wait need a value each".into()));
    };
    // A polling program under SCHED_FIFO gives its core to nobody, not even to the one that ends it.
    let room = available.len() > 2;
    let plain = |carrier, payload, wait| Case { carrier, payload, wait, pinned: true, fifo: false };
    for &wait in &waits {
        let carriers: &[Carrier] = match wait {
            Wait::SpinThenBlock => &[Carrier::Graph],
            // What is held against each other takes turns right after each other.
            _ => &[
                Carrier::RecordedGraph,
                Carrier::Graph,
                Carrier::Iceoryx2,
                Carrier::Futex,
                Carrier::Channel,
                Carrier::Crossbeam,
                Carrier::UnixSocket,
            ],
        };
        carriers.iter().for_each(|&carrier| add(plain(carrier, small, wait)));
    }
    for &payload in &arguments.payload {
        let carriers = [Carrier::Graph, Carrier::Channel, Carrier::Iceoryx2, Carrier::UnixSocket];
        carriers.iter().for_each(|&carrier| add(plain(carrier, payload, first)));
    }
    for &wait in &waits {
        add(Case { pinned: false, ..plain(Carrier::Graph, small, wait) });
        if wait == Wait::Block || room {
            for carrier in [Carrier::Graph, Carrier::Iceoryx2, Carrier::Futex] {
                add(Case { fifo: true, ..plain(carrier, small, wait) });
            }
        }
    }
    if arguments.full {
        for &payload in &arguments.payload {
            for (&wait, pinned) in waits.iter().flat_map(|wait| [(wait, true), (wait, false)]) {
                for fifo in [false, true] {
                    if !fifo || wait == Wait::Block || (room && pinned) {
                        add(Case { carrier: Carrier::Graph, payload, wait, pinned, fifo });
                        add(Case { carrier: Carrier::Iceoryx2, payload, wait, pinned, fifo });
                    }
                }
            }
        }
    }
    if !room {
        notes.push(
            "polling under SCHED_FIFO is left out: it would keep both cores from everything else".into(),
        );
    }
    let (time, rounds) = (Duration::from_secs_f64(arguments.seconds), arguments.rounds);
    Ok((Options { cases, rate: arguments.rate, time, rounds, cores }, notes))
}

/// What the numbers belong to.
fn machine() -> serde_json::Value {
    let text = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    let model = text("/proc/cpuinfo");
    let model = model.lines().find_map(|line| line.strip_prefix("model name")?.split_once(": "));
    json!({
        "processor": model.map(|(_, name)| name),
        "cores": latency::cores().len(),
        "kernel": text("/proc/sys/kernel/osrelease").trim(),
    })
}

fn cell(delays: &Delays, percent: f64) -> String {
    delays.at(percent).map_or_else(String::new, |ns| output::seconds(ns as f64 * 1e-9))
}

fn print(report: &Report, aims: &[Aim]) {
    for warning in &report.warnings {
        eprintln!("warning: {warning}");
    }
    let mut last = None;
    let mut rows = Vec::new();
    // Cases that compare stand together.
    let mut sorted: Vec<_> = report.rows.iter().collect();
    let order = |case: &Case| (case.payload, case.wait.to_string(), !case.pinned, case.fifo);
    sorted.sort_by_key(|row| order(&row.case));
    for row in sorted {
        let group = plot::latency::describe(&row.case);
        let mut cells = vec![if last.as_ref() == Some(&group) { String::new() } else { group.clone() }];
        last = Some(group);
        cells.push(row.case.carrier.to_string());
        cells.extend([50.0, 99.0, 99.9, 99.99].map(|percent| cell(&row.one_way, percent)));
        cells.push(output::seconds(row.one_way.range().1 as f64 * 1e-9));
        cells.extend([50.0, 99.0].map(|percent| cell(&row.round_trip, percent)));
        cells.push(row.one_way.len().to_string());
        rows.push(cells);
    }
    output::table(
        &[
            "message",
            "carrier",
            "one way",
            "99 %",
            "99.9 %",
            "99.99 %",
            "most",
            "round trip",
            "99 %",
            "samples",
        ],
        &rows,
    );
    output::line("");
    let row = |what: &str, delays: &Delays| {
        let mut cells = vec![what.to_owned()];
        cells.extend([50.0, 99.0, 99.9].map(|percent| cell(delays, percent)));
        cells.push(output::seconds(delays.range().1 as f64 * 1e-9));
        cells
    };
    output::table(
        &["runtime", "50 %", "99 %", "99.9 %", "most"],
        &[
            row("around a step, recorded", &report.step),
            row("around a step, not recorded", &report.step_unrecorded),
            row("start of a step, 1 kHz, FIFO, sleeping", &report.lateness),
            row("clock_nanosleep, 1 kHz, FIFO", &report.bare_lateness),
        ],
    );
    output::line("");
    let aims: Vec<Vec<String>> = aims
        .iter()
        .map(|aim| {
            vec![
                match aim.verdict {
                    Verdict::Reached => "reached",
                    Verdict::Missed => "missed",
                    Verdict::Undecided => "undecided",
                }
                .into(),
                aim.what.clone(),
                output::seconds(aim.measured_ns * 1e-9),
                output::seconds(aim.limit_ns * 1e-9),
                format!("{:.2}", aim.ratio),
                aim.interval.map_or_else(String::new, |(low, high)| format!("{low:.2} to {high:.2}")),
            ]
        })
        .collect();
    output::table(&["aim", "what", "measured", "limit", "ratio", "95 %"], &aims);
}
