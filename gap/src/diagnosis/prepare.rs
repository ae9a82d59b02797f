//! What comes before the search: a look at the data, what stands against a diagnosis, and the null hypothesis.

use parallax_model::system::Equations;

use super::DiagnosisError;
use crate::equations::MOST_VARIABLES;
use crate::experiment::Experiment;
use crate::held_out;
use crate::options::Options;
use crate::quantify;
use crate::readings::Raw;
use crate::search::{self, Fit};
use crate::setup::Setup;
use crate::stop::Stop;

/// How often the nominal model is fitted again with each state's share of the process noise that its innovations tell.
const NOISE_ROUNDS: usize = 2;

/// Looks at the data, and fits the nominal model: the null hypothesis; with a given part of the log `held_out`, or one that surprises
/// that model no more than the rest.
pub(crate) fn prepare(
    equations: Equations,
    experiment: &Experiment,
    raw: &Raw,
    title: &str,
    options: &Options,
    held_out: Option<usize>,
) -> Result<(Setup, Fit), DiagnosisError> {
    let system = equations.system();
    let (states, calibrated) =
        (system.states.len(), system.parameters.iter().filter(|p| p.calibrate.is_some()).count());
    // An effect and a small residual must fit beside them.
    let most = MOST_VARIABLES / 2;
    if states + calibrated > most {
        return Err(DiagnosisError::TooMany { file: system.file.clone(), states, calibrated, most });
    }
    // Readings that do not follow the plant would be taken for its motion.
    let least = raw.believed(&equations);
    let (experiment, _) = raw.cleaned(experiment);
    let (from, to) = experiment.span();
    let mut setup = Setup::with_noise(equations, experiment, options.horizon, &least);
    if setup.horizon < 2.0 * setup.period {
        let (horizon, period) = (setup.horizon, setup.period);
        return Err(DiagnosisError::Horizon { title: title.into(), horizon, period });
    }
    if setup.output_range.iter().all(|range| range.width() == 0.0) {
        return Err(DiagnosisError::Still { title: title.into() });
    }
    if let Some(which) = held_out {
        setup.hold_out(which);
    }
    quantify::refine_step(&mut setup);
    setup.stop = Stop::when(options.stop.clone());
    if setup.train.is_empty() || setup.test.is_empty() {
        return Err(DiagnosisError::Short {
            title: title.into(),
            span: to - from,
            horizon: setup.horizon,
            needed: 12.0 * setup.horizon,
        });
    }
    let shared = setup.noise.is_shared();
    if shared {
        let (walked, noise) = search::nominal(&setup);
        setup.share_noise(&walked, &noise);
    }
    let mut null = search::null(&setup);
    let fairer = held_out.is_none().then(|| held_out::fairer(&setup, &null)).flatten();
    if let Some(other) = fairer {
        setup.hold_out(other);
        null = search::null(&setup);
    }
    for _ in 0..if shared { NOISE_ROUNDS } else { 0 } {
        if setup.stop.asked() || !setup.share_noise(&null.innovation.pass, &null.innovation.noise) {
            break;
        }
        null = search::null(&setup);
    }
    null.hold_to_predictions(&setup);
    if !null.innovation.minimum.cost.is_finite() {
        return Err(DiagnosisError::NotFinite {
            file: setup.equations.system().file.clone(),
            title: title.into(),
        });
    }
    Ok((setup, null))
}
