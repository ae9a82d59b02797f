//! What a fit says of the nominal system's own parameters.

use crate::hypothesis::{Fitted, Slot};
use crate::report::Calibration;
use crate::search::{Fit, RESTS};
use crate::setup::Setup;

/// How far each moved.
pub(crate) fn moved(setup: &Setup, fit: &Fit) -> Vec<Calibration> {
    let (theta, std) = (fit.estimate(), fit.std());
    let mut out = Vec::new();
    for (k, f) in fit.hypothesis.fitted.iter().enumerate() {
        let Slot::Nominal(index) = f.slot else { continue };
        if setup.equations.system().parameters[index].calibrate.is_none() {
            continue;
        }
        out.push(Calibration {
            name: f.name.clone(),
            nominal: f.null,
            value: theta[k],
            std: std[k],
            unit: f.unit.clone(),
            significant: (theta[k] - f.null).abs() > 2.0 * std[k],
            at_bound: near(f, theta[k]),
        });
    }
    out
}

/// Whether a value lies at a bound of its parameter.
fn near(fitted: &Fitted, value: f64) -> bool {
    let near = RESTS * (fitted.high - fitted.low);
    near.is_finite() && (value - fitted.low <= near || fitted.high - value <= near)
}

/// The values of all that were fitted, freed ones included, by name.
pub(crate) fn values(setup: &Setup, fit: &Fit) -> Vec<(String, f64)> {
    let theta = fit.estimate();
    let system = setup.equations.system();
    let fitted = fit.hypothesis.fitted.iter().zip(theta);
    fitted
        .filter_map(|(f, value)| match f.slot {
            Slot::Nominal(index) => Some((system.parameters[index].name.clone(), *value)),
            _ => None,
        })
        .collect()
}
