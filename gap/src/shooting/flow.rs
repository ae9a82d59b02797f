//! How far the flow of a system shrinks volumes before a window begins.
//!
//! A window's initial state is that at its first reading, and a late reading was taken before its stamp. What integrating
//! the state out costs is a volume, and volumes shrink along the flow (Liouville's theorem): where one sensor of several is
//! late, the windows would begin earlier than what most sensors tell, and the hypothesis would seem likelier for that
//! alone. Volumes are compared where most sensors begin. Where all are late the whole window is, and nothing changes.

use nalgebra::DMatrix;

use super::Placed;
use crate::simulator::{At, Event, LANES, Motion, Run};

/// Sets each window's [`super::Window`] flow: ln |det ∂x(begin)/∂x(first)|, where most sensors begin.
pub(super) fn set(run: &mut dyn Run, group: &mut [Placed<'_>], states: usize, outputs: usize) {
    let mut motion = Motion::new(states, states, 0);
    let mut at: At = [None; LANES];
    let mut begins = [0.0; LANES];
    for (lane, (window, first, end)) in group.iter_mut().enumerate() {
        window.flow = 0.0;
        at[lane] = Some(*first);
        begins[lane] = most_begin(&run.events()[*first..*end], window.from, outputs);
        for (x, value) in motion.x.iter_mut().zip(&window.state) {
            x[lane] = *value;
        }
    }
    motion.seed();
    loop {
        for (lane, (window, first, end)) in group.iter_mut().enumerate() {
            let Some(index) = at[lane] else { continue };
            let to = begins[lane];
            let (begin, now) = (run.events()[*first].time, run.events()[index].time);
            if now < to - 1e-9 && index + 1 < *end {
                continue;
            }
            at[lane] = None;
            if now > begin && to > begin {
                let by = |i: usize, j: usize| motion.by[i * motion.columns + j][lane];
                let volume = DMatrix::from_fn(states, states, by).determinant().abs().ln();
                // Events need not fall on the stamp; the flow is even enough over a step.
                let whole = volume * (to - begin) / (now - begin);
                window.flow = if whole.is_finite() { whole } else { 0.0 };
            }
        }
        if at.iter().all(Option::is_none) {
            return;
        }
        run.advance_lanes(&at, &mut motion);
        for index in at.iter_mut().flatten() {
            *index += 1;
        }
    }
}

/// When the sensor in the middle was first read, of those stamped from `from` on; of an even number the later one.
fn most_begin(events: &[Event], from: f64, outputs: usize) -> f64 {
    let mut first: Vec<Option<f64>> = vec![None; outputs];
    let mut missing = outputs;
    for event in events {
        let Some(reading) = event.reading.filter(|r| r.stamp >= from) else { continue };
        if first[reading.output].is_none() {
            first[reading.output] = Some(event.time);
            missing -= 1;
            if missing == 0 {
                break;
            }
        }
    }
    let mut times: Vec<f64> = first.into_iter().flatten().collect();
    times.sort_by(f64::total_cmp);
    times.get(times.len() / 2).copied().unwrap_or(from)
}
