//! The models on lanes agree with the models on plain numbers.

use parallax_model::lanes::{F64x16, InMemory, Kernel, Level, Simd};
use parallax_model::tree::Tree;
use parallax_model::{Model, Scalar};
use parallax_nodes::models::pendulum::{self, Pendulum};
use parallax_nodes::models::quadrotor::{self, Quadrotor};
use proptest::prelude::*;

/// One step of a model: parameters, state, input and time step as leaves; gives the next state.
struct Step<M, T> {
    leaves: [Vec<T>; 3],
    dt: T,
    model: std::marker::PhantomData<M>,
}

impl<M: Model, T: InMemory> Kernel for Step<M, T> {
    type Output = Vec<T>;
    #[inline(always)]
    fn run<S: Simd>(mut self) -> Vec<T> {
        let [params, state, input] = &self.leaves;
        let params = Tree::read_from(T::registers::<S>(params));
        let state = Tree::read_from(T::registers::<S>(state));
        let input = Tree::read_from(T::registers::<S>(input));
        let (next, _) = M::step(&params, state, input, T::load::<S>(&self.dt));
        next.write_to(T::registers_mut::<S>(&mut self.leaves[1]));
        let [_, state, _] = self.leaves;
        state
    }
}

fn plain<M: Model>(leaves: &[Vec<f64>; 3], dt: f64) -> Vec<f64> {
    let [params, state, input] = leaves;
    let (next, _) =
        M::step::<f64>(&Tree::read_from(params), Tree::read_from(state), Tree::read_from(input), dt);
    next.to_vec()
}

fn check<M: Model>(environments: &[[Vec<f64>; 3]], dt: f64) -> Result<(), TestCaseError> {
    for level in Level::ALL.into_iter().filter(|level| level.is_available()) {
        let leaves: [Vec<F64x16>; 3] = std::array::from_fn(|tree| {
            let count = environments[0][tree].len();
            (0..count).map(|leaf| F64x16::from_fn(|lane| environments[lane][tree][leaf])).collect()
        });
        let dt_lanes = F64x16::constant(dt);
        let next = level.run(Step::<M, _> { leaves, dt: dt_lanes, model: std::marker::PhantomData });
        for (lane, environment) in environments.iter().enumerate() {
            for (leaf, expected) in plain::<M>(environment, dt).into_iter().enumerate() {
                let found = next[leaf][lane];
                prop_assert!(
                    (found - expected).abs() <= 1e-12 * expected.abs().max(1.0),
                    "{level:?}, lane {lane}, leaf {leaf}: {found}, plain {expected}"
                );
            }
        }
    }
    Ok(())
}

/// Sixteen environments around nominal constants, with states and inputs of this size.
fn environments(
    nominal: Vec<f64>,
    state: Vec<f64>,
    input: Vec<f64>,
) -> impl Strategy<Value = Vec<[Vec<f64>; 3]>> {
    let factors = (nominal.len(), state.len(), input.len());
    let one = (
        prop::collection::vec(0.7..1.3f64, factors.0),
        prop::collection::vec(-1.0..1.0f64, factors.1),
        prop::collection::vec(-1.0..1.0f64, factors.2),
    );
    prop::collection::vec(one, 16).prop_map(move |all| {
        let scale =
            |sizes: &[f64], factors: Vec<f64>| sizes.iter().zip(factors).map(|(s, f)| s * f).collect();
        all.into_iter().map(|(p, x, u)| [scale(&nominal, p), scale(&state, x), scale(&input, u)]).collect()
    })
}

proptest! {
    #[test]
    fn pendulum_on_lanes(environments in environments(
        pendulum::Params::default().to_vec(), vec![20.0, 15.0], vec![12.0],
    )) {
        check::<Pendulum>(&environments, pendulum::STEP)?;
    }

    #[test]
    fn quadrotor_on_lanes(environments in environments(
        quadrotor::Params::default().to_vec(), vec![3.0, 3.0, 3.0, 2.0, 2.0, 2.0, 0.6, 0.6, 3.0, 3000.0],
        vec![60_000.0, 0.5, 0.5],
    )) {
        check::<Quadrotor>(&environments, quadrotor::STEP)?;
    }
}
