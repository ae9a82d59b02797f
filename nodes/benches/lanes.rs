//! The Runge–Kutta step of the pendulum on lanes against a loop written by hand for it: nanoseconds for each step and
//! environment, and how much of the hand-written loop's speed the model has.
//!
//! `cargo bench -p parallax-nodes --bench lanes`. Both use the same reduction and polynomial for the sine; the loop
//! by hand knows no angles beyond their range.

use std::hint::black_box;
use std::time::Instant;

use parallax_model::lanes::{Element, InMemory, Kernel, Lanes, Level, Simd};
use parallax_model::tree::Tree;
use parallax_model::{Model, Scalar};
use parallax_nodes::models::pendulum::{Input, Params, Pendulum, STEP, State};

/// The model, as it stands in the library.
struct Ours<T> {
    p: [T; 7],
    u: T,
    x: [T; 2],
    steps: usize,
}
impl<T: InMemory> Kernel for Ours<T> {
    type Output = [T; 2];
    #[inline(always)]
    fn run<S: Simd>(mut self) -> Self::Output {
        let p = Params::read_from(T::registers::<S>(&self.p));
        let u = Input { voltage: T::load::<S>(&self.u) };
        let mut x = State::read_from(T::registers::<S>(&self.x));
        let dt = T::On::<S>::constant(STEP);
        for _ in 0..self.steps {
            x = Pendulum::step(&p, x, u, dt).0;
        }
        x.write_to(T::registers_mut::<S>(&mut self.x));
        self.x
    }
}

/// The polynomial of the sine, as the library evaluates it.
macro_rules! polynomial {
    (f64, $c:ident, $y:ident) => {{
        let (y2, y4) = ($y * $y, ($y * $y) * ($y * $y));
        ($c[6] * y2 + ($c[5] * $y + $c[4])) * y4 + (($c[3] * $y + $c[2]) * y2 + ($c[1] * $y + $c[0]))
    }};
    (f32, $c:ident, $y:ident) => {{
        let y2 = $y * $y;
        ($c[3] * $y + $c[2]) * y2 + ($c[1] * $y + $c[0])
    }};
}
/// The same equations as one loop over lanes.
macro_rules! hand {
    ($name:ident, $f:tt, $bits:ty, $n:literal, $round:expr, $parts:expr, $coef:expr) => {
        #[derive(Clone)]
        struct $name {
            p: [[$f; $n]; 7],
            u: [$f; $n],
            x: [[$f; $n]; 2],
            steps: usize,
        }
        impl Kernel for $name {
            type Output = [[$f; $n]; 2];
            #[inline(always)]
            fn run<S: Simd>(self) -> Self::Output {
                let mut x = self.x;
                let h = STEP as $f;
                let [j, m, l, b, k, r, c] = &self.p;
                for _ in 0..self.steps {
                    for i in 0..$n {
                        let f = |a: $f, s: $f| -> ($f, $f) {
                            const ROUND: $f = $round;
                            let parts: [$f; 2] = $parts;
                            let t = a * (std::f64::consts::FRAC_1_PI as $f) + ROUND;
                            let n = t - ROUND;
                            let q = (a - n * parts[0]) - n * parts[1];
                            let y = q * q;
                            let w = $coef;
                            let z: $f = polynomial!($f, w, y);
                            let z = q + q * (y * z);
                            let sine = <$f>::from_bits(z.to_bits() ^ (t.to_bits() << (<$bits>::BITS - 1)));
                            let sign = if s > 0.0 {
                                1.0
                            } else if s < 0.0 {
                                -1.0
                            } else {
                                0.0
                            };
                            let gain = k[i] / r[i];
                            let a = self.u[i] * gain + m[i] * l[i] * 9.81 * sine
                                - s * (b[i] + k[i] * gain)
                                - c[i] * sign;
                            (s, a * (1.0 / j[i]))
                        };
                        let (a, s) = (x[0][i], x[1][i]);
                        let k1 = f(a, s);
                        let k2 = f(a + k1.0 * (h * 0.5), s + k1.1 * (h * 0.5));
                        let k3 = f(a + k2.0 * (h * 0.5), s + k2.1 * (h * 0.5));
                        let k4 = f(a + k3.0 * h, s + k3.1 * h);
                        x[0][i] = a + (k1.0 + k4.0 + (k2.0 + k3.0) * 2.0) * (h / 6.0);
                        x[1][i] = s + (k1.1 + k4.1 + (k2.1 + k3.1) * 2.0) * (h / 6.0);
                    }
                }
                x
            }
        }
    };
}
hand!(
    Hand64,
    f64,
    u64,
    16,
    6755399441055744.0,
    [3.1415926534682512, 1.2154201013012384e-10],
    [
        -0.16666666666666186,
        0.008333333333285512,
        -0.00019841269825048206,
        2.7557316599509727e-06,
        -2.5051880205833036e-08,
        1.6048093230936877e-10,
        -7.373317470983476e-13
    ]
);
hand!(
    Hand32,
    f32,
    u32,
    32,
    12582912.0,
    [3.140625, 0.0009676536],
    [-0.1666666, 0.008333066, -0.00019809598, 2.6057671e-06]
);

fn values(i: usize) -> ([f64; 7], f64, [f64; 2]) {
    let d: Params<f64> = Params::default();
    let s = 1.0 + 0.01 * i as f64;
    (
        [d.inertia * s, d.mass, d.length * s, d.damping, d.motor, d.resistance * s, d.friction],
        2.0 - 0.1 * i as f64,
        [0.1 * i as f64, 0.5],
    )
}
fn ours<F: Element, const N: usize>(steps: usize) -> Ours<Lanes<F, N>> {
    let lanes = |value: &dyn Fn(usize) -> f64| Lanes::from_fn(|i| F::from_f64(value(i)));
    Ours {
        p: std::array::from_fn(|k| lanes(&|i| values(i).0[k])),
        u: lanes(&|i| values(i).1),
        x: std::array::from_fn(|k| lanes(&|i| values(i).2[k])),
        steps,
    }
}
fn time<T>(lanes: usize, steps: usize, mut f: impl FnMut() -> T) -> f64 {
    let mut best = f64::MAX;
    for _ in 0..15 {
        let t = Instant::now();
        black_box(f());
        best = best.min(t.elapsed().as_secs_f64());
    }
    best * 1e9 / (lanes * steps) as f64
}
fn main() {
    let steps = 20_000;
    println!("level     lanes     by hand  model  ratio");
    for level in Level::ALL {
        if !level.is_available() {
            continue;
        }
        let h = Hand64 {
            p: std::array::from_fn(|k| std::array::from_fn(|i| values(i).0[k])),
            u: std::array::from_fn(|i| values(i).1),
            x: std::array::from_fn(|k| std::array::from_fn(|i| values(i).2[k])),
            steps,
        };
        let a = time(16, steps, || level.run(black_box(h.clone())));
        let b = time(16, steps, || level.run(black_box(ours::<f64, 16>(steps))));
        let h = Hand32 {
            p: std::array::from_fn(|k| std::array::from_fn(|i| values(i).0[k] as f32)),
            u: std::array::from_fn(|i| values(i).1 as f32),
            x: std::array::from_fn(|k| std::array::from_fn(|i| values(i).2[k] as f32)),
            steps,
        };
        let c = time(32, steps, || level.run(black_box(h.clone())));
        let d = time(32, steps, || level.run(black_box(ours::<f32, 32>(steps))));
        for (lanes, by_hand, model) in [("16 x f64", a, b), ("32 x f32", c, d)] {
            println!(
                "{:<8}  {lanes}  {by_hand:7.2}  {model:5.2}  {:5.2}",
                format!("{level:?}"),
                by_hand / model
            );
        }
    }
}
