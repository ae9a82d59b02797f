//! Sensors with limits: which readings rest at one, and what the others show.

use parallax_model::effect::{Effect, PlaceKind};
use parallax_model::lanes::F64x16;
use parallax_model::plant::Plant;

use super::EquationsRun;
use crate::limit::AT_LIMIT;
use crate::simulator::{At, AtLimit, Gradient, Motion, wrapped};

/// An output whose sensor has limits.
#[derive(Clone, Debug)]
pub(super) struct Clipped {
    output: usize,
    /// Where among the fields' outputs it stands without limits.
    unclipped: usize,
    /// How far from a limit a reading is not at it, in the output's unit; infinite where the noise is not known.
    resting: f64,
    /// The lower limit and the upper one.
    levels: [Level; 2],
}

/// A limit.
#[derive(Clone, Copy, Debug)]
enum Level {
    /// The system's own.
    Fixed(f64),
    /// One of the programs' parameters, and the entry of θ that it is, if it is fitted.
    Parameter(usize, Option<usize>),
}

impl Clipped {
    /// All such outputs of a plant; `theta` tells which of its programs' parameters are fitted.
    pub(super) fn all(plant: &Plant, outputs: usize, theta: &[Option<usize>]) -> Vec<Clipped> {
        let nominal = plant.equations().nominal().len();
        let limited = (0..outputs).filter_map(|output| {
            let effects = plant.effects_at(PlaceKind::Output, output);
            // What the last one clips is what is read.
            let bound = effects.into_iter().rev().find(|bound| bound.effect == Effect::SensorSaturation)?;
            let level = |k: usize| match &bound.fixed {
                Some(values) => values.get(k).map_or(Level::Fixed(f64::NAN), |value| Level::Fixed(*value)),
                None => {
                    let position = nominal + bound.first + k;
                    Level::Parameter(position, theta.get(position).copied().flatten())
                }
            };
            Some((output, [level(0), level(1)]))
        });
        let resting = f64::INFINITY;
        limited
            .enumerate()
            .map(|(k, (output, levels))| Clipped { output, unclipped: outputs + k, resting, levels })
            .collect()
    }

    /// Learns the standard deviation of each output's noise.
    pub(super) fn learn(&mut self, noise: &[f64]) {
        self.resting = AT_LIMIT * noise[self.output];
    }
}

impl EquationsRun<'_> {
    /// Predicts one output, held to its sensor's limits where the reading is at one.
    pub(super) fn within_limits(
        &mut self,
        output: usize,
        at: &At,
        motion: &Motion,
        by: &mut Gradient,
    ) -> F64x16 {
        let mut value = self.machine.observe(output, &self.drive, motion, by);
        let clipped = self.simulator.clipped.iter().find(|clipped| clipped.output == output);
        let Some(clipped) = clipped.filter(|clipped| clipped.resting.is_finite()) else { return value };
        let open = self.machine.observe(clipped.unclipped, &self.drive, motion, &mut self.unclipped);
        let wrap = self.simulator.experiment.wraps[output];
        for (lane, event) in at.iter().enumerate() {
            let reading = event.and_then(|event| self.table.events[event].reading);
            let Some(reading) = reading.filter(|reading| reading.output == output) else { continue };
            let beyond = open[lane] - value[lane];
            if beyond == 0.0 {
                self.at_limit[lane] = self.rests(clipped, reading.value, open[lane]);
                continue;
            }
            if wrapped(value[lane] - reading.value, wrap) * beyond.signum() > clipped.resting {
                value[lane] = open[lane];
                for (to, from) in by.by.iter_mut().zip(&self.unclipped.by) {
                    to[lane] = from[lane];
                }
            }
        }
        by.live.extend(&self.unclipped.live);
        value
    }

    /// The limit at which a reading rests, of which a prediction falls short.
    fn rests(&self, clipped: &Clipped, reading: f64, predicted: f64) -> Option<AtLimit> {
        let limits = clipped.levels.iter().zip([-1.0, 1.0]).filter_map(|(level, side)| {
            let (level, column) = match *level {
                Level::Fixed(level) => (level, None),
                Level::Parameter(position, column) => (self.parameters[position], column),
            };
            let rests = (level - reading) * side <= clipped.resting && (level - predicted) * side > 0.0;
            rests.then_some(AtLimit { level, side, column: column.filter(|_| self.variables > 0) })
        });
        // A limit far behind a reading is the other side's.
        limits.min_by(|a, b| (a.level - reading).abs().total_cmp(&(b.level - reading).abs()))
    }
}
