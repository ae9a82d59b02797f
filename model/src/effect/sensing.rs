//! Effects between an output's true value and its reading.

use crate::Scalar;

/// An error that grows in proportion to time since the recording's start.
pub(super) fn drift<T: Scalar>(rate: T, value: T, time: T) -> T {
    value + rate * time
}

#[cfg(test)]
mod tests {
    use crate::effect::Effect;

    #[test]
    fn readings_have_their_formulas() {
        assert_eq!(Effect::Bias.output(&[0.5], 2.0, 3.0), 2.5);
        assert_eq!(Effect::Scale.output(&[1.5], 2.0, 3.0), 3.0);
        assert_eq!(Effect::Drift.output(&[0.5], 2.0, 3.0), 3.5);
        assert_eq!(Effect::SensorSaturation.output(&[-1.0, 1.0], 2.0, 3.0), 1.0);
    }
}
