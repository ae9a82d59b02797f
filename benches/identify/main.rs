//! Identification against machines that it cannot look into: time, quality and calibration, by one command.
//!
//! ```text
//! cargo bench --bench identify [-- --truths 40 --seed SEED --json FILE]
//! ```
//!
//! The machines are integrated by code of their own (`pendulum.rs`) in steps of 0.1 ms, with constants,
//! delays, noise and first states drawn from a seed that the clock gives, unless one is stated. Only their recordings reach
//! the identification. `docs/identification.md` says what is measured.

mod pendulum;
mod quadrotor;
mod truth;

use std::ops::ControlFlow;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use clap::Parser;
use parallax_model::fit::CmaOptions;
use parallax_sim::identify::{Identified, Method, Problem, search};
use serde::Serialize;
use serde_json::{Value, json};

use truth::{Truth, delay, share};

/// Identification against machines that it cannot look into.
#[derive(Parser)]
struct Options {
    /// How many machines.
    #[arg(long, default_value_t = 40)]
    truths: usize,
    /// Seed of the machines [default: the clock].
    #[arg(long)]
    seed: Option<u64>,
    /// Only this part: time, pendulum, quadrotor or jitter.
    #[arg(long)]
    only: Option<String>,
    /// Settings of the default solver, as JSON.
    #[arg(long, default_value = "{}")]
    solver: String,
    /// Writes all figures to this file.
    #[arg(long)]
    json: Option<std::path::PathBuf>,
    /// What `cargo bench` adds.
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> anyhow::Result<()> {
    let options = Options::parse();
    let clock = SystemTime::now().duration_since(UNIX_EPOCH).map_or(1, |time| time.as_nanos() as u64);
    let seed = options.seed.unwrap_or(clock);
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let load = load.split(' ').next().unwrap_or("?");
    println!("seed {seed}, {} threads, load {load}", rayon::current_num_threads());
    let wanted = |part: &str| options.only.as_deref().is_none_or(|only| only == part);
    let mut figures = json!({ "seed": seed, "load": load });
    if wanted("time") {
        figures["time"] = times(seed)?;
    }
    if wanted("pendulum") {
        let method = Method::Hybrid(serde_json::from_str(&options.solver)?);
        figures["pendulum"] = quality("pendulum", pendulum::truth, options.truths, seed, &method)?;
    }
    if wanted("quadrotor") {
        let method = Method::Hybrid(serde_json::from_str(&options.solver)?);
        figures["quadrotor"] = quality("quadrotor", quadrotor::truth, options.truths, seed, &method)?;
    }
    if wanted("jitter") {
        let method = Method::Hybrid(serde_json::from_str(&options.solver)?);
        let truth = pendulum::truth_with_a_camera_that_jitters;
        figures["jitter"] = quality("jitter", truth, options.truths, seed, &method)?;
    }
    if let Some(path) = &options.json {
        std::fs::write(path, serde_json::to_string_pretty(&figures)?)?;
    }
    Ok(())
}

/// One search and how long it took.
fn timed(problem: &Problem, method: &Method) -> anyhow::Result<(Identified, Duration)> {
    let start = Instant::now();
    let found = search(problem, method, None, &mut |_| ControlFlow::Continue(()))?;
    Ok((found, start.elapsed()))
}

/// The paper's searches at their size (section 4.3, appendix E): CMA-ES alone over all parameters.
fn times(seed: u64) -> anyhow::Result<Value> {
    let common = CmaOptions {
        population: Some(200),
        parents: Some(20),
        sigma: 0.4,
        single: true,
        ..CmaOptions::default()
    };
    let pendulum = CmaOptions {
        generations: 38,
        path_rate: Some(0.40),
        covariance_path_rate: Some(0.14),
        rank_one_rate: Some(0.0024),
        rank_mu_rate: Some(0.038),
        damping: Some(1.40),
        ..common.clone()
    };
    let quadrotor = CmaOptions {
        generations: 31,
        path_rate: Some(0.65),
        covariance_path_rate: Some(0.68),
        rank_one_rate: Some(0.19),
        rank_mu_rate: Some(0.27),
        damping: Some(2.41),
        ..common
    };
    Ok(json!({
        "pendulum": time("pendulum", pendulum::truth_with_every_parameter_searched(seed)?, pendulum)?,
        "quadrotor": time("quadrotor", quadrotor::truth(seed)?, quadrotor)?,
    }))
}

fn time(name: &str, truth: Truth, options: CmaOptions) -> anyhow::Result<Value> {
    let Truth { recording, registry, specification, floor, .. } = truth;
    let start = Instant::now();
    let problem = Problem::new(&[recording], &registry, &specification)?;
    let build = start.elapsed();
    let mut seconds: Vec<f64> = Vec::new();
    let (mut rollouts, mut of_floor) = (0, f64::NAN);
    for _ in 0..7 {
        let (found, time) = timed(&problem, &Method::CmaEs(options.clone()))?;
        seconds.push(time.as_secs_f64());
        (rollouts, of_floor) = (found.rollouts, share(&found, &floor));
    }
    seconds.sort_by(f64::total_cmp);
    let parameters = problem.names().count();
    println!(
        "{name}: CMA-ES at the paper's size, {parameters} parameters, {rollouts} rollouts: {:.3} s ({:.3} to {:.3}), ends at \
         {of_floor:.2} of the floor; tables {:.3} s",
        seconds[3],
        seconds[0],
        seconds[6],
        build.as_secs_f64()
    );
    Ok(json!({
        "parameters": parameters, "rollouts": rollouts, "seconds": seconds, "of_floor": of_floor,
        "tables_seconds": build.as_secs_f64(),
    }))
}

/// What was found of delays with one hump or two.
#[derive(Default, Serialize)]
struct Counted {
    one: usize,
    /// Of these, taken for two.
    false_alarms: usize,
    two: usize,
    told: usize,
    /// Of what was told, distances and shares within their 95 % intervals.
    distances_covered: usize,
    shares_covered: usize,
    worst_distance_s: f64,
    worst_share: f64,
}

impl Counted {
    fn count(&mut self, found: &Identified, truth: Option<(f64, f64)>) {
        let told = found.humps.first();
        let Some((apart, share)) = truth else {
            self.one += 1;
            if let Some(told) = told {
                self.false_alarms += 1;
                println!("      one hump, taken for two: {told:?}");
            }
            return;
        };
        self.two += 1;
        let Some(told) = told else {
            println!(
                "      two humps {:.2} ms apart with {share:.2} in the later one: not told",
                1e3 * apart
            );
            return;
        };
        self.told += 1;
        let late = told.humps[told.humps.len() - 1].share;
        println!(
            "      two humps {:+.3}±{:.3} of {:.2} ms apart, {:+.3}±{:.3} of {share:.2} in the later one",
            1e3 * (told.apart.value - apart),
            1e3 * told.apart.std,
            1e3 * apart,
            late.value - share,
            late.std
        );
        self.distances_covered += usize::from((told.apart.value - apart).abs() <= 1.96 * told.apart.std);
        self.shares_covered += usize::from((late.value - share).abs() <= 1.96 * late.std);
        self.worst_distance_s = self.worst_distance_s.max((told.apart.value - apart).abs());
        self.worst_share = self.worst_share.max((late.value - share).abs());
    }

    fn print(&self, name: &str) {
        println!(
            "{name}: {} of {} delays with one hump taken for two; of {} with two, {} told, {} distances and {} shares within \
             their 95 % intervals, worst errors {:.3} ms and {:.3}",
            self.false_alarms,
            self.one,
            self.two,
            self.told,
            self.distances_covered,
            self.shares_covered,
            1e3 * self.worst_distance_s,
            self.worst_share
        );
    }
}

/// The default solver on machines drawn at random.
fn quality(
    name: &str,
    truth: impl Fn(u64) -> anyhow::Result<Truth>,
    truths: usize,
    seed: u64,
    method: &Method,
) -> anyhow::Result<Value> {
    let mut cases = Vec::new();
    let (mut reached, mut quick) = (0, 0);
    let mut seconds = Vec::new();
    let (mut told, mut covered) = (0, 0);
    let (mut spread, mut spread_covered, mut spread_worst) = (0, 0, 0.0f64);
    let mut worst: f64 = 0.0;
    let mut two = Counted::default();
    for index in 0..truths as u64 {
        let seed = seed.wrapping_add(index.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let Truth { recording, registry, specification, floor, delays, spreads, humps } = truth(seed)?;
        let start = Instant::now();
        let problem = Problem::new(&[recording], &registry, &specification)?;
        let build = start.elapsed();
        let (found, time) = timed(&problem, method)?;
        let ratio = share(&found, &floor);
        reached += usize::from(ratio <= 1.05);
        quick += usize::from(time.as_secs_f64() <= 0.2);
        seconds.push(time.as_secs_f64());
        let mut errors = Vec::new();
        for (combination, value) in &delays {
            let (estimate, std) = delay(&found, combination);
            let Some(std) = std else {
                errors.push(json!({ "delay": combination.join(" + "), "determined": false }));
                continue;
            };
            told += 1;
            let error = estimate - value;
            covered += usize::from(error.abs() <= 1.96 * std);
            worst = worst.max(error.abs());
            errors.push(json!({ "delay": combination.join(" + "), "error": error, "std": std }));
        }
        for (name, value) in &spreads {
            let Some(estimate) = found.estimate(name) else { continue };
            spread += 1;
            let [low, high] = estimate.interval;
            spread_covered += usize::from(low <= *value && *value <= high);
            let (error, std) = (estimate.value - value, estimate.std);
            spread_worst = spread_worst.max(error.abs());
            errors.push(json!({ "delay": name, "error": error, "std": std, "truth": value }));
        }
        println!(
            "{name} {index:2}: {ratio:.3} of the floor, {:.3} s, {} rollouts, {:?}, delays {}",
            time.as_secs_f64(),
            found.rollouts,
            found.stop,
            errors
                .iter()
                .map(|e| format!(
                    "{:+.3}±{:.3} ms",
                    1e3 * e["error"].as_f64().unwrap_or(f64::NAN),
                    1e3 * e["std"].as_f64().unwrap_or(f64::NAN)
                ))
                .collect::<Vec<_>>()
                .join(", ")
        );
        if !spreads.is_empty() {
            two.count(&found, humps);
        }
        cases.push(json!({
            "seed": seed, "of_floor": ratio, "seconds": time.as_secs_f64(), "tables_seconds": build.as_secs_f64(),
            "rollouts": found.rollouts, "delays": errors,
        }));
    }
    seconds.sort_by(f64::total_cmp);
    let middle = seconds[seconds.len() / 2];
    println!(
        "{name}: {reached} of {truths} within 5 % of the noise floor; {quick} in at most 0.2 s, median {middle:.3} s, \
         most {:.3} s; {told} delays determined, worst error {:.3} ms, {covered} within their 95 % intervals",
        seconds[seconds.len() - 1],
        1e3 * worst
    );
    if spread > 0 {
        println!(
            "{name}: {spread} spreads, worst error {:.3} ms, {spread_covered} within their 95 % intervals",
            1e3 * spread_worst
        );
        two.print(name);
    }
    Ok(json!({
        "humps": two,
        "spreads": spread, "spreads_covered": spread_covered, "worst_spread_error_s": spread_worst,
        "truths": truths, "within_5_percent": reached, "within_0.2_s": quick, "seconds": seconds,
        "delays_determined": told, "delays_covered": covered, "worst_delay_error_s": worst, "cases": cases,
    }))
}
