//! Solvers on problems whose answers are known.

use nalgebra::{DMatrix, DVector};
use parallax_model::fit::separable::{Sums, eliminate};
use parallax_model::fit::{
    Ask, Bounds, CmaEs, CmaOptions, CrossEntropy, CrossEntropyOptions, FitError, Hybrid, HybridOptions,
    LevenbergMarquardt, Local, MarquardtOptions, Solver, Stop, Tell, minimise, minimise_with,
};
use parallax_model::{Dual, Scalar};
use proptest::prelude::*;

fn all(loss: impl Fn(&[f64]) -> f64) -> impl FnMut(&[Vec<f64>]) -> Vec<f64> {
    move |points| points.iter().map(|x| loss(x)).collect()
}

/// `(x − m)ᵀ A (x − m)` for a random rotation and axes from 1 to `condition`.
fn bowl(entries: &[f64], middle: &[f64], condition: f64) -> impl Fn(&[f64]) -> f64 {
    let n = middle.len();
    let basis = DMatrix::from_row_slice(n, n, entries).qr().q();
    let lengths = DVector::from_fn(n, |i, _| condition.powf(i as f64 / (n.max(2) - 1) as f64));
    let matrix = &basis * DMatrix::from_diagonal(&lengths) * basis.transpose();
    let middle = DVector::from_row_slice(middle);
    move |x: &[f64]| {
        let d = DVector::from_row_slice(x) - &middle;
        (d.transpose() * &matrix * &d)[0]
    }
}

/// Residuals by dual numbers.
fn local<const N: usize>(x: &[f64], residuals: impl Fn(&[Dual<N>]) -> Vec<Dual<N>>) -> Local {
    let duals: Vec<Dual<N>> = x.iter().enumerate().map(|(i, x)| Dual::variable(*x, i)).collect();
    let mut local = Local::zero(N);
    for r in residuals(&duals) {
        local.cost += r.value * r.value;
        for i in 0..N {
            local.gradient[i] += r.gradient[i] * r.value;
            for j in 0..N {
                local.information[i * N + j] += r.gradient[i] * r.gradient[j];
            }
        }
    }
    local
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn evolution_finds_the_bottom_of_any_rotated_bowl(
        entries in prop::collection::vec(-1.0..1.0f64, 16),
        middle in prop::collection::vec(-0.8..0.8f64, 4),
        seed in 0u64..1000,
    ) {
        let loss = bowl(&entries, &middle, 1e4);
        let bounds = Bounds::new(vec![-1.0; 4], vec![1.0; 4]).unwrap();
        let options = CmaOptions { seed, loss_tolerance: 1e-14, ..CmaOptions::default() };
        let best = minimise(&mut CmaEs::new(bounds, &[0.0; 4], options).unwrap(), all(loss)).unwrap();
        prop_assert!(best.loss < 1e-8, "{best:?}");
    }

    #[test]
    fn evolution_sees_the_order_of_losses_alone(
        middle in prop::collection::vec(-0.8..0.8f64, 3),
        seed in 0u64..1000,
    ) {
        let bounds = Bounds::unit(3);
        let options = CmaOptions { seed, generations: 30, loss_tolerance: 0.0, ..CmaOptions::default() };
        let square = |x: &[f64]| x.iter().zip(&middle).map(|(x, m)| (x - m).powi(2)).sum::<f64>();
        let mut plain = CmaEs::new(bounds.clone(), &[0.5; 3], options.clone()).unwrap();
        let mut bent = CmaEs::new(bounds, &[0.5; 3], options).unwrap();
        for _ in 0..30 {
            let (Ask::Losses { points, .. }, Ask::Losses { points: others, .. }) = (plain.ask(), bent.ask())
            else { break };
            prop_assert_eq!(&points, &others);
            plain.tell(Tell::Losses(points.iter().map(|x| square(x)).collect()));
            bent.tell(Tell::Losses(points.iter().map(|x| (1.0 + 100.0 * square(x)).ln()).collect()));
        }
    }

    #[test]
    fn bounds_hold_and_an_optimum_beyond_them_is_found_on_them(
        outside in prop::collection::vec(prop_oneof![-3.0..-0.2f64, 1.2..3.0f64], 3),
        seed in 0u64..1000,
    ) {
        let best_inside: Vec<f64> = outside.iter().map(|m| m.clamp(0.0, 1.0)).collect();
        let target = outside.clone();
        let square = move |x: &[f64]| {
            assert!(x.iter().all(|x| (0.0..=1.0).contains(x)), "{x:?}");
            x.iter().zip(&target).map(|(x, m)| (x - m).powi(2)).sum::<f64>()
        };
        let cma = CmaOptions { seed, ..CmaOptions::default() };
        let cross = CrossEntropyOptions { seed, population: Some(400), ..CrossEntropyOptions::default() };
        let from_cma = minimise(&mut CmaEs::new(Bounds::unit(3), &[0.5; 3], cma).unwrap(), all(&square));
        let from_cross =
            minimise(&mut CrossEntropy::new(Bounds::unit(3), &[0.5; 3], cross).unwrap(), all(&square));
        for (best, tolerance) in [(from_cma.unwrap(), 1e-4), (from_cross.unwrap(), 1e-2)] {
            for (x, y) in best.point.iter().zip(&best_inside) {
                prop_assert!((x - y).abs() < tolerance, "{:?} {:?}", best, best_inside);
            }
        }
        let start = LevenbergMarquardt::new(Bounds::unit(3), &[vec![0.5; 3]], MarquardtOptions::default());
        let best = minimise_with(
            &mut start.unwrap(),
            |points, _| points.iter().map(|x| square(x)).collect(),
            |points, _| {
                let residuals = |x: &[Dual<3>]| x.iter().zip(&outside).map(|(x, m)| *x - *m).collect();
                points.iter().map(|x| local::<3>(x, residuals)).collect()
            },
        ).unwrap();
        prop_assert_eq!(best.point, best_inside);
    }

    #[test]
    fn one_step_of_gauss_newton_solves_linear_least_squares(
        rows in prop::collection::vec((prop::collection::vec(-1.0..1.0f64, 3), -1.0..1.0f64), 6..20),
    ) {
        let matrix = DMatrix::from_fn(rows.len(), 3, |i, j| rows[i].0[j]);
        let right = DVector::from_fn(rows.len(), |i, _| rows[i].1);
        let svd = matrix.clone().svd(true, true);
        prop_assume!(svd.singular_values.min() > 0.2);
        let expected = svd.solve(&right, 1e-12).unwrap();
        let residuals = |x: &[Dual<3>]| -> Vec<Dual<3>> {
            rows.iter().map(|(a, y)| x[0] * a[0] + x[1] * a[1] + x[2] * a[2] - *y).collect()
        };
        let options = MarquardtOptions { gain: 1e-20, damping: 1e-10, ..MarquardtOptions::default() };
        let mut search = LevenbergMarquardt::new(Bounds::none(3), &[vec![0.0; 3]], options).unwrap();
        let best = minimise_with(
            &mut search,
            |points, _| points.iter().map(|x| local::<3>(x, residuals).cost).collect(),
            |points, _| points.iter().map(|x| local::<3>(x, residuals)).collect(),
        ).unwrap();
        for i in 0..3 {
            prop_assert!((best.point[i] - expected[i]).abs() < 1e-6, "{:?} {}", best, expected);
        }
        // The same by sums.
        let mut sums = Sums::new(3);
        rows.iter().for_each(|(a, y)| sums.add(a, *y));
        let (coefficients, left) = sums.solve(f64::EPSILON);
        prop_assert!((left - (&matrix * &expected - &right).norm_squared()).abs() < 1e-9);
        for i in 0..3 {
            prop_assert!((coefficients[i] - expected[i]).abs() < 1e-8);
        }
    }

    #[test]
    fn sums_in_single_precision_never_promise_what_is_not_there(
        width in 1e-3..1.5f64, middle in -3.0..3.0f64, noise in 0.001..0.01f64, seed in 0u32..1000,
    ) {
        // A dot on an image, by the angle of what carries it: over a small turn its three columns nearly depend on each other.
        let random = |k: u32| f64::from((k.wrapping_mul(2_654_435_761) ^ seed.wrapping_mul(40_503)) >> 8) / f64::from(1 << 24) - 0.5;
        let rows: Vec<([f64; 3], f64)> = (0..400).map(|k| {
            let angle = middle + width * (0.03 * f64::from(k)).sin();
            ([1.0, angle.sin(), angle.cos()], 3.0 + 2.0 * angle.sin() - angle.cos() + noise * random(k))
        }).collect();
        let (mut exact, mut single) = (Sums::new(3), ([0.0f32; 9], [0.0f32; 3]));
        for (row, y) in &rows {
            exact.add(row, *y);
            for i in 0..3 {
                for j in 0..3 {
                    single.0[3 * i + j] += row[i] as f32 * row[j] as f32;
                }
                single.1[i] += row[i] as f32 * *y as f32;
            }
        }
        let rough = Sums {
            gram: single.0.iter().copied().map(f64::from).collect(),
            right: single.1.iter().copied().map(f64::from).collect(),
            square: exact.square,
        };
        let left = exact.solve(f64::EPSILON).1;
        let (_, promised) = rough.solve(f64::from(f32::EPSILON));
        prop_assert!(promised > 0.5 * left, "{promised} of {left}");
    }

    #[test]
    fn eliminating_linear_parameters_leaves_the_slope_of_the_projected_loss(
        rate in 0.2..3.0f64, scale in 0.5..2.0f64, offset in -1.0..1.0f64, shift in -0.3..0.3f64,
    ) {
        let times: Vec<f64> = (0..40).map(|i| 0.05 * f64::from(i)).collect();
        let data: Vec<f64> =
            times.iter().map(|t| scale * (-rate * t).exp() + offset + 0.01 * (37.0 * t).sin()).collect();
        let projected = |rate: f64| {
            let mut sums = Sums::new(2);
            times.iter().zip(&data).for_each(|(t, y)| sums.add(&[(-rate * t).exp(), 1.0], *y));
            sums.solve(f64::EPSILON)
        };
        let at = rate + shift.max(0.1 - rate);
        let (c, loss) = projected(at);
        let whole = local::<3>(&[at, c[0], c[1]], |x| {
            times.iter().zip(&data)
                .map(|(t, y)| x[1] * Scalar::exp(x[0] * -*t) + x[2] - *y).collect()
        });
        let eliminated = eliminate(&whole, 2);
        prop_assert!((eliminated.cost - loss).abs() < 1e-9);
        let h = 1e-5;
        let slope = (projected(at + h).1 - projected(at - h).1) / (2.0 * h);
        prop_assert!((2.0 * eliminated.gradient[0] - slope).abs() < 1e-5 * (1.0 + slope.abs()),
            "{} {slope}", 2.0 * eliminated.gradient[0]);
        prop_assert!(eliminated.information[0] >= 0.0);
    }
}

#[test]
fn rosenbrocks_valley_in_ten_dimensions() {
    let loss = |x: &[f64]| {
        x.windows(2).map(|p| 100.0 * (p[1] - p[0] * p[0]).powi(2) + (1.0 - p[0]).powi(2)).sum::<f64>()
    };
    let bounds = Bounds::new(vec![-2.0; 10], vec![2.0; 10]).unwrap();
    let options = CmaOptions { target: Some(1e-9), restarts: 2, ..CmaOptions::default() };
    let mut solver = CmaEs::new(bounds.clone(), &[-0.5; 10], options).unwrap();
    let best = minimise(&mut solver, all(loss)).unwrap();
    assert!(best.loss <= 1e-9 && solver.ask() == Ask::Done(Stop::Target), "{best:?}");

    let residuals = |x: &[Dual<2>]| vec![(x[1] - x[0] * x[0]) * 10.0, -(x[0] - 1.0)];
    let bounds = Bounds::new(vec![-2.0; 2], vec![2.0; 2]).unwrap();
    let options = MarquardtOptions { gain: 1e-16, ..MarquardtOptions::default() };
    let mut solver = LevenbergMarquardt::new(bounds, &[vec![-1.2, 1.0], vec![1.5, -1.5]], options).unwrap();
    let best = minimise_with(
        &mut solver,
        |points, _| points.iter().map(|x| local::<2>(x, residuals).cost).collect(),
        |points, _| points.iter().map(|x| local::<2>(x, residuals)).collect(),
    );
    assert!(best.unwrap().loss < 1e-15);
}

#[test]
fn restarts_with_more_points_leave_local_minima() {
    // Rastrigin's function: one minimum of 1 for each of 11³ whole numbers, the least at 0.
    let loss =
        |x: &[f64]| x.iter().map(|x| x * x + 10.0 * (1.0 - (std::f64::consts::TAU * x).cos())).sum::<f64>();
    let bounds = Bounds::new(vec![-5.0; 3], vec![5.0; 3]).unwrap();
    let options = CmaOptions { restarts: 7, target: Some(1e-8), ..CmaOptions::default() };
    let mut solver = CmaEs::new(bounds, &[3.7, -2.2, 4.1], options).unwrap();
    assert!(minimise(&mut solver, all(loss)).unwrap().loss < 1e-8);
}

/// A sine of unknown frequency, phase and size over a long time: a minimum for every swing too many.
fn sine(share: f64) -> impl Fn(&[Dual<3>]) -> Vec<Dual<3>> {
    move |x: &[Dual<3>]| {
        let count = (400.0 * share) as usize;
        let sample = |i: usize| {
            let t = 0.05 * i as f64;
            x[2] * Scalar::sin(x[0] * t + x[1]) - 1.3 * (7.3 * t + 0.4).sin()
        };
        (0..count).map(sample).collect()
    }
}

#[test]
fn more_and_more_of_the_data_leads_past_local_minima() {
    let bounds = Bounds::new(vec![1.0, -3.0, 0.1], vec![15.0, 3.0, 3.0]).unwrap();
    let options = HybridOptions { target: Some(1e-6), gain: 1e-9, ..HybridOptions::default() };
    let mut solver = Hybrid::new(bounds.clone(), &[3.0, 0.0, 1.0], options).unwrap();
    let best = minimise_with(
        &mut solver,
        |points, share| points.iter().map(|x| local::<3>(x, sine(share)).cost).collect(),
        |points, share| points.iter().map(|x| local::<3>(x, sine(share))).collect(),
    )
    .unwrap();
    assert!((best.point[0] - 7.3).abs() < 1e-4 && best.loss < 1e-6, "{best:?}");
    assert_eq!(solver.ask(), Ask::Done(Stop::Target));
}

#[test]
fn a_fit_that_is_written_down_and_taken_up_again_ends_at_the_same_bits() {
    let bounds = Bounds::new(vec![1.0, -3.0, 0.1], vec![15.0, 3.0, 3.0]).unwrap();
    let mut solver = Hybrid::new(bounds, &[3.0, 0.0, 1.0], HybridOptions::default()).unwrap();
    let run = |solver: &mut Hybrid, questions: usize| {
        for _ in 0..questions {
            match solver.ask() {
                Ask::Losses { points, view, .. } => {
                    let losses = points.iter().map(|x| local::<3>(x, sine(view.share)).cost).collect();
                    solver.tell(Tell::Losses(losses));
                }
                Ask::Locals { points, view } => {
                    let locals = points.iter().map(|x| local::<3>(x, sine(view.share))).collect();
                    solver.tell(Tell::Locals(locals));
                }
                Ask::States { .. } => panic!("it is not cut"),
                Ask::Done(_) => break,
            }
        }
    };
    run(&mut solver, 28);
    let text = serde_json::to_string(&solver).unwrap();
    let mut again: Hybrid = serde_json::from_str(&text).unwrap();
    run(&mut solver, 10_000);
    run(&mut again, 10_000);
    assert!(matches!(solver.ask(), Ask::Done(_)));
    assert_eq!(solver, again);
}

#[test]
fn losses_that_are_no_numbers_are_the_worst() {
    let loss = |x: &[f64]| if x[0] < 0.5 { f64::NAN } else { (x[0] - 0.7).powi(2) };
    let options = CmaOptions { generations: 60, ..CmaOptions::default() };
    let mut solver = CmaEs::new(Bounds::unit(1), &[0.4], options).unwrap();
    assert!(minimise(&mut solver, all(loss)).unwrap().loss < 1e-6);
    let options = CmaOptions { generations: 20, ..CmaOptions::default() };
    let mut solver = CmaEs::new(Bounds::unit(1), &[0.4], options).unwrap();
    assert_eq!(minimise(&mut solver, all(|_| f64::NAN)), None);
    assert_eq!(solver.ask(), Ask::Done(Stop::Failed));
}

#[test]
fn impossible_options_are_named() {
    assert!(matches!(Bounds::new(vec![1.0], vec![0.0]), Err(FitError::Bounds { index: 0, .. })));
    let options = CmaOptions { population: Some(1), ..CmaOptions::default() };
    let error = CmaEs::new(Bounds::unit(2), &[0.5; 2], options).unwrap_err();
    assert!(error.to_string().contains("population"), "{error}");
    let error = CmaEs::new(Bounds::unit(2), &[0.5; 3], CmaOptions::default()).unwrap_err();
    assert_eq!(error, FitError::Count { what: "start values", found: 3, expected: 2 });
    let options = HybridOptions { shares: vec![0.5, 0.2, 1.0], ..HybridOptions::default() };
    assert!(Hybrid::new(Bounds::unit(2), &[0.5; 2], options).unwrap_err().to_string().contains("shares"));
}
