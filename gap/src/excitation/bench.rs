//! The bench on which inputs are tried: the machine's ranges, its rest, and what each candidate does there.

use parallax_model::system::Suggestion;

use super::apart::Apart;
use super::inputs::{Frame, Shape, Span};
use super::sensors::Sensor;
use super::trial::{Trial, calm};
use super::{Command, Design, DesignError, Wishes, short};
use crate::experiment::Held;
use crate::filter::Noise;
use crate::search::Fit;
use crate::setup::Setup;
use crate::statistics::median;

/// Commands that are varied one by one, at most; more are varied together only.
const MOST_ALONE: usize = 3;

/// Readings of a trial, at most: a longer one has fewer.
const MOST_READINGS: f64 = 4000.0;

/// An input to try: what each chosen command does.
#[derive(Clone, Debug)]
pub(super) struct Proposal {
    order: usize,
    description: String,
    /// Shape values by input, on the bench's grid.
    shapes: Vec<(usize, Vec<f64>)>,
    kind: (Shape, usize),
}

/// A proposal with what it shows of every pair of candidates.
#[derive(Clone, Debug)]
pub(super) struct Tried {
    pub(super) order: usize,
    proposal: Proposal,
    amplitude: f64,
    pub(super) apart: Apart,
    reach: Vec<(f64, f64)>,
}

/// Everything that is the same for all proposals.
pub(super) struct Bench<'a> {
    setup: &'a Setup,
    candidates: &'a [&'a Fit],
    trial: Trial,
    pub(super) frame: Frame,
    grid: Vec<f64>,
    /// The commands that can be chosen, with their ranges.
    chosen: Vec<(usize, Span)>,
    /// The range of each output; none where an angle goes round.
    ranges: Vec<Option<(f64, f64)>>,
}

impl<'a> Bench<'a> {
    pub(super) fn new(
        setup: &'a Setup,
        null: &Fit,
        candidates: &'a [&'a Fit],
        wishes: &Wishes,
    ) -> Result<Self, DesignError> {
        let system = setup.equations.system();
        check(setup, wishes)?;
        let limit = |signal: &str, name: &str| {
            wishes.limits.iter().rev().find(|limit| limit.signal == signal || limit.signal == name)
        };
        let mut chosen = Vec::new();
        let mut rest = Vec::new();
        for (index, input) in system.inputs.iter().enumerate() {
            let range = &setup.input_range[index];
            let usual = median(&mut setup.experiment.inputs[index].values.clone());
            let asked = limit(&input.signal, &input.name);
            let (low, high) = asked.map_or((range.low, range.high), |limit| (limit.low, limit.high));
            let given = setup.experiment.given.get(index).copied().unwrap_or(false) && asked.is_none();
            if given || low >= high {
                rest.push(usual);
                continue;
            }
            let span = Span::new(low, high, usual);
            rest.push(span.rest);
            chosen.push((index, span));
        }
        if chosen.is_empty() {
            return Err(DesignError::NoCommand);
        }
        let ranges = system.outputs.iter().enumerate().map(|(index, output)| {
            if let Some(limit) = limit(&output.signal, &output.name) {
                return Some((limit.low, limit.high));
            }
            // Twice as far as the log went, to either side of its middle.
            let range = &setup.output_range[index];
            output.wrap.is_none().then(|| (range.middle() - range.width(), range.middle() + range.width()))
        });
        let ranges = ranges.collect();
        let (from, to) = setup.experiment.span();
        let readings: f64 =
            (0..system.outputs.len()).map(|o| 1.0 / setup.experiment.period(o).max(1e-9)).sum();
        let usual = (to - from).min(20.0).max(20.0 * setup.horizon);
        let duration = wishes.duration.unwrap_or_else(|| usual.min(MOST_READINGS / readings.max(1e-9)));
        let step = chosen
            .iter()
            .map(|(input, _)| {
                let times = &setup.experiment.inputs[*input].times;
                median(&mut times.windows(2).map(|w| w[1] - w[0]).collect::<Vec<_>>())
            })
            .filter(|step| *step > 0.0 && step.is_finite())
            .fold(f64::INFINITY, f64::min);
        let step = if step.is_finite() { step } else { setup.period };
        let grid: Vec<f64> =
            (0..(duration / step + 1e-6).floor() as usize).map(|k| k as f64 * step).collect();
        let highest = (0.4 / setup.period).min(0.25 / step);
        let frame = Frame { duration, highest, seed: wishes.seed };
        let resting = |trial: Trial, rest: &[f64]| {
            let held = |value: &f64| Held { times: vec![0.0], values: vec![*value] };
            trial.with_commands(&rest.iter().map(held).enumerate().collect::<Vec<_>>())
        };
        let state = calm(setup, null, &rest);
        let trial = resting(Trial::new(setup, &state, duration), &rest);
        Ok(Bench { setup, candidates, trial, frame, grid, chosen, ranges })
    }

    /// Every shape on every command alone, and on all of them at once.
    pub(super) fn proposals(&self) -> Vec<Proposal> {
        let system = self.setup.equations.system();
        let mut groups: Vec<Vec<usize>> = Vec::new();
        if self.chosen.len() <= MOST_ALONE {
            groups.extend((0..self.chosen.len()).map(|k| vec![k]));
        }
        if self.chosen.len() > 1 {
            groups.push((0..self.chosen.len()).collect());
        }
        let mut out = Vec::new();
        for (g, group) in groups.iter().enumerate() {
            for shape in Shape::ALL {
                let shapes = group.iter().map(|k| {
                    let seed = self.frame.seed.wrapping_mul(31).wrapping_add(*k as u64 + 1);
                    let frame = Frame { seed, ..self.frame };
                    let mut values = shape.values(&frame, &self.grid);
                    // Commands that move alike could not be told apart: every second one runs backwards in sign.
                    if k % 2 == 1 {
                        values.iter_mut().for_each(|v| *v = -*v);
                    }
                    (self.chosen[*k].0, values)
                });
                let names: Vec<&str> =
                    group.iter().map(|k| system.inputs[self.chosen[*k].0].signal.as_str()).collect();
                let on = if names.len() > 3 { "all commands".to_owned() } else { names.join(" and ") };
                out.push(Proposal {
                    order: out.len(),
                    description: format!("{} on {on}", shape.describe(&self.frame)),
                    shapes: shapes.collect(),
                    kind: (shape, g),
                });
            }
        }
        out
    }

    /// The first half of the best input and of the next ones of another kind.
    pub(super) fn halves(&self, tried: &[Tried]) -> Vec<Proposal> {
        let Some(best) = tried.first() else { return Vec::new() };
        let others = tried
            .iter()
            .filter(|t| t.proposal.kind != best.proposal.kind && t.apart.worst().0 != best.apart.worst().0);
        let next = tried.iter().skip(1).filter(|t| t.proposal.kind.0 != best.proposal.kind.0);
        let mut seen = Vec::new();
        let mut out = Vec::new();
        for other in others.take(1).chain(next.take(2)) {
            if seen.contains(&other.order) {
                continue;
            }
            seen.push(other.order);
            let middle = self.grid.len() / 2;
            let blank = vec![0.0; self.grid.len()];
            let mut shapes = Vec::new();
            for (input, _) in &self.chosen {
                let of =
                    |t: &Tried| t.proposal.shapes.iter().find(|(i, _)| i == input).map(|(_, v)| v.clone());
                let (a, b) = (of(best), of(other));
                if a.is_none() && b.is_none() {
                    continue;
                }
                let (a, b) = (a.unwrap_or_else(|| blank.clone()), b.unwrap_or_else(|| blank.clone()));
                // Played twice as fast, so that each half has the whole of its input.
                let fast = |v: &[f64], k: usize| v[(2 * k).min(v.len() - 1)];
                let values = (0..self.grid.len()).map(|k| {
                    if k < middle {
                        best.amplitude * fast(&a, k)
                    } else {
                        other.amplitude * fast(&b, k - middle)
                    }
                });
                shapes.push((*input, values.collect()));
            }
            out.push(Proposal {
                order: 1000 + out.len(),
                description: format!("{}, then {}", best.proposal.description, other.proposal.description),
                shapes,
                kind: best.proposal.kind,
            });
        }
        out
    }

    fn commands(&self, proposal: &Proposal, amplitude: f64) -> Vec<(usize, Held)> {
        let span = |input: usize| self.chosen.iter().find(|(i, _)| *i == input).map(|(_, span)| *span);
        let held = |(input, values): &(usize, Vec<f64>)| {
            let span = span(*input)?;
            let values = values.iter().map(|v| span.value(*v, amplitude)).collect();
            Some((*input, Held { times: self.grid.clone(), values }))
        };
        proposal.shapes.iter().filter_map(held).collect()
    }

    /// The proposal with the largest amplitude that keeps every candidate within the ranges.
    pub(super) fn try_alone(&self, proposal: Proposal) -> Option<Tried> {
        [1.0, 0.5, 0.25, 0.1].into_iter().find_map(|amplitude| {
            let trial = self.trial.with_commands(&self.commands(&proposal, amplitude));
            let noise = |k: usize| self.candidates[k].innovation.noise.clone();
            let (apart, reach) = self.apart(&trial, noise)?;
            Some(Tried { order: proposal.order, proposal: proposal.clone(), amplitude, apart, reach })
        })
    }

    /// The same with one sensor more.
    pub(super) fn try_with(&self, tried: &Tried, sensor: &Sensor) -> Option<Tried> {
        let setup = sensor.added(self.trial.setup())?;
        let trial = self.trial.with_setup(setup, self.setup.period);
        let trial = trial.with_commands(&self.commands(&tried.proposal, tried.amplitude));
        let noise = |k: usize| sensor.noise(&self.candidates[k].innovation.noise);
        let (apart, reach) = self.apart(&trial, noise)?;
        Some(Tried { apart, reach, ..tried.clone() })
    }

    /// How far the candidates are from each other, and how far each output would go. `None` when a candidate leaves the ranges.
    fn apart(&self, trial: &Trial, noise: impl Fn(usize) -> Noise) -> Option<(Apart, Vec<(f64, f64)>)> {
        // Smoothed friction creeps where a machine stands: what is told by how it creeps is told by nothing.
        let sticks = self.candidates.iter().any(|fit| fit.hypothesis.is_dry());
        let mut shown = Vec::with_capacity(self.candidates.len());
        for candidate in self.candidates {
            let found = if sticks { trial.simulate_finely(candidate)? } else { trial.simulate(candidate)? };
            let inside =
                self.ranges.iter().zip(&found.reach).all(|(range, (low, high))| {
                    range.is_none_or(|(least, most)| *low >= least && *high <= most)
                });
            if !inside {
                return None;
            }
            shown.push(found);
        }
        let mut apart = Apart::nowhere(self.candidates.len());
        for (truth, readings) in shown.iter().enumerate() {
            let away =
                |k: usize, noise: &Noise| trial.separation(readings, self.candidates[k], noise).powi(2);
            for other in (0..self.candidates.len()).filter(|other| *other != truth) {
                let noise = noise(other);
                // As far as the truth is from itself, to the same noise, another one may be as well, and by chance not be.
                let own = if sticks { 2.0 * away(truth, &noise) } else { 0.0 };
                apart.keep(truth, other, (away(other, &noise) - own).max(0.0).sqrt());
            }
        }
        let reach = (0..shown[0].reach.len()).map(|o| {
            let lows = shown.iter().map(|s| s.reach[o].0).fold(f64::INFINITY, f64::min);
            (lows, shown.iter().map(|s| s.reach[o].1).fold(f64::NEG_INFINITY, f64::max))
        });
        Some((apart, reach.collect()))
    }

    /// Which output leaves its range even when the commands rest, or the first one.
    pub(super) fn reason(&self) -> String {
        let Some(shown) = self.candidates.first().and_then(|c| self.trial.simulate(c)) else {
            return "the simulation runs away with the commands at rest".into();
        };
        let system = self.setup.equations.system();
        let out = system.outputs.iter().zip(&self.ranges).zip(&shown.reach).find_map(|((o, range), reach)| {
            let (low, high) = (*range)?;
            (reach.0 < low || reach.1 > high).then(|| {
                format!("with the commands at rest, `{}` goes from {:.4} to {:.4}, and may go from {low:.4} to {high:.4}", o.name, reach.0, reach.1)
            })
        });
        out.unwrap_or_else(|| "even at a tenth of the commands' ranges".into())
    }

    pub(super) fn conclude(&self, tried: &Tried, sensor: Option<&Sensor>) -> Design {
        let system = self.setup.equations.system();
        let held = self.commands(&tried.proposal, tried.amplitude);
        let commands: Vec<Command> = held
            .into_iter()
            .flat_map(|(input, held)| {
                let unit = self.setup.experiment.input_units.get(input).cloned().unwrap_or_default();
                let bound = &system.inputs[input];
                // What is the mean of several signals is sent to each of them.
                let signals = [&bound.signal].into_iter().chain(&bound.others);
                signals.map(move |signal| Command {
                    input,
                    signal: signal.clone(),
                    unit: unit.clone(),
                    held: held.clone(),
                })
            })
            .collect();
        let ranges: Vec<String> = commands
            .iter()
            .take(3)
            .map(|command| {
                let low = command.held.values.iter().copied().fold(f64::INFINITY, f64::min);
                let high = command.held.values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let unit = if command.unit.is_empty() { String::new() } else { format!(" {}", command.unit) };
                format!("{} to {}{unit}", short(low), short(high))
            })
            .collect();
        let description = format!(
            "{} ({}, {} s)",
            tried.proposal.description,
            ranges.join(" and "),
            short(self.frame.duration)
        );
        let label = |k: usize| self.candidates[k].hypothesis.label();
        let groups = tried.apart.groups();
        let (pair, separation) = tried.apart.between(&groups);
        let alike = groups.iter().filter(|group| groups.len() > 1 && group.len() > 1);
        let reach =
            system.outputs.iter().zip(&tried.reach).map(|(o, (low, high))| (o.name.clone(), *low, *high));
        Design {
            effects: (0..self.candidates.len()).map(label).collect(),
            duration: self.frame.duration,
            commands,
            description,
            sensor: sensor.map(Sensor::describe),
            pair: (label(pair.0), label(pair.1)),
            separation,
            alike: alike.map(|group| group.iter().map(|k| label(*k)).collect()).collect(),
            reach: reach.collect(),
        }
    }
}

/// Whether every limit is on something.
fn check(setup: &Setup, wishes: &Wishes) -> Result<(), DesignError> {
    let system = setup.equations.system();
    let inputs = system.inputs.iter().map(|input| (&input.signal, &input.name));
    let known: Vec<(&String, &String)> =
        inputs.chain(system.outputs.iter().map(|output| (&output.signal, &output.name))).collect();
    for limit in &wishes.limits {
        if !known.iter().any(|(signal, name)| **signal == limit.signal || **name == limit.signal) {
            let signals: Vec<&str> = known.iter().map(|(signal, _)| signal.as_str()).collect();
            return Err(DesignError::Limit {
                signal: limit.signal.clone(),
                suggestion: Suggestion::nearest(&limit.signal, signals.iter().copied()),
                known: signals.join(", "),
            });
        }
    }
    Ok(())
}
