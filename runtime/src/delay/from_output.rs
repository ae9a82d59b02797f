//! The rule by which a step's output decides how long the step took.

use crate::time::{Nanos, from_seconds};

/// [`Delay::Output`](super::Delay::Output) with the place of its leaf: `offset + scale × leaf`, kept within bounds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DelayOfOutput {
    /// The leaf's place among those of the output.
    pub leaf: usize,
    /// Delay where the leaf is zero, s.
    pub offset: f64,
    /// Delay for each unit of the leaf, s.
    pub scale: f64,
    /// Shortest, s.
    pub min: f64,
    /// Longest, s; also the delay of a leaf that is not a number.
    pub max: f64,
}

impl DelayOfOutput {
    /// How long a step takes whose leaf has this value, ns. Everything that runs a graph asks here, so that all
    /// round alike.
    ///
    /// ```
    /// use parallax_runtime::delay::Delay;
    /// let delay: Delay = toml::from_str(
    ///     "distribution = 'output'\nleaf = 'objects'\noffset = 0.002\nscale = 0.001\nmin = 0.002\nmax = 0.01",
    /// ).unwrap();
    /// let rule = delay.of_output(&["image".into(), "objects".into()]).unwrap();
    /// assert_eq!(rule.leaf, 1);
    /// assert_eq!([0.0, 3.0, 1e9, f64::NAN].map(|objects| rule.nanos(objects)), [2_000_000, 5_000_000, 10_000_000, 10_000_000]);
    /// ```
    #[inline]
    pub fn nanos(&self, leaf: f64) -> Nanos {
        let seconds = self.offset + self.scale * leaf;
        from_seconds(if seconds.is_nan() { self.max } else { seconds.clamp(self.min, self.max) })
    }

    /// The shortest and the longest, ns.
    pub fn bounds(&self) -> (Nanos, Nanos) {
        (from_seconds(self.min), from_seconds(self.max))
    }
}
