//! Commands on their way to the machine, and readings on their way from it.

use crate::effect::{Cause, Kind, Place, uniform};
use crate::mechanics::H;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use std::collections::VecDeque;

/// One input: a queue of messages by time of arrival, then what the actuator makes of them.
pub(crate) struct Channel {
    causes: Vec<Cause>,
    queue: VecDeque<(f64, f64)>,
    last: f64,
    held: Option<f64>,
    state: Vec<Option<[f64; 2]>>,
    rest: f64,
    rng: ChaCha8Rng,
}

impl Channel {
    pub(crate) fn new(causes: &[Cause], input: usize, rest: f64, rng: ChaCha8Rng) -> Self {
        let causes: Vec<Cause> = causes.iter().filter(|c| c.place == Place::Input(input)).copied().collect();
        let state = vec![None; causes.len()];
        Self { causes, queue: VecDeque::new(), last: 0.0, held: None, state, rest, rng }
    }

    /// A message is sent. The first is in force from the start, however late it arrives.
    pub(crate) fn send(&mut self, t: f64, value: f64) {
        let first = self.held.is_none();
        self.held.get_or_insert(value);
        let mut late = 0.0;
        let mut lost = false;
        for c in &self.causes {
            match c.kind {
                Kind::DelayIn => late += c.p[0],
                Kind::SkewIn => late += c.p[0] * t,
                Kind::EventDelay if (value - self.rest).abs() > c.p[1] => late += c.p[0],
                Kind::JitterIn => late += scattered(c.p[0], &mut self.rng),
                Kind::DropsIn => lost = lost || self.rng.random::<f64>() < c.p[0],
                _ => {}
            }
        }
        if lost && !first {
            return;
        }
        // A queue keeps its order.
        self.last = self.last.max((t + late).max(0.0));
        self.queue.push_back((self.last, value));
    }

    /// What acts from `t` to `t + H`: a message that arrives meanwhile does so for the rest of it, which pushes as much as its share.
    pub(crate) fn act(&mut self, t: f64) -> f64 {
        let mut u = self.held.unwrap_or(self.rest);
        while let Some(&(arrival, value)) = self.queue.front() {
            let share = (t + H - arrival) / H;
            if share < 1e-5 {
                break;
            }
            u = if share < 1.0 - 1e-5 { u + share * (value - self.held.unwrap_or(self.rest)) } else { value };
            self.held = Some(value);
            self.queue.pop_front();
        }
        for (c, state) in self.causes.iter().zip(&mut self.state) {
            u = actuator(c, state, u, self.rest);
        }
        u
    }
}

/// A lateness with this standard deviation: half a normal distribution.
fn scattered(spread: f64, rng: &mut ChaCha8Rng) -> f64 {
    spread / (1.0 - 2.0 / std::f64::consts::PI).sqrt() * rng.sample::<f64, _>(StandardNormal).abs()
}

fn actuator(c: &Cause, state: &mut Option<[f64; 2]>, u: f64, rest: f64) -> f64 {
    let [a, b, ..] = c.p;
    let s = state.get_or_insert([u, 0.0]);
    match c.kind {
        Kind::Gain => a * u,
        Kind::Offset => a + u,
        Kind::Saturation => u.max(a).min(b),
        Kind::TanhSaturation => rest + a * ((u - rest) / a.max(1e-12)).tanh(),
        Kind::Deadband => {
            // The zone is around zero, as an actuator's is.
            if u.abs() < a { 0.0 } else { u - u.signum() * a }
        }
        Kind::SmoothDeadband => u - a * (u / a.max(1e-12)).tanh(),
        Kind::SupplySag => u * (1.0 - a * u.abs()),
        Kind::RateLimit => {
            s[0] += (u - s[0]).clamp(-a * H, a * H);
            s[0]
        }
        Kind::Backlash => {
            // A command of a machine that runs away may be none.
            s[0] = s[0].max(u - a / 2.0).min(u + a / 2.0);
            s[0]
        }
        Kind::Lag if a > 0.0 => {
            // What acts over a step is what the lag shows in its middle.
            let before = s[0];
            s[0] += (u - s[0]) * (1.0 - (-H / a).exp());
            0.5 * (before + s[0])
        }
        Kind::LagSecond if a > 0.0 => {
            let before = s[0];
            0.5 * (before + second_order(s, u, a, b))
        }
        _ => u,
    }
}

/// A step under a constant `u` by the trapezoidal rule, so that what is shown is neither early nor late.
fn second_order(s: &mut [f64; 2], u: f64, time: f64, damping: f64) -> f64 {
    let (stiff, damped) = ((0.5 * H / time).powi(2), H * damping / time);
    let before = s[1];
    s[1] = (before * (1.0 - stiff - damped) + H * (u - s[0]) / (time * time)) / (1.0 + stiff + damped);
    s[0] += 0.5 * H * (before + s[1]);
    s[0]
}

/// What a sensor with these causes shows, before noise: (stamp, value) for every sample; `true_values` are per step.
pub(crate) fn show(
    causes: &[Cause],
    output: usize,
    true_values: &[f64],
    every: usize,
    rng: &mut ChaCha8Rng,
) -> Vec<(f64, f64)> {
    let causes: Vec<&Cause> = causes.iter().filter(|c| c.place == Place::Output(output)).collect();
    let mut shown = std::borrow::Cow::Borrowed(true_values);
    for c in &causes {
        let [a, b, ..] = c.p;
        let mut s = [true_values[0], 0.0];
        // What the sensor sees over a step is what is true in its middle.
        let mut before = true_values[0];
        let mut seen = |y: f64| 0.5 * (y + std::mem::replace(&mut before, y));
        match c.kind {
            Kind::SensorLag if a > 0.0 => {
                let step = 1.0 - (-H / a).exp();
                for y in shown.to_mut() {
                    s[0] += (seen(*y) - s[0]) * step;
                    *y = s[0];
                }
            }
            Kind::SensorLagSecond if a > 0.0 => {
                for y in shown.to_mut() {
                    *y = second_order(&mut s, seen(*y), a, b);
                }
            }
            _ => {}
        }
    }
    let last = shown.len() - 1;
    let mut readings = Vec::new();
    for k in (0..=last).step_by(every) {
        let stamp = k as f64 * H;
        let mut taken = stamp;
        let mut lost = false;
        for c in &causes {
            match c.kind {
                Kind::DelayOut => taken -= c.p[0],
                Kind::SkewOut => taken -= c.p[0] * stamp,
                Kind::JitterOut => taken -= scattered(c.p[0], rng),
                Kind::DropsOut => lost = lost || (k > 0 && rng.random::<f64>() < c.p[0]),
                _ => {}
            }
        }
        if lost {
            continue;
        }
        let at = (taken / H).max(0.0);
        // Beyond the end it goes on as it went last ([`was_taken`]).
        let i = (at as usize).min(last.saturating_sub(1));
        let mut y = shown[i] + (at - i as f64) * (shown[(i + 1).min(last)] - shown[i]);
        for c in &causes {
            let [a, b, ..] = c.p;
            match c.kind {
                Kind::Bias => y += a,
                Kind::Scale => y *= a,
                Kind::Drift => y += a * stamp,
                Kind::SensorSaturation => y = y.max(a).min(b),
                _ => {}
            }
        }
        readings.push((stamp, y));
    }
    readings
}

/// Whether a reading with this stamp is from before the end of the run: a sensor whose clock is fast shows what comes after it.
pub(crate) fn was_taken(causes: &[Cause], output: usize, stamp: f64, end: f64) -> bool {
    let fast = causes.iter().filter(|c| c.place == Place::Output(output) && c.kind == Kind::SkewOut);
    stamp - fast.map(|c| c.p[0] * stamp).sum::<f64>() <= end
}

/// How readings scatter: noise of the sensor, then what is wrong with it.
pub(crate) fn scatter(
    causes: &[Cause],
    output: usize,
    readings: &mut [(f64, f64)],
    noise: f64,
    rngs: &mut [ChaCha8Rng; 2],
) {
    let [plain, odd] = rngs;
    for (_, y) in readings.iter_mut() {
        *y += noise * plain.sample::<f64, _>(StandardNormal);
    }
    for c in causes.iter().filter(|c| c.place == Place::Output(output)) {
        let a = c.p[0];
        match c.kind {
            Kind::Noise => {
                readings.iter_mut().for_each(|(_, y)| *y += a * odd.sample::<f64, _>(StandardNormal))
            }
            Kind::Quantization if a > 0.0 => readings.iter_mut().for_each(|(_, y)| *y = (*y / a).round() * a),
            Kind::Outliers => {
                for (_, y) in readings.iter_mut() {
                    if odd.random::<f64>() < a {
                        *y += noise * uniform(odd, 10.0, 50.0) * odd.sample::<f64, _>(StandardNormal);
                    }
                }
            }
            Kind::Stuck => {
                let mut i = 1;
                while i < readings.len() {
                    // The rate is the share of readings that are old; a run has four and a half of them on average.
                    if odd.random::<f64>() < a / (4.5 * (1.0 - a) + a) {
                        let until = (i + odd.random_range(2..8usize)).min(readings.len());
                        let old = readings[i - 1].1;
                        readings[i..until].iter_mut().for_each(|(_, y)| *y = old);
                        i = until;
                    }
                    i += 1;
                }
            }
            _ => {}
        }
    }
}
