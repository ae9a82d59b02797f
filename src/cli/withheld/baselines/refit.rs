//! Nominal refit only: the calibrated parameters are fitted, and nothing is ever named.

use std::sync::atomic::AtomicBool;

use parallax_gap::search;
use parallax_model::system::System;
use parallax_runtime::recording::log::Log;

use super::{BaselineResult, closed_from_nominal, setup};

/// It has no test for a gap, so it detects none.
pub(super) fn answer(system: &System, log: &Log, _stop: &AtomicBool) -> anyhow::Result<BaselineResult> {
    let setup = setup(system, log)?;
    let null = search::null(&setup);
    let closed = closed_from_nominal(&setup, &null, &null);
    Ok(BaselineResult { closed: Some(closed), ..BaselineResult::default() })
}
