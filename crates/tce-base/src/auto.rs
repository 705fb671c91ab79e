//! Settings that are a number, or `"auto"`: then the data tell.

use std::borrow::Cow;
use std::fmt;
use std::marker::PhantomData;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{Error, IntoDeserializer, Unexpected, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// The word.
const AUTO: &str = "auto";

/// A number, or `"auto"`: then the data tell.
///
/// ```
/// use tce_base::OrAuto;
///
/// assert_eq!(serde_json::from_str::<OrAuto<u64>>("500").unwrap(), OrAuto::Given(500));
/// assert_eq!(serde_json::from_str::<OrAuto<f64>>("\"auto\"").unwrap(), OrAuto::Auto);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OrAuto<T> {
    /// This number.
    Given(T),
    /// The data tell.
    Auto,
}

impl<T> OrAuto<T> {
    /// The number, if there is one.
    pub fn given(self) -> Option<T> {
        match self {
            Self::Given(number) => Some(number),
            Self::Auto => None,
        }
    }
}

impl<T: Default> Default for OrAuto<T> {
    fn default() -> Self {
        Self::Given(T::default())
    }
}

/// A kind of numbers that a setting may have.
pub trait Number: for<'de> Deserialize<'de> {
    /// What it is called in messages.
    const NAME: &'static str;
}

impl Number for u64 {
    const NAME: &'static str = "a whole number from 0 on";
}

impl Number for f64 {
    const NAME: &'static str = "a number";
}

impl<T: Serialize> Serialize for OrAuto<T> {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Given(number) => number.serialize(to),
            Self::Auto => to.serialize_str(AUTO),
        }
    }
}

impl<T: JsonSchema> JsonSchema for OrAuto<T> {
    fn schema_name() -> Cow<'static, str> {
        format!("{}_or_auto", T::schema_name()).into()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        json_schema!({ "anyOf": [generator.subschema_for::<T>(), { "const": AUTO }] })
    }
}

impl<'de, T: Number> Deserialize<'de> for OrAuto<T> {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        from.deserialize_any(NumberOrWord(PhantomData))
    }
}

struct NumberOrWord<T>(PhantomData<T>);

impl<T: Number> NumberOrWord<T> {
    fn number<'de, E: Error>(self, from: impl IntoDeserializer<'de, E>, found: Unexpected) -> Result<OrAuto<T>, E> {
        T::deserialize(from.into_deserializer()).map(OrAuto::Given).map_err(|_| E::invalid_value(found, &self))
    }
}

impl<T: Number> Visitor<'_> for NumberOrWord<T> {
    type Value = OrAuto<T>;

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}, or \"{AUTO}\"", T::NAME)
    }

    fn visit_f64<E: Error>(self, number: f64) -> Result<OrAuto<T>, E> {
        self.number(number, Unexpected::Float(number))
    }

    fn visit_u64<E: Error>(self, number: u64) -> Result<OrAuto<T>, E> {
        self.number(number, Unexpected::Unsigned(number))
    }

    fn visit_i64<E: Error>(self, number: i64) -> Result<OrAuto<T>, E> {
        self.number(number, Unexpected::Signed(number))
    }

    fn visit_str<E: Error>(self, word: &str) -> Result<OrAuto<T>, E> {
        match word {
            AUTO => Ok(OrAuto::Auto),
            _ => Err(E::invalid_value(Unexpected::Str(word), &self)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read<T: Number>(text: &str) -> Result<OrAuto<T>, String> {
        serde_json::from_str(text).map_err(|e| e.to_string())
    }

    #[test]
    fn numbers_and_the_word_are_read_and_written() {
        for (text, value) in [("0.25", OrAuto::Given(0.25)), ("0", OrAuto::Given(0.0)), ("\"auto\"", OrAuto::Auto)] {
            assert_eq!(read::<f64>(text), Ok(value));
            assert_eq!(read::<f64>(&serde_json::to_string(&value).unwrap()), Ok(value));
        }
        assert_eq!(read::<u64>("18446744073709551615"), Ok(OrAuto::Given(u64::MAX)));
        assert_eq!(serde_json::to_string(&OrAuto::Given(300u64)).unwrap(), "300");
        assert_eq!((OrAuto::Given(3).given(), OrAuto::<u64>::Auto.given()), (Some(3), None));
    }

    #[test]
    fn anything_else_is_refused_with_what_was_expected() {
        for text in ["-1", "0.5", "\"much\"", "true", "[1]"] {
            let message = read::<u64>(text).unwrap_err();
            assert!(message.contains("expected a whole number from 0 on, or \"auto\""), "{text}: {message}");
        }
        let message = read::<f64>("\"0.5\"").unwrap_err();
        assert!(message.contains("string \"0.5\", expected a number, or \"auto\""), "{message}");
    }
}
