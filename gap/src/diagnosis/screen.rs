//! Which effects are tried: what the user lets, what the log can show, and what no calibrated parameter covers.

use parallax_model::effect::{Effect, Place, PlaceKind};

use crate::hypothesis::{EffectAt, Slot};
use crate::library;
use crate::options::Options;
use crate::report::Absorbed;
use crate::search::Fit;
use crate::setup::Setup;
use crate::signature::{self, Nuisance};

/// Calibrated parameters that want to leave their bounds: each is a hypothesis of its own.
pub(super) fn outgrown(setup: &Setup, null: &Fit) -> Vec<EffectAt> {
    let fitted = null.hypothesis.fitted.iter().enumerate();
    fitted
        .filter(|(j, _)| null.rests(*j))
        .filter_map(|(_, f)| {
            let Slot::Nominal(index) = f.slot else { return None };
            let name = &setup.equations.system().parameters[index].name;
            Some(EffectAt {
                effect: Effect::Parameter,
                place: Place::new(PlaceKind::Parameter, name.clone()),
            })
        })
        .collect()
}

/// The effects that the user lets be tried; the others are listed as not tested.
pub(super) fn chosen(
    candidates: Vec<EffectAt>,
    not_testable: &mut Vec<library::NotTestable>,
    options: &Options,
) -> Vec<EffectAt> {
    not_testable.retain(|n| options.allows(&n.effect));
    let (kept, left_out) = candidates.into_iter().partition(|at| options.allows(at));
    not_testable.extend(
        Vec::into_iter(left_out)
            .map(|effect| library::NotTestable { effect, reason: "you left it out".into() }),
    );
    kept
}

/// Share of a sensitivity's length that must be left beyond the calibrated parameters for an effect to be its own.
const ABSORBED: f64 = 0.03;

/// Leaves out effects that calibrated parameters cover or that leave no trace in this log.
pub(super) fn screen(
    setup: &Setup,
    null: &Fit,
    nuisance: &Nuisance,
    candidates: Vec<EffectAt>,
    not_testable: &mut Vec<library::NotTestable>,
) -> (Vec<EffectAt>, Vec<nalgebra::DMatrix<f64>>, Vec<Absorbed>) {
    let (mut kept, mut kept_columns, mut absorbed) = (Vec::new(), Vec::new(), Vec::new());
    for effect in candidates {
        let columns = signature::columns(setup, null, &effect);
        let before = columns.norm();
        if before.is_nan() || before <= signature::TRACE {
            let reason = "it leaves no trace in these readings".to_owned();
            not_testable.push(library::NotTestable { effect, reason });
        } else if nuisance.covers(&columns, ABSORBED) {
            absorbed.push(Absorbed { effect: effect.label(), by: absorber(null, &columns) });
        } else {
            kept.push(effect);
            kept_columns.push(columns);
        }
    }
    (kept, kept_columns, absorbed)
}

/// The calibrated parameter that moves most when it takes an effect's place.
fn absorber(null: &Fit, columns: &nalgebra::DMatrix<f64>) -> String {
    let p = null.hypothesis.fitted.len();
    let all = null.innovation.pass.whitened_by_parameter();
    let by = (0..p).max_by(|a, b| {
        let cosine = |j: usize| {
            let v = nalgebra::DVector::from_iterator(columns.nrows(), all.iter().skip(j).step_by(p).copied());
            columns.column_iter().map(|c| signature::cosine(&c.into_owned(), &v)).fold(0.0, f64::max)
        };
        cosine(*a).total_cmp(&cosine(*b))
    });
    by.map_or_else(String::new, |j| null.hypothesis.fitted[j].name.clone())
}
