//! One case: a machine with real parameters, a cause or none, and what was recorded of it.

use crate::channel::{Channel, scatter, show, was_taken};
use crate::drive::{command, excitation, played};
use crate::effect::{Cause, Kind, uniform};
use crate::mechanics::{H, Machine};
use crate::system::{N, State, System};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// Everything about a case but its noise.
#[derive(Clone)]
pub(crate) struct Case {
    pub(crate) system: &'static System,
    pub(crate) causes: Vec<Cause>,
    pub(crate) duration: f64,
    pub(crate) poor: bool,
    /// Whether the joints' forces scatter.
    pub(crate) rough: bool,
    pub(crate) seed: u64,
    /// Which recording of the machine: each has noise and chances of its own.
    pub(crate) take: u64,
}

/// A run: commands and readings as recorded, and the truth behind them.
pub(crate) struct Run {
    pub(crate) parameters: Vec<f64>,
    pub(crate) noise: Vec<f64>,
    pub(crate) declared: bool,
    pub(crate) commands: Vec<[f64; N]>,
    pub(crate) readings: Vec<Vec<(f64, f64)>>,
    pub(crate) states: Vec<State>,
}

/// A stream of random numbers of its own for every purpose, so that a cause does not move the others' numbers.
pub(crate) fn stream(seed: u64, purpose: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(purpose);
    rng
}

/// Real noise of every sensor.
pub(crate) fn noises(system: &System, seed: u64) -> Vec<f64> {
    let mut rng = stream(seed, 1);
    system
        .outputs
        .iter()
        .map(|o| o.noise.0 * (o.noise.1 / o.noise.0).powf(uniform(&mut rng, 0.0, 1.0)))
        .collect()
}

fn real(system: &System, seed: u64) -> Vec<f64> {
    let mut rng = stream(seed, 2);
    let draw = |p: &crate::system::Parameter| {
        let off = uniform(&mut rng, -p.spread, p.spread);
        let value = if p.value == 0.0 { off } else { p.value * (1.0 + off) };
        p.bounds.map_or(value, |(low, high)| value.clamp(low, high))
    };
    system.parameters.iter().map(draw).collect()
}

/// What a sensor of the machine would show without any fault.
pub(crate) fn reading(system: &System, output: usize, s: &State) -> f64 {
    let of = system.outputs[output].of;
    if of < system.joints.len() { s.q[of] } else { s.x[of - system.joints.len()] }
}

/// Forces on the joints that follow nothing: those of the ripple of motors and gears, of cables and of the air. They forget themselves
/// within milliseconds (an Ornstein-Uhlenbeck process), and are the same share of every joint's usual force.
struct Roughness {
    /// Standard deviation of each joint's, and the share that one step keeps.
    size: Vec<f64>,
    keeps: f64,
    force: [f64; N],
    chances: ChaCha8Rng,
}

/// Standard deviation of forces that scatter, as a share of a joint's usual force, and how long they last (s): from, to.
const ROUGH: (f64, f64) = (0.02, 0.15);
const LASTS: (f64, f64) = (0.002, 0.02);

impl Roughness {
    fn new(case: &Case) -> Self {
        let mut rng = stream(case.seed, 6);
        let mut between = |(low, high): (f64, f64)| low * f64::powf(high / low, uniform(&mut rng, 0.0, 1.0));
        let (share, lasts) = (between(ROUGH), between(LASTS));
        let size = case.system.joints.iter().map(|joint| share * joint.force).collect();
        Self { size, keeps: (-H / lasts).exp(), force: [0.0; N], chances: case.chances(60) }
    }

    fn next(&mut self) -> [f64; N] {
        let fresh = (1.0 - self.keeps * self.keeps).sqrt();
        for (force, size) in self.force.iter_mut().zip(&self.size) {
            let chance: f64 = self.chances.sample(StandardNormal);
            *force = self.keeps * *force + fresh * size * chance;
        }
        self.force
    }
}

impl Case {
    fn chances(&self, purpose: u64) -> ChaCha8Rng {
        stream(self.seed, purpose + 1000 * self.take)
    }

    /// The case under its own excitation.
    pub(crate) fn run(&self) -> Run {
        self.recorded(None)
    }

    /// The case under these wishes, one at every tick, or under its own excitation.
    pub(crate) fn recorded(&self, wishes: Option<&[[f64; N]]>) -> Run {
        let system = self.system;
        let parameters = real(system, self.seed);
        let machine = Machine::new(system, &parameters, &self.causes);
        let own: Vec<Vec<f64>> = (0..system.inputs.len())
            .map(|i| excitation(system, i, self.duration, self.poor, &mut stream(self.seed, 10 + i as u64)))
            .collect();
        let mut channels = self.channels();
        let mut s = State::default();
        if system.extras == 3 {
            s.x[2] = system.inputs[0].rest / 15.47;
        }
        let mut hidden = machine.hidden();
        let mut scatter_of = self.rough.then(|| Roughness::new(self));
        let every = (1.0 / system.command_rate / H).round() as usize;
        let steps = (self.duration / H).round() as usize;
        let mut commands = Vec::new();
        let mut states = Vec::with_capacity(steps);
        for i in 0..steps {
            let t = i as f64 * H;
            if i % every == 0 {
                let k = i / every;
                let u = match wishes {
                    Some(wishes) => played(system, &wishes[k], &s),
                    None => {
                        let wish = std::array::from_fn(|j| own.get(j).map_or(0.0, |w| w[k]));
                        command(system, &wish, &s)
                    }
                };
                for (channel, u) in channels.iter_mut().zip(u) {
                    channel.send(t, u);
                }
                commands.push(u);
            }
            states.push(s);
            let mut u = [0.0; N];
            for (u, channel) in u.iter_mut().zip(&mut channels) {
                *u = channel.act(t);
            }
            let push = scatter_of.as_mut().map_or([0.0; N], Roughness::next);
            machine.pushed(&mut s, &mut hidden, &u, &push, t);
        }
        let noise = noises(system, self.seed);
        let readings = (0..system.outputs.len())
            .map(|o| {
                let mut shown = self.shown(o, &states, &self.causes);
                shown.retain(|(stamp, _)| was_taken(&self.causes, o, *stamp, (steps - 1) as f64 * H));
                let mut rngs = [self.chances(30 + o as u64), self.chances(40 + o as u64)];
                scatter(&self.causes, o, &mut shown, noise[o], &mut rngs);
                shown
            })
            .collect();
        // Without a stated noise, more of it is no gap.
        let declared = uniform(&mut stream(self.seed, 3), 0.0, 1.0) < 0.5
            || self.causes.iter().any(|c| c.kind == Kind::Noise);
        Run { parameters, noise, declared, commands, readings, states }
    }

    fn channels(&self) -> Vec<Channel> {
        let one =
            |i: usize| Channel::new(&self.causes, i, self.system.inputs[i].rest, self.chances(20 + i as u64));
        (0..self.system.inputs.len()).map(one).collect()
    }

    /// What the sensor shows before noise.
    pub(crate) fn shown(&self, output: usize, states: &[State], causes: &[Cause]) -> Vec<(f64, f64)> {
        let truth: Vec<f64> = states.iter().map(|s| reading(self.system, output, s)).collect();
        let every = (1.0 / self.system.sample_rate / H).round() as usize;
        show(causes, output, &truth, every, &mut self.chances(50 + output as u64))
    }

    /// What acts on the machine in every step when these commands are played open loop.
    pub(crate) fn acting(&self, commands: &[[f64; N]], steps: usize, causes: &[Cause]) -> Vec<[f64; N]> {
        let other = Self { causes: causes.to_vec(), ..*self };
        let mut channels = other.channels();
        let every = (1.0 / self.system.command_rate / H).round() as usize;
        (0..steps)
            .map(|i| {
                let t = i as f64 * H;
                let mut u = [0.0; N];
                for (j, channel) in channels.iter_mut().enumerate() {
                    if i % every == 0 {
                        channel.send(t, commands[i / every][j]);
                    }
                    u[j] = channel.act(t);
                }
                u
            })
            .collect()
    }
}
