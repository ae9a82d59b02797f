//! Expressions mean what mathematics means by them.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use parallax_model::system::{Expression, Point, System};
use proptest::prelude::*;

/// The value of an expression of x and y.
fn evaluate(text: &str, x: f64, y: f64) -> f64 {
    let text = format!(
        "format = 1\nname = \"s\"\n[inputs]\nx = {{}}\ny = {{}}\n[outputs]\nz = {{ value = \"{text}\" }}"
    );
    let equations = System::parse(&text, "s.toml").unwrap().equations().unwrap();
    equations.values(&Point { parameters: &[], states: &[], inputs: &[x, y], time: 7.0 }, &[]).outputs[0]
}

#[test]
fn operators_bind_as_usual() {
    for (text, expected) in [
        ("1 + 2*3", 7.0),
        ("(1 + 2)*3", 9.0),
        ("2 - 3 - 4", -5.0),
        ("16/4/2", 2.0),
        ("-x^2", -9.0),
        ("(-x)^2", 9.0),
        ("2^3^2", 512.0),
        ("2^-x", 0.125),
        ("2^-2^2", 0.0625),
        ("-2^2", -4.0),
        ("2*-x", -6.0),
        ("x - -y", 7.0),
        ("x--y", 7.0),
        ("+x", 3.0),
        ("1 + x < 2*y", 1.0),
        ("x^-2", 1.0 / 9.0),
        ("1.5e+1 + .5 + 2. + 1E-1", 17.6),
        ("pi", std::f64::consts::PI),
        ("time", 7.0),
    ] {
        assert_eq!(evaluate(text, 3.0, 4.0), expected, "{text}");
    }
}

#[test]
fn comparisons_are_one_or_zero_and_select() {
    for (text, expected) in [
        ("x < y", 1.0),
        ("x > y", 0.0),
        ("x <= 3", 1.0),
        ("x >= 3", 1.0),
        ("x == 3", 1.0),
        ("x == y", 0.0),
        ("10*(x < y) + (y < x)", 10.0),
        ("select(x < y, 1, 2)", 1.0),
        ("select(x - 3, 1, 2)", 2.0),
        ("select(y, 1, 2)", 1.0),
        ("select((x < y)*(y < 3), 1, 2)", 2.0),
        ("select(x > y, 1/0, 2)", 2.0),
    ] {
        assert_eq!(evaluate(text, 3.0, 4.0), expected, "{text}");
    }
}

#[test]
fn functions_are_those_of_mathematics() {
    let (x, y) = (0.3_f64, -0.7_f64);
    for (text, expected) in [
        ("sin(x)", x.sin()),
        ("cos(x)", x.cos()),
        ("tan(x)", x.tan()),
        ("asin(x)", x.asin()),
        ("acos(x)", x.acos()),
        ("atan(x)", x.atan()),
        ("atan2(y, x)", y.atan2(x)),
        ("exp(y)", y.exp()),
        ("log(x)", x.ln()),
        ("sqrt(x)", x.sqrt()),
        ("abs(y)", 0.7),
        ("sign(y)", -1.0),
        ("sign(x)", 1.0),
        ("sign(x - x)", 0.0),
        ("tanh(y)", y.tanh()),
        ("min(x, y)", y),
        ("max(x, y)", x),
        ("clamp(x, -1, 0.1)", 0.1),
        ("clamp(y, -0.5, 0.1)", -0.5),
        ("floor(y)", -1.0),
        ("x^0.5", x.powf(0.5)),
        ("x^y", x.powf(y)),
        ("y^3", y.powi(3)),
    ] {
        assert_eq!(evaluate(text, x, y), expected, "{text}");
    }
}

/// An expression as text, and what it must give.
#[derive(Clone, Debug)]
enum Tree {
    Number(f64),
    X,
    Y,
    Negate(Box<Tree>),
    Binary(char, Box<Tree>, Box<Tree>),
    Call(&'static str, Box<Tree>),
    Select(Box<Tree>, Box<Tree>, Box<Tree>),
}

impl Tree {
    /// As few parentheses as the grammar allows, so that its precedences are what is tested.
    fn text(&self) -> String {
        let within = |tree: &Tree, level: u8| {
            let text = tree.text();
            if tree.level() < level { format!("({text})") } else { text }
        };
        match self {
            Tree::Number(value) => format!("{value:?}"),
            Tree::X => "x".into(),
            Tree::Y => "y".into(),
            Tree::Negate(a) => format!("-{}", within(a, 3)),
            Tree::Binary('^', a, b) => format!("{}^{}", within(a, 5), within(b, 3)),
            Tree::Binary(symbol @ ('*' | '/'), a, b) => format!("{} {symbol} {}", within(a, 2), within(b, 3)),
            Tree::Binary(symbol @ ('+' | '-'), a, b) => format!("{}{symbol}{}", within(a, 1), within(b, 2)),
            Tree::Binary(symbol, a, b) => format!("{} {symbol} {}", within(a, 1), within(b, 1)),
            Tree::Call(name, a) => format!("{name}( {} )", a.text()),
            Tree::Select(a, b, c) => format!("select({},{} , {})", a.text(), b.text(), c.text()),
        }
    }

    /// How tightly the outermost operator binds.
    fn level(&self) -> u8 {
        match self {
            Tree::Number(_) | Tree::X | Tree::Y | Tree::Call(..) | Tree::Select(..) => 5,
            Tree::Binary('^', ..) => 4,
            Tree::Negate(_) => 3,
            Tree::Binary('*' | '/', ..) => 2,
            Tree::Binary('+' | '-', ..) => 1,
            Tree::Binary(..) => 0,
        }
    }

    fn value(&self, x: f64, y: f64) -> f64 {
        match self {
            Tree::Number(value) => *value,
            Tree::X => x,
            Tree::Y => y,
            Tree::Negate(a) => -a.value(x, y),
            Tree::Call("sin", a) => a.value(x, y).sin(),
            Tree::Call("tanh", a) => a.value(x, y).tanh(),
            Tree::Call(_, a) => a.value(x, y).abs(),
            Tree::Select(a, b, c) => {
                if a.value(x, y) != 0.0 {
                    b.value(x, y)
                } else {
                    c.value(x, y)
                }
            }
            Tree::Binary(symbol, a, b) => {
                let (a, b) = (a.value(x, y), b.value(x, y));
                match symbol {
                    '+' => a + b,
                    '-' => a - b,
                    '*' => a * b,
                    '/' => a / b,
                    '^' => a.powf(b),
                    _ => f64::from(a < b),
                }
            }
        }
    }
}

fn tree() -> impl Strategy<Value = Tree> {
    let leaf = prop_oneof![(0.0..100.0_f64).prop_map(Tree::Number), Just(Tree::X), Just(Tree::Y)];
    leaf.prop_recursive(5, 40, 3, |inner| {
        let boxed = || inner.clone().prop_map(Box::new);
        let symbols = prop_oneof![Just('+'), Just('-'), Just('*'), Just('/'), Just('^'), Just('<')];
        let functions = prop_oneof![Just("sin"), Just("tanh"), Just("abs")];
        prop_oneof![
            boxed().prop_map(Tree::Negate),
            (symbols, boxed(), boxed()).prop_map(|(symbol, a, b)| Tree::Binary(symbol, a, b)),
            (functions, boxed()).prop_map(|(name, a)| Tree::Call(name, a)),
            (boxed(), boxed(), boxed()).prop_map(|(a, b, c)| Tree::Select(a, b, c)),
        ]
    })
}

proptest! {
    #[test]
    fn what_is_written_is_what_is_computed(tree in tree(), x in -5.0..5.0_f64, y in -5.0..5.0_f64) {
        let (found, expected) = (evaluate(&tree.text(), x, y), tree.value(x, y));
        // A whole power may be rounded differently.
        let close = (found - expected).abs() <= 1e-9 * expected.abs();
        prop_assert!(found == expected || close || (found.is_nan() && expected.is_nan()), "{}: {found} {expected}", tree.text());
    }

    #[test]
    fn no_text_makes_the_reader_panic(text in ".{0,60}") {
        if let Err(error) = Expression::parse(&text, "f", 1, "it") {
            prop_assert!(!error.to_string().is_empty());
        }
    }

    #[test]
    fn no_soup_of_words_makes_the_reader_panic(
        words in prop::collection::vec(prop::sample::select(vec![
            "1", "x", "y", "sin", "select", "clamp", "(", ")", ",", "+", "-", "*", "/", "^", "<", "==", "2e", ".", " ", "é",
        ]), 0..30)
    ) {
        let _ = Expression::parse(&words.concat(), "f", 1, "it");
    }

    #[test]
    fn no_text_makes_the_file_reader_panic(text in "(format = 1\n)?[\\[\\]a-z=\"{} .0-9\n]{0,80}") {
        let _ = System::parse(&text, "f");
    }
}
