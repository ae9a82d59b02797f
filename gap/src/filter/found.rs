//! What a walk finds on one lane, in the order in which all hypotheses are compared.

/// What one lane found, in the order of its readings.
#[derive(Clone, Debug, Default)]
pub(super) struct Found {
    pub(super) innovation: Vec<f64>,
    pub(super) variance: Vec<f64>,
    pub(super) by_parameter: Vec<f64>,
    pub(super) output: Vec<usize>,
    pub(super) stamp: Vec<f64>,
    pub(super) event: Vec<usize>,
    pub(super) state: Vec<f64>,
    pub(super) weighs: Vec<bool>,
    pub(super) beyond: Vec<f64>,
}

impl Found {
    pub(super) fn with_room(readings: usize, states: usize, parameters: usize) -> Self {
        Found {
            innovation: Vec::with_capacity(readings),
            variance: Vec::with_capacity(readings),
            by_parameter: Vec::with_capacity(readings * parameters),
            output: Vec::with_capacity(readings),
            stamp: Vec::with_capacity(readings),
            event: Vec::with_capacity(readings),
            state: Vec::with_capacity(readings * states),
            weighs: Vec::with_capacity(readings),
            beyond: Vec::with_capacity(readings),
        }
    }

    /// The readings in the order of their stamps and outputs: the same for every hypothesis, whatever delays it has.
    pub(super) fn in_order(self) -> Self {
        let mut order: Vec<usize> = (0..self.stamp.len()).collect();
        let key = |k: usize| (self.stamp[k], self.output[k]);
        let sorted = |a: usize, b: usize| key(a).0.total_cmp(&key(b).0).then(key(a).1.cmp(&key(b).1));
        if order.windows(2).all(|pair| sorted(pair[0], pair[1]).is_le()) {
            return self;
        }
        order.sort_by(|a, b| sorted(*a, *b));
        let rows = |of: &[f64]| {
            let width = of.len() / order.len();
            order.iter().flat_map(|k| of[k * width..(k + 1) * width].iter().copied()).collect()
        };
        Found {
            innovation: rows(&self.innovation),
            variance: rows(&self.variance),
            by_parameter: rows(&self.by_parameter),
            output: order.iter().map(|k| self.output[*k]).collect(),
            stamp: rows(&self.stamp),
            event: order.iter().map(|k| self.event[*k]).collect(),
            state: rows(&self.state),
            weighs: order.iter().map(|k| self.weighs[*k]).collect(),
            beyond: rows(&self.beyond),
        }
    }
}
