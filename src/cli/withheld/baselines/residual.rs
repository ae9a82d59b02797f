//! Black-box residual: a flexible force or reading on top of the refitted nominal system. It closes a gap and names nothing.

use std::sync::atomic::AtomicBool;

use parallax_gap::search;
use parallax_gap::unknown::{choose, fit_unknown, kinds};
use parallax_model::system::System;
use parallax_runtime::recording::log::Log;

use super::{BaselineResult, closed_from_nominal, setup};

/// The kind of residual that predicts short windows better.
pub(super) fn answer(system: &System, log: &Log, _stop: &AtomicBool) -> anyhow::Result<BaselineResult> {
    let setup = setup(system, log)?;
    let null = search::null(&setup);
    let fits = kinds(&setup)
        .into_iter()
        .map(|kind| fit_unknown(&setup, &null, &null, choose(&setup, &null, &null, kind)));
    let best = fits.min_by(|a, b| a.shooting_error.total_cmp(&b.shooting_error));
    let closed = best.map(|fit| closed_from_nominal(&setup, &null, &fit));
    Ok(BaselineResult { closed, ..BaselineResult::default() })
}
