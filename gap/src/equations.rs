//! Equations as a [`Simulator`]: the plant of a hypothesis along the events of a recording, on lanes.
//!
//! Between two events the commands are constant, and so is everything that depends on them alone. A delayed command
//! changes, and a late reading is taken, at a time that carries its derivative by the delay: fractional delays are
//! smooth, and no sample is interpolated.

mod clipped;
mod table;

use std::sync::{Arc, OnceLock};

use parallax_model::Dual;
use parallax_model::effect::{Effect, PlaceKind};
use parallax_model::lanes::F64x16;
use parallax_model::plant::Plant;
use parallax_model::program::Program;
use parallax_model::system::Point;

use crate::commands;
use crate::experiment::Experiment;
use crate::hypothesis::Slot;
use crate::machine::{Drive, Field, Layout, Machine};
use crate::simulator::{At, AtLimit, Event, Gradient, LANES, Motion, Run, Simulator};
use clipped::Clipped;
use table::{Table, table};

/// Most states and fitted parameters together.
pub const MOST_VARIABLES: usize = 128;

/// A plant bound to a recording, with the slots that θ fills.
#[derive(Clone, Debug)]
pub struct EquationsSimulator<'a> {
    plant: Plant,
    slots: Vec<Slot>,
    experiment: &'a Experiment,
    step: f64,
    /// Entries of θ on which commands or the times of events depend.
    timed: Vec<usize>,
    /// With derivatives by θ.
    full: Field,
    /// With derivatives by the states alone; made when it is asked for.
    plain: OnceLock<Field>,
    /// The events where they do not depend on θ; made when they are asked for.
    events: OnceLock<Arc<Table>>,
    /// Standard deviations of the states beyond the nominal ones, where a stretch begins.
    extra_std: Vec<f64>,
    /// Outputs whose sensor has limits.
    clipped: Vec<Clipped>,
    /// Standard deviation of each output's noise; zero where it is not known.
    noise: Vec<f64>,
}

impl<'a> EquationsSimulator<'a> {
    /// The plant with the hypothesis' effects, what each entry of θ stands for, the recording, and the longest
    /// integration step (s).
    #[must_use]
    pub fn new(plant: Plant, slots: Vec<Slot>, experiment: &'a Experiment, step: f64) -> Self {
        let timed: Vec<usize> = (0..slots.len())
            .filter(|j| match slots[*j] {
                Slot::Effect { effect, .. } => {
                    !matches!(plant.effects()[effect].kind, PlaceKind::Joint | PlaceKind::State)
                }
                _ => false,
            })
            .collect();
        let theta: Vec<Option<usize>> = {
            let mut theta = vec![None; plant.equations().nominal().len() + plant.extra_parameters()];
            for (j, slot) in slots.iter().enumerate() {
                theta[position(&plant, slot)] = Some(j);
            }
            theta
        };
        let plant = plant.with_step(step);
        let full = field(&plant, experiment, &theta, !timed.is_empty());
        let (plain, events) = (OnceLock::new(), OnceLock::new());
        let extra_std = vec![1.0; plant.extra_states().len()];
        let outputs = experiment.wraps.len();
        let clipped = Clipped::all(&plant, outputs, &theta);
        let noise = vec![0.0; outputs];
        EquationsSimulator {
            plant,
            slots,
            experiment,
            step,
            timed,
            full,
            plain,
            events,
            extra_std,
            clipped,
            noise,
        }
    }

    /// The same simulator with the standard deviation of each output's noise: it tells which readings are at a sensor's limit,
    /// and what a reading is off by that nothing can predict.
    #[must_use]
    pub fn with_noise(mut self, noise: &[f64]) -> Self {
        self.noise = noise.to_vec();
        self.clipped.iter_mut().for_each(|clipped| clipped.learn(noise));
        self
    }

    /// The same simulator with standard deviations for the states that effects bring with them, in the plant's order.
    #[must_use]
    pub fn with_extra_std(mut self, std: Vec<f64>) -> Self {
        self.extra_std = std;
        self
    }

    /// The stamp of the command of one input that is in force after each event at θ (s). Nothing where there is none, or where an
    /// effect with a memory spreads each command over those that follow.
    #[must_use]
    pub fn in_force(&self, theta: &[f64], input: usize) -> Option<Vec<f64>> {
        let mut effects = self.plant.effects_at(PlaceKind::Input, input).into_iter();
        if effects.any(|bound| bound.effect.has_memory()) {
            return None;
        }
        let mut extra = self.plant.extra_values();
        let nominal = self.plant.equations().nominal().len();
        for (slot, value) in self.slots.iter().zip(theta) {
            if let Some(at) = position(&self.plant, slot).checked_sub(nominal) {
                extra[at] = *value;
            }
        }
        let variables: Vec<Dual<0>> = extra.iter().copied().map(Dual::from_value).collect();
        let changes = commands::changes(&self.plant, self.experiment, self.step, &variables, input);
        if changes.is_empty() {
            return None;
        }
        let table = table::<0>(self, theta, &extra);
        let held = table.current.chunks(self.experiment.inputs.len());
        Some(held.map(|current| changes[current[input] as usize].stamp).collect())
    }

    fn walk<'b>(&'b self, theta: &[f64], full: bool) -> Box<dyn Run + 'b> {
        let mut parameters = self.plant.equations().nominal();
        let first_extra = parameters.len();
        parameters.extend(self.plant.extra_values());
        for (slot, value) in self.slots.iter().zip(theta) {
            parameters[position(&self.plant, slot)] = *value;
        }
        let field = if full {
            &self.full
        } else {
            self.plain
                .get_or_init(|| field(&self.plant, self.experiment, &vec![None; parameters.len()], false))
        };
        let extra = &parameters[first_extra..];
        let table = match self.timed.len() {
            0 => Arc::clone(self.events.get_or_init(|| Arc::new(table::<0>(self, theta, extra)))),
            _ if !full => Arc::new(table::<0>(self, theta, extra)),
            1 => Arc::new(table::<1>(self, theta, extra)),
            2 => Arc::new(table::<2>(self, theta, extra)),
            3 | 4 => Arc::new(table::<4>(self, theta, extra)),
            5..=8 => Arc::new(table::<8>(self, theta, extra)),
            9..=16 => Arc::new(table::<16>(self, theta, extra)),
            17..=32 => Arc::new(table::<32>(self, theta, extra)),
            // [`MOST_VARIABLES`] is checked before any simulator is made.
            _ => Arc::new(table::<MOST_VARIABLES>(self, theta, extra)),
        };
        let timed = if full { self.timed.clone() } else { Vec::new() };
        Box::new(EquationsRun {
            simulator: self,
            variables: if full { self.slots.len() } else { 0 },
            machine: Machine::new(field, &parameters),
            parameters,
            loaded: [0; LANES],
            drive: Drive::new(self.experiment.inputs.len(), timed),
            table,
            scratch: Gradient::default(),
            unclipped: Gradient::default(),
            at_limit: [None; LANES],
        })
    }
}

/// Where a slot is among the programs' parameters: those of the system, of effects, and the weights of residuals.
fn position(plant: &Plant, slot: &Slot) -> usize {
    let nominal = plant.equations().nominal().len();
    match *slot {
        Slot::Nominal(index) => index,
        Slot::Effect { effect, parameter } => nominal + plant.effects()[effect].first + parameter,
        Slot::Weight(index) => nominal + plant.first_weight() + index,
    }
}

fn field(plant: &Plant, experiment: &Experiment, theta: &[Option<usize>], driven: bool) -> Field {
    let count = experiment.wraps.len();
    let shown = (0..count).map(|output| plant.output_program(output));
    let unclipped = (0..count).filter_map(|output| plant.unclipped_program(output));
    let outputs: Vec<Program> = shown.chain(unclipped).collect();
    let layout =
        Layout { parameters: theta.len(), states: plant.states(), commands: experiment.inputs.len() };
    Field::new(&plant.derivative_program(), &outputs, layout, theta, driven)
}

impl Simulator for EquationsSimulator<'_> {
    fn states(&self) -> usize {
        self.plant.states()
    }

    fn parameters(&self) -> usize {
        self.slots.len()
    }

    fn start(&self, state: &[f64], std: &[f64], time: f64) -> (Vec<f64>, Vec<f64>) {
        let n = self.plant.equations().system().states.len();
        if state.len() == self.plant.states() {
            return (state.to_vec(), std.to_vec());
        }
        let inputs: Vec<f64> = self.experiment.inputs.iter().map(|held| held.at(time)).collect();
        let parameters = self.plant.equations().nominal();
        let point = Point { parameters: &parameters, states: &state[..n], inputs: &inputs, time };
        (self.plant.start(&point), std[..n].iter().chain(&self.extra_std).copied().collect())
    }

    fn scale(&self, theta: &[f64], output: usize) -> f64 {
        let fitted = |(slot, value): (&Slot, &f64)| match slot {
            Slot::Effect { effect, .. } => {
                let bound = &self.plant.effects()[*effect];
                let is_it =
                    (bound.effect, bound.kind, bound.index) == (Effect::Scale, PlaceKind::Output, output);
                is_it.then_some(*value)
            }
            _ => None,
        };
        self.slots.iter().zip(theta).filter_map(fitted).product()
    }

    fn run<'a>(&'a self, theta: &[f64]) -> Box<dyn Run + 'a> {
        self.walk(theta, true)
    }

    fn run_at<'a>(&'a self, theta: &[f64]) -> Box<dyn Run + 'a> {
        self.walk(theta, false)
    }
}

/// A walk on lanes.
struct EquationsRun<'a> {
    simulator: &'a EquationsSimulator<'a>,
    /// How many entries of θ are variables.
    variables: usize,
    machine: Machine<'a>,
    /// The parameters, with the first recording's constants.
    parameters: Vec<f64>,
    /// The recording whose constants each lane has.
    loaded: [u32; LANES],
    drive: Drive,
    table: Arc<Table>,
    scratch: Gradient,
    unclipped: Gradient,
    /// Where the readings last compared rest at a limit of which their prediction falls short.
    at_limit: [Option<AtLimit>; LANES],
}

impl EquationsRun<'_> {
    /// Constants as they are in the lanes' recordings.
    fn load_constants(&mut self, at: &At) {
        let parts = &self.simulator.experiment.parts;
        if parts.len() < 2 {
            return;
        }
        let mut wanted = self.loaded;
        for (lane, index) in at.iter().enumerate() {
            if let Some(index) = index {
                wanted[lane] = self.table.parts[*index];
            }
        }
        if wanted == self.loaded {
            return;
        }
        self.loaded = wanted;
        let mut lanes: Vec<F64x16> = self.parameters.iter().map(|v| F64x16::splat(*v)).collect();
        let fitted: Vec<usize> =
            self.simulator.slots.iter().map(|slot| position(&self.simulator.plant, slot)).collect();
        for (index, lanes) in lanes.iter_mut().enumerate().filter(|(index, _)| !fitted.contains(index)) {
            for (lane, part) in wanted.iter().enumerate() {
                if let Some(value) = parts[*part as usize].parameters.get(index) {
                    lanes[lane] = *value;
                }
            }
        }
        self.machine.set_parameters(&lanes);
    }

    /// Predicts the readings of the lanes' events, each output as `one` has it.
    fn predict(
        &mut self,
        at: &At,
        by: &mut Gradient,
        mut one: impl FnMut(&mut Self, usize, &mut Gradient) -> F64x16,
    ) -> F64x16 {
        let output = |lane: usize| Some(self.table.events[at[lane]?].reading?.output);
        let outputs: At = std::array::from_fn(output);
        let after = |last: Option<usize>| outputs.iter().flatten().copied().filter(|o| Some(*o) > last).min();
        let seen = || std::iter::successors(after(None), |last| after(Some(*last)));
        // States alone are on the lanes already.
        if seen().any(|output| self.machine.is_driven(output)) {
            self.load(at, true);
        } else {
            self.load_constants(at);
        }
        let mut value = F64x16::splat(0.0);
        let mut scratch = std::mem::take(&mut self.scratch);
        for (k, output) in seen().enumerate() {
            if k == 0 {
                value = one(self, output, by);
                continue;
            }
            let other = one(self, output, &mut scratch);
            for lane in (0..LANES).filter(|lane| outputs[*lane] == Some(output)) {
                value[lane] = other[lane];
                for (to, from) in by.by.iter_mut().zip(&scratch.by) {
                    to[lane] = from[lane];
                }
            }
            by.live.extend(&scratch.live);
        }
        self.scratch = scratch;
        value
    }

    /// Predicts one output, to be compared. A reading that is not at its sensor's limit shows the truth (a censored
    /// observation: Tobin 1958): where the prediction lies beyond that limit, it counts as if there were none, and is pulled
    /// back. The derivative of what is clipped is zero, and would leave it there.
    ///
    /// What a late reading shows of before the recording began, nobody can predict: it counts as off by the noise, whatever the
    /// hypothesis, so that all are judged by as many readings.
    fn compared(&mut self, output: usize, at: &At, motion: &Motion, by: &mut Gradient) -> F64x16 {
        let mut value = self.within_limits(output, at, motion, by);
        for (lane, event) in at.iter().enumerate() {
            let Some(event) = event.filter(|event| self.table.unrecorded.get(*event) == Some(&true)) else {
                continue;
            };
            let Some(reading) = self.table.events[event].reading else { continue };
            value[lane] = reading.value - self.simulator.noise[reading.output];
            self.at_limit[lane] = None;
            by.by.iter_mut().for_each(|by| by[lane] = 0.0);
        }
        value
    }

    /// Commands and times as they are at the lanes' events, or as the readings there show them.
    fn load(&mut self, at: &At, reading: bool) {
        self.load_constants(at);
        let inputs = self.table.values.len();
        let count = self.drive.timed.len();
        for (lane, index) in at.iter().enumerate() {
            let Some(index) = *index else { continue };
            self.drive.time[lane] = self.table.events[index].time - self.table.origins[index];
            for k in 0..count {
                self.drive.time_by[k][lane] = self.table.times_by[index * count + k];
            }
            for input in 0..inputs {
                let holds = if reading { &self.table.shown } else { &self.table.current };
                let change = holds[index * inputs + input] as usize;
                self.drive.commands[input][lane] =
                    self.table.values[input].get(change).copied().unwrap_or(0.0);
                for k in 0..count {
                    self.drive.commands_by[input * count + k][lane] =
                        self.table.values_by[input].get(change * count + k).copied().unwrap_or(0.0);
                }
            }
        }
    }
}

impl Run for EquationsRun<'_> {
    fn events(&self) -> &[Event] {
        &self.table.events
    }

    fn parameters(&self) -> usize {
        self.variables
    }

    fn stands(&self, index: usize) -> bool {
        let (events, count) = (&self.table.events, self.drive.timed.len());
        // Two events may meet at these parameters, and part at others.
        let by = |index: usize| &self.table.times_by[index * count..(index + 1) * count];
        index + 1 < events.len() && events[index + 1].time == events[index].time && by(index + 1) == by(index)
    }

    fn advance_lanes(&mut self, at: &At, motion: &mut Motion) {
        let count = self.drive.timed.len();
        self.drive.step = F64x16::splat(0.0);
        self.drive.step_by.fill(F64x16::splat(0.0));
        let (mut longest, mut still) = (0.0_f64, true);
        for (lane, index) in at.iter().enumerate() {
            let Some(index) = *index else { continue };
            let span = self.table.events[index + 1].time - self.table.events[index].time;
            self.drive.step[lane] = span;
            longest = longest.max(span);
            still &= span == 0.0;
            for k in 0..count {
                let by =
                    self.table.times_by[(index + 1) * count + k] - self.table.times_by[index * count + k];
                self.drive.step_by[k][lane] = by;
                still &= by == 0.0;
            }
        }
        if still {
            return;
        }
        self.load(at, false);
        // A rounding excess must not double the work of a step that just fits.
        let steps = (longest / self.simulator.step - 1e-6).ceil().max(1.0);
        self.drive.steps = steps as usize;
        self.drive.step = self.drive.step / steps;
        for by in &mut self.drive.step_by {
            *by = *by / steps;
        }
        self.machine.advance(&self.drive, motion);
    }

    fn observe_lanes(&mut self, at: &At, motion: &Motion, by: &mut Gradient) -> F64x16 {
        self.predict(at, by, |run, output, by| run.machine.observe(output, &run.drive, motion, by))
    }

    fn compare_lanes(&mut self, at: &At, motion: &Motion, by: &mut Gradient) -> F64x16 {
        self.at_limit = [None; LANES];
        self.predict(at, by, |run, output, by| run.compared(output, at, motion, by))
    }

    fn at_limits(&self) -> At<AtLimit> {
        self.at_limit
    }

    fn wrap(&self, output: usize) -> Option<f64> {
        self.simulator.experiment.wraps[output]
    }
}
