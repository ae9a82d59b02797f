//! Effects between a command and the plant, and on when a reading is taken: the part of a hypothesis that acts on a
//! recording's stamps and held values, before the equations see them.
//!
//! A command is a sequence of values, each held until the next. What changes a value alone changes the sequence. What
//! has a memory (a lag, a limited rate) is not constant between two commands: the sequence is cut into pieces shorter
//! than an integration step, over which its mean stands for it, exactly integrated. A delay moves the sequence in time
//! and keeps its derivative, so that fractional delays are smooth.

use parallax_model::Dual;
use parallax_model::effect::{Effect, PlaceKind, play_step, sag};
use parallax_model::plant::{BoundEffect, Plant};

use crate::experiment::Experiment;

/// A command's value from a time on.
#[derive(Clone, Copy, Debug)]
pub struct Change<const N: usize> {
    /// When it was sent (s).
    pub stamp: f64,
    /// When it begins to act (s).
    pub time: Dual<N>,
    /// What reaches the equations.
    pub value: Dual<N>,
}

/// A value held over an interval that begins at a stamp.
struct Piece<const N: usize> {
    stamp: f64,
    length: f64,
    value: Dual<N>,
}

/// How long a command is followed after its last stamp, in time constants of what smooths it.
const SETTLING: f64 = 6.0;

/// The command of one input as it reaches the plant's equations; `extra` are the plant's extra parameters and `step`
/// the longest integration step (s).
#[must_use]
pub fn changes<const N: usize>(
    plant: &Plant,
    experiment: &Experiment,
    step: f64,
    extra: &[Dual<N>],
    input: usize,
) -> Vec<Change<N>> {
    let here: Vec<(&BoundEffect, Vec<Dual<N>>)> = plant
        .effects_at(PlaceKind::Input, input)
        .into_iter()
        .map(|bound| (bound, plant.own(bound, extra)))
        .collect();
    let mut pieces = sent(experiment, input, here.iter().any(|(b, _)| b.effect == Effect::SupplySag));
    let mut cut = false;
    for (bound, own) in &here {
        if bound.effect.has_memory() && bound.effect != Effect::Backlash && !cut {
            pieces = into_pieces(&pieces, step, tail(&here, &pieces));
            cut = true;
        }
        let begin = begins(plant, experiment, input);
        act(bound.effect, own, experiment, input, begin, &mut pieces);
    }
    let mut out: Vec<Change<N>> = Vec::with_capacity(pieces.len());
    for piece in &pieces {
        let time = arrival(&here, Dual::from_value(piece.stamp), experiment.origin(piece.stamp));
        out.push(Change { stamp: piece.stamp, time, value: piece.value });
    }
    out
}

/// Where one input's commands begin in a recording.
#[derive(Clone, Copy, Debug)]
pub struct Beginning {
    /// Stamp of the first one (s).
    stamp: f64,
    /// How much later it acts (s).
    late: f64,
}

impl Beginning {
    /// Whether a reading that is stamped `stamp` (s) and taken at `taken` shows a machine under an earlier command, although it
    /// is stamped later: nobody recorded that command.
    #[must_use]
    pub fn hides(&self, stamp: f64, taken: f64) -> bool {
        stamp >= self.stamp && taken - self.late < self.stamp - 1e-9
    }
}

/// Where the commands of each input begin, recording by recording.
#[must_use]
pub fn beginnings<const N: usize>(
    experiment: &Experiment,
    changes: &[Vec<Change<N>>],
) -> Vec<Vec<Beginning>> {
    let mut found: Vec<Vec<Beginning>> = vec![Vec::new(); experiment.parts.len().max(1)];
    for channel in changes {
        let mut next = 0;
        for change in channel {
            let part = experiment.part(change.stamp);
            if part < next {
                continue;
            }
            let late = change.time.value - change.stamp;
            found[part].push(Beginning { stamp: change.stamp, late });
            next = part + 1;
        }
    }
    found
}

/// What is between the stamps of an output's readings and the times at which they are taken.
#[derive(Clone, Debug)]
pub struct Clock<const N: usize>(Vec<(Effect, Dual<N>)>);

impl<const N: usize> Clock<N> {
    /// Of an output under the plant's effects.
    #[must_use]
    pub fn new(plant: &Plant, extra: &[Dual<N>], output: usize) -> Self {
        let effects = plant.effects_at(PlaceKind::Output, output).into_iter();
        let late = effects.filter(|bound| matches!(bound.effect, Effect::Delay | Effect::ClockSkew));
        Clock(late.map(|bound| (bound.effect, plant.own(bound, extra)[0])).collect())
    }

    /// When a reading was taken that is stamped `stamp` (s).
    #[must_use]
    pub fn taken(&self, stamp: f64) -> Dual<N> {
        let mut time = Dual::from_value(stamp);
        for (effect, own) in &self.0 {
            match effect {
                Effect::Delay => time -= *own,
                // The stamp is t (1 + skew).
                _ => time /= *own + 1.0,
            }
        }
        time
    }
}

/// Whether readings of an output may be taken at another time than their stamp says.
#[must_use]
pub fn is_late(plant: &Plant, output: usize) -> bool {
    plant.effects_at(PlaceKind::Output, output).iter().any(|b| moves(b.effect))
}

/// Whether a command may act at another time than its stamp says.
#[must_use]
pub fn acts_late(plant: &Plant, input: usize) -> bool {
    plant.effects_at(PlaceKind::Input, input).iter().any(|b| moves(b.effect))
}

fn moves(effect: Effect) -> bool {
    matches!(effect, Effect::Delay | Effect::ClockSkew)
}

/// What a reading shows of a command where one of them is late; it is stamped `stamp` (s) and taken at `time`.
///
/// A reading that shows a command directly would be flat in a delay between two commands, and jump where they share a
/// stamp: no fit could find the delay, and the order of events within one period, which a log does not tell, would
/// pass for one. It shows the command interpolated between its samples instead: without a delay the one that holds, and
/// a delay of one period later the one before, whatever the phase between stamps and commands.
#[must_use]
pub fn between<const N: usize>(channel: &[Change<N>], stamp: f64, time: Dual<N>) -> Dual<N> {
    let after = |t: f64| channel.partition_point(|c| c.stamp <= t).saturating_sub(1);
    let Some(holds) = channel.get(after(stamp)) else { return Dual::from_value(0.0) };
    let late = (time - stamp) - (holds.time - holds.stamp);
    let back = late + holds.stamp;
    let at = after(back.value);
    let here = channel[at];
    match channel.get(at + 1) {
        Some(next) if back.value >= here.stamp && next.stamp > here.stamp => {
            here.value + (next.value - here.value) * ((back - here.stamp) / (next.stamp - here.stamp))
        }
        _ => here.value,
    }
}

/// When a command acts that is stamped `stamp`: its delay grows from the recording's own zero where the clock is skewed.
fn arrival<const N: usize>(here: &[(&BoundEffect, Vec<Dual<N>>)], stamp: Dual<N>, origin: f64) -> Dual<N> {
    let mut time = stamp;
    for (bound, own) in here {
        match bound.effect {
            Effect::Delay => time += own[0],
            Effect::ClockSkew => time += own[0] * (stamp.value - origin),
            _ => {}
        }
    }
    time
}

/// The commands as they were sent; changes of the supply voltage cut them, if it matters.
fn sent<const N: usize>(experiment: &Experiment, input: usize, supplied: bool) -> Vec<Piece<N>> {
    let held = &experiment.inputs[input];
    let mut stamps = held.times.clone();
    if let (true, Some(supply)) = (supplied, experiment.supply(input)) {
        let begin = held.times.first().copied().unwrap_or(0.0);
        stamps.extend(supply.voltage.times.iter().filter(|t| **t > begin));
        stamps.sort_by(f64::total_cmp);
        stamps.dedup();
    }
    let lengths = stamps.windows(2).map(|w| w[1] - w[0]).chain([0.0]);
    let value = |stamp: f64| Dual::from_value(held.at(stamp));
    // The sequence as it was recorded is kept where nothing cuts it: two commands may share a stamp.
    if stamps.len() == held.times.len() {
        let values = held.values.iter().map(|v| Dual::from_value(*v));
        return stamps
            .iter()
            .zip(lengths)
            .zip(values)
            .map(|((stamp, length), value)| Piece { stamp: *stamp, length, value })
            .collect();
    }
    stamps
        .iter()
        .zip(lengths)
        .map(|(stamp, length)| Piece { stamp: *stamp, length, value: value(*stamp) })
        .collect()
}

/// How long the command still moves after its last stamp (s).
fn tail<const N: usize>(here: &[(&BoundEffect, Vec<Dual<N>>)], pieces: &[Piece<N>]) -> f64 {
    let range = pieces.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), p| {
        (low.min(p.value.value), high.max(p.value.value))
    });
    let way = (range.1 - range.0).max(0.0);
    let each = here.iter().map(|(bound, own)| match bound.effect {
        Effect::Lag => SETTLING * own[0].value,
        // A lightly damped one rings for 1/ζ as long.
        Effect::LagSecondOrder => SETTLING * own[0].value * own[1].value.max(1.0 / own[1].value.max(0.05)),
        Effect::RateLimit if own[0].value > 0.0 => (way / own[0].value).min(1.0),
        _ => 0.0,
    });
    each.sum()
}

/// Cuts intervals to at most half a step: the mean of a smoothed command stands for it over a piece.
fn into_pieces<const N: usize>(pieces: &[Piece<N>], step: f64, tail: f64) -> Vec<Piece<N>> {
    let mut out = Vec::with_capacity(4 * pieces.len());
    for (k, piece) in pieces.iter().enumerate() {
        // Whole steps after the last command: the cuts must not move with the parameters.
        let length = if k + 1 == pieces.len() { (tail / step).ceil() * step + step } else { piece.length };
        let count = (2.0 * length / step - 1e-6).ceil().max(1.0);
        for part in 0..count as usize {
            let stamp = piece.stamp + length / count * part as f64;
            out.push(Piece { stamp, length: length / count, value: piece.value });
        }
    }
    out
}

/// What the first reading shows of a command, if an output shows it as it is.
fn begins(plant: &Plant, experiment: &Experiment, input: usize) -> Option<f64> {
    let system = plant.equations().system();
    let name = &system.inputs[input].name;
    let output = system.outputs.iter().position(|output| output.value.as_name() == Some(name))?;
    experiment.samples.iter().find(|sample| sample.output == output).map(|sample| sample.value)
}

/// What one effect makes of the sequence. What has a memory has settled at the first command; play is anywhere within
/// its gap, and `begin` may show where.
fn act<const N: usize>(
    effect: Effect,
    own: &[Dual<N>],
    experiment: &Experiment,
    input: usize,
    begin: Option<f64>,
    pieces: &mut [Piece<N>],
) {
    let Some(first) = pieces.first().map(|p| p.value) else { return };
    let mut memory = [first, Dual::from_value(0.0)];
    if let (Effect::Backlash, Some(begin)) = (effect, begin) {
        memory[0] = play_step(own[0], Dual::from_value(begin), first);
    }
    let supply = experiment.supply(input);
    for piece in pieces {
        // Two commands at one stamp: the first acts for no time.
        let dt = Dual::from_value(piece.length.max(1e-12));
        piece.value = match effect {
            Effect::SupplySag => {
                supply.map_or(piece.value, |supply| sag(own[0], supply.ratio(piece.stamp), piece.value))
            }
            effect => effect.held(own, &mut memory, piece.value, dt),
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_late_reading_shows_earlier_commands_smoothly() {
        let sent = |late: Dual<1>| {
            let change = move |(k, value): (usize, &f64)| {
                let stamp = 0.1 * k as f64;
                Change { stamp, time: late + stamp, value: Dual::from_value(*value) }
            };
            [1.0, 3.0, 2.0, 6.0].iter().enumerate().map(change).collect::<Vec<Change<1>>>()
        };
        let at_once = sent(Dual::from_value(0.0));
        // Stamped 40 ms after the command that holds.
        let shown = |delay: f64| between(&at_once, 0.24, Dual::variable(delay, 0) * -1.0 + 0.24);
        assert!((shown(0.0).value - 2.0).abs() < 1e-9 && (shown(0.1).value - 3.0).abs() < 1e-9);
        assert!((shown(0.2).value - 1.0).abs() < 1e-9 && (shown(9.0).value - 1.0).abs() < 1e-9);
        let halfway = shown(0.05);
        assert!((halfway.value - 2.5).abs() < 1e-9 && (halfway.gradient[0] - 10.0).abs() < 1e-6);
        // The same where the command is late instead.
        for delay in [0.05, 0.12, 0.18] {
            let late = between(&sent(Dual::variable(delay, 0)), 0.24, Dual::from_value(0.24));
            assert!((late.value - shown(delay).value).abs() < 1e-9, "{delay}");
            assert!((late.gradient[0] - shown(delay).gradient[0]).abs() < 1e-6, "{delay}");
        }
    }
}
