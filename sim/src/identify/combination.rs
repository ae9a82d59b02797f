//! What the data determine where they do not determine every number: products, ratios and sums, in plain words.
//!
//! Directions in which nothing changes the predictions are found from the information matrix, positive numbers by their
//! logarithms: a product of powers is then a plain combination with whole exponents. Of all such combinations with small
//! exponents those are named that do not move along any of these directions, the simplest first.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::around::Around;
use super::coordinate::Sort;
use super::spread::Spread;

/// What is determined together, where the single numbers are not.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Combination {
    /// How it is written, such as `K/(J R)`.
    pub text: String,
    /// Its value at the estimate.
    pub value: f64,
    /// Its standard deviation.
    pub std: f64,
    /// Exponents of a product, or factors of a sum, by the names of the numbers.
    pub factors: Vec<(String, f64)>,
    /// Whether they are exponents.
    pub product: bool,
}

/// One number, as combinations see it.
pub(super) struct Member<'a> {
    pub(super) name: &'a str,
    pub(super) value: f64,
    pub(super) sort: Sort,
    /// How the number changes with the coordinate in which the information stands.
    pub(super) slope: f64,
}

/// A combination is determined where its standard deviation is below this: of the logarithm of a product, or in widths of
/// the bounds of delays.
const FIRM: f64 = 0.25;

/// A sum of delays is named where its standard deviation is below this share of what the single ones' would make it.
const BETTER: f64 = 0.25;

/// The combinations that are determined of numbers that are not, and which numbers those are.
pub(super) fn combinations(
    members: &[Member<'_>],
    spread: &Spread,
    around: &[Around],
) -> (Vec<usize>, Vec<Combination>) {
    let involved: Vec<usize> = (0..members.len()).filter(|&i| !spread.determines(i)).collect();
    let mut found: Vec<Combination> = Vec::new();
    for sort in [Sort::Parameter, Sort::Delay] {
        let is_product = sort == Sort::Parameter;
        let belongs = |m: &Member<'_>| m.sort == sort && (!is_product || m.value > 0.0);
        // Delays in a row are told apart by little more than how a simulation rounds: their sum is always named.
        let considered = (0..members.len()).filter(|i| sort == Sort::Delay || involved.contains(i));
        let group: Vec<usize> = considered.filter(|&i| belongs(&members[i])).collect();
        if !(2..=12).contains(&group.len()) {
            continue;
        }
        // In the numbers' own scale: the logarithm of what multiplies, the number itself of what adds.
        let widest = group.iter().map(|&i| members[i].slope.abs()).fold(f64::MIN_POSITIVE, f64::max);
        let scale = |i: usize| members[i].slope / if is_product { members[i].value } else { widest };
        let covariance = DMatrix::from_fn(group.len(), group.len(), |a, b| {
            spread.covariance[(group[a], group[b])] * scale(group[a]) * scale(group[b])
        });
        let firm = |variance: f64| variance.max(0.0).sqrt() < FIRM;
        let wanted = covariance.symmetric_eigenvalues().iter().filter(|value| firm(**value)).count();
        let mut basis: Vec<DVector<f64>> = Vec::new();
        let ways = ways(&group, if is_product { &[] } else { around });
        let others = candidates(group.len(), if is_product { 2 } else { 1 });
        for (is_way, exponents) in
            ways.into_iter().map(|way| (true, way)).chain(others.into_iter().map(|e| (false, e)))
        {
            if basis.len() == wanted {
                break;
            }
            let vector = DVector::from_iterator(group.len(), exponents.iter().map(|&e| f64::from(e)));
            let variance = (vector.transpose() * &covariance * &vector)[0];
            let alone: f64 = (0..group.len()).map(|k| vector[k] * vector[k] * covariance[(k, k)]).sum();
            let together = exponents.iter().filter(|e| **e != 0).count() > 1;
            let factor = |i| group.iter().position(|&own| own == i).map_or(0, |k| exponents[k]);
            let seen = is_product || around.iter().all(|around| around.shift(factor) == 0);
            let better = is_way || is_product || (together && variance.max(0.0) < BETTER * BETTER * alone);
            if !seen || !firm(variance / vector.norm_squared()) || !better {
                continue;
            }
            let mut rest = vector.clone();
            basis.iter().for_each(|b| rest -= b * b.dot(&vector));
            if rest.norm() < 1e-6 * vector.norm() {
                continue;
            }
            basis.push(rest.normalize());
            found.push(combination(members, &group, &exponents, spread));
        }
    }
    (involved, found)
}

/// The ways through nodes of whose own time nothing is seen, as factors of the delays of a group.
fn ways(group: &[usize], around: &[Around]) -> Vec<Vec<i32>> {
    let of = |way: [usize; 2]| group.iter().map(|own| i32::from(way.contains(own))).collect();
    around.iter().flat_map(Around::ways).map(of).collect()
}

fn combination(members: &[Member<'_>], group: &[usize], exponents: &[i32], spread: &Spread) -> Combination {
    let n = members.len();
    let is_product = members[group[0]].sort != Sort::Delay;
    let factors: Vec<(usize, i32)> =
        group.iter().copied().zip(exponents.iter().copied()).filter(|(_, e)| *e != 0).collect();
    let mut along = DVector::zeros(n);
    for &(i, e) in &factors {
        let m = &members[i];
        along[i] = f64::from(e) * if is_product { m.slope / m.value } else { m.slope };
    }
    let relative = (along.transpose() * &spread.covariance * &along)[0].max(0.0).sqrt();
    let value: f64 = if is_product {
        factors.iter().map(|&(i, e)| members[i].value.powi(e)).product()
    } else {
        factors.iter().map(|&(i, e)| f64::from(e) * members[i].value).sum()
    };
    let names: Vec<(&str, i32)> = factors.iter().map(|&(i, e)| (members[i].name, e)).collect();
    Combination {
        text: if is_product { ratio(&names) } else { sum(&names) },
        value,
        std: if is_product { relative * value.abs() } else { relative },
        factors: names.iter().map(|&(name, e)| (name.to_owned(), f64::from(e))).collect(),
        product: is_product,
    }
}

/// Small whole numbers for `count` places, the simplest first; the first that is not zero is positive unless fewer minus
/// signs come out so.
fn candidates(count: usize, largest: i32) -> Vec<Vec<i32>> {
    let mut found = Vec::new();
    for size in 1..=count.min(4) {
        let mut places: Vec<usize> = (0..size).collect();
        loop {
            let choices: Vec<i32> = (-largest..=largest).filter(|e| *e != 0).collect();
            for mut code in 0..choices.len().pow(size as u32) {
                let mut exponents = vec![0; count];
                for &place in &places {
                    exponents[place] = choices[code % choices.len()];
                    code /= choices.len();
                }
                let minus = exponents.iter().filter(|e| **e < 0).count();
                let plus = exponents.iter().filter(|e| **e > 0).count();
                let first = exponents.iter().find(|e| **e != 0).copied().unwrap_or(0);
                let whole = exponents.iter().any(|e| e.abs() == 1);
                if whole && (plus > minus || (plus == minus && first > 0)) {
                    found.push(exponents);
                }
            }
            if !next(&mut places, count) {
                break;
            }
        }
    }
    found.sort_by_key(|exponents| {
        let used = exponents.iter().filter(|e| **e != 0).count();
        (used, exponents.iter().map(|e| e.abs()).sum::<i32>())
    });
    found
}

/// The next choice of places, if there is one.
fn next(places: &mut [usize], count: usize) -> bool {
    let size = places.len();
    for k in (0..size).rev() {
        if places[k] < count - size + k {
            places[k] += 1;
            for later in k + 1..size {
                places[later] = places[later - 1] + 1;
            }
            return true;
        }
    }
    false
}

fn power(name: &str, exponent: i32) -> String {
    if exponent == 1 { name.to_owned() } else { format!("{name}^{exponent}") }
}

/// `a b/(c d)`
fn ratio(factors: &[(&str, i32)]) -> String {
    let above: Vec<String> =
        factors.iter().filter(|(_, e)| *e > 0).map(|(name, e)| power(name, *e)).collect();
    let below: Vec<String> =
        factors.iter().filter(|(_, e)| *e < 0).map(|(name, e)| power(name, -e)).collect();
    let above = if above.is_empty() { "1".into() } else { above.join(" ") };
    match below.len() {
        0 => above,
        1 => format!("{above}/{}", below[0]),
        _ => format!("{above}/({})", below.join(" ")),
    }
}

/// `a + b - c`
fn sum(factors: &[(&str, i32)]) -> String {
    let mut text = String::new();
    for (name, factor) in factors {
        let sign = if *factor < 0 { "-" } else { "+" };
        let size = if factor.abs() == 1 { String::new() } else { format!("{} ", factor.abs()) };
        text += &match (text.is_empty(), sign) {
            (true, "+") => format!("{size}{name}"),
            (true, _) => format!("-{size}{name}"),
            _ => format!(" {sign} {size}{name}"),
        };
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Information of residuals that depend on products of the numbers alone.
    fn information(rows: &[&[f64]]) -> DMatrix<f64> {
        let n = rows[0].len();
        let j = DMatrix::from_fn(rows.len(), n, |i, k| 1e3 * rows[i][k]);
        j.transpose() * j
    }

    #[test]
    fn of_four_constants_three_ratios_are_left() {
        // J, m, l, b: only m l/J and b/J matter, by their logarithms.
        let free = Spread::new(&information(&[&[-1.0, 1.0, 1.0, 0.0], &[-1.0, 0.0, 0.0, 1.0]]));
        let members: Vec<Member<'_>> = ["J", "m", "l", "b"]
            .into_iter()
            .map(|name| Member { name, value: 2.0, sort: Sort::Parameter, slope: 2.0 })
            .collect();
        let (involved, found) = combinations(&members, &free, &[]);
        assert_eq!(involved, [0, 1, 2, 3]);
        let texts: Vec<&str> = found.iter().map(|c| c.text.as_str()).collect();
        assert_eq!(texts.len(), 2, "{texts:?}");
        assert!(texts.contains(&"J/b"), "{texts:?}");
        assert!(texts.contains(&"m l/J"), "{texts:?}");
    }

    #[test]
    fn of_two_delays_the_sum_is_left() {
        let free = Spread::new(&information(&[&[1.0, 1.0, 0.0], &[0.0, 0.0, 1.0]]));
        let member = |name, sort| Member { name, value: 0.01, sort, slope: 0.05 };
        let members = [member("a", Sort::Delay), member("b", Sort::Delay), member("x", Sort::State)];
        let (involved, found) = combinations(&members, &free, &[]);
        assert_eq!(involved, [0, 1]);
        assert_eq!(found[0].text, "a + b");
        assert!((found[0].value - 0.02).abs() < 1e-12 && found[0].std < 1e-3);
    }

    #[test]
    fn of_delays_around_a_node_the_ways_through_it_are_left_whatever_the_information_says() {
        // Rounding tells each by itself, three times less well than the sums.
        let free = Spread::new(&information(&[&[1.0, 1.0, 0.0], &[1.0, 0.0, 1.0], &[0.4, -0.3, -0.3]]));
        let members =
            ["a", "b", "c"].map(|name| Member { name, value: 0.01, sort: Sort::Delay, slope: 0.05 });
        let texts = |around: &[Around]| -> Vec<String> {
            combinations(&members, &free, around).1.into_iter().map(|c| c.text).collect()
        };
        assert_eq!(texts(&[]), [""; 0]);
        assert_eq!(texts(&[Around { before: vec![0], behind: vec![1, 2] }]), ["a + b", "a + c"]);
    }
}
