//! The families of effects, as the documentation's table groups them.

/// Each family with its effects.
const FAMILIES: [(&str, &[&str]); 6] = [
    ("timing", &["delay", "jitter", "drops", "clock_skew"]),
    (
        "actuation",
        &["gain", "offset", "lag", "saturation", "deadband", "rate_limit", "backlash", "supply_sag"],
    ),
    (
        "friction",
        &[
            "viscous",
            "coulomb",
            "stribeck",
            "load_friction",
            "asymmetric_friction",
            "quadratic_drag",
            "cogging",
        ],
    ),
    (
        "body",
        &[
            "inertia",
            "payload",
            "gravity_tilt",
            "spring",
            "flexibility",
            "constant_force",
            "end_stop",
            "parameter",
        ],
    ),
    ("environment", &["wind", "periodic_disturbance"]),
    (
        "sensing",
        &[
            "bias",
            "scale",
            "noise",
            "quantization",
            "sensor_lag",
            "drift",
            "outliers",
            "sensor_saturation",
            "stuck",
        ],
    ),
];

/// The family of an effect; none for a name that the library does not have.
pub(crate) fn family(effect: &str) -> Option<&'static str> {
    FAMILIES.iter().find(|(_, effects)| effects.contains(&effect)).map(|(name, _)| *name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use parallax_model::effect::Effect;

    #[test]
    fn every_effect_of_the_library_is_in_one_family() {
        for effect in Effect::ALL {
            let homes = FAMILIES.iter().filter(|(_, effects)| effects.contains(&effect.name())).count();
            assert_eq!(homes, 1, "{}", effect.name());
        }
        assert_eq!(family("coulomb"), Some("friction"));
        assert_eq!(family("ghost"), None);
    }
}
