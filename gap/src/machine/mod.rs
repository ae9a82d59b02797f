//! The plant of a hypothesis on lanes: sixteen stretches of a recording at once, with exact derivatives.
//!
//! A [`Field`] holds the plant's programs with their derivatives ([`tape`]). Along an integration step the sensitivities
//! obey the variational equations, S' = (∂f/∂x) S + ∂f/∂θ (Hairer, Nørsett & Wanner, "Solving Ordinary Differential
//! Equations I", section I.14), by the same Runge–Kutta method: the derivatives are those of the numbers computed.

mod batches;
pub mod columns;
mod plan;
pub mod tape;

use parallax_model::Scalar;
use parallax_model::lanes::{F64x16, InMemory, Kernel, Level, Simd};
use parallax_model::program::Program;

use crate::simulator::{Gradient, Motion};
use plan::Plan;
use tape::{Entry, Rhythm, Tape};

/// What a program's inputs are, in order: parameters, states, commands, time.
#[derive(Clone, Copy, Debug)]
pub struct Layout {
    /// Parameters of the system and of effects.
    pub parameters: usize,
    /// States.
    pub states: usize,
    /// Commands.
    pub commands: usize,
}

/// Programs with their derivatives by states, commands, time and θ.
#[derive(Clone, Debug)]
pub struct Field {
    layout: Layout,
    derivative: Equation,
    outputs: Vec<Equation>,
}

/// One program and where its derivatives are.
#[derive(Clone, Debug)]
struct Equation {
    tape: Tape,
    rows: Vec<Row>,
}

/// The derivatives of one output: index and entry.
#[derive(Clone, Debug, Default)]
struct Row {
    by_state: Vec<(usize, Entry)>,
    by_command: Vec<(usize, Entry)>,
    by_time: Option<Entry>,
    by_theta: Vec<(usize, Entry)>,
}

impl Equation {
    fn new(program: &Program, layout: Layout, theta: &[Option<usize>], driven: bool) -> Self {
        let Layout { parameters, states, commands } = layout;
        let mut rhythm = vec![Rhythm::Fixed; parameters];
        rhythm.resize(parameters + states, Rhythm::Moving);
        rhythm.resize(parameters + states + commands, Rhythm::Held);
        rhythm.push(Rhythm::Moving);
        // Columns: states, commands, time, θ.
        let first = states + commands + 1;
        let mut column: Vec<Option<u32>> = theta.iter().map(|j| j.map(|j| (first + j) as u32)).collect();
        column.extend((0..states).map(|i| Some(i as u32)));
        column.extend((states..first).map(|c| driven.then_some(c as u32)));
        let tape = Tape::new(program, &rhythm, &column);
        let rows = tape
            .derivatives
            .iter()
            .map(|derivatives| {
                let mut row = Row::default();
                for (column, entry) in derivatives {
                    let column = *column as usize;
                    if column < states {
                        row.by_state.push((column, *entry));
                    } else if column < states + commands {
                        row.by_command.push((column - states, *entry));
                    } else if column == states + commands {
                        row.by_time = Some(*entry);
                    } else {
                        row.by_theta.push((column - first, *entry));
                    }
                }
                row
            })
            .collect();
        Equation { tape, rows }
    }
}

impl Field {
    /// Differentiates the rates of change and the outputs. `theta` gives, for each parameter, the entry of θ that it is;
    /// `driven` says whether commands and times depend on θ.
    #[must_use]
    pub fn new(
        derivative: &Program,
        outputs: &[Program],
        layout: Layout,
        theta: &[Option<usize>],
        driven: bool,
    ) -> Self {
        Field {
            layout,
            derivative: Equation::new(derivative, layout, theta, driven),
            outputs: outputs.iter().map(|o| Equation::new(o, layout, theta, driven)).collect(),
        }
    }
}

/// What drives the lanes over an interval, with derivatives by those entries of θ that commands and times depend on.
#[derive(Clone, Debug)]
pub struct Drive {
    /// The entries of θ.
    pub timed: Vec<usize>,
    /// Commands.
    pub commands: Vec<F64x16>,
    /// Their derivatives, commands × timed.
    pub commands_by: Vec<F64x16>,
    /// Start of the interval (s).
    pub time: F64x16,
    /// Its derivatives.
    pub time_by: Vec<F64x16>,
    /// Length of one integration step (s).
    pub step: F64x16,
    /// Its derivatives.
    pub step_by: Vec<F64x16>,
    /// Integration steps.
    pub steps: usize,
}

impl Drive {
    /// Nothing yet, for this many commands.
    #[must_use]
    pub fn new(commands: usize, timed: Vec<usize>) -> Self {
        let zero = F64x16::splat(0.0);
        let count = timed.len();
        Drive {
            timed,
            commands: vec![zero; commands],
            commands_by: vec![zero; commands * count],
            time: zero,
            time_by: vec![zero; count],
            step: zero,
            step_by: vec![zero; count],
            steps: 0,
        }
    }
}

/// A field at given parameters, with the space to walk.
#[derive(Clone, Debug)]
pub struct Machine<'a> {
    field: &'a Field,
    slots: Vec<F64x16>,
    output_slots: Vec<Vec<F64x16>>,
    at: Vec<F64x16>,
    at_by: Vec<F64x16>,
    next_by: Vec<F64x16>,
    sum: Vec<F64x16>,
    sum_by: Vec<F64x16>,
    /// Plans for the sensitivities met so far, of which there are few.
    plans: Vec<Plan>,
}

/// Most plans that are kept.
const PLANS: usize = 8;

impl<'a> Machine<'a> {
    /// A machine at these parameters, the same on all lanes.
    #[must_use]
    pub fn new(field: &'a Field, parameters: &[f64]) -> Self {
        let zero = F64x16::splat(0.0);
        let space = |equation: &Equation| vec![zero; equation.tape.slots];
        let mut machine = Machine {
            field,
            slots: space(&field.derivative),
            output_slots: field.outputs.iter().map(space).collect(),
            at: vec![zero; field.layout.states],
            at_by: Vec::new(),
            next_by: Vec::new(),
            sum: vec![zero; field.layout.states],
            sum_by: Vec::new(),
            plans: Vec::new(),
        };
        let lanes: Vec<F64x16> = parameters.iter().map(|v| F64x16::splat(*v)).collect();
        machine.set_parameters(&lanes);
        machine
    }

    /// Sets the parameters, lane by lane.
    pub fn set_parameters(&mut self, parameters: &[F64x16]) {
        let prepare = |equation: &Equation, slots: &mut Vec<F64x16>| {
            slots[..parameters.len()].copy_from_slice(parameters);
            Level::widest().run(Prepare { tape: &equation.tape, slots });
        };
        prepare(&self.field.derivative, &mut self.slots);
        for (equation, slots) in self.field.outputs.iter().zip(&mut self.output_slots) {
            prepare(equation, slots);
        }
    }

    /// Takes the lanes over the interval, by the classical fourth-order Runge–Kutta method (Hairer, Nørsett & Wanner,
    /// section II.1) with held commands.
    pub fn advance(&mut self, drive: &Drive, motion: &mut Motion) {
        let size = motion.by.len();
        let zero = F64x16::splat(0.0);
        for space in [&mut self.at_by, &mut self.next_by, &mut self.sum_by] {
            space.resize(size, zero);
        }
        let timed: &[usize] = if motion.columns > motion.seeds { &drive.timed } else { &[] };
        let known = self.plans.iter().position(|plan| plan.fits(&motion.live, motion.columns));
        let plan = known.unwrap_or_else(|| {
            if self.plans.len() >= PLANS {
                self.plans.clear();
            }
            let equation = &self.field.derivative;
            self.plans.push(Plan::new(equation, &motion.live, motion.seeds, motion.columns, timed));
            self.plans.len() - 1
        });
        motion.live.clone_from(&self.plans[plan].after);
        let layout = self.field.layout;
        let commands = layout.parameters + layout.states;
        self.slots[commands..commands + layout.commands].copy_from_slice(&drive.commands);
        Level::widest().run(Advance { machine: self, plan, timed, drive, motion });
    }

    /// Whether a reading of this output shows commands or the time, or states alone.
    #[must_use]
    pub fn is_driven(&self, output: usize) -> bool {
        let Layout { parameters, states, .. } = self.field.layout;
        self.field.outputs[output].tape.uses[parameters + states..].contains(&true)
    }

    /// Predicts a reading on the lanes: its value, and in `by` its derivatives, seeds first.
    pub fn observe(&mut self, output: usize, drive: &Drive, motion: &Motion, by: &mut Gradient) -> F64x16 {
        let layout = self.field.layout;
        let slots = &mut self.output_slots[output];
        let (states, commands) = (layout.parameters, layout.parameters + layout.states);
        slots[states..commands].copy_from_slice(&motion.x);
        slots[commands..commands + layout.commands].copy_from_slice(&drive.commands);
        slots[commands + layout.commands] = drive.time;
        let equation = &self.field.outputs[output];
        let timed: &[usize] = if motion.columns > motion.seeds { &drive.timed } else { &[] };
        by.reset(motion.columns);
        let row = &equation.rows[0];
        for (state, _) in &row.by_state {
            by.live.extend(&motion.live[*state]);
        }
        if motion.columns > motion.seeds {
            row.by_theta.iter().for_each(|(j, _)| by.live.insert(motion.seeds + j));
            timed.iter().for_each(|j| by.live.insert(motion.seeds + j));
        }
        Level::widest().run(Observe { equation, slots, timed, drive, motion, by: &mut by.by })
    }
}

struct Prepare<'a> {
    tape: &'a Tape,
    slots: &'a mut [F64x16],
}

impl Kernel for Prepare<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        self.tape.run(Rhythm::Fixed, F64x16::registers_mut::<S>(self.slots));
    }
}

#[inline(always)]
fn times<T: Scalar>(entry: Entry, slots: &[T], value: T) -> T {
    match entry {
        Entry::One => value,
        Entry::Slot(slot) => slots[slot as usize] * value,
    }
}

/// Derivatives of what drives a row, by those entries of θ that commands and times depend on.
#[derive(Clone, Copy)]
struct Outer<'a, T> {
    commands_by: &'a [T],
    time_by: &'a [T],
    step_by: &'a [T],
    /// Steps from the start of the interval to the stage.
    share: f64,
}

impl<T: Scalar> Outer<'_, T> {
    /// The `k`-th of `count` derivatives of a row, through commands and time.
    #[inline(always)]
    fn of(&self, row: &Row, slots: &[T], k: usize, count: usize) -> T {
        let mut sum = T::constant(0.0);
        for (command, entry) in &row.by_command {
            sum += times(*entry, slots, self.commands_by[command * count + k]);
        }
        if let Some(entry) = row.by_time {
            sum += times(entry, slots, self.time_by[k] + self.step_by[k] * self.share);
        }
        sum
    }
}

struct Advance<'a, 'f> {
    machine: &'a mut Machine<'f>,
    /// Index of the plan.
    plan: usize,
    timed: &'a [usize],
    drive: &'a Drive,
    motion: &'a mut Motion,
}

impl Kernel for Advance<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self) {
        let Advance { machine, plan, timed, drive, motion } = self;
        let layout = machine.field.layout;
        let n = layout.states;
        let (first, time_at) = (layout.parameters, layout.parameters + n + layout.commands);
        let equation = &machine.field.derivative;
        let (seeds, width) = (motion.seeds, motion.columns);
        let plan = &machine.plans[plan];
        let slots = F64x16::registers_mut::<S>(&mut machine.slots);
        let x = F64x16::registers_mut::<S>(&mut motion.x);
        let by = F64x16::registers_mut::<S>(&mut motion.by);
        let at = F64x16::registers_mut::<S>(&mut machine.at);
        let mut at_by = F64x16::registers_mut::<S>(&mut machine.at_by);
        let mut next_by = F64x16::registers_mut::<S>(&mut machine.next_by);
        let sum = F64x16::registers_mut::<S>(&mut machine.sum);
        let sum_by = F64x16::registers_mut::<S>(&mut machine.sum_by);
        let commands_by = F64x16::registers::<S>(&drive.commands_by);
        let time_by = F64x16::registers::<S>(&drive.time_by);
        let step_by = F64x16::registers::<S>(&drive.step_by);
        let step = <F64x16 as InMemory>::load::<S>(&drive.step);
        let start = <F64x16 as InMemory>::load::<S>(&drive.time);
        equation.tape.run(Rhythm::Held, slots);
        for count in 0..drive.steps {
            // Steps before this one.
            let before = count as f64;
            at.copy_from_slice(x);
            sum.copy_from_slice(x);
            // Where the next stage is evaluated, and the weight of this one.
            for (stage, (reach, weight)) in
                [(0.5, 1.0 / 6.0), (0.5, 1.0 / 3.0), (1.0, 1.0 / 3.0), (0.0, 1.0 / 6.0)]
                    .into_iter()
                    .enumerate()
            {
                let share = before + [0.0, 0.5, 0.5, 1.0][stage];
                slots[first..first + n].copy_from_slice(at);
                slots[time_at] = start + step * share;
                equation.tape.run(Rhythm::Moving, slots);
                let (far, part) = (step * reach, step * weight);
                for i in 0..n {
                    let slope = slots[equation.tape.outputs[i] as usize];
                    sum[i] += slope * part;
                    at[i] = x[i] + slope * far;
                }
                // The sensitivities follow the same rule; the first stage starts from them, the last one ends in them.
                match stage {
                    0 => plan.slopes(slots, by, |k, slope| {
                        sum_by[k] = by[k] + slope * part;
                        next_by[k] = by[k] + slope * far;
                    }),
                    3 => plan.slopes(slots, at_by, |k, slope| by[k] = sum_by[k] + slope * part),
                    _ => plan.slopes(slots, at_by, |k, slope| {
                        sum_by[k] += slope * part;
                        next_by[k] = by[k] + slope * far;
                    }),
                }
                let outer = Outer { commands_by, time_by, step_by, share };
                for (i, row) in equation.rows.iter().enumerate().filter(|_| !timed.is_empty()) {
                    let slope = slots[equation.tape.outputs[i] as usize];
                    for (k, j) in timed.iter().enumerate() {
                        let at = i * width + seeds + j;
                        let more = outer.of(row, slots, k, timed.len());
                        let weighed = more * part + slope * (step_by[k] * weight);
                        if stage == 3 {
                            by[at] += weighed;
                        } else {
                            sum_by[at] += weighed;
                            next_by[at] += more * far + slope * (step_by[k] * reach);
                        }
                    }
                }
                std::mem::swap(&mut at_by, &mut next_by);
            }
            x.copy_from_slice(sum);
        }
    }
}

struct Observe<'a> {
    equation: &'a Equation,
    slots: &'a mut [F64x16],
    timed: &'a [usize],
    drive: &'a Drive,
    motion: &'a Motion,
    by: &'a mut [F64x16],
}

impl Kernel for Observe<'_> {
    type Output = F64x16;

    #[inline(always)]
    fn run<S: Simd>(self) -> F64x16 {
        let Observe { equation, slots, timed, drive, motion, by } = self;
        let slots = F64x16::registers_mut::<S>(slots);
        equation.tape.run(Rhythm::Held, slots);
        equation.tape.run(Rhythm::Moving, slots);
        let by = F64x16::registers_mut::<S>(by);
        let sensitivity = F64x16::registers::<S>(&motion.by);
        let (row, width, seeds) = (&equation.rows[0], motion.columns, motion.seeds);
        for (state, entry) in &row.by_state {
            for column in motion.live[*state].iter() {
                by[column] += times(*entry, slots, sensitivity[state * width + column]);
            }
        }
        if width > seeds {
            for (j, entry) in &row.by_theta {
                by[seeds + j] += match entry {
                    Entry::One => Scalar::constant(1.0),
                    Entry::Slot(slot) => slots[*slot as usize],
                };
            }
        }
        let time_by = F64x16::registers::<S>(&drive.time_by);
        let commands_by = F64x16::registers::<S>(&drive.commands_by);
        let outer = Outer { commands_by, time_by, step_by: time_by, share: 0.0 };
        for (k, j) in timed.iter().enumerate() {
            by[seeds + j] += outer.of(row, slots, k, timed.len());
        }
        let mut value = F64x16::splat(0.0);
        <F64x16 as InMemory>::store::<S>(&mut value, slots[equation.tape.outputs[0] as usize]);
        value
    }
}
