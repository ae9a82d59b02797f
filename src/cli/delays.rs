//! `parallax delays`: what a recording says about its delays, as distributions.

use std::path::PathBuf;

use anyhow::{Context, anyhow};
use clap::Args;
use parallax_runtime::delay::Delay;
use parallax_runtime::recording::Recording;
use parallax_sim::delays::{DelayFit, FittedGraph, Place, fitted_graph};
use serde_json::json;

use super::args::make_parent;
use super::failure::{Failure, Outcome, Sort};
use super::output;
use crate::plot;

#[derive(Args)]
pub(crate) struct Arguments {
    /// The recording.
    recording: PathBuf,
    /// Write the recording's graph with the fitted delays.
    #[arg(short, long, value_name = "GRAPH.toml")]
    out: Option<PathBuf>,
    /// Draw the fits over what was measured: a page, or a picture.
    #[arg(long, value_name = "FILE.html|FILE.svg")]
    plot: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: &Arguments) -> Result<Outcome, Failure> {
    let path = arguments.recording.display();
    let recording = Recording::read(&arguments.recording).input()?;
    if recording.is_imported() {
        return Err(Failure::input(anyhow!(
            "{path} is an imported log: it has signals and no steps whose delays could be measured"
        )));
    }
    let fitted = fitted_graph(&recording, &crate::cli::python::registry())
        .with_context(|| format!("the graph of {path}"))
        .map_err(Failure::input)?;
    if fitted.fits.is_empty() {
        return Err(Failure::input(anyhow!(
            "{path} holds no whole step; record anew, or copy the file whole"
        )));
    }
    if let Some(end) = &recording.truncated {
        eprintln!("warning: {path} is only the beginning of a recording: {end}");
    }
    if let Some(out) = &arguments.out {
        make_parent(out)?;
        let text = fitted.graph.to_toml().input()?;
        std::fs::write(out, text)
            .with_context(|| format!("{} cannot be written", out.display()))
            .map_err(Failure::input)?;
    }
    if let Some(out) = &arguments.plot {
        let title = format!("Delays of {}", recording.graph.name);
        let figure = plot::delays::figure(&fitted.fits, &fitted.measured);
        plot::write(out, &title, &path.to_string(), vec![figure])?;
    }
    if arguments.json {
        output::json(&json!({
            "graph": recording.graph.name, "delays": fitted.fits, "without_samples": fitted.missing,
            "out": arguments.out, "plot": arguments.plot,
        }))?;
    } else {
        print(&fitted);
        for written in arguments.out.iter().chain(&arguments.plot) {
            output::line(format!("written to {}", written.display()));
        }
    }
    Ok(Outcome::Done)
}

fn print(fitted: &FittedGraph) {
    for (what, computation) in [("node", true), ("connection", false)] {
        let rows: Vec<Vec<String>> = fitted
            .fits
            .iter()
            .filter(|fit| matches!(fit.place, Place::Computation { .. }) == computation)
            .map(row)
            .collect();
        if !rows.is_empty() {
            let header =
                [what, "samples", "mean", "std", "least", "most", "outliers", "correlation", "KS", "fit"];
            output::table(&header, &rows);
        }
    }
    for fit in &fitted.fits {
        if fit.left_out.negative > 0 {
            output::line(format!(
                "note: {}: {} delays are below zero and were left out: the clocks of the two ends disagree",
                fit.place, fit.left_out.negative
            ));
        }
        if fit.left_out.unseen * 10 > fit.samples + fit.left_out.unseen {
            output::line(format!(
                "note: {}: {} messages reached no step, and when they arrived is not recorded",
                fit.place, fit.left_out.unseen
            ));
        }
    }
    for place in &fitted.missing {
        output::line(format!("note: {place}: no delay was recorded; the graph keeps what it declares"));
    }
}

fn row(fit: &DelayFit) -> Vec<String> {
    let correlation = match fit.correlation {
        c if c.pairs == 0 || fit.components == 0 => "-".into(),
        c if c.significant => format!("{:.2}", c.value),
        c => format!("({:.2})", c.value),
    };
    vec![
        fit.place.to_string(),
        fit.samples.to_string(),
        output::seconds(fit.mean_s),
        output::seconds(fit.std_s),
        output::seconds(fit.min_s),
        output::seconds(fit.max_s),
        fit.outliers.to_string(),
        correlation,
        format!("{:.3}", fit.distance),
        describe(&fit.fit),
    ]
}

/// A delay in a few words.
pub(crate) fn describe(delay: &Delay) -> String {
    let pair = |mean: f64, std: f64| match std {
        0.0 => output::seconds(mean),
        std => format!("{} ± {}", output::seconds(mean), output::seconds(std)),
    };
    match delay {
        Delay::Constant { seconds: 0.0 } => "none".into(),
        Delay::Constant { seconds } => format!("constant {}", output::seconds(*seconds)),
        Delay::Normal { mean, std } => format!("normal {}", pair(*mean, *std)),
        Delay::Mixture { weights, means, stds } => {
            let sum: f64 = weights.iter().sum();
            let parts = weights.iter().zip(means).zip(stds);
            let parts: Vec<String> = parts
                .map(|((weight, mean), std)| format!("{:.0} %: {}", 100.0 * weight / sum, pair(*mean, *std)))
                .collect();
            format!("mixture {}", parts.join(", "))
        }
        Delay::LogNormal { mean, std } => format!("log-normal {}", pair(*mean, *std)),
        Delay::Gamma { mean, std } => format!("gamma {}", pair(*mean, *std)),
        Delay::Uniform { low, high } => {
            format!("uniform {} to {}", output::seconds(*low), output::seconds(*high))
        }
        Delay::Empirical { samples } => {
            format!("empirical, {} samples, mean {}", samples.len(), output::seconds(delay.expected()))
        }
        Delay::Correlated { correlation, of } => format!("{}, correlation {correlation:.2}", describe(of)),
        Delay::Output { leaf, min, max, .. } => {
            format!("by output {leaf}, {} to {}", output::seconds(*min), output::seconds(*max))
        }
    }
}
