//! When commands act and readings are taken, at given parameters.

use parallax_model::Dual;

use super::{EquationsSimulator, position};
use crate::commands::{self, Change};
use crate::simulator::{Event, Reading};

/// Events and commands at given parameters, with derivatives by the entries of θ that they depend on.
#[derive(Clone, Debug, Default)]
pub(super) struct Table {
    pub(super) events: Vec<Event>,
    /// Derivatives of the events' times, events × timed.
    pub(super) times_by: Vec<f64>,
    /// Where the zero of each event's recording lies (s).
    pub(super) origins: Vec<f64>,
    /// The recording of each event.
    pub(super) parts: Vec<u32>,
    /// Readings that show what commands did that were sent before the recording began; empty where nothing is late.
    pub(super) unrecorded: Vec<bool>,
    /// For each event and input, the index of the change that holds.
    pub(super) current: Vec<u32>,
    /// The same for what a reading shows: a late reading of a command has values of its own.
    pub(super) shown: Vec<u32>,
    /// For each input, the values of its changes.
    pub(super) values: Vec<Vec<f64>>,
    /// For each input, their derivatives, changes × timed.
    pub(super) values_by: Vec<Vec<f64>>,
}

/// Puts changes and readings in the order of time; at equal times a command comes before a reading.
pub(super) fn table<const N: usize>(
    simulator: &EquationsSimulator<'_>,
    theta: &[f64],
    extra: &[f64],
) -> Table {
    let experiment = simulator.experiment;
    let nominal = simulator.plant.equations().nominal().len();
    let mut variables: Vec<Dual<N>> = extra.iter().copied().map(Dual::from_value).collect();
    for (k, j) in simulator.timed.iter().enumerate().take(N) {
        let at = position(&simulator.plant, &simulator.slots[*j]) - nominal;
        variables[at] = Dual::variable(theta[*j], k);
    }
    let count = simulator.timed.len().min(N);
    let extra = variables;
    let inputs = experiment.inputs.len();
    let changes: Vec<Vec<Change<N>>> = (0..inputs)
        .map(|i| commands::changes(&simulator.plant, experiment, simulator.step, &extra, i))
        .collect();
    enum What {
        Change { input: usize, index: usize },
        Reading(Reading),
    }
    let mut all: Vec<(Dual<N>, What)> =
        Vec::with_capacity(experiment.samples.len() + changes.iter().map(Vec::len).sum::<usize>());
    for (input, channel) in changes.iter().enumerate() {
        all.extend(channel.iter().enumerate().map(|(index, c)| (c.time, What::Change { input, index })));
    }
    let clocks: Vec<commands::Clock<N>> = (0..experiment.wraps.len())
        .map(|output| commands::Clock::new(&simulator.plant, &extra, output))
        .collect();
    for sample in &experiment.samples {
        // A clock goes astray from the beginning of its own recording.
        let origin = experiment.origin(sample.stamp);
        let time = clocks[sample.output].taken(sample.stamp - origin) + origin;
        let reading = Reading { output: sample.output, value: sample.value, stamp: sample.stamp };
        all.push((time, What::Reading(reading)));
    }
    // The sort is stable, and changes were put in first.
    all.sort_by(|a, b| a.0.value.total_cmp(&b.0.value));
    let mut table = Table::default();
    table.events.reserve(all.len());
    table.times_by.reserve(all.len() * count);
    table.current.reserve(all.len() * inputs);
    table.shown.reserve(all.len() * inputs);
    let mut current = vec![0_u32; inputs];
    let delayed = (0..inputs).any(|input| commands::acts_late(&simulator.plant, input));
    let system = simulator.plant.equations().system();
    let late = |output: usize| {
        (delayed || commands::is_late(&simulator.plant, output)) && system.shows_command(output)
    };
    let late: Vec<bool> = (0..experiment.wraps.len()).map(late).collect();
    let anything_late =
        delayed || (0..experiment.wraps.len()).any(|o| commands::is_late(&simulator.plant, o));
    let beginnings: Vec<Vec<commands::Beginning>> =
        if anything_late { commands::beginnings(experiment, &changes) } else { Vec::new() };
    let mut between: Vec<Vec<Dual<N>>> = vec![Vec::new(); inputs];
    for (time, what) in all {
        let reading = match what {
            What::Change { input, index } => {
                // Not before its own event, even where another one shares its time: between the two the old value acts for no
                // time, and that is where a derivative by the one's time comes from.
                current[input] = current[input].max(index as u32);
                None
            }
            What::Reading(reading) => Some(reading),
        };
        table.current.extend_from_slice(&current);
        match reading.filter(|r| late[r.output]) {
            Some(reading) => {
                for (input, channel) in changes.iter().enumerate() {
                    table.shown.push((channel.len() + between[input].len()) as u32);
                    between[input].push(commands::between(channel, reading.stamp, time));
                }
            }
            None => table.shown.extend_from_slice(&current),
        }
        table.events.push(Event { time: time.value, reading });
        if anything_late {
            let begins = |reading: &Reading| beginnings.get(experiment.part(reading.stamp));
            let unrecorded = |reading: Reading| {
                begins(&reading).is_some_and(|all| all.iter().any(|b| b.hides(reading.stamp, time.value)))
            };
            table.unrecorded.push(reading.is_some_and(unrecorded));
        }
        table.parts.push(experiment.part(time.value) as u32);
        table.origins.push(experiment.origin(time.value));
        table.times_by.extend_from_slice(&time.gradient[..count]);
    }
    for (channel, between) in changes.iter().zip(between) {
        let values: Vec<Dual<N>> = channel.iter().map(|c| c.value).chain(between).collect();
        table.values.push(values.iter().map(|v| v.value).collect());
        let mut by = Vec::with_capacity(values.len() * count);
        values.iter().for_each(|v| by.extend_from_slice(&v.gradient[..count]));
        table.values_by.push(by);
    }
    table
}
