//! Lanes agree with plain numbers, and have the same bits on every instruction set.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

mod common;

use common::{Arm, ArmParams, ArmState};
use parallax_model::lanes::{Element, F32x32, F64x16, InMemory, Kernel, Lanes, Level, Simd};
use parallax_model::program::Workspace;
use parallax_model::trace::{Traced, trace_fn, trace_model};
use parallax_model::{Model, Program, Scalar, Tree};
use proptest::prelude::*;

/// So many cases; one under Miri, which runs every instruction by itself and looks at what it touches.
fn cases(count: u32) -> u32 {
    if cfg!(miri) { 1 } else { count }
}

/// A function of two numbers, over any scalar.
trait Binary: Copy {
    fn apply<T: Scalar>(self, a: T, b: T) -> T;
}

/// Every operation of a scalar; those of one number take the first.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Operation {
    Add,
    Sub,
    Mul,
    Div,
    AddConstant,
    SubConstant,
    MulConstant,
    DivConstant,
    Assign,
    Neg,
    Sin,
    Cos,
    Tan,
    Asin,
    Acos,
    Atan,
    Atan2,
    Exp,
    Ln,
    Sqrt,
    Tanh,
    Powf,
    Powi(i32),
    Abs,
    Sign,
    Floor,
    Min,
    Max,
    Clamp,
    Lt,
    Le,
    Eq,
    Gt,
    Ge,
    And,
    Or,
    Not,
}

use Operation::*;

const OPERATIONS: [Operation; 45] = [
    Add,
    Sub,
    Mul,
    Div,
    AddConstant,
    SubConstant,
    MulConstant,
    DivConstant,
    Assign,
    Neg,
    Sin,
    Cos,
    Tan,
    Asin,
    Acos,
    Atan,
    Atan2,
    Exp,
    Ln,
    Sqrt,
    Tanh,
    Powf,
    Powi(0),
    Powi(1),
    Powi(2),
    Powi(3),
    Powi(7),
    Powi(-1),
    Powi(-2),
    Powi(-5),
    Abs,
    Sign,
    Floor,
    Min,
    Max,
    Clamp,
    Lt,
    Le,
    Eq,
    Gt,
    Ge,
    And,
    Or,
    Not,
    Powi(4),
];

impl Binary for Operation {
    #[inline(always)]
    fn apply<T: Scalar>(self, a: T, b: T) -> T {
        let truth = |mask| T::select(mask, T::constant(1.0), T::constant(0.0));
        let zero = T::constant(0.0);
        match self {
            Add => a + b,
            Sub => a - b,
            Mul => a * b,
            Div => a / b,
            AddConstant => a + 0.3,
            SubConstant => a - 0.3,
            MulConstant => a * 0.3,
            DivConstant => a / 0.3,
            Assign => {
                let mut x = a;
                x += b;
                x *= a;
                x -= b;
                x /= a;
                x
            }
            Neg => -a,
            Sin => a.sin(),
            Cos => a.cos(),
            Tan => a.tan(),
            Asin => a.asin(),
            Acos => a.acos(),
            Atan => a.atan(),
            Atan2 => a.atan2(b),
            Exp => a.exp(),
            Ln => a.ln(),
            Sqrt => a.sqrt(),
            Tanh => a.tanh(),
            Powf => a.powf(b),
            Powi(exponent) => a.powi(exponent),
            Abs => a.abs(),
            Sign => a.sign(),
            Floor => a.floor(),
            Min => a.min(b),
            Max => a.max(b),
            Clamp => a.clamp(T::constant(-1.0), T::constant(2.0)),
            Lt => truth(a.lt(b)),
            Le => truth(a.le(b)),
            Operation::Eq => truth(Scalar::eq(a, b)),
            Gt => truth(a.gt(b)),
            Ge => truth(a.ge(b)),
            And => truth(a.lt(b) & zero.lt(a)),
            Or => truth(a.lt(b) | zero.lt(a)),
            Not => truth(!a.lt(b)),
        }
    }
}

/// One operation on lanes, for [`Level::run`].
struct Apply<T>(Operation, T, T);

impl<T: InMemory> Kernel for Apply<T> {
    type Output = T;
    #[inline(always)]
    fn run<S: Simd>(self) -> T {
        let (a, b) = (T::load::<S>(&self.1), T::load::<S>(&self.2));
        let mut result = self.1;
        T::store::<S>(&mut result, self.0.apply(a, b));
        result
    }
}

fn close(a: f64, b: f64, tolerance: f64) -> bool {
    (a.is_nan() && b.is_nan()) || a == b || (a - b).abs() <= tolerance * b.abs().max(1.0)
}

/// Numbers of every size and kind.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        4 => -10.0..10.0f64,
        3 => -1e5..1e5f64,
        2 => (-300.0..300.0f64, any::<bool>()).prop_map(|(e, s)| if s { -(10f64.powf(e)) } else { 10f64.powf(e) }),
        2 => (-8i32..8).prop_map(f64::from),
        1 => prop::sample::select(vec![0.0, -0.0, f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 5e-324, -5e-324,
            f64::MIN_POSITIVE, f64::MAX, f64::MIN, 1.0, -1.0, 709.78, 709.79, -745.1, -745.2, -708.5, 1048576.0, 1e22]),
    ]
}

/// Runs an operation on every level and as arrays: the same bits, and those agree with plain numbers.
fn check_f64(operation: Operation, a: [f64; 16], b: [f64; 16]) -> Result<(), TestCaseError> {
    let (a, b) = (F64x16::from_fn(|lane| a[lane]), F64x16::from_fn(|lane| b[lane]));
    let arrays = operation.apply(a, b);
    for level in Level::ALL.into_iter().filter(|level| level.is_available()) {
        let result = level.run(Apply(operation, a, b));
        for lane in 0..16 {
            let (x, y) = (result[lane], arrays[lane]);
            prop_assert!(
                x.to_bits() == y.to_bits() || (x.is_nan() && y.is_nan()),
                "{operation:?}({}, {}) on {level:?}: {x:?}, as arrays {y:?}",
                a[lane],
                b[lane]
            );
            let expected = operation.apply(a[lane], b[lane]);
            prop_assert!(
                close(x, expected, 1e-12),
                "{operation:?}({:e}, {:e}): {x:e}, plain {expected:e}",
                a[lane],
                b[lane]
            );
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(cases(400)))]

    #[test]
    fn every_operation_agrees_with_plain_numbers(
        a in prop::array::uniform16(number()), b in prop::array::uniform16(number()),
    ) {
        for operation in OPERATIONS {
            check_f64(operation, a, b)?;
        }
    }

    #[test]
    fn single_precision_agrees_to_its_precision(
        a in prop::array::uniform32(-50.0..50.0f32), b in prop::array::uniform32(-50.0..50.0f32),
    ) {
        let (la, lb) = (F32x32::from_fn(|lane| a[lane]), F32x32::from_fn(|lane| b[lane]));
        for operation in OPERATIONS {
            let arrays = operation.apply(la, lb);
            for level in Level::ALL.into_iter().filter(|level| level.is_available()) {
                let result = level.run(Apply(operation, la, lb));
                for lane in 0..32 {
                    let (x, y) = (result[lane], arrays[lane]);
                    prop_assert!(x.to_bits() == y.to_bits() || (x.is_nan() && y.is_nan()), "{operation:?}({}, {}) on {level:?}: {x:?}, {y:?}", a[lane], b[lane]);
                    let (a, b) = (f64::from(a[lane]), f64::from(b[lane]));
                    // What the rounding of the operands and of constants to single precision may change.
                    let expected = operation.apply(a, b);
                    let moved = operation.apply(a * (1.0 + 1e-7), b) - expected;
                    let tolerance = 4e-6 * expected.abs().max(1.0) + 4.0 * moved.abs();
                    prop_assert!(
                        (f64::from(x) - expected).abs() <= tolerance || (x.is_nan() && expected.is_nan())
                            || (f64::from(x)).is_infinite() && expected.abs() > 1e38,
                        "{operation:?}({a}, {b}): {x}, plain {expected}"
                    );
                }
            }
        }
    }

    #[test]
    fn lanes_do_not_mix(a in prop::array::uniform16(number()), lane in 0..16usize) {
        for operation in OPERATIONS {
            let alone = operation.apply(F64x16::splat(a[lane]), F64x16::splat(a[(lane + 1) % 16]));
            let together = operation.apply(F64x16::from_fn(|i| a[i]), F64x16::from_fn(|i| a[(i + 1) % 16]));
            prop_assert!(
                alone[0].to_bits() == together[lane].to_bits() || (alone[0].is_nan() && together[lane].is_nan()),
                "{operation:?}"
            );
        }
    }
}

/// Sines and cosines at the accuracy that their polynomials promise, far beyond what the other tests ask.
#[test]
fn sine_and_cosine_are_exact_to_1e_15_up_to_a_million() {
    for step in (0..200_000).step_by(if cfg!(miri) { 20_011 } else { 1 }) {
        let x = (f64::from(step) - 1e5) * 10.485 + 0.001 * f64::from(step % 977);
        let lanes = F64x16::splat(x);
        assert!((lanes.sin()[0] - x.sin()).abs() < 1e-15, "sin {x}");
        assert!((lanes.cos()[0] - x.cos()).abs() < 1e-15, "cos {x}");
    }
}

/// A program on registers.
struct Evaluate<'a, T>(&'a Program, &'a [T], &'a mut [T]);

impl<T: InMemory> Kernel for Evaluate<'_, T> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self) {
        let outputs = T::registers_mut::<S>(self.2);
        self.0.evaluate(T::registers::<S>(self.1), &mut Workspace::new(), outputs);
    }
}

fn on_every_level<F: Element, const N: usize>(
    program: &Program,
    inputs: &[Vec<f64>],
    check: impl Fn(usize, usize, f64, f64),
) where
    Lanes<F, N>: InMemory,
{
    let lanes: Vec<Lanes<F, N>> = (0..program.inputs().len())
        .map(|leaf| Lanes::from_fn(|lane| F::from_f64(inputs[lane % inputs.len()][leaf])))
        .collect();
    let expected: Vec<Vec<f64>> = inputs
        .iter()
        .map(|inputs| {
            let mut outputs = vec![0.0; program.outputs().len()];
            program.evaluate(inputs, &mut Workspace::new(), &mut outputs);
            outputs
        })
        .collect();
    let mut first: Option<Vec<Lanes<F, N>>> = None;
    for level in Level::ALL.into_iter().filter(|level| level.is_available()) {
        let mut outputs = vec![Lanes::splat(F::from_f64(0.0)); program.outputs().len()];
        level.run(Evaluate(program, &lanes, &mut outputs));
        for (leaf, output) in outputs.iter().enumerate() {
            for lane in 0..N {
                check(leaf, lane, output[lane].to_f64(), expected[lane % inputs.len()][leaf]);
            }
        }
        let first = first.get_or_insert_with(|| outputs.clone());
        for (output, first) in outputs.iter().zip(first) {
            for lane in 0..N {
                assert_eq!(output[lane].to_f64().to_bits(), first[lane].to_f64().to_bits(), "{level:?}");
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(cases(100)))]

    #[test]
    fn models_and_their_programs_run_on_lanes(
        values in prop::collection::vec(prop::collection::vec(-3.0..3.0f64, 9), 16),
    ) {
        // Inertia, load, two frictions, motor; angle, speed, current; voltage.
        let inputs: Vec<Vec<f64>> = values
            .into_iter()
            .map(|v| [&[0.5 + v[0].abs(), v[1], v[2].abs(), v[3].abs(), v[4]], &v[5..], &[0.01]].concat())
            .collect();
        let program = trace_model::<Arm>();
        on_every_level::<f64, 16>(&program, &inputs, |leaf, lane, x, y| assert!(close(x, y, 1e-12), "{leaf} {lane}: {x} {y}"));
        on_every_level::<f32, 32>(&program, &inputs, |leaf, lane, x, y| assert!(close(x, y, 1e-5), "{leaf} {lane}: {x} {y}"));

        let leaf = |index: usize| F64x16::from_fn(|lane| inputs[lane][index]);
        let all: Vec<F64x16> = (0..10).map(leaf).collect();
        let (state, _) = Arm::step(&ArmParams::read_from(&all[..5]), ArmState::read_from(&all[5..8]), all[8], all[9]);
        for (lane, inputs) in inputs.iter().enumerate() {
            let (expected, _) = Arm::step(
                &ArmParams::read_from(&inputs[..5]), ArmState::read_from(&inputs[5..8]), inputs[8], inputs[9],
            );
            prop_assert!(close(state.speed[lane], expected.speed, 1e-12));
            prop_assert!(close(state.current[lane], expected.current, 1e-12));
        }
    }

    #[test]
    fn random_programs_run_on_lanes(
        recipe in prop::collection::vec((0..OPERATIONS.len(), any::<prop::sample::Index>(), any::<prop::sample::Index>()), 1..40),
        values in prop::collection::vec(prop::collection::vec(-2.0..2.0f64, 3), 16),
    ) {
        // Whatever a step gives is led back to moderate numbers; steps at which numbers jump are left to the tests above.
        let smooth = |operation| !matches!(operation, Floor | Sign | Lt | Le | Operation::Eq | Gt | Ge | And | Or | Not | Tan | Div | Assign | Powf | Powi(-5..=-1) | Asin | Acos | Ln | Sqrt | Atan2);
        let names = ["x", "y", "z"].map(str::to_owned);
        let program = trace_fn("random", &names, &["out".to_owned(), "last".to_owned()], |inputs: &[Traced]| {
            let mut known = inputs.to_vec();
            for (operation, a, b) in &recipe {
                let operation = OPERATIONS[*operation];
                if smooth(operation) {
                    let next = operation.apply(known[a.index(known.len())], known[b.index(known.len())]);
                    known.push(next.tanh() + Traced::constant(0.25));
                }
            }
            let sum = known.iter().fold(Traced::constant(0.0), |sum, x| sum + *x);
            vec![sum, known[known.len() - 1]]
        });
        on_every_level::<f64, 16>(&program, &values, |leaf, lane, x, y| assert!(close(x, y, 1e-12), "{leaf} {lane}: {x} {y}\n{program}"));
    }
}
