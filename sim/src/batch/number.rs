//! What a block of environments is computed with: one number, or lanes.

use parallax_model::Scalar;
use parallax_model::lanes::{F32x32, F64x16};
use parallax_model::node_model::{ErasedModel, NodeStep, Scratch};

/// A number for each environment of a block.
pub(super) trait Number: Scalar + Send + Sync {
    /// How many environments a block holds.
    const LANES: usize;
    /// One environment's number.
    fn get(&self, lane: usize) -> f64;
    /// Changes one environment's number.
    fn set(&mut self, lane: usize, value: f64);
    /// One step of a model for the whole block.
    fn step(
        model: &dyn ErasedModel,
        params: &[Self],
        state: &mut [Self],
        step: &NodeStep<'_, Self>,
        scratch: &mut Scratch<Self>,
        output: &mut [Self],
    );
}

impl Number for f64 {
    const LANES: usize = 1;
    #[inline(always)]
    fn get(&self, _: usize) -> f64 {
        *self
    }
    #[inline(always)]
    fn set(&mut self, _: usize, value: f64) {
        *self = value;
    }
    #[inline(always)]
    fn step(
        model: &dyn ErasedModel,
        params: &[Self],
        state: &mut [Self],
        step: &NodeStep<'_, Self>,
        scratch: &mut Scratch<Self>,
        output: &mut [Self],
    ) {
        model.step_f64(params, state, step, scratch, output);
    }
}

macro_rules! lanes {
    ($lanes:ident, $float:ty, $step:ident) => {
        impl Number for $lanes {
            const LANES: usize = $lanes::LANES;
            #[inline(always)]
            fn get(&self, lane: usize) -> f64 {
                self[lane].into()
            }
            #[inline(always)]
            fn set(&mut self, lane: usize, value: f64) {
                self[lane] = value as $float;
            }
            #[inline(always)]
            fn step(
                model: &dyn ErasedModel,
                params: &[Self],
                state: &mut [Self],
                step: &NodeStep<'_, Self>,
                scratch: &mut Scratch<Self>,
                output: &mut [Self],
            ) {
                model.$step(params, state, step, scratch, output);
            }
        }
    };
}

lanes!(F64x16, f64, step_f64x16);
lanes!(F32x32, f32, step_f32x32);
