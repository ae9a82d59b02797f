//! The arithmetic of a multilayer perceptron.

/// What stands between two layers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Activation {
    /// Nothing.
    None,
    /// `tanh x`
    Tanh,
    /// `max(x, 0)`
    Relu,
    /// `x` above zero, `0.01 x` below.
    LeakyRelu,
    /// `x` above zero, `exp x − 1` below.
    Elu,
    /// `x / (1 + exp −x)`
    Swish,
    /// `1 / (1 + exp −x)`
    Sigmoid,
    /// `log(1 + exp x)`
    Softplus,
    /// `x (1 + tanh(√(2/π) (x + 0.044715 x³))) / 2`: D. Hendrycks and K. Gimpel, 2016, equation 2.
    Gelu,
}

impl Activation {
    /// All names by which activations are called in files.
    pub const NAMES: [(&'static str, Self); 12] = [
        ("none", Self::None),
        ("linear", Self::None),
        ("identity", Self::None),
        ("tanh", Self::Tanh),
        ("relu", Self::Relu),
        ("leaky_relu", Self::LeakyRelu),
        ("elu", Self::Elu),
        ("swish", Self::Swish),
        ("silu", Self::Swish),
        ("sigmoid", Self::Sigmoid),
        ("softplus", Self::Softplus),
        ("gelu", Self::Gelu),
    ];

    /// The activation of this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::NAMES.iter().find(|(known, _)| *known == name).map(|(_, activation)| *activation)
    }

    /// Its value at a place.
    #[inline]
    pub fn at(self, x: f64) -> f64 {
        match self {
            Self::None => x,
            Self::Tanh => x.tanh(),
            Self::Relu => x.max(0.0),
            Self::LeakyRelu => {
                if x > 0.0 {
                    x
                } else {
                    0.01 * x
                }
            }
            Self::Elu => {
                if x > 0.0 {
                    x
                } else {
                    x.exp_m1()
                }
            }
            Self::Swish => x * sigmoid(x),
            Self::Sigmoid => sigmoid(x),
            // Without the detour, exp overflows for large x.
            Self::Softplus => x.max(0.0) + (-x.abs()).exp().ln_1p(),
            Self::Gelu => {
                let inner = (2.0 / std::f64::consts::PI).sqrt() * (x + 0.044_715 * x * x * x);
                0.5 * x * (1.0 + inner.tanh())
            }
        }
    }
}

fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// One layer: `activation(weight × input + bias)`.
#[derive(Debug, Clone)]
pub(super) struct Layer {
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    /// Column by column: the outputs of one input stand together, so that they are added side by side.
    pub(super) columns: Box<[f64]>,
    pub(super) bias: Box<[f64]>,
    pub(super) activation: Activation,
}

impl Layer {
    #[inline]
    fn evaluate(&self, input: &[f64], output: &mut [f64]) {
        output.copy_from_slice(&self.bias);
        for (value, column) in input.iter().zip(self.columns.chunks_exact(self.outputs)) {
            for (sum, weight) in output.iter_mut().zip(column) {
                *sum += value * weight;
            }
        }
        for value in output {
            *value = self.activation.at(*value);
        }
    }
}

/// What is done to a number on its way in or out: `(x − shift) * factor`, held within a range.
#[derive(Debug, Clone, Copy)]
pub(super) struct Scaling {
    pub(super) shift: f64,
    pub(super) factor: f64,
    pub(super) offset: f64,
    pub(super) low: f64,
    pub(super) high: f64,
}

impl Scaling {
    pub(super) const NONE: Self =
        Self { shift: 0.0, factor: 1.0, offset: 0.0, low: f64::NEG_INFINITY, high: f64::INFINITY };

    #[inline]
    fn apply(&self, x: f64) -> f64 {
        ((x - self.shift) * self.factor + self.offset).clamp(self.low, self.high)
    }
}

/// A perceptron with what stands before and behind it. Evaluating it allocates nothing.
#[derive(Debug, Clone)]
pub struct Network {
    layers: Box<[Layer]>,
    before: Box<[Scaling]>,
    behind: Box<[Scaling]>,
    /// Room for two layers' outputs.
    front: Box<[f64]>,
    back: Box<[f64]>,
}

impl Network {
    /// The layers must fit each other, and the scalings the first and the last one.
    pub(super) fn new(layers: Vec<Layer>, before: Vec<Scaling>, behind: Vec<Scaling>) -> Self {
        let widths = layers.iter().flat_map(|layer| [layer.inputs, layer.outputs]);
        let widest = widths.max().unwrap_or(0);
        let room = || vec![0.0; widest].into_boxed_slice();
        Self {
            layers: layers.into(),
            before: before.into(),
            behind: behind.into(),
            front: room(),
            back: room(),
        }
    }

    /// How many numbers go in.
    pub fn inputs(&self) -> usize {
        self.before.len()
    }

    /// How many come out.
    pub fn outputs(&self) -> usize {
        self.behind.len()
    }

    /// Computes the outputs.
    ///
    /// # Panics
    ///
    /// When `inputs` or `outputs` has another length than the network's.
    pub fn evaluate(&mut self, inputs: &[f64], outputs: &mut [f64]) {
        assert_eq!(
            (inputs.len(), outputs.len()),
            (self.before.len(), self.behind.len()),
            "numbers in and out"
        );
        let Self { layers, before, behind, front, back } = self;
        for ((value, input), scaling) in front.iter_mut().zip(inputs).zip(before.iter()) {
            *value = scaling.apply(*input);
        }
        for layer in layers.iter() {
            layer.evaluate(&front[..layer.inputs], &mut back[..layer.outputs]);
            std::mem::swap(front, back);
        }
        for ((output, value), scaling) in outputs.iter_mut().zip(front.iter()).zip(behind.iter()) {
            *output = scaling.apply(*value);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn activations_at_known_places() {
        // To seven digits, by hand.
        let places = [
            (Activation::Tanh, 0.5, 0.462_117_2),
            (Activation::Elu, -1.0, -0.632_120_6),
            (Activation::Swish, 1.0, 0.731_058_6),
            (Activation::Sigmoid, -2.0, 0.119_202_9),
            (Activation::Softplus, 1.0, 1.313_261_7),
            (Activation::Softplus, 1000.0, 1000.0),
            (Activation::Gelu, 1.0, 0.841_192_0),
            (Activation::LeakyRelu, -3.0, -0.03),
            (Activation::Relu, -3.0, 0.0),
            (Activation::None, -3.0, -3.0),
        ];
        for (activation, x, expected) in places {
            assert!(
                (activation.at(x) - expected).abs() < 1e-7,
                "{activation:?} at {x}: {}",
                activation.at(x)
            );
        }
        assert!(Activation::NAMES.iter().all(|(name, known)| Activation::from_name(name) == Some(*known)));
    }
}
