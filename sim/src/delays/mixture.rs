//! How many components a mixture needs, which delays are outliers, and the mixture of the rest.
//!
//! **Number of components.** The one with the smallest Bayesian information criterion, `−2 ln L + p ln n`, which for
//! mixtures of normal distributions finds the true number as `n` grows (Keribin, "Consistent estimation of the order of
//! mixture models", Sankhyā 2000) and does so in practice (Fraley and Raftery, J. Am. Stat. Assoc. 2002). The integrated
//! likelihood of classifications (ICL) asks for separate clusters instead, which a schedule does not need: overlapping
//! components that describe a skewed delay are wanted.
//!
//! **Outliers.** Every candidate is fitted with and without a uniform background over the range of the data. What lies more
//! than [`FAR`] standard deviations from every component, and more probably belongs to the background or to components of
//! less than [`SUBSTANTIAL`] of all delays, is an outlier: counted, reported, and not part of the fit. A background of more
//! than [`SUBSTANTIAL`] is no explanation; components must then describe what it held.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

use super::cells::Cells;
use super::em::{Component, Mixture, NARROWEST};

/// Shares below this may be outliers.
pub(super) const SUBSTANTIAL: f64 = 0.03;
/// How many standard deviations of every component that is kept an outlier lies away at least.
const FAR: f64 = 6.0;
/// A component describes at least so many delays, and this share of them: fewer are no evidence of a shape.
const LEAST: (f64, f64) = (8.0, 0.008);
/// About so many groups of neighbouring delays stand for all of them until a candidate has nearly converged.
const GROUPS: usize = 250;
/// Iterations from each start, and from the best of them.
const ITERATIONS: (usize, usize) = (12, 400);
/// Gain in the logarithm of the likelihood per delay below which a candidate has converged, and the chosen one.
const TOLERANCE: (f64, f64) = (2e-6, 1e-7);

/// The components, and which cells they describe.
pub(super) struct Found {
    pub(super) components: Vec<Component>,
    /// Cells that are not outliers.
    pub(super) kept: Vec<bool>,
}

/// Fits mixtures of 1 to `most` components and takes the best.
pub(super) fn find(cells: &Cells, most: usize) -> Found {
    let mut random = ChaCha8Rng::seed_from_u64(0x6465_6c61_7973);
    let coarse = cells.coarse(GROUPS);
    let mut best: Option<(f64, Mixture)> = None;
    let mut before: Option<Mixture> = None;
    let mut misses = 0;
    for count in 1..=most {
        let mut winner: Option<(f64, Mixture)> = None;
        let mut better = false;
        for background in [None, Some(SUBSTANTIAL / 2.0)] {
            let Some(mixture) = candidate((cells, &coarse), count, background, before.as_ref(), &mut random)
            else {
                continue;
            };
            if count > 1 && small(&mixture, cells) {
                continue;
            }
            let criterion = criterion(&mixture, cells.total);
            let less =
                |best: &Option<(f64, Mixture)>| best.as_ref().is_none_or(|(least, _)| criterion < *least);
            let vague = mixture.background.is_some_and(|weight| weight > SUBSTANTIAL);
            if !vague && less(&best) {
                best = Some((criterion, mixture.clone()));
                better = true;
            }
            // Where a mixture with a vague background describes most, its components are still good to split.
            if less(&winner) {
                winner = Some((criterion, mixture));
            }
        }
        misses = if better { 0 } else { misses + 1 };
        if misses == 2 {
            break;
        }
        before = winner.map(|(_, mixture)| mixture);
    }
    let mixture = match best {
        Some((_, mixture)) => mixture,
        // Nothing described the data within the limits: one component describes all of it.
        None => moments(cells),
    };
    settle(cells, mixture)
}

/// Whether a component describes too few delays.
fn small(mixture: &Mixture, cells: &Cells) -> bool {
    let least = LEAST.0.max(LEAST.1 * cells.total);
    mixture.components.iter().any(|c| c.weight * cells.total < least)
}

fn criterion(mixture: &Mixture, total: f64) -> f64 {
    let parameters = 3 * mixture.components.len() - 1 + usize::from(mixture.background.is_some());
    -2.0 * mixture.log_likelihood + parameters as f64 * total.ln()
}

/// One normal distribution with the mean and standard deviation of everything.
fn moments(cells: &Cells) -> Mixture {
    let mut mixture = with_components(vec![whole(cells)], None);
    mixture.fit(cells, ITERATIONS.1, TOLERANCE.1);
    mixture
}

fn whole(cells: &Cells) -> Component {
    stretch(cells, 0, cells.x.len())
}

fn with_components(mut components: Vec<Component>, background: Option<f64>) -> Mixture {
    let sum: f64 = components.iter().map(|c| c.weight).sum();
    for component in &mut components {
        component.weight *= (1.0 - background.unwrap_or(0.0)) / sum;
    }
    Mixture { components, background, log_likelihood: f64::NEG_INFINITY }
}

/// The best of several starts on the joined cells, fitted to convergence on all.
fn candidate(
    (all, cells): (&Cells, &Cells),
    count: usize,
    background: Option<f64>,
    before: Option<&Mixture>,
    random: &mut ChaCha8Rng,
) -> Option<Mixture> {
    if cells.x.len() < count {
        return None;
    }
    let mut starts = vec![by_quantiles(cells, count)];
    if count > 1 {
        starts.push(by_means(cells, count, random));
        starts.push(by_means(cells, count, random));
        starts.push(by_gaps(cells, count));
    }
    if let Some(before) = before.filter(|before| before.components.len() + 1 == count) {
        starts.extend(splits(before));
    }
    let mut best: Option<Mixture> = None;
    for components in starts {
        let mut mixture = with_components(components, background);
        mixture.fit(cells, ITERATIONS.0, TOLERANCE.0);
        // A start that lost itself in a few delays has a great likelihood and describes nothing.
        if count > 1 && small(&mixture, cells) {
            continue;
        }
        if best.as_ref().is_none_or(|best| mixture.log_likelihood > best.log_likelihood) {
            best = Some(mixture);
        }
    }
    if let Some(best) = &mut best {
        best.fit(cells, ITERATIONS.1, TOLERANCE.0);
        best.fit(all, ITERATIONS.1, TOLERANCE.0);
    }
    best
}

/// Mean and standard deviation of the cells from `from` to before `to`.
fn stretch(cells: &Cells, from: usize, to: usize) -> Component {
    let to = to.max(from + 1);
    let (x, count) = (&cells.x[from..to], &cells.count[from..to]);
    let weight: f64 = count.iter().sum();
    let mean = x.iter().zip(count).map(|(x, c)| x * c).sum::<f64>() / weight;
    let variance = x.iter().zip(count).map(|(x, c)| c * (x - mean).powi(2)).sum::<f64>() / weight;
    let narrowest = NARROWEST * 2.0 * cells.half;
    Component { weight, mean, std: variance.sqrt().max(cells.half).max(narrowest) }
}

/// Equal shares of the middle 96 %, in order.
fn by_quantiles(cells: &Cells, count: usize) -> Vec<Component> {
    let (mut sum, mut ends) = (0.0, Vec::with_capacity(count + 1));
    let part = |k: usize| cells.total * (0.02 + 0.96 * k as f64 / count as f64);
    for (index, c) in cells.count.iter().enumerate() {
        while ends.len() <= count && sum + c > part(ends.len()) {
            ends.push(index);
        }
        sum += c;
    }
    ends.resize(count + 1, cells.x.len());
    (0..count).map(|k| stretch(cells, ends[k].min(cells.x.len() - 1), ends[k + 1])).collect()
}

/// Split at the widest gaps: small modes that lie apart.
fn by_gaps(cells: &Cells, count: usize) -> Vec<Component> {
    let mut gaps: Vec<usize> = (1..cells.x.len()).collect();
    let width = |index: usize| cells.x[index] - cells.x[index - 1];
    gaps.sort_by(|&a, &b| width(b).total_cmp(&width(a)).then(a.cmp(&b)));
    gaps.truncate(count - 1);
    gaps.sort_unstable();
    let ends: Vec<usize> = [0].into_iter().chain(gaps).chain([cells.x.len()]).collect();
    ends.windows(2).map(|pair| stretch(cells, pair[0], pair[1])).collect()
}

/// k-means from centres drawn far from each other (k-means++, Arthur and Vassilvitskii 2007).
fn by_means(cells: &Cells, count: usize, random: &mut ChaCha8Rng) -> Vec<Component> {
    let mut unit = || (random.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
    let draw = |weights: &[f64], u: f64| {
        let sum: f64 = weights.iter().sum();
        let mut rest = u * sum;
        weights.iter().position(|w| {
            rest -= w;
            rest < 0.0
        })
    };
    let mut centres = vec![cells.x[draw(&cells.count, unit()).unwrap_or(0)]];
    let mut weights = vec![0.0; cells.x.len()];
    while centres.len() < count {
        for ((weight, &x), count) in weights.iter_mut().zip(&cells.x).zip(&cells.count) {
            let nearest = centres.iter().map(|c| (x - c).abs()).fold(f64::INFINITY, f64::min);
            *weight = count * nearest * nearest;
        }
        centres.push(cells.x[draw(&weights, unit()).unwrap_or(0)]);
    }
    let mut ends = Vec::new();
    for _ in 0..8 {
        centres.sort_by(f64::total_cmp);
        ends = vec![0];
        ends.extend(
            centres.windows(2).map(|pair| cells.x.partition_point(|x| *x < 0.5 * (pair[0] + pair[1]))),
        );
        ends.push(cells.x.len());
        for (centre, end) in centres.iter_mut().zip(ends.windows(2)) {
            if end[0] < end[1] {
                *centre = stretch(cells, end[0], end[1]).mean;
            }
        }
    }
    ends.windows(2).map(|pair| stretch(cells, pair[0].min(cells.x.len() - 1), pair[1])).collect()
}

/// The best mixture with one component fewer, each of its components in turn in two halves, or in a core and a flank.
fn splits(before: &Mixture) -> Vec<Vec<Component>> {
    let mut starts = Vec::new();
    for (index, &Component { weight, mean, std }) in before.components.iter().enumerate() {
        let half = 0.5 * weight;
        for [first, second] in [
            [
                Component { weight: half, mean: mean - 0.8 * std, std: 0.6 * std },
                Component { weight: half, mean: mean + 0.8 * std, std: 0.6 * std },
            ],
            [
                Component { weight: half, mean, std: 0.5 * std },
                Component { weight: half, mean, std: 1.5 * std },
            ],
        ] {
            let mut components = before.components.clone();
            components[index] = first;
            components.push(second);
            starts.push(components);
        }
    }
    starts
}

/// Sorts out the outliers, and fits the rest again.
fn settle(cells: &Cells, mixture: Mixture) -> Found {
    let large: Vec<Component> =
        mixture.components.iter().filter(|c| c.weight >= SUBSTANTIAL).copied().collect();
    let near =
        |c: &Component| large.iter().any(|l| (c.mean - l.mean).abs() <= FAR * l.std.max(2.0 * cells.half));
    let keep: Vec<bool> = mixture.components.iter().map(|c| c.weight >= SUBSTANTIAL || near(c)).collect();
    let strange = mixture.strangeness(cells, &keep);
    let far = |x: f64| {
        let kept = mixture.components.iter().zip(&keep).filter(|(_, keep)| **keep);
        kept.into_iter().all(|(c, _)| (x - c.mean).abs() > FAR * c.std.max(2.0 * cells.half))
    };
    let mut kept: Vec<bool> = strange.iter().zip(&cells.x).map(|(p, x)| *p <= 0.5 || !far(*x)).collect();
    let Some(rest) = cells.filtered(&kept) else {
        kept.fill(true);
        return Found { components: mixture.components, kept };
    };
    let components =
        mixture.components.iter().zip(&keep).filter(|(_, keep)| **keep).map(|(c, _)| *c).collect();
    let mut again = with_components(components, None);
    again.fit(&rest, ITERATIONS.1, TOLERANCE.1);
    let mut components = again.components;
    components.sort_by(|a, b| a.mean.total_cmp(&b.mean));
    Found { components, kept }
}
