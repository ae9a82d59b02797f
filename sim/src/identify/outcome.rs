//! From the best point of a search: what was found, how sure it is, and how well it predicts.

use nalgebra::{DMatrix, DVector};
use parallax_model::fit::{Best, Local, Stop};

use super::around::all_around;
use super::combination::{Combination, Member, combinations};
use super::coordinate::Sort;
use super::error::IdentifyError;
use super::evaluate::{Evaluator, Fit, Model, Scattered, wrapped};
use super::humps::{Component, Two, two_humps};
use super::identified::{Estimate, Hump, Humps, Identified, Known, Score};
use super::location::{Location, Moment, locations};
use super::problem::Problem;
use super::spread::{Part, Spread};

/// A coefficient whose uncertainty grows by this factor through the others is not determined.
const LOOSE_COEFFICIENT: f64 = 1e3;
/// 97.5 % of the normal distribution lie below this many standard deviations.
const BELOW: f64 = 1.959_963_984_540_054;

/// Makes a result of the best point.
pub(super) fn outcome(
    problem: &Problem,
    evaluator: &Evaluator<'_>,
    best: &Best,
    stop: Option<Stop>,
    rollouts: u64,
) -> Result<Identified, IdentifyError> {
    let scattered = match problem.scattered.is_empty() {
        true => None,
        false => Some(evaluator.scattered(best)?),
    };
    let best = scattered.as_ref().map_or(best, |scattered| &scattered.best);
    let (local, coefficients, inflation, parts) = match &scattered {
        Some(Scattered { local, coefficients, parts, .. }) => {
            (local.clone(), coefficients.clone(), 1.0, parts.clone())
        }
        None => {
            let Model { local, fit, parts } = evaluator.explained(&best.point)?;
            let inflation = inflation(problem, local.gradient.len(), &fit);
            (local, fit.coefficients, inflation, parts)
        }
    };
    if !local.is_finite() {
        return Err(IdentifyError::NotFinite);
    }
    let mut values = Vec::new();
    for (coordinate, z) in problem.coordinates.iter().zip(&best.point) {
        values.push((coordinate.value(*z), coordinate.slope(*z)));
    }
    let linear = problem.outputs.iter().zip(&coefficients);
    let linear: Vec<(&str, f64)> = linear
        .flat_map(|(output, coefficients)| {
            output.names.iter().map(String::as_str).zip(coefficients.iter().copied())
        })
        .collect();

    let n = values.len();
    let all = n + linear.len();
    let information = DMatrix::from_row_slice(all, all, &local.information) / inflation;
    // Linear coefficients have no bounds to compare with; their uncertainty without that of the others is.
    let scale: Vec<f64> = (0..all)
        .map(|i| match i < n {
            true => 1.0,
            false => LOOSE_COEFFICIENT / information[(i, i)].sqrt().max(f64::MIN_POSITIVE),
        })
        .collect();
    let scaled = |information: &[f64]| {
        DMatrix::from_fn(all, all, |i, j| information[i * all + j] * scale[i] * scale[j])
    };
    let part = |part: &Local| Part {
        information: scaled(&part.information),
        gradient: DVector::from_fn(all, |i, _| part.gradient[i] * scale[i]),
    };
    let parts: Vec<Part> = parts.iter().map(part).collect();
    let spread = Spread::of_parts(&(scaled(&local.information) / inflation), inflation, &parts);

    let mut members: Vec<Member<'_>> = Vec::new();
    for (coordinate, (value, slope)) in problem.coordinates.iter().zip(&values) {
        members.push(Member { name: &coordinate.name, value: *value, sort: coordinate.sort, slope: *slope });
    }
    for (k, (name, value)) in linear.iter().enumerate() {
        members.push(Member { name, value: *value, sort: Sort::Linear, slope: scale[n + k] });
    }
    let deviation = |i: usize| spread.std(i) * members[i].slope.abs();

    let mut estimates = Vec::with_capacity(all);
    for ((i, member), places) in members.iter().enumerate().zip(locations(problem)) {
        let coordinate = problem.coordinates.get(i);
        let bounds = coordinate.map(|c| [c.low, c.high]);
        let at_bound = coordinate.is_some() && !(1e-6..=1.0 - 1e-6).contains(&best.point[i]);
        let std = spread.determines(i).then(|| deviation(i));
        let interval = match (std, coordinate) {
            (Some(_), Some(c)) => {
                // On the scale of the search, where the loss is more nearly a parabola.
                let z = best.point[i];
                let half = BELOW * spread.std(i);
                [c.value((z - half).max(0.0)), c.value((z + half).min(1.0))]
            }
            (Some(std), None) => [member.value - BELOW * std, member.value + BELOW * std],
            (None, Some(c)) => [c.low, c.high],
            (None, None) => [f64::MIN, f64::MAX],
        };
        estimates.push(Estimate {
            name: member.name.to_owned(),
            sort: member.sort,
            places,
            value: member.value,
            std,
            interval,
            bounds,
            at_bound,
            unit: coordinate.map_or_else(String::new, |c| c.unit.clone()),
        });
    }
    let spreads: Vec<(f64, f64)> =
        scattered.as_ref().map_or_else(Vec::new, |scattered| scattered.spreads.clone());
    let with_spreads = all + spreads.len();
    let covariance = (0..with_spreads * with_spreads).map(|at| {
        let (i, j) = (at / with_spreads, at % with_spreads);
        match (i < all && j < all, i == j) {
            (true, _) => spread.covariance[(i, j)] * members[i].slope * members[j].slope,
            (false, true) => deviation_of(spreads[i - all]).powi(2),
            (false, false) => 0.0,
        }
    });
    let covariance = covariance.collect();
    let (involved, combinations) = combinations(&members, &spread, &all_around(problem));
    leave_open_what_only_a_sum_tells(&mut estimates, &combinations);
    let mut remarks = remarks(&estimates, &involved, &combinations);
    for (&delay, found) in problem.scattered.iter().zip(&spreads) {
        let estimate = spread_of(&estimates[delay], *found);
        remarks.push(format!(
            "`{}` is another one for every message, with a standard deviation of {:.2} ms: the predictions are those of its mean, \
             and err by more than the noise where things move fast",
            estimates[delay].name,
            1e3 * estimate.value
        ));
        estimates.push(estimate);
    }
    let humps: Vec<Humps> = scattered.iter().filter_map(|found| humps(problem, found, &estimates)).collect();
    for found in &humps {
        remarks.push(format!(
            "`{}` comes in two humps, {:.2} ms apart: {:.0} % of its messages are in the later one",
            found.delay,
            1e3 * found.apart.value,
            100.0 * found.humps.last().map_or(0.0, |late| late.share.value)
        ));
    }
    let outputs = scores(problem, evaluator, best, &coefficients)?;
    let (loss, point) = (local.cost, best.point.clone());
    Ok(Identified {
        estimates,
        covariance,
        combinations,
        remarks,
        outputs,
        loss,
        stop,
        rollouts,
        point,
        humps,
    })
}

/// The humps of the delay that scatters, where a mixture was asked for and the recordings tell two.
fn humps(problem: &Problem, found: &Scattered, estimates: &[Estimate]) -> Option<Humps> {
    let (delay, (spread, _)) = (estimates.get(*problem.scattered.first()?)?, found.spreads.first()?);
    if !problem.asks_for_humps() {
        return None;
    }
    let Two { humps: [early, late], covariance, evidence } = two_humps(&found.readings, *spread)?;
    let variance = |i: usize| covariance[(i, i)];
    let hump = |component: Component, k: usize| Hump {
        share: Known::new(component.share, variance(0)),
        mean: Known::new(delay.value + component.offset, variance(1 + k)),
        spread: Known::new(component.spread, variance(3 + k)),
    };
    let apart = variance(1) + variance(2) - 2.0 * covariance[(1, 2)];
    Some(Humps {
        delay: delay.name.clone(),
        places: delay.places.clone(),
        humps: vec![hump(early, 0), hump(late, 1)],
        apart: Known::new(late.offset - early.offset, apart),
        evidence,
    })
}

/// The standard deviation of a spread that is the root of a variance with a standard deviation.
fn deviation_of((spread, of_square): (f64, f64)) -> f64 {
    of_square / (2.0 * spread.max(f64::MIN_POSITIVE))
}

/// The spread of a delay.
fn spread_of(delay: &Estimate, (spread, of_square): (f64, f64)) -> Estimate {
    let half = BELOW * of_square;
    let places = delay.places.iter().cloned().map(|place| match place {
        Location::Delay { from, to, port, .. } => Location::Delay { from, to, port, of: Moment::Spread },
        place => place,
    });
    Estimate {
        name: format!("{}.spread", delay.name),
        sort: Sort::Spread,
        places: places.collect(),
        value: spread,
        std: Some(deviation_of((spread, of_square))),
        interval: [(spread * spread - half).max(0.0).sqrt(), (spread * spread + half).sqrt()],
        bounds: None,
        at_bound: false,
        unit: delay.unit.clone(),
    }
}

/// Delays in a row of which the data tell the sum: a machine that starts anywhere shows nothing of the single ones, and what
/// the information says of them is how a simulation rounds between its ticks. Each lies where its bounds and the sums allow.
fn leave_open_what_only_a_sum_tells(estimates: &mut [Estimate], combinations: &[Combination]) {
    let of = |(name, _): &(String, f64)| estimates.iter().position(|estimate| estimate.name == *name);
    let is_sum = |c: &&Combination| {
        !c.product && c.factors.len() > 1 && c.factors.iter().all(|(_, factor)| *factor == 1.0)
    };
    let sums: Vec<(Vec<usize>, &Combination)> = combinations
        .iter()
        .filter(is_sum)
        .filter_map(|sum| Some((sum.factors.iter().map(of).collect::<Option<_>>()?, sum)))
        .collect();
    for &member in sums.iter().flat_map(|(members, _)| members) {
        let estimate = &mut estimates[member];
        estimate.std = None;
        estimate.interval = estimate.bounds.unwrap_or(estimate.interval);
    }
    // What one sum leaves of a delay narrows the others of the next: as often as there are sums.
    for (members, sum) in sums.iter().cycle().take(sums.len() * sums.len()) {
        let half = BELOW * sum.std;
        for &member in members {
            let total = |end: usize| {
                members.iter().filter(|&&i| i != member).map(|&i| estimates[i].interval[end]).sum::<f64>()
            };
            let [low, high] = estimates[member].interval;
            let interval = [low.max(sum.value - half - total(1)), high.min(sum.value + half - total(0))];
            estimates[member].interval = interval;
        }
    }
}

/// How much larger than declared the noise is that is there: where predictions err by more, their errors count.
fn inflation(problem: &Problem, all: usize, fit: &Fit) -> f64 {
    let samples: usize = fit.samples.iter().sum();
    let freedom = samples.saturating_sub(all).max(1) as f64;
    let declared = problem.outputs.iter().zip(&fit.squares).map(|(output, squares)| match output.noise {
        Some(noise) => squares / (noise * noise),
        None => 0.0,
    });
    match problem.outputs.iter().all(|output| output.noise.is_some()) {
        true => (declared.sum::<f64>() / freedom).max(1.0),
        // The estimated noise is that of the residuals, which the fit has made smaller.
        false => samples as f64 / freedom,
    }
}

fn remarks(estimates: &[Estimate], involved: &[usize], combinations: &[Combination]) -> Vec<String> {
    let mut remarks = Vec::new();
    for (sort, what) in [(Sort::Parameter, "parameters"), (Sort::Delay, "delays")] {
        let of = |i: &&usize| estimates[**i].sort == sort;
        let names: Vec<&str> = involved.iter().filter(of).map(|&i| estimates[i].name.as_str()).collect();
        if names.is_empty() {
            continue;
        }
        let found: Vec<&str> = combinations
            .iter()
            .filter(|c| c.product == (sort == Sort::Parameter))
            .map(|c| c.text.as_str())
            .collect();
        remarks.push(match (names.len(), found.len()) {
            (1, _) => format!("the data do not determine {}", names[0]),
            (_, 0) => format!("the data do not determine the {what} {}", names.join(", ")),
            (all, some) => format!(
                "of the {all} {what} {} the data determine only {some} combination{}: {}. To know each by itself, fix {} or \
                 give priors.",
                names.join(", "),
                if some == 1 { "" } else { "s" },
                found.join(", "),
                if all - some == 1 { "one of them".to_owned() } else { format!("{} of them", all - some) },
            ),
        });
    }
    let among = |names: &[(String, f64)]| {
        names.iter().all(|(name, _)| involved.iter().any(|&i| estimates[i].name == *name))
    };
    for sum in combinations.iter().filter(|c| !c.product && !among(&c.factors)) {
        remarks.push(format!(
            "the data tell {} far better than each of these delays by itself: single ones lie where their bounds and the sum \
             allow",
            sum.text
        ));
    }
    let states: Vec<&str> = involved
        .iter()
        .filter(|&&i| matches!(estimates[i].sort, Sort::State | Sort::Linear))
        .map(|&i| estimates[i].name.as_str())
        .collect();
    if !states.is_empty() {
        remarks.push(format!("the data do not determine {} by themselves", states.join(", ")));
    }
    for estimate in estimates.iter().filter(|estimate| estimate.at_bound && estimate.std.is_some()) {
        // A delay or a spread cannot be less than nothing: there is no bound to widen.
        let nothing = matches!(estimate.sort, Sort::Delay | Sort::Spread) && estimate.value.abs() < 1e-9;
        remarks.push(if nothing {
            format!("`{}` ended at zero: the recordings show none", estimate.name)
        } else {
            format!(
                "`{}` ended at its bound {:.6}: widen the bounds, or take it as fixed",
                estimate.name, estimate.value
            )
        });
    }
    remarks
}

fn scores(
    problem: &Problem,
    evaluator: &Evaluator<'_>,
    best: &Best,
    coefficients: &[Vec<f64>],
) -> Result<Vec<Score>, IdentifyError> {
    let predicted = evaluator.predict(&best.point, coefficients)?;
    let scores = problem.outputs.iter().enumerate().map(|(index, output)| {
        let error = |seen: bool| {
            let (mut count, mut square) = (0, 0.0);
            for (episode, predicted) in predicted[index].iter().enumerate() {
                let [from, until, end] = problem.spans[episode];
                let (from, until) = if seen { (from, until) } else { (until, end) };
                for (step, value) in predicted.iter().enumerate() {
                    if output.counts(episode, step, from, until) && value.is_finite() {
                        let residual = wrapped(output.values[episode][step] - value, output.wrap);
                        square += residual * residual;
                        count += 1;
                    }
                }
            }
            (count, (square / f64::from(count.max(1))).sqrt())
        };
        let (samples, fitted) = error(true);
        let (unseen, held_out) = error(false);
        Score {
            output: output.name.clone(),
            fitted,
            samples: samples as usize,
            held_out: (unseen > 0).then_some(held_out),
            noise: output.noise,
        }
    });
    Ok(scores.collect())
}
