//! Numbers as JSON, which knows no NaN and no infinities: these become texts. A `null`, which was written for them before, is read as NaN.

use serde::de::Error;
use serde::{Deserialize, Serialize};

#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum Number {
    Finite(f64),
    Other(String),
    Null(()),
}

impl From<f64> for Number {
    fn from(value: f64) -> Self {
        if value.is_finite() { Self::Finite(value) } else { Self::Other(value.to_string()) }
    }
}

impl Number {
    fn value<E: Error>(self) -> Result<f64, E> {
        match self {
            Self::Finite(value) => Ok(value),
            Self::Other(text) => text.parse().map_err(E::custom),
            Self::Null(()) => Ok(f64::NAN),
        }
    }
}

/// One number: `#[serde(with = "any_number::one")]`.
pub(crate) mod one {
    use super::Number;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub(crate) fn serialize<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        Number::from(*value).serialize(serializer)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        Number::deserialize(deserializer)?.value()
    }
}

/// A list of numbers.
pub(crate) mod list {
    use super::Number;
    use serde::{Deserialize, Deserializer, Serializer};

    pub(crate) fn serialize<S: Serializer>(values: &[f64], serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(values.iter().map(|value| Number::from(*value)))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<f64>, D::Error> {
        Vec::<Number>::deserialize(deserializer)?.into_iter().map(Number::value).collect()
    }
}

/// A list of numbers, each of something.
pub(crate) mod named {
    use super::Number;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub(crate) fn serialize<T: Serialize, S: Serializer>(
        values: &[(T, f64)],
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(values.iter().map(|(of, value)| (of, Number::from(*value))))
    }

    pub(crate) fn deserialize<'de, T: Deserialize<'de>, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Vec<(T, f64)>, D::Error> {
        let all = Vec::<(T, Number)>::deserialize(deserializer)?;
        all.into_iter().map(|(of, number)| Ok((of, number.value()?))).collect()
    }
}

#[cfg(test)]
mod tests {
    use serde::{Deserialize, Serialize};

    #[derive(Debug, Serialize, Deserialize)]
    struct All {
        #[serde(with = "super::one")]
        one: f64,
        #[serde(with = "super::list")]
        list: Vec<f64>,
        #[serde(with = "super::named")]
        named: Vec<(String, f64)>,
    }

    #[test]
    fn what_is_no_number_arrives_as_what_it_was() {
        let list = vec![0.1, f64::INFINITY, f64::NEG_INFINITY, f64::NAN];
        let all = All { one: f64::INFINITY, list: list.clone(), named: vec![("theta".into(), f64::NAN)] };
        let back: All = serde_json::from_str(&serde_json::to_string(&all).unwrap()).unwrap();
        assert_eq!(back.one, f64::INFINITY);
        assert!(back.list.iter().zip(&list).all(|(a, b)| a.to_bits() == b.to_bits()), "{:?}", back.list);
        assert!(back.named[0].1.is_nan() && back.named[0].0 == "theta");
        let old: All =
            serde_json::from_str(r#"{"one": null, "list": [null, 1], "named": [["a", null]]}"#).unwrap();
        assert!(old.one.is_nan() && old.list[0].is_nan() && old.list[1] == 1.0 && old.named[0].1.is_nan());
    }
}
