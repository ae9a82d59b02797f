//! What a block of environments is computed with: one number, or lanes.

use parallax_model::lanes::{F32x32, F64x16, InMemory};
use parallax_model::node_model::{BlockStep, Directions, ErasedModel, Scratch};

/// A number for each environment of a block.
pub(crate) trait Number: InMemory + Send + Sync {
    /// How many environments a block holds.
    const LANES: usize;
    /// How far apart the numbers around 1 are.
    const EPSILON: f64 = f64::EPSILON;
    /// One environment's number.
    fn get(&self, lane: usize) -> f64;
    /// Changes one environment's number.
    fn set(&mut self, lane: usize, value: f64);
    /// Makes it change by `slope` along a direction; numbers without derivatives stay what they are.
    fn incline(&mut self, direction: usize, slope: f64) {
        let _ = (direction, slope);
    }
    /// What a model prepares of the parameters of one block.
    fn prepare(model: &dyn ErasedModel, params: &[Self], prepared: &mut [Self]);
    /// One step of a model for all blocks.
    fn step(model: &dyn ErasedModel, step: &mut BlockStep<'_, Self>, scratch: &mut Scratch<Self>);
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
    fn prepare(model: &dyn ErasedModel, params: &[Self], prepared: &mut [Self]) {
        model.prepare_f64(params, prepared);
    }
    #[inline(always)]
    fn step(model: &dyn ErasedModel, step: &mut BlockStep<'_, Self>, scratch: &mut Scratch<Self>) {
        model.step_blocks_f64(step, scratch);
    }
}

macro_rules! lanes {
    ($lanes:ident, $float:ty, $prepare:ident, $step:ident) => {
        impl Number for $lanes {
            const LANES: usize = $lanes::LANES;
            const EPSILON: f64 = <$float>::EPSILON as f64;
            #[inline(always)]
            fn get(&self, lane: usize) -> f64 {
                self[lane].into()
            }
            #[inline(always)]
            fn set(&mut self, lane: usize, value: f64) {
                self[lane] = value as $float;
            }
            fn prepare(model: &dyn ErasedModel, params: &[Self], prepared: &mut [Self]) {
                model.$prepare(params, prepared);
            }
            #[inline(always)]
            fn step(model: &dyn ErasedModel, step: &mut BlockStep<'_, Self>, scratch: &mut Scratch<Self>) {
                model.$step(step, scratch);
            }
        }
    };
}

lanes!(F64x16, f64, prepare_f64x16, step_blocks_f64x16);
lanes!(F32x32, f32, prepare_f32x32, step_blocks_f32x32);

impl Number for Directions {
    const LANES: usize = 1;
    #[inline(always)]
    fn get(&self, _: usize) -> f64 {
        self.value
    }
    #[inline(always)]
    fn set(&mut self, _: usize, value: f64) {
        *self = Directions::from_value(value);
    }
    fn incline(&mut self, direction: usize, slope: f64) {
        self.gradient[direction] += slope;
    }
    fn prepare(model: &dyn ErasedModel, params: &[Self], prepared: &mut [Self]) {
        model.prepare_dual(params, prepared);
    }
    #[inline(always)]
    fn step(model: &dyn ErasedModel, step: &mut BlockStep<'_, Self>, scratch: &mut Scratch<Self>) {
        model.step_blocks_dual(step, scratch);
    }
}
