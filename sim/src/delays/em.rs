//! Expectation maximisation of a mixture of normal distributions on cells.
//!
//! A cell is an interval as wide as the clock's step, and the likelihood is the probability of the intervals (McLachlan
//! and Jones, "Fitting mixture models to grouped and truncated data via the EM algorithm", Biometrics 1988). Ties and coarse
//! clocks therefore do not pull a component into a point of infinite density. A cell at zero reaches down without end, as
//! delays are clipped there.

use parallax_runtime::delay::special::{normal_cdf, normal_density};

use super::cells::Cells;

/// One normal distribution of a mixture, in the cells' units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Component {
    pub(super) weight: f64,
    pub(super) mean: f64,
    pub(super) std: f64,
}

impl Component {
    /// The cell that holds all of it but half a per cent, if there is one.
    pub(super) fn cell(&self, cells: &Cells) -> Option<f64> {
        let after = cells.x.partition_point(|x| *x < self.mean);
        let around = [after.checked_sub(1), Some(after)].into_iter().flatten().filter(|i| *i < cells.x.len());
        let whole =
            |index: &usize| interval(self, cells, cells.x[*index], cells.clipped && *index == 0).0 > 0.995;
        around.into_iter().find(whole).map(|index| cells.x[index])
    }
}

/// Components, and a uniform background over the whole range for what belongs to none (Banfield and Raftery 1993).
#[derive(Debug, Clone)]
pub(super) struct Mixture {
    pub(super) components: Vec<Component>,
    /// Weight of the background; `None` for a mixture without one.
    pub(super) background: Option<f64>,
    /// Logarithm of the likelihood of all delays.
    pub(super) log_likelihood: f64,
}

/// A component is a density as long as it is this many times wider than a cell.
const WIDE: f64 = 8.0;
/// The logarithm of the square root of two pi.
const LOG_ROOT_TWO_PI: f64 = 0.918_938_533_204_672_7;
/// The narrowest component, in steps of the clock: all of it lies in one cell.
pub(super) const NARROWEST: f64 = 0.1;

/// Sums over the cells of what belongs to one component.
#[derive(Clone, Copy, Default)]
struct Moments {
    weight: f64,
    first: f64,
    second: f64,
}

impl Mixture {
    /// Iterates until the likelihood gains less than `tolerance` per delay, at most `iterations` times.
    pub(super) fn fit(&mut self, cells: &Cells, iterations: usize, tolerance: f64) {
        let mut masses = vec![0.0; self.components.len()];
        let mut moments = vec![Moments::default(); self.components.len()];
        let mut last = f64::NEG_INFINITY;
        for _ in 0..iterations {
            self.iterate(cells, &mut masses, &mut moments);
            if self.log_likelihood - last < tolerance * cells.total {
                break;
            }
            last = self.log_likelihood;
        }
    }

    /// One iteration; the likelihood is that of the mixture before it.
    fn iterate(&mut self, cells: &Cells, masses: &mut [f64], moments: &mut [Moments]) {
        moments.fill(Moments::default());
        let (mut log_likelihood, mut outside) = (0.0, 0.0);
        let uniform = self.background.map(|weight| weight * 2.0 * cells.half / cells.range());
        let factors: Vec<(f64, f64)> = self
            .components
            .iter()
            .map(|c| {
                (1.0 / c.std, c.weight * 2.0 * cells.half / (c.std * (2.0 * std::f64::consts::PI).sqrt()))
            })
            .collect();
        let points: Vec<bool> = self.components.iter().map(|c| c.std > WIDE * cells.half).collect();
        for (index, (&x, &count)) in cells.x.iter().zip(&cells.count).enumerate() {
            let at_zero = cells.clipped && index == 0;
            let mut sum = uniform.unwrap_or(0.0);
            for (k, mass) in masses.iter_mut().enumerate() {
                let component = &self.components[k];
                *mass = if points[k] && !at_zero {
                    let z = (x - component.mean) * factors[k].0;
                    factors[k].1 * (-0.5 * z * z).exp()
                } else {
                    component.weight * interval(component, cells, x, at_zero).0
                };
                sum += *mass;
            }
            if sum < 1e-280 {
                // Farther from all than numbers reach: it belongs to the nearest.
                let distance = |c: &Component| ((x - c.mean) / c.std).abs();
                let mut nearest = 0;
                for (k, component) in self.components.iter().enumerate() {
                    if distance(component) < distance(&self.components[nearest]) {
                        nearest = k;
                    }
                }
                let Component { weight, std, .. } = self.components[nearest];
                let factor = (weight * 2.0 * cells.half / std).max(1e-280);
                log_likelihood += count
                    * (factor.ln() - 0.5 * distance(&self.components[nearest]).powi(2) - LOG_ROOT_TWO_PI);
                moments[nearest].weight += count;
                moments[nearest].first += count * x;
                moments[nearest].second += count * x * x;
                continue;
            }
            log_likelihood += count * sum.ln();
            let share = count / sum;
            outside += share * uniform.unwrap_or(0.0);
            for (k, mass) in masses.iter().enumerate() {
                let part = share * mass;
                let (first, second) = if points[k] && !at_zero {
                    (x, x * x)
                } else {
                    let (_, first, second) = interval(&self.components[k], cells, x, at_zero);
                    (first, second)
                };
                moments[k].weight += part;
                moments[k].first += part * first;
                moments[k].second += part * second;
            }
        }
        self.log_likelihood = log_likelihood;
        for (component, moment) in self.components.iter_mut().zip(moments.iter()) {
            component.weight = moment.weight / cells.total;
            if moment.weight > 1e-9 {
                component.mean = moment.first / moment.weight;
                let variance = moment.second / moment.weight - component.mean * component.mean;
                component.std = variance.max(0.0).sqrt();
            }
            component.std = component.std.max(NARROWEST * 2.0 * cells.half);
        }
        if let Some(weight) = &mut self.background {
            *weight = outside / cells.total;
        }
    }

    /// How probable it is that each cell belongs to what `keep` does not name, or to the background.
    pub(super) fn strangeness(&self, cells: &Cells, keep: &[bool]) -> Vec<f64> {
        let uniform = self.background.unwrap_or(0.0) * 2.0 * cells.half / cells.range();
        let mass = |index: usize, x: f64| {
            let at_zero = cells.clipped && index == 0;
            let (mut inside, mut outside) = (0.0, uniform);
            for (component, keep) in self.components.iter().zip(keep) {
                let mass = component.weight * interval(component, cells, x, at_zero).0;
                *if *keep { &mut inside } else { &mut outside } += mass;
            }
            if inside + outside > 0.0 { outside / (inside + outside) } else { 1.0 }
        };
        cells.x.iter().enumerate().map(|(index, &x)| mass(index, x)).collect()
    }
}

/// The probability of a cell under a component, and the first two moments of the component within the cell.
fn interval(component: &Component, cells: &Cells, x: f64, at_zero: bool) -> (f64, f64, f64) {
    let Component { mean, std, .. } = *component;
    if std > WIDE * cells.half && !at_zero {
        let z = (x - mean) / std;
        return (normal_density(z) * 2.0 * cells.half / std, x, x * x);
    }
    let high = (x + cells.half - mean) / std;
    let low = if at_zero { f64::NEG_INFINITY } else { (x - cells.half - mean) / std };
    // The smaller tails keep the digits.
    let mass =
        if low > 0.0 { normal_cdf(-low) - normal_cdf(-high) } else { normal_cdf(high) - normal_cdf(low) };
    if mass < 1e-290 {
        return (0.0, x, x * x);
    }
    let density = |z: f64| if z.is_finite() { normal_density(z) } else { 0.0 };
    let moment = |z: f64| if z.is_finite() { z * normal_density(z) } else { 0.0 };
    let first = (density(low) - density(high)) / mass;
    let second = 1.0 + (moment(low) - moment(high)) / mass;
    (mass, mean + std * first, mean * mean + 2.0 * mean * std * first + std * std * second)
}
