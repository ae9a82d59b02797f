//! How far the flow of a system shrinks volumes before a window begins.
//!
//! A window's initial state is that at its first reading, and a late reading was taken before its stamp. What integrating
//! the state out costs is a volume, and volumes shrink along the flow (Liouville's theorem): a hypothesis that begins its
//! windows earlier would seem likelier for that alone. Volumes are compared where the windows begin by their stamps.

use nalgebra::DMatrix;

use super::Placed;
use crate::simulator::{At, LANES, Motion, Run};

/// Sets each window's [`super::Window`] flow: ln |det ∂x(from)/∂x(first)|.
pub(super) fn set(run: &mut dyn Run, group: &mut [Placed<'_>], states: usize) {
    let mut motion = Motion::new(states, states, 0);
    let mut at: At = [None; LANES];
    for (lane, (window, first, _)) in group.iter_mut().enumerate() {
        window.flow = 0.0;
        at[lane] = Some(*first);
        for (x, value) in motion.x.iter_mut().zip(&window.state) {
            x[lane] = *value;
        }
    }
    motion.seed();
    loop {
        for (lane, (window, first, end)) in group.iter_mut().enumerate() {
            let Some(index) = at[lane] else { continue };
            let (begin, now) = (run.events()[*first].time, run.events()[index].time);
            if now < window.from - 1e-9 && index + 1 < *end {
                continue;
            }
            at[lane] = None;
            if now > begin && window.from > begin {
                let by = |i: usize, j: usize| motion.by[i * motion.columns + j][lane];
                let volume = DMatrix::from_fn(states, states, by).determinant().abs().ln();
                // Events need not fall on the stamp; the flow is even enough over a step.
                let whole = volume * (window.from - begin) / (now - begin);
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
