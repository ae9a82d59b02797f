//! The registers of x86-64: SSE2 (every such machine), AVX2 and AVX-512.
//!
//! Their operations are the machine's instructions, so values of these types exist only inside a kernel that
//! [`Level::run`](super::Level::run) has dispatched: the types cannot be named elsewhere.

use std::arch::x86_64::*;
use std::mem::transmute;

use super::vector::Vector;
use super::{F32x32, F64x16, Kernel, Lanes, Simd, functions};
use crate::scalar::Inlined;

/// 128 bits, on every machine.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sse2;
/// 256 bits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Avx2;
/// 512 bits.
#[derive(Clone, Copy, Debug)]
pub(super) struct Avx512;

impl Simd for Sse2 {
    type F64x16 = Lanes<__m128d, 8>;
    type F32x32 = Lanes<__m128, 8>;
}
impl Simd for Avx2 {
    type F64x16 = Lanes<__m256d, 4>;
    type F32x32 = Lanes<__m256, 4>;
}
impl Simd for Avx512 {
    type F64x16 = Lanes<__m512d, 2>;
    type F32x32 = Lanes<__m512, 2>;
}

const _: () = {
    assert!(size_of::<Lanes<__m128d, 8>>() == size_of::<F64x16>());
    assert!(size_of::<Lanes<__m256d, 4>>() == size_of::<F64x16>());
    assert!(size_of::<Lanes<__m512d, 2>>() == size_of::<F64x16>());
    assert!(size_of::<Lanes<__m512, 2>>() == size_of::<F32x32>());
};

/// Runs `work` on SSE2.
///
/// # Safety
///
/// None: every x86-64 machine has it. Unsafe for the sake of its brothers.
#[inline(always)]
pub(super) unsafe fn compiled_sse2<W: Inlined>(work: W) -> W::Output {
    work.run()
}

/// Runs `work`, compiled for AVX2. Not for FMA, which rounds differently.
///
/// # Safety
///
/// The machine must have AVX2.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn compiled_avx2<W: Inlined>(work: W) -> W::Output {
    work.run()
}

/// Runs `work`, compiled for AVX-512.
///
/// # Safety
///
/// The machine must have these instructions.
#[target_feature(enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl")]
pub(super) unsafe fn compiled_avx512<W: Inlined>(work: W) -> W::Output {
    work.run()
}

/// Runs a kernel on AVX2.
///
/// # Safety
///
/// The machine must have AVX2.
#[target_feature(enable = "avx2")]
pub(super) unsafe fn run_avx2<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Avx2>()
}

/// Runs a kernel on AVX-512.
///
/// # Safety
///
/// The machine must have these instructions.
#[target_feature(enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl")]
pub(super) unsafe fn run_avx512<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Avx512>()
}

/// Implements [`Vector`] by intrinsics. SAFETY of every call: see the module.
macro_rules! register {
    (
        $vector:ident of $float:ident, $bits:ident, compiled $compiled:ident, mantissa $mantissa:literal, bias $bias:literal;
        splat $splat:ident, splat_bits $splat_bits:ident,
        add $add:ident, sub $sub:ident, mul $mul:ident, div $div:ident, sqrt $sqrt:ident,
        and $and:ident, andnot $andnot:ident, or $or:ident, xor $xor:ident,
        int_add $int_add:ident, int_sub $int_sub:ident, shl $shl:ident, shr $shr:ident, sign $sign:literal,
        to_int $to_int:ident, to_float $to_float:ident,
        floor $floor:ident, signum $signum:path,
        mask $mask:ty, lt $lt:ident, le $le:ident, eq $eq:ident,
        mask_and $mask_and:ident, mask_or $mask_or:ident, mask_not $mask_not:ident, all $all:ident, select $select:ident
    ) => {
        #[allow(clippy::undocumented_unsafe_blocks, reason = "said once, in the module's documentation")]
        impl Vector for $vector {
            type Element = $float;
            type Mask = $mask;

            #[inline(always)]
            fn splat(value: $float) -> Self {
                unsafe { $splat(value) }
            }
            #[inline(always)]
            fn add(self, other: Self) -> Self {
                unsafe { $add(self, other) }
            }
            #[inline(always)]
            fn sub(self, other: Self) -> Self {
                unsafe { $sub(self, other) }
            }
            #[inline(always)]
            fn mul(self, other: Self) -> Self {
                unsafe { $mul(self, other) }
            }
            #[inline(always)]
            fn div(self, other: Self) -> Self {
                unsafe { $div(self, other) }
            }
            #[inline(always)]
            fn neg(self) -> Self {
                unsafe { $xor(self, $splat(-0.0)) }
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                unsafe { $sqrt(self) }
            }
            #[inline(always)]
            fn abs(self) -> Self {
                unsafe { $andnot($splat(-0.0), self) }
            }
            #[inline(always)]
            fn floor(self) -> Self {
                unsafe { $floor(self) }
            }
            #[inline(always)]
            fn copysign(self, sign: Self) -> Self {
                unsafe { $or($andnot($splat(-0.0), self), $and($splat(-0.0), sign)) }
            }
            #[inline(always)]
            #[allow(unused_unsafe, reason = "some need none")]
            fn sign(self) -> Self {
                unsafe { $signum(self) }
            }
            #[inline(always)]
            fn lt(self, other: Self) -> $mask {
                unsafe { $lt(self, other) }
            }
            #[inline(always)]
            fn le(self, other: Self) -> $mask {
                unsafe { $le(self, other) }
            }
            #[inline(always)]
            fn eq(self, other: Self) -> $mask {
                unsafe { $eq(self, other) }
            }
            #[inline(always)]
            fn and(a: $mask, b: $mask) -> $mask {
                unsafe { $mask_and(a, b) }
            }
            #[inline(always)]
            fn or(a: $mask, b: $mask) -> $mask {
                unsafe { $mask_or(a, b) }
            }
            #[inline(always)]
            fn not(a: $mask) -> $mask {
                unsafe { $mask_not(a) }
            }
            #[inline(always)]
            fn all(mask: $mask) -> bool {
                unsafe { $all(mask) }
            }
            #[inline(always)]
            fn select(mask: $mask, then: Self, otherwise: Self) -> Self {
                unsafe { $select(mask, then, otherwise) }
            }
            #[inline(always)]
            fn each(self, function: impl FnMut($float) -> $float) -> Self {
                type Numbers = [$float; size_of::<$vector>() / size_of::<$float>()];
                unsafe { transmute::<Numbers, $vector>(transmute::<$vector, Numbers>(self).map(function)) }
            }
            #[inline(always)]
            fn each_pair(self, other: Self, function: impl Fn($float, $float) -> $float) -> Self {
                type Numbers = [$float; size_of::<$vector>() / size_of::<$float>()];
                let (a, b) =
                    unsafe { (transmute::<$vector, Numbers>(self), transmute::<$vector, Numbers>(other)) };
                let numbers: Numbers = std::array::from_fn(|lane| function(a[lane], b[lane]));
                unsafe { transmute::<Numbers, $vector>(numbers) }
            }
            #[inline(always)]
            fn compiled<W: Inlined>(work: W) -> W::Output {
                unsafe { $compiled(work) }
            }
            #[inline(always)]
            fn flip_if_odd(self, rounded: Self) -> Self {
                unsafe { $xor(self, $to_float($shl::<$sign>($to_int(rounded)))) }
            }
            #[inline(always)]
            fn two_to(rounded: Self) -> Self {
                unsafe { $to_float($shl::<$mantissa>($int_add($to_int(rounded), $splat_bits($bias)))) }
            }
            #[inline(always)]
            fn split(self) -> (Self, Self) {
                const LEAST: $bits = std::$float::consts::FRAC_1_SQRT_2.to_bits() as $bits;
                const ONE: $bits = (1.0 as $float).to_bits() as $bits;
                const HIGH: $float = ((1 as $bits) << $mantissa) as $float;
                unsafe {
                    let bits = $to_int(self);
                    let exponent = $shr::<$mantissa>($int_add(bits, $splat_bits(ONE.wrapping_sub(LEAST))));
                    let mantissa = $int_add($int_sub(bits, $shl::<$mantissa>(exponent)), $splat_bits(ONE));
                    let whole = $or($to_float(exponent), $splat(HIGH));
                    ($to_float(mantissa), $sub(whole, $splat(HIGH + $bias as $float)))
                }
            }
        }
    };
}

// How instruction sets differ: comparison, masks and rounding.
macro_rules! helpers {
    ($($name:ident($($argument:ident: $type:ty),*) -> $result:ty = $body:expr;)*) => {
        $(
            #[inline(always)]
            #[allow(clippy::undocumented_unsafe_blocks, reason = "said once, in the module's documentation")]
            unsafe fn $name($($argument: $type),*) -> $result {
                #[allow(unused_unsafe, reason = "some need none")]
                unsafe {
                    $body
                }
            }
        )*
    };
}

helpers! {
    not_pd(a: __m128d) -> __m128d = _mm_xor_pd(a, _mm_castsi128_pd(_mm_set1_epi64x(-1)));
    not_ps(a: __m128) -> __m128 = _mm_xor_ps(a, _mm_castsi128_ps(_mm_set1_epi32(-1)));
    all_pd(a: __m128d) -> bool = _mm_movemask_pd(a) == 0b11;
    all_ps(a: __m128) -> bool = _mm_movemask_ps(a) == 0b1111;
    select_pd(m: __m128d, a: __m128d, b: __m128d) -> __m128d = _mm_or_pd(_mm_and_pd(m, a), _mm_andnot_pd(m, b));
    select_ps(m: __m128, a: __m128, b: __m128) -> __m128 = _mm_or_ps(_mm_and_ps(m, a), _mm_andnot_ps(m, b));
    // SSE2 does not round: number by number.
    floor_pd(a: __m128d) -> __m128d =
        transmute::<[f64; 2], __m128d>(transmute::<__m128d, [f64; 2]>(a).map(f64::floor));
    floor_ps(a: __m128) -> __m128 =
        transmute::<[f32; 4], __m128>(transmute::<__m128, [f32; 4]>(a).map(f32::floor));

    lt_pd256(a: __m256d, b: __m256d) -> __m256d = _mm256_cmp_pd::<_CMP_LT_OQ>(a, b);
    le_pd256(a: __m256d, b: __m256d) -> __m256d = _mm256_cmp_pd::<_CMP_LE_OQ>(a, b);
    eq_pd256(a: __m256d, b: __m256d) -> __m256d = _mm256_cmp_pd::<_CMP_EQ_OQ>(a, b);
    lt_ps256(a: __m256, b: __m256) -> __m256 = _mm256_cmp_ps::<_CMP_LT_OQ>(a, b);
    le_ps256(a: __m256, b: __m256) -> __m256 = _mm256_cmp_ps::<_CMP_LE_OQ>(a, b);
    eq_ps256(a: __m256, b: __m256) -> __m256 = _mm256_cmp_ps::<_CMP_EQ_OQ>(a, b);
    not_pd256(a: __m256d) -> __m256d = _mm256_xor_pd(a, _mm256_castsi256_pd(_mm256_set1_epi64x(-1)));
    not_ps256(a: __m256) -> __m256 = _mm256_xor_ps(a, _mm256_castsi256_ps(_mm256_set1_epi32(-1)));
    all_pd256(a: __m256d) -> bool = _mm256_movemask_pd(a) == 0xF;
    all_ps256(a: __m256) -> bool = _mm256_movemask_ps(a) == 0xFF;
    select_pd256(m: __m256d, a: __m256d, b: __m256d) -> __m256d = _mm256_blendv_pd(b, a, m);
    select_ps256(m: __m256, a: __m256, b: __m256) -> __m256 = _mm256_blendv_ps(b, a, m);

    lt_pd512(a: __m512d, b: __m512d) -> u8 = _mm512_cmp_pd_mask::<_CMP_LT_OQ>(a, b);
    le_pd512(a: __m512d, b: __m512d) -> u8 = _mm512_cmp_pd_mask::<_CMP_LE_OQ>(a, b);
    eq_pd512(a: __m512d, b: __m512d) -> u8 = _mm512_cmp_pd_mask::<_CMP_EQ_OQ>(a, b);
    lt_ps512(a: __m512, b: __m512) -> u16 = _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b);
    le_ps512(a: __m512, b: __m512) -> u16 = _mm512_cmp_ps_mask::<_CMP_LE_OQ>(a, b);
    eq_ps512(a: __m512, b: __m512) -> u16 = _mm512_cmp_ps_mask::<_CMP_EQ_OQ>(a, b);
    and_8(a: u8, b: u8) -> u8 = a & b;
    or_8(a: u8, b: u8) -> u8 = a | b;
    not_8(a: u8) -> u8 = !a;
    all_8(a: u8) -> bool = a == u8::MAX;
    and_16(a: u16, b: u16) -> u16 = a & b;
    or_16(a: u16, b: u16) -> u16 = a | b;
    not_16(a: u16) -> u16 = !a;
    all_16(a: u16) -> bool = a == u16::MAX;
    select_pd512(m: u8, a: __m512d, b: __m512d) -> __m512d = _mm512_mask_blend_pd(m, b, a);
    select_ps512(m: u16, a: __m512, b: __m512) -> __m512 = _mm512_mask_blend_ps(m, b, a);
    floor_pd512(a: __m512d) -> __m512d = _mm512_roundscale_pd::<{ _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC }>(a);
    sign_pd512(a: __m512d) -> __m512d = _mm512_fixupimm_pd::<0>(a, a, _mm512_set1_epi64(SIGN as i64));
    sign_ps512(a: __m512) -> __m512 = _mm512_fixupimm_ps::<0>(a, a, _mm512_set1_epi32(SIGN as i32));
    floor_ps512(a: __m512) -> __m512 = _mm512_roundscale_ps::<{ _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC }>(a);
}

/// What `fixupimm` puts for a number of each class, four bits a class from the lowest: itself for the two kinds of what is
/// not a number, 0 for ±0, 1 for 1, −1 for −∞, 1 for ∞, −1 below and 1 above zero.
const SIGN: u32 = 0xA9A9_A811;

register! {
    __m128d of f64, i64, compiled compiled_sse2, mantissa 52, bias 1023;
    splat _mm_set1_pd, splat_bits _mm_set1_epi64x,
    add _mm_add_pd, sub _mm_sub_pd, mul _mm_mul_pd, div _mm_div_pd, sqrt _mm_sqrt_pd,
    and _mm_and_pd, andnot _mm_andnot_pd, or _mm_or_pd, xor _mm_xor_pd,
    int_add _mm_add_epi64, int_sub _mm_sub_epi64, shl _mm_slli_epi64, shr _mm_srli_epi64, sign 63,
    to_int _mm_castpd_si128, to_float _mm_castsi128_pd,
    floor floor_pd, signum functions::sign,
    mask __m128d, lt _mm_cmplt_pd, le _mm_cmple_pd, eq _mm_cmpeq_pd,
    mask_and _mm_and_pd, mask_or _mm_or_pd, mask_not not_pd, all all_pd, select select_pd
}

register! {
    __m128 of f32, i32, compiled compiled_sse2, mantissa 23, bias 127;
    splat _mm_set1_ps, splat_bits _mm_set1_epi32,
    add _mm_add_ps, sub _mm_sub_ps, mul _mm_mul_ps, div _mm_div_ps, sqrt _mm_sqrt_ps,
    and _mm_and_ps, andnot _mm_andnot_ps, or _mm_or_ps, xor _mm_xor_ps,
    int_add _mm_add_epi32, int_sub _mm_sub_epi32, shl _mm_slli_epi32, shr _mm_srli_epi32, sign 31,
    to_int _mm_castps_si128, to_float _mm_castsi128_ps,
    floor floor_ps, signum functions::sign,
    mask __m128, lt _mm_cmplt_ps, le _mm_cmple_ps, eq _mm_cmpeq_ps,
    mask_and _mm_and_ps, mask_or _mm_or_ps, mask_not not_ps, all all_ps, select select_ps
}

register! {
    __m256d of f64, i64, compiled compiled_avx2, mantissa 52, bias 1023;
    splat _mm256_set1_pd, splat_bits _mm256_set1_epi64x,
    add _mm256_add_pd, sub _mm256_sub_pd, mul _mm256_mul_pd, div _mm256_div_pd, sqrt _mm256_sqrt_pd,
    and _mm256_and_pd, andnot _mm256_andnot_pd, or _mm256_or_pd, xor _mm256_xor_pd,
    int_add _mm256_add_epi64, int_sub _mm256_sub_epi64, shl _mm256_slli_epi64, shr _mm256_srli_epi64, sign 63,
    to_int _mm256_castpd_si256, to_float _mm256_castsi256_pd,
    floor _mm256_floor_pd, signum functions::sign,
    mask __m256d, lt lt_pd256, le le_pd256, eq eq_pd256,
    mask_and _mm256_and_pd, mask_or _mm256_or_pd, mask_not not_pd256, all all_pd256, select select_pd256
}

register! {
    __m256 of f32, i32, compiled compiled_avx2, mantissa 23, bias 127;
    splat _mm256_set1_ps, splat_bits _mm256_set1_epi32,
    add _mm256_add_ps, sub _mm256_sub_ps, mul _mm256_mul_ps, div _mm256_div_ps, sqrt _mm256_sqrt_ps,
    and _mm256_and_ps, andnot _mm256_andnot_ps, or _mm256_or_ps, xor _mm256_xor_ps,
    int_add _mm256_add_epi32, int_sub _mm256_sub_epi32, shl _mm256_slli_epi32, shr _mm256_srli_epi32, sign 31,
    to_int _mm256_castps_si256, to_float _mm256_castsi256_ps,
    floor _mm256_floor_ps, signum functions::sign,
    mask __m256, lt lt_ps256, le le_ps256, eq eq_ps256,
    mask_and _mm256_and_ps, mask_or _mm256_or_ps, mask_not not_ps256, all all_ps256, select select_ps256
}

register! {
    __m512d of f64, i64, compiled compiled_avx512, mantissa 52, bias 1023;
    splat _mm512_set1_pd, splat_bits _mm512_set1_epi64,
    add _mm512_add_pd, sub _mm512_sub_pd, mul _mm512_mul_pd, div _mm512_div_pd, sqrt _mm512_sqrt_pd,
    and _mm512_and_pd, andnot _mm512_andnot_pd, or _mm512_or_pd, xor _mm512_xor_pd,
    int_add _mm512_add_epi64, int_sub _mm512_sub_epi64, shl _mm512_slli_epi64, shr _mm512_srli_epi64, sign 63,
    to_int _mm512_castpd_si512, to_float _mm512_castsi512_pd,
    floor floor_pd512, signum sign_pd512,
    mask u8, lt lt_pd512, le le_pd512, eq eq_pd512,
    mask_and and_8, mask_or or_8, mask_not not_8, all all_8, select select_pd512
}

register! {
    __m512 of f32, i32, compiled compiled_avx512, mantissa 23, bias 127;
    splat _mm512_set1_ps, splat_bits _mm512_set1_epi32,
    add _mm512_add_ps, sub _mm512_sub_ps, mul _mm512_mul_ps, div _mm512_div_ps, sqrt _mm512_sqrt_ps,
    and _mm512_and_ps, andnot _mm512_andnot_ps, or _mm512_or_ps, xor _mm512_xor_ps,
    int_add _mm512_add_epi32, int_sub _mm512_sub_epi32, shl _mm512_slli_epi32, shr _mm512_srli_epi32, sign 31,
    to_int _mm512_castps_si512, to_float _mm512_castsi512_ps,
    floor floor_ps512, signum sign_ps512,
    mask u16, lt lt_ps512, le le_ps512, eq eq_ps512,
    mask_and and_16, mask_or or_16, mask_not not_16, all all_16, select select_ps512
}
