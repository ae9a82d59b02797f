//! Programs: what a trace writes down, and that all readings of one source agree.

mod common;

use common::{Arm, ArmParams, ArmState};
use parallax_model::control::{call, map, repeat, scan};
use parallax_model::integrate::{rk4, rk4_steps};
use parallax_model::program::{Binary, Compare, Function, Op, ProgramError, Unary, Workspace};
use parallax_model::trace::{Traced, trace_fn, trace_model, trace_tree};
use parallax_model::{Dual, Model, Program, Scalar, Tree};
use proptest::prelude::*;

/// Runs a program on numbers.
fn run<T: Scalar>(program: &Program, inputs: &[T]) -> Vec<T> {
    let mut outputs = vec![T::constant(0.0); program.outputs().len()];
    program.evaluate(inputs, &mut Workspace::new(), &mut outputs);
    outputs
}

/// A step of the model on a flat list of all its numbers.
fn direct<T: Scalar>(inputs: &[T]) -> Vec<T> {
    let mut inputs = inputs.iter().copied();
    let params = ArmParams::read(&mut inputs);
    let state = ArmState::read(&mut inputs);
    let input = T::read(&mut inputs);
    let dt = T::read(&mut inputs);
    let (state, output) = Arm::step(&params, state, input, dt);
    [state.to_vec(), output.to_vec()].concat()
}

fn numbers() -> impl Strategy<Value = Vec<f64>> {
    (proptest::collection::vec(0.2..2.0f64, 5), proptest::collection::vec(-3.0..3.0f64, 4), 0.001..0.02f64)
        .prop_map(|(params, rest, dt)| [params, rest, vec![dt]].concat())
}

fn close(a: f64, b: f64, tolerance: f64) -> bool {
    (a - b).abs() <= tolerance * (1.0 + a.abs().max(b.abs()))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn a_program_computes_what_the_model_computes(inputs in numbers()) {
        let program = trace_model::<Arm>();
        prop_assert_eq!(run(&program, &inputs), direct(&inputs));
    }

    #[test]
    fn a_program_differentiates_as_the_model_does(inputs in numbers()) {
        let program = trace_model::<Arm>();
        let duals: Vec<Dual<10>> =
            inputs.iter().enumerate().map(|(index, value)| Dual::variable(*value, index)).collect();
        for (a, b) in run(&program, &duals).iter().zip(direct(&duals)) {
            prop_assert_eq!(a.value, b.value);
            for (a, b) in a.gradient.iter().zip(b.gradient) {
                prop_assert!(close(*a, b, 1e-12));
            }
        }
    }

    #[test]
    fn the_jacobian_matches_central_differences(inputs in numbers()) {
        // A difference across the Coulomb kink is no derivative.
        prop_assume!(inputs[6].abs() > 1.0);
        let program = trace_model::<Arm>();
        let wrt: Vec<usize> = (0..inputs.len()).collect();
        let jacobian = program.jacobian(&inputs, &wrt);
        for column in wrt {
            let at = |offset: f64| {
                let mut moved = inputs.clone();
                moved[column] += offset;
                run(&program, &moved)
            };
            for (row, (high, low)) in at(1e-5).into_iter().zip(at(-1e-5)).enumerate() {
                let difference = (high - low) / 2e-5;
                prop_assert!(
                    close(jacobian[(row, column)], difference, 1e-6),
                    "d{}/d{}: {} but differences say {}",
                    program.outputs()[row], program.inputs()[column], jacobian[(row, column)], difference
                );
            }
        }
    }

    #[test]
    fn loops_and_calls_compute_what_their_bodies_do(
        xs in proptest::array::uniform4(-2.0..2.0f64),
        scale in -2.0..2.0f64,
    ) {
        let program = trace_tree("loops", |(xs, scale): ([Traced; 4], Traced)| loops(xs, scale));
        let flat: Vec<f64> = xs.iter().copied().chain([scale]).collect();
        prop_assert_eq!(run(&program, &flat), loops(xs, scale).to_vec());
        let duals: Vec<Dual<5>> = flat.iter().enumerate().map(|(i, x)| Dual::variable(*x, i)).collect();
        let direct = loops(<[Dual<5>; 4]>::read_from(&duals[..4]), duals[4]);
        prop_assert_eq!(run(&program, &duals), direct.to_vec());
    }

    #[test]
    fn a_program_survives_json_bit_for_bit(constant in any::<f64>(), x in -3.0..3.0f64) {
        let program = trace_fn("f", &["x"], &["y"], |x| vec![(x[0] + constant) * 0.1]);
        let back = Program::from_json(&program.to_json()).unwrap();
        prop_assert_eq!(back.to_json(), program.to_json());
        prop_assert_eq!(run(&back, &[x])[0].to_bits(), run(&program, &[x])[0].to_bits());
    }
}

#[derive(Tree)]
struct Sums<T> {
    total: T,
    partial: [T; 4],
    mapped: [[T; 2]; 4],
    called: [T; 2],
    doubled: T,
}

/// Every structured operation, nested, with captured numbers, masks and constants.
fn loops<T: Scalar>(xs: [T; 4], scale: T) -> Sums<T> {
    let negative = scale.lt(T::constant(0.0));
    let offset = scale.sin() + 1.0;
    let (total, partial) = scan(T::constant(0.0), &xs, |sum, x| {
        // The inner loop captures from this body and from outside of it.
        let inner = repeat(3, *x, |y| y * scale * 0.5 + sum * offset);
        let sum = sum + T::select(negative, inner, -inner);
        (sum, sum * offset)
    });
    let mapped = map(&xs, |x| [*x * scale, T::select(negative & x.lt(scale), offset, T::constant(2.0))]);
    let cube = |x: T| call("cube", x, |x| x * x * x);
    let called = [cube(xs[0]), cube(scale)];
    // Steps that a trace must not confuse with those above.
    let doubled = repeat(5, scale, |x| x + x);
    Sums { total, partial, mapped, called, doubled }
}

#[test]
fn tracing_names_inputs_and_outputs_after_the_leaves() {
    let program = trace_model::<Arm>();
    assert_eq!(program.name(), "arm");
    assert_eq!(
        program.inputs(),
        [
            "params.inertia",
            "params.load",
            "params.friction.viscous",
            "params.friction.coulomb",
            "params.motor",
            "state.angle",
            "state.speed",
            "state.current",
            "input",
            "dt"
        ]
    );
    assert_eq!(program.outputs(), ["state.angle", "state.speed", "state.current", "output"]);
    assert_eq!(program.input("state.speed"), Some(6));
    assert_eq!(program.output("nothing"), None);
}

#[test]
fn a_loop_is_written_once() {
    let size = |steps: usize| {
        trace_fn("swing", &["x", "dt"], &["x"], |v| vec![rk4_steps(|x: &Traced| -x.sin(), v[0], v[1], steps)])
            .size()
    };
    assert_eq!(size(4), size(4000), "the number of steps does not change the size");
    let program = trace_model::<Arm>();
    assert!(program.size() < 150, "{} operations:\n{program}", program.size());
    let calls =
        program.functions().iter().flat_map(|f| &f.ops).filter(|op| matches!(op, Op::Call { .. })).count();
    let derivatives = program.functions().iter().filter(|f| f.name == "derivative").count();
    assert_eq!((calls, derivatives), (4, 1), "four calls of one derivative");
}

#[test]
fn a_program_evaluated_on_a_trace_becomes_part_of_it_and_keeps_its_loops() {
    let inner =
        trace_fn("inner", &["x", "dt"], &["x"], |v| vec![rk4_steps(|x: &Traced| -x.sin(), v[0], v[1], 1000)]);
    let outer = trace_fn("outer", &["x"], &["y"], |v| {
        vec![run(&inner, &[v[0] * 2.0, Traced::constant(0.5)])[0] + 1.0]
    });
    assert!(outer.size() < inner.size() + 10, "{outer}");
    let expected = run(&inner, &[0.6, 0.5])[0] + 1.0;
    assert_eq!(run(&outer, &[0.3]), [expected]);
}

#[test]
fn only_exact_identities_are_folded() {
    let size = |f: fn(Traced) -> Traced| trace_fn("f", &["x"], &["y"], |x| vec![f(x[0])]).size();
    assert_eq!(size(|x| x * 1.0), 0);
    assert_eq!(size(|x| x - 0.0), 0);
    assert_eq!(size(|x| x / 1.0), 0);
    assert_eq!(size(|x| -(-x)), 0);
    assert_eq!(size(|x| x + -0.0), 0);
    assert_eq!(size(|x| x.powi(1)), 0);
    assert_eq!(size(|x| Traced::select(x.lt(x + 1.0), x, x)), 0);
    // −0 + 0 is 0, and 0 · x is not 0 for an infinite x: these stay.
    assert_eq!(size(|x| x + 0.0), 2);
    assert_eq!(size(|x| x * 0.0), 2);
    assert_eq!(size(|x| x - x), 1);
    // Shared once, computed once, and dead code left out.
    assert_eq!(size(|x| x.sin() * x.sin()), 2);
    assert_eq!(size(|x| (x * 2.0) + (Traced::constant(2.0) * x)), 3);
    assert_eq!(
        size(|x| {
            let _ = x.exp();
            x.cos()
        }),
        1
    );
    assert_eq!(size(|x| x * (Traced::constant(3.0).sqrt() + 2.0)), 2);
    let zero = trace_fn("f", &["x"], &["y"], |x| vec![x[0] + 0.0]);
    assert!(run(&zero, &[-0.0])[0].is_sign_positive());
}

#[test]
fn select_and_sqrt_give_no_nan_in_gradients() {
    let guarded = trace_fn("guarded", &["x", "y"], &["length", "ratio"], |v| {
        let length = (v[0] * v[0] + v[1] * v[1]).sqrt();
        let small = length.lt(Traced::constant(1e-9));
        vec![length, Traced::select(small, Traced::constant(0.0), v[0] / length)]
    });
    let jacobian = guarded.jacobian(&[0.0, 0.0], &[0, 1]);
    assert!(jacobian.iter().all(|slope| *slope == 0.0), "{jacobian}");
}

#[test]
fn jacobians_of_many_inputs_are_put_together_from_chunks() {
    let names: Vec<String> = (0..19).map(|index| format!("x{index}")).collect();
    let program = trace_fn("sum", &names, &["y"], |x| {
        vec![x.iter().enumerate().fold(Traced::constant(0.0), |sum, (index, x)| sum + *x * *x * index as f64)]
    });
    let inputs: Vec<f64> = (0..19).map(|index| 0.1 * index as f64).collect();
    let wrt: Vec<usize> = (0..19).rev().collect();
    let jacobian = program.jacobian(&inputs, &wrt);
    for (column, input) in wrt.iter().enumerate() {
        assert!(close(jacobian[(0, column)], 2.0 * inputs[*input] * *input as f64, 1e-14));
    }
}

#[test]
fn a_printed_program_can_be_read() {
    let program = trace_fn("limit", &["x"], &["y"], |x| {
        let doubled = repeat(3, x[0], |x| x * 2.0);
        vec![Traced::select(doubled.lt(x[0]), Traced::constant(-1.0), doubled.sin())]
    });
    assert_eq!(
        program.to_string(),
        "fn scan_body#0(a0) {\n  v2 = a0 * 2.0\n  return v2\n}\n\n\
         program limit(x) {\n  v1 = scan scan_body#0 x 3 (carry x)\n  v2 = v1 < x\n  \
         v3 = sin(v1)\n  v5 = if v2 then (-1.0) else v3\n  return y = v5\n}"
    );
}

#[test]
fn a_wrong_program_is_refused() {
    let function = |ops, outputs| Function { name: "f".into(), inputs: 1, ops, outputs };
    let refuse = |functions: Vec<Function>| {
        Program::new(vec!["x".into()], vec!["y".into()], functions).expect_err("it is wrong")
    };
    assert_eq!(refuse(vec![]), ProgramError::Empty);
    assert!(matches!(
        refuse(vec![function(vec![Op::Unary(Unary::Sin, 1)], vec![1])]),
        ProgramError::Undefined { value: 1, .. }
    ));
    assert!(matches!(refuse(vec![function(vec![], vec![7])]), ProgramError::Undefined { value: 7, .. }));
    let compared = vec![Op::Compare(Compare::Lt, 0, 0), Op::Binary(Binary::Add, 0, 1)];
    assert!(matches!(
        refuse(vec![function(compared, vec![2])]),
        ProgramError::Kind { expected: "number", .. }
    ));
    assert!(matches!(
        refuse(vec![function(vec![Op::Select(0, 0, 0)], vec![1])]),
        ProgramError::Kind { expected: "mask", .. }
    ));
    let call = |function, inputs| Op::Call { function, inputs };
    assert!(matches!(
        refuse(vec![function(vec![call(0, vec![0])], vec![1])]),
        ProgramError::Callee { callee: 0, .. }
    ));
    let identity = function(vec![], vec![0]);
    assert!(matches!(
        refuse(vec![identity.clone(), function(vec![call(0, vec![0, 0])], vec![1])]),
        ProgramError::Arity { .. }
    ));
    let uneven = Op::Map { function: 0, length: 2, xs: vec![0, 0, 0], captures: vec![] };
    assert!(matches!(
        refuse(vec![identity.clone(), function(vec![uneven], vec![1])]),
        ProgramError::Arity { .. }
    ));
    let huge = Op::Map { function: 0, length: u32::MAX, xs: vec![], captures: vec![0] };
    assert!(matches!(
        refuse(vec![identity.clone(), function(vec![huge], vec![1])]),
        ProgramError::TooLarge { .. }
    ));
    let deep = std::iter::once(identity)
        .chain((0..1000).map(|index| function(vec![call(index, vec![0])], vec![1])))
        .collect();
    assert!(matches!(refuse(deep), ProgramError::TooLarge { .. }));
    assert!(matches!(
        Program::new(
            vec!["x".into(), "x".into()],
            vec![],
            vec![Function { name: "f".into(), inputs: 2, ops: vec![], outputs: vec![] }]
        ),
        Err(ProgramError::Duplicate { .. })
    ));
    assert!(matches!(Program::from_json("{}"), Err(ProgramError::Json { .. })));
    let text =
        trace_fn("f", &["x"], &["y"], |x| vec![x[0].sin()]).to_json().replace("\"sin\",0", "\"sin\",9");
    let error = Program::from_json(&text).expect_err("value 9 is not defined").to_string();
    assert!(error.contains("value 9 is not defined"), "{error}");
}

#[test]
fn infinite_constants_survive_json() {
    let program = trace_fn("limits", &["x"], &["low", "high", "none"], |_| {
        [f64::NEG_INFINITY, f64::INFINITY, f64::NAN].map(Traced::constant).to_vec()
    });
    let back = run(&Program::from_json(&program.to_json()).unwrap(), &[0.0]);
    assert_eq!(back[..2], [f64::NEG_INFINITY, f64::INFINITY]);
    assert!(back[2].is_nan());
}

#[test]
#[should_panic(expected = "used outside the function")]
fn a_value_that_leaves_its_loop_is_noticed() {
    trace_fn("leak", &["x"], &["y"], |x| {
        let mut leaked = x[0];
        repeat(3, x[0], |x| {
            leaked = x * 2.0;
            x
        });
        vec![leaked]
    });
}

#[test]
fn a_trace_that_panicked_does_not_spoil_the_next() {
    let caught = std::panic::catch_unwind(|| {
        trace_fn("broken", &["x"], &["y"], |x| vec![repeat(2, x[0], |_| panic!("the model's own"))])
    });
    assert!(caught.is_err());
    assert_eq!(run(&trace_fn("f", &["x"], &["y"], |x| vec![x[0] * 3.0]), &[2.0]), [6.0]);
}

#[test]
fn traces_nest() {
    let outer = trace_fn("outer", &["x"], &["y"], |x| {
        let half = x[0] * 0.5;
        let inner = trace_fn("inner", &["x"], &["y"], |x| vec![x[0] + 1.0]);
        vec![run(&inner, &[half])[0] * half]
    });
    assert_eq!(run(&outer, &[4.0]), [6.0]);
}

#[test]
fn rk4_is_of_fourth_order() {
    let error = |steps: usize| {
        let end = rk4_steps(|x: &[f64; 2]| [x[1], -x[0]], [1.0, 0.0], 1.0, steps);
        (end[0] - 1f64.cos()).abs()
    };
    let order = (error(10) / error(20)).log2();
    assert!((order - 4.0).abs() < 0.1, "halving the step divides the error by 2^{order}");
    let x = rk4(|x: &f64| *x, 1.0, 0.5);
    let series: f64 =
        [1.0, 0.5, 0.5f64.powi(2) / 2.0, 0.5f64.powi(3) / 6.0, 0.5f64.powi(4) / 24.0].iter().sum();
    assert!(close(x, series, 1e-15), "one step is the exponential's series to fourth order");
}
