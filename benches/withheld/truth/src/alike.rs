//! What cannot be told from a cause: the class in which an answer counts as right.
//!
//! Another cause is alike when a machine that has it in the true one's place follows what the sensors show, but for the
//! share that a cosine of 0.97 between two signatures leaves. Its size, the machine's calibrated parameters, the initial
//! states and the other true causes are fitted: a large cause and another one may need other parameters to be the same.

use crate::case::stream;
use crate::effect::{Cause, Kind, Place, draw, label, table};
use crate::least_squares::{orthonormal, remove};
use crate::signature::{NOTHING, Slopes, Values, View};
use nalgebra::DVector;

/// Cosine above which two causes count as one class.
pub(crate) const ALIKE: f64 = 0.97;
/// Sizes of a cause that are looked at; the cosine from which it comes near, and from which it is fitted.
const SIZES: usize = 6;
const NEAR: f64 = 0.3;
const FITTED: f64 = 0.6;

impl View<'_> {
    /// Adds the labels of all effects of the table that are alike the cause which this machine lacks.
    pub(crate) fn classify(&self, lacking: &Cause, labels: &mut Vec<String>) {
        if lacking.kind.statistical() || self.cost <= NOTHING {
            return;
        }
        let case = self.case;
        let slopes = self.slopes();
        let span = Span::new(self, &slopes);
        let truth = span.beyond(&self.rest);
        // Beside another cause the fit may have moved that one far to make up for the one that it lacks.
        let real = self.real(lacking);
        let beside_another = !self.causes.is_empty();
        let enough = |cost: f64| cost <= (1.0 - ALIKE * ALIKE) * self.cost;
        for (i, (kind, place)) in table(case.system).into_iter().enumerate() {
            let name = label(case.system, kind, place);
            if kind.statistical() || labels.contains(&name) {
                continue;
            }
            if self.shifted(lacking, kind) || real.is_its_sum(lacking, kind, place, enough) {
                labels.push(name);
                continue;
            }
            let noise = match place {
                Place::Output(o) => self.run.noise[o],
                _ => 0.0,
            };
            // The true one's size where it is the same effect elsewhere, else some that might as well be there.
            let mut rng = stream(0, 100 + i as u64);
            let same = (kind.names().0, kind.names().2) == (lacking.kind.names().0, lacking.kind.names().2);
            let mut sizes = if same { vec![Cause { kind, place, p: lacking.p }] } else { Vec::new() };
            sizes.extend((0..SIZES).map(|_| draw(case.system, kind, place, case.duration, noise, &mut rng)));
            let mut best: Option<(f64, Cause)> = None;
            for cause in sizes {
                let other = span.beyond(&self.change(&cause));
                let size = (truth.norm_squared() * other.norm_squared()).sqrt();
                let along = truth.dot(&other) / size.max(1e-300);
                let along = if kind.two_sided() { along.abs() } else { along };
                if best.is_none_or(|(most, _)| along > most) {
                    best = Some((along, cause));
                }
                if !(NEAR..ALIKE).contains(&along) {
                    break;
                }
            }
            let Some((along, cause)) = best else { continue };
            let alike =
                along >= ALIKE || ((same || along >= FITTED) && enough(self.with(cause, enough).cost));
            let stands_in =
                || real.in_its_place(cause).is_some_and(|cause| enough(real.with(cause, enough).cost));
            if alike || beside_another && stands_in() {
                labels.push(name);
            }
        }
    }

    /// The cause as large as what this machine lacks, where it does the same to it but for its size.
    fn in_its_place(&self, mut cause: Cause) -> Option<Cause> {
        let all = |values: &Values| {
            DVector::from_iterator(values.iter().map(|v| v.len()).sum(), values.iter().flatten().copied())
        };
        let (lacks, does) = (all(&self.rest), all(&self.change(&cause)));
        let along = lacks.dot(&does) / (lacks.norm() * does.norm());
        let along = if cause.kind.two_sided() { along.abs() } else { along };
        cause.p[0] *= lacks.dot(&does) / does.norm_squared();
        (along >= ALIKE).then_some(cause)
    }

    /// Of the real machine but for the true one: whether it is another value of a constant to which that adds, or adds to a constant
    /// whose other value is true. An added inertia is another inertia, and the same machine.
    fn is_its_sum(&self, lacking: &Cause, kind: Kind, place: Place, enough: impl Fn(f64) -> bool) -> bool {
        let real = &self.run.parameters;
        let size = match (lacking.place, place) {
            (Place::Parameter(k), Place::Joint(_)) => lacking.p[0] - real[k],
            (Place::Joint(_), Place::Parameter(k)) => lacking.p[0] + real[k],
            _ => return false,
        };
        if size <= 0.0 && !kind.two_sided() {
            return false;
        }
        enough(self.left_with(Cause { kind, place, p: [size, 0.0, 0.0, 0.0] }))
    }

    /// Whether it is the true one at the other end of a machine with one command and one sensor, whose clocks or times are
    /// off: the laws of motion are the same at all times, so that nobody can tell the two apart, however large they are; nor, of a
    /// linear machine, which of the two is sluggish.
    /// A command of this generator never acts before it is sent, as one on a slow clock seems to.
    fn shifted(&self, lacking: &Cause, kind: Kind) -> bool {
        let system = self.case.system;
        let one = system.inputs.len() == 1 && system.outputs.len() == 1;
        let (name, other) = (lacking.kind.names().0, kind.names().0);
        let filters = |name: &str| ["lag", "sensor_lag"].contains(&name);
        // A pair's other cause need not be linear.
        let filtered = system.linear && self.causes.is_empty() && filters(name) && filters(other);
        one && (filtered || name == other && ["delay", "clock_skew"].contains(&name))
    }
}

/// What the fit follows to first order.
struct Span {
    local: Vec<Vec<DVector<f64>>>,
    global: Vec<DVector<f64>>,
}

impl Span {
    fn new(view: &View, slopes: &Slopes) -> Self {
        let mut local = vec![Vec::new(); view.starts.len()];
        for (segment, columns) in local.iter_mut().enumerate() {
            for values in &slopes.local {
                orthonormal(columns, values[segment].clone());
            }
        }
        let mut span = Self { local, global: Vec::new() };
        for column in &slopes.global {
            // A parameter at its bound does not follow.
            let (low, high) = view.room(column);
            if low < 0.0 && high > 0.0 {
                let column = span.beyond(&column.2);
                orthonormal(&mut span.global, column);
            }
        }
        span
    }

    /// The part outside the span, as one row.
    fn beyond(&self, values: &Values) -> DVector<f64> {
        let mut all = Vec::<f64>::new();
        for (values, columns) in values.iter().zip(&self.local) {
            let mut r = values.clone();
            columns.iter().for_each(|c| remove(&mut r, c));
            all.extend(r.iter());
        }
        let mut all = DVector::from_vec(all);
        self.global.iter().for_each(|c| remove(&mut all, c));
        all
    }
}
