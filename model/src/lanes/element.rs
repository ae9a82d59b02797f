//! What one lane holds: `f64` or `f32`.

use std::fmt::Debug;

use super::vector::Vector;

/// The number in a lane: `f64` or `f32`.
pub trait Element:
    Vector<Element = Self, Mask = bool> + Debug + PartialEq + Default + sealed::Constants
{
    /// The nearest number to a double.
    fn from_f64(value: f64) -> Self;
    /// The number as a double.
    fn to_f64(self) -> f64;
}

/// Bits and constants of a format, for [`super::functions`].
///
/// The polynomials minimise the largest error (Remez) over the range that is left after reduction.
pub(crate) mod sealed {
    /// See the module.
    pub trait Constants: Copy + 'static {
        /// Zero.
        const ZERO: Self;
        /// One.
        const ONE: Self;
        /// Adding this number rounds to a whole number, which its lowest bits then hold: 1.5 · 2^(mantissa bits).
        const ROUND: Self;
        /// The smallest normal number.
        const MIN_POSITIVE: Self;
        /// A power of two that makes every subnormal number normal, and its exponent.
        const RESCALE: [Self; 2];
        /// Infinity.
        const INFINITY: Self;
        /// Not a number.
        const NAN: Self;
        /// One half.
        const HALF: Self;
        /// Two.
        const TWO: Self;

        /// 1/π.
        const FRAC_1_PI: Self;
        /// π as a sum; products of the first part with the multiples within `CIRCLE_LIMIT` are exact.
        const PI: [Self; 2];
        /// π/2 likewise.
        const FRAC_PI_2: [Self; 2];
        /// The largest angle whose reduction is exact enough, rad.
        const CIRCLE_LIMIT: Self;
        /// S in sin x = x + x³ S(x²), |x| ≤ π/2.
        const SINE: &'static [Self];

        /// 1/ln 2.
        const LOG2_E: Self;
        /// ln 2 as a sum; products of the first part with exponents are exact.
        const LN_2: [Self; 2];
        /// Below the first, exp is zero; above the second, infinite.
        const EXP_LIMITS: [Self; 2];
        /// Q in exp x = 1 + x + x² Q(x), |x| ≤ ln 2 / 2.
        const EXP: &'static [Self];
        /// L in ln((1 + s)/(1 − s)) = 2 s + s³ L(s²), for arguments of ln between √½ and √2.
        const LOG: &'static [Self];
        /// From here on, tanh is one.
        const TANH_LIMIT: Self;
    }
}

macro_rules! element {
    ($float:ident, mantissa $mantissa:literal, $($constants:tt)*) => {
        impl Element for $float {
            #[inline(always)]
            fn from_f64(value: f64) -> Self {
                value as $float
            }
            #[inline(always)]
            fn to_f64(self) -> f64 {
                self.into()
            }
        }

        impl sealed::Constants for $float {
            const ZERO: Self = 0.0;
            const ONE: Self = 1.0;
            const ROUND: Self = 1.5 * (1u64 << $mantissa) as $float;
            const MIN_POSITIVE: Self = $float::MIN_POSITIVE;
            const INFINITY: Self = $float::INFINITY;
            const NAN: Self = $float::NAN;
            const HALF: Self = 0.5;
            const TWO: Self = 2.0;
            const FRAC_1_PI: Self = std::$float::consts::FRAC_1_PI;
            const LOG2_E: Self = std::$float::consts::LOG2_E;
            $($constants)*
        }
    };
}

element! { f64, mantissa 52,
    const RESCALE: [f64; 2] = [18_014_398_509_481_984.0, 54.0];
    const PI: [f64; 2] = [3.141_592_653_468_251_2, 1.215_420_101_301_238_4e-10];
    const FRAC_PI_2: [f64; 2] = [1.570_796_326_734_125_6, 6.077_100_506_506_192e-11];
    const CIRCLE_LIMIT: f64 = 1_048_576.0;
    const SINE: &'static [f64] = &[
        -0.166_666_666_666_661_86,
        0.008_333_333_333_285_512,
        -0.000_198_412_698_250_482_06,
        2.755_731_659_950_972_7e-6,
        -2.505_188_020_583_303_6e-8,
        1.604_809_323_093_687_7e-10,
        -7.373_317_470_983_476e-13,
    ];
    const LN_2: [f64; 2] = [0.693_147_180_369_123_8, 1.908_214_929_270_587_7e-10];
    const EXP_LIMITS: [f64; 2] = [-746.0, 710.0];
    const EXP: &'static [f64] = &[
        0.500_000_000_000_001_2,
        0.166_666_666_666_667,
        0.041_666_666_666_515_424,
        0.008_333_333_333_307_134,
        0.001_388_888_894_701_526,
        0.000_198_412_699_175_603_8,
        2.480_148_994_260_303_7e-5,
        2.755_721_612_855_479_3e-6,
        2.763_128_027_281_7e-7,
        2.511_791_840_682_651_4e-8,
    ];
    const LOG: &'static [f64] = &[
        0.666_666_666_666_673_4,
        0.399_999_999_994_139_9,
        0.285_714_287_425_587_13,
        0.222_221_985_540_373_03,
        0.181_835_653_980_669_12,
        0.153_140_212_773_810_65,
        0.147_962_601_810_539_6,
    ];
    const TANH_LIMIT: f64 = 20.0;
}

element! { f32, mantissa 23,
    const RESCALE: [f32; 2] = [33_554_432.0, 25.0];
    const PI: [f32; 2] = [3.140_625, 0.000_967_653_6];
    const FRAC_PI_2: [f32; 2] = [1.570_312_5, 0.000_483_826_8];
    const CIRCLE_LIMIT: f32 = 8_000.0;
    const SINE: &'static [f32] = &[-0.166_666_6, 0.008_333_066, -0.000_198_095_98, 2.605_767_1e-6];
    const LN_2: [f32; 2] = [0.693_359_4, -2.121_944_4e-4];
    const EXP_LIMITS: [f32; 2] = [-104.0, 89.0];
    const EXP: &'static [f32] = &[0.5, 0.166_665_18, 0.041_666_206, 0.008_368_889, 0.001_395_048_6];
    const LOG: &'static [f32] = &[0.666_667_76, 0.399_775_33, 0.298_719_97];
    const TANH_LIMIT: f32 = 10.0;
}
