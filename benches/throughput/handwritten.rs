//! The limit: the pendulum written by hand for vectors, with nothing around it.
//!
//! Constants are joined beforehand, the sine is a polynomial, multiplications and additions are fused. Sixteen lanes of
//! double or thirty-two of single precision are two registers of AVX-512, so that each hides the other's latency. The
//! bits are not those of the models.

use std::f64::consts::FRAC_1_PI;

use parallax_nodes::models::pendulum::{GRAVITY, Params, STEP};

/// What the loop needs of a pendulum, for `N` of them: torques over the inertia.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub(crate) struct Block<F, const N: usize> {
    motor: [F; N],
    gravity: [F; N],
    drag: [F; N],
    friction: [F; N],
    /// Angle, rad.
    pub(crate) angle: [F; N],
    /// Speed, rad/s.
    pub(crate) speed: [F; N],
}

macro_rules! handwritten {
    ($run:ident, $avx512:ident, $avx2:ident, $body:ident, $float:ty, $bits:ty, $lanes:literal,
     round: $round:expr, pi: $pi:expr, sine: $sine:expr) => {
        impl Block<$float, $lanes> {
            /// Pendulums at rest, hanging.
            pub(crate) fn new(parameters: [Params<f64>; $lanes]) -> Self {
                let each = |f: &dyn Fn(&Params<f64>) -> f64| -> [$float; $lanes] {
                    std::array::from_fn(|lane| f(&parameters[lane]) as $float)
                };
                Self {
                    motor: each(&|p| p.motor / p.resistance / p.inertia),
                    gravity: each(&|p| p.mass * p.length * GRAVITY / p.inertia),
                    drag: each(&|p| (p.damping + p.motor * p.motor / p.resistance) / p.inertia),
                    friction: each(&|p| p.friction / p.inertia),
                    angle: [std::f64::consts::PI as $float; $lanes],
                    speed: [0.0; $lanes],
                }
            }
        }

        /// Steps a block by two steps of the integrator for each action, on the widest registers of this machine.
        pub(crate) fn $run(block: &mut Block<$float, $lanes>, actions: &[[$float; $lanes]]) {
            #[cfg(target_arch = "x86_64")]
            {
                if std::arch::is_x86_feature_detected!("avx512f")
                    && std::arch::is_x86_feature_detected!("avx512dq")
                    && std::arch::is_x86_feature_detected!("avx512vl")
                {
                    // SAFETY: the machine has these instructions.
                    return unsafe { $avx512(block, actions) };
                }
                if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                    // SAFETY: the machine has these instructions.
                    return unsafe { $avx2(block, actions) };
                }
            }
            $body(block, actions);
        }

        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx512f,avx512dq,avx512vl,avx2,fma")]
        fn $avx512(block: &mut Block<$float, $lanes>, actions: &[[$float; $lanes]]) {
            $body(block, actions);
        }

        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2,fma")]
        fn $avx2(block: &mut Block<$float, $lanes>, actions: &[[$float; $lanes]]) {
            $body(block, actions);
        }

        #[inline(always)]
        fn $body(block: &mut Block<$float, $lanes>, actions: &[[$float; $lanes]]) {
            const ROUND: $float = $round;
            const PI: [$float; 2] = $pi;
            const SINE: &[$float] = &$sine;
            const H: $float = STEP as $float;
            let Block { motor, gravity, drag, friction, mut angle, mut speed } = *block;
            for action in actions {
                let mut torque = [0.0; $lanes];
                for lane in 0..$lanes {
                    torque[lane] = action[lane] * motor[lane];
                }
                let slope = |a: &[$float; $lanes], s: &[$float; $lanes]| -> [$float; $lanes] {
                    let mut slopes = [0.0; $lanes];
                    for lane in 0..$lanes {
                        // The nearest multiple of pi; its parity is the sign.
                        let turns = a[lane].mul_add(FRAC_1_PI as $float, ROUND);
                        let n = turns - ROUND;
                        let x = n.mul_add(-PI[1], n.mul_add(-PI[0], a[lane]));
                        let x2 = x * x;
                        let mut polynomial = SINE[0];
                        for coefficient in &SINE[1..] {
                            polynomial = polynomial.mul_add(x2, *coefficient);
                        }
                        let sine = (polynomial * x2).mul_add(x, x);
                        let sine =
                            <$float>::from_bits(sine.to_bits() ^ (turns.to_bits() << (<$bits>::BITS - 1)));
                        let sign = friction[lane].copysign(s[lane]);
                        let rest = if s[lane] == 0.0 { torque[lane] } else { torque[lane] - sign };
                        slopes[lane] = gravity[lane].mul_add(sine, s[lane].mul_add(-drag[lane], rest));
                    }
                    slopes
                };
                let add = |x: &[$float; $lanes], d: &[$float; $lanes], h: $float| -> [$float; $lanes] {
                    let mut moved = [0.0; $lanes];
                    for lane in 0..$lanes {
                        moved[lane] = d[lane].mul_add(h, x[lane]);
                    }
                    moved
                };
                for _ in 0..2 {
                    let v1 = slope(&angle, &speed);
                    let s2 = add(&speed, &v1, H / 2.0);
                    let v2 = slope(&add(&angle, &speed, H / 2.0), &s2);
                    let s3 = add(&speed, &v2, H / 2.0);
                    let v3 = slope(&add(&angle, &s2, H / 2.0), &s3);
                    let s4 = add(&speed, &v3, H);
                    let v4 = slope(&add(&angle, &s3, H), &s4);
                    for lane in 0..$lanes {
                        let moved = (s2[lane] + s3[lane]).mul_add(2.0, speed[lane] + s4[lane]);
                        let pushed = (v2[lane] + v3[lane]).mul_add(2.0, v1[lane] + v4[lane]);
                        angle[lane] = moved.mul_add(H / 6.0, angle[lane]);
                        speed[lane] = pushed.mul_add(H / 6.0, speed[lane]);
                    }
                }
            }
            (block.angle, block.speed) = (angle, speed);
        }
    };
}

// Coefficients: sin x = x + x^3 P(x^2) on [-pi/2, pi/2], least maximum error, highest power first.
handwritten!(
    run_f64, avx512_f64, avx2_f64, body_f64, f64, u64, 16,
    round: 6755399441055744.0,
    pi: [std::f64::consts::PI, 1.2246467991473532e-16],
    sine: [
        -7.373317470983476e-13,
        1.6048093230936877e-10,
        -2.5051880205833036e-8,
        2.7557316599509727e-6,
        -1.9841269825048206e-4,
        8.333333333285512e-3,
        -1.6666666666666186e-1,
    ]
);
handwritten!(
    run_f32, avx512_f32, avx2_f32, body_f32, f32, u32, 32,
    round: 12582912.0,
    pi: [std::f32::consts::PI, -8.742278e-8],
    sine: [2.6057671e-6, -1.980_96e-4, 8.333066e-3, -1.666666e-1]
);
