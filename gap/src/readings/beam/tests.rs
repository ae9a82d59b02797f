use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::*;

const COMMANDS: usize = 600;
const STATES: usize = 2;
/// A mass of one with some friction, pushed in steps of 10 ms; its position is read at each command.
const STEP: f64 = 0.01;
const NOISE: f64 = 1e-3;
/// An α–β filter in its steady state, which forgets within half a second: α, and β = α²/(2 − α) over the step.
const GAIN: [f64; STATES] = [0.06, 0.186];

fn sent() -> Held {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let value = |_| 4.0 * Distribution::<f64>::sample(&StandardNormal, &mut random);
    let values = (0..COMMANDS).map(value).collect();
    Held { times: (0..COMMANDS).map(|k| STEP * k as f64).collect(), values }
}

fn transition() -> [f64; 4] {
    [1.0, STEP, 0.0, 1.0 - 0.5 * STEP]
}

fn pushed(force: f64) -> [f64; STATES] {
    [0.5 * STEP * STEP * force, STEP * force]
}

fn moved(x: [f64; STATES], force: f64) -> [f64; STATES] {
    let (t, push) = (transition(), pushed(force));
    [t[0] * x[0] + t[1] * x[1] + push[0], t[2] * x[0] + t[3] * x[1] + push[1]]
}

/// What a filter that believes in `acted` finds of a machine to which `true_force` happened.
fn beam<'a>(sent: &'a Held, acted: &'a Held, true_force: &[f64]) -> Beam<'a> {
    let mut random = ChaCha8Rng::seed_from_u64(4);
    let other = Held { times: acted.times.clone(), values: acted.values.iter().map(|v| v + 1.0).collect() };
    let mut chain = Chain::new(STATES);
    let (mut machine, mut filter) = ([0.0; STATES], [0.0; STATES]);
    for (k, force) in true_force.iter().enumerate() {
        chain.advance(k, transition(), pushed(1.0));
        machine = moved(machine, *force);
        filter = moved(filter, acted.values[k]);
        let noise: f64 = StandardNormal.sample(&mut random);
        let innovation = machine[0] + NOISE * noise - filter[0];
        chain.read(k, (innovation, NOISE * NOISE / (1.0 - GAIN[0])), [1.0, 0.0], GAIN, 0.0);
        filter = [filter[0] + GAIN[0] * innovation, filter[1] + GAIN[1] * innovation];
    }
    Beam { sent, acted, other, in_force: (0..COMMANDS).collect(), stretches: vec![(chain, true)] }
}

/// By how much the commands that are believed lost were not, without what noise makes of it.
fn beyond_noise(beam: &Beam<'_>) -> f64 {
    let (arrived, noise) = beam.arrived();
    arrived - noise
}

fn without(sent: &Held, lost: &[usize]) -> Held {
    let mut held = sent.clone();
    for k in 1..COMMANDS {
        if lost.contains(&k) {
            held.values[k] = held.values[k - 1];
        }
    }
    held
}

/// A twentieth of the commands, by chance.
fn some() -> Vec<usize> {
    let mut random = ChaCha8Rng::seed_from_u64(5);
    (1..COMMANDS).filter(|_| random.random_bool(0.05)).collect()
}

fn found(beam: &Beam<'_>) -> (Losses, Vec<usize>) {
    let mut rate = FIRST_RATE;
    let losses = beam.losses(&mut rate);
    let lost = (0..COMMANDS).filter(|k| losses.lost[*k]).collect();
    (losses, lost)
}

#[test]
fn lost_commands_are_found_and_nothing_where_all_arrive() {
    let (sent, lost) = (sent(), some());
    let acted = without(&sent, &lost);
    let (losses, own) = found(&beam(&sent, &sent, &acted.values));
    let right = own.iter().filter(|k| lost.contains(k)).count();
    // Some change hardly more than the readings' noise, and some pass for their neighbour.
    assert!(right as f64 > 0.75 * own.len() as f64 && 2 * right > lost.len(), "{own:?} of {lost:?}");
    assert!(losses.gain > 20.0 && losses.trained == losses.gain, "{losses:?}");
    assert!((losses.rate - 0.05).abs() < 0.025, "{}", losses.rate);

    let (losses, own) = found(&beam(&sent, &sent, &sent.values));
    assert!(losses.gain < 3.0 && own.len() < 3, "{} {own:?}", losses.gain);
}

#[test]
fn a_command_that_was_believed_lost_and_arrived_is_taken_back() {
    let (sent, lost) = (sent(), some());
    let acted = without(&sent, &lost);
    // The largest change that arrived.
    let change = |k: &usize| (sent.values[*k] - sent.values[*k - 1]).abs();
    let arrived = (2..COMMANDS).filter(|k| !lost.contains(k) && !lost.contains(&(k - 1)));
    let wrong = arrived.max_by(|a, b| change(a).total_cmp(&change(b))).expect("one of many");
    let mut believed: Vec<usize> = lost.clone();
    believed.push(wrong);
    let believed = without(&sent, &believed);
    let beam = beam(&sent, &believed, &acted.values);
    assert!(!found(&beam).1.contains(&wrong));
    assert!(beyond_noise(&beam) > 0.02, "{}", beyond_noise(&beam));
}

#[test]
fn commands_that_acted_in_part_were_not_lost() {
    let (sent, lost) = (sent(), some());
    let acted = without(&sent, &lost);
    let shares = |share: f64| -> Vec<f64> {
        acted.values.iter().zip(&sent.values).map(|(held, sent)| held + share * (sent - held)).collect()
    };
    let arrived = |share: f64| beyond_noise(&beam(&sent, &acted, &shares(share)));
    assert!(arrived(0.0).abs() < 0.02, "{}", arrived(0.0));
    // A quarter, and what those before and after add where responses overlap.
    assert!(arrived(0.5) > 0.25, "{}", arrived(0.5));
}
