//! Dual numbers: exact derivatives against central differences, and no NaN where a derivative has no finite value.

use parallax_model::{Dual, Scalar};
use proptest::prelude::*;

/// Every elementary function, each kept inside its domain and away from its kinks.
fn functions<T: Scalar>(x: T, y: T) -> Vec<T> {
    let inside = x.sin() * 0.9;
    let positive = x * x + 0.1;
    vec![
        x + y,
        x - y,
        x * y,
        x / (y * y + 1.0),
        -x,
        x * 3.0 - 2.0 + y / 4.0,
        x.sin(),
        x.cos(),
        inside.tan(),
        inside.asin(),
        inside.acos(),
        y.atan(),
        x.atan2(positive),
        (x * 0.1).exp(),
        positive.ln(),
        positive.sqrt(),
        y.tanh(),
        positive.powf(y * 0.3),
        positive.powi(3),
        positive.powi(-2),
        x.powi(0),
        (x + 20.0).abs(),
        (x - 20.0).abs(),
        y * x.sign(),
        y * x.floor(),
        T::select(x.lt(y), x * x, y * x),
        x.min(y) * y,
        x.max(y) * x,
        x.clamp(y - 30.0, y + 30.0),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn derivatives_match_central_differences(x in -3.0..3.0f64, y in -3.0..3.0f64) {
        // A difference across a kink or a step is no derivative.
        prop_assume!((x - y).abs() > 1e-3 && x.abs() > 1e-3 && (x - x.round()).abs() > 1e-3);
        let duals = functions(Dual::<2>::variable(x, 0), Dual::variable(y, 1));
        let values = functions(x, y);
        let h = 1e-5;
        let along_x = functions(x + h, y).into_iter().zip(functions(x - h, y));
        let along_y = functions(x, y + h).into_iter().zip(functions(x, y - h));
        for (index, ((dual, value), (dx, dy))) in duals.iter().zip(&values).zip(along_x.zip(along_y)).enumerate() {
            prop_assert_eq!(dual.value, *value, "value of function {}", index);
            for (slope, (high, low)) in dual.gradient.iter().zip([dx, dy]) {
                let difference = (high - low) / (2.0 * h);
                prop_assert!(
                    (slope - difference).abs() <= 1e-6 * (1.0 + difference.abs()),
                    "function {} at ({}, {}): {} but differences say {}", index, x, y, slope, difference
                );
            }
        }
    }
}

#[test]
fn edges_of_domains_give_zero_not_nan() {
    let zero = Dual::<2>::variable(0.0, 0);
    let one = Dual::<2>::variable(1.0, 0);
    let half = Dual::<2>::from_value(0.5);
    let other = Dual::<2>::variable(0.0, 1);
    for (name, dual) in [
        ("sqrt", zero.sqrt()),
        ("sqrt of a square", (zero * zero + other * other).sqrt()),
        ("abs", zero.abs()),
        ("sign", zero.sign()),
        ("asin", one.asin()),
        ("acos", (-one).acos()),
        ("atan2", zero.atan2(other)),
        ("powf to a fraction", zero.powf(half)),
        ("powf to zero", zero.powf(other)),
        ("powi to zero", zero.powi(0)),
    ] {
        assert_eq!(dual.gradient, [0.0; 2], "{name}");
        assert!(dual.value.is_finite(), "{name}");
    }
    assert_eq!(zero.powf(Dual::from_value(1.0)).gradient, [1.0, 0.0]);
    assert_eq!(zero.powf(Dual::from_value(2.0)).gradient, [0.0, 0.0]);
    // A negative base has whole powers, and their slope does not touch the logarithm.
    assert_eq!((-one).powf(Dual::from_value(2.0)).gradient, [2.0, 0.0]);
    // The branch that is not taken may be undefined.
    let guarded = Scalar::select(Scalar::lt(zero, Dual::from_value(0.1)), zero * 2.0, one / zero);
    assert_eq!(guarded.gradient, [2.0, 0.0]);
}
