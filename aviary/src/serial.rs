//! Serde modules for types of other crates: vectors as three numbers, attitudes as `[w, x, y, z]`, and non-finite
//! numbers by name.
//!
//! The round trip is exact in formats that store doubles exactly.

use std::fmt::{self, Write as _};

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Serializes a `Vector3` as three numbers.
pub(crate) mod vector {
    use super::*;
    use nalgebra::Vector3;

    pub(crate) fn serialize<S: Serializer>(vector: &Vector3<f64>, serializer: S) -> Result<S::Ok, S::Error> {
        <[f64; 3]>::from(*vector).serialize(serializer)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vector3<f64>, D::Error> {
        Ok(<[f64; 3]>::deserialize(deserializer)?.into())
    }
}

/// Serializes an array of four `Vector3`.
pub(crate) mod vector_array {
    use super::*;
    use nalgebra::Vector3;

    pub(crate) fn serialize<S: Serializer>(vectors: &[Vector3<f64>; 4], serializer: S) -> Result<S::Ok, S::Error> {
        vectors.map(<[f64; 3]>::from).serialize(serializer)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[Vector3<f64>; 4], D::Error> {
        Ok(<[[f64; 3]; 4]>::deserialize(deserializer)?.map(Vector3::from))
    }
}

/// Serializes a list of `Vector3`.
pub(crate) mod vector_list {
    use super::*;
    use nalgebra::Vector3;

    pub(crate) fn serialize<S: Serializer>(vectors: &[Vector3<f64>], serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(vectors.iter().map(|vector| <[f64; 3]>::from(*vector)))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Vector3<f64>>, D::Error> {
        Ok(Vec::<[f64; 3]>::deserialize(deserializer)?.into_iter().map(Vector3::from).collect())
    }
}

/// Serializes a list of pairs of a `Vector3` and a number.
pub(crate) mod vectors_and_numbers {
    use super::*;
    use nalgebra::Vector3;

    pub(crate) fn serialize<S: Serializer>(pairs: &[(Vector3<f64>, f64)], serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(pairs.iter().map(|(vector, number)| (<[f64; 3]>::from(*vector), *number)))
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<Vec<(Vector3<f64>, f64)>, D::Error> {
        let pairs = Vec::<([f64; 3], f64)>::deserialize(deserializer)?;
        Ok(pairs.into_iter().map(|(vector, number)| (vector.into(), number)).collect())
    }
}

/// Serializes a `Matrix4` as four columns.
pub(crate) mod matrix {
    use super::*;
    use nalgebra::Matrix4;

    pub(crate) fn serialize<S: Serializer>(matrix: &Matrix4<f64>, serializer: S) -> Result<S::Ok, S::Error> {
        <[[f64; 4]; 4]>::from(*matrix).serialize(serializer)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Matrix4<f64>, D::Error> {
        Ok(<[[f64; 4]; 4]>::deserialize(deserializer)?.into())
    }
}

/// Serializes an attitude as a quaternion `[w, x, y, z]`, without normalization.
pub(crate) mod attitude {
    use super::*;
    use crate::state::{attitude_from_wxyz, wxyz};
    use nalgebra::UnitQuaternion;

    pub(crate) fn serialize<S: Serializer>(attitude: &UnitQuaternion<f64>, serializer: S) -> Result<S::Ok, S::Error> {
        wxyz(attitude).serialize(serializer)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<UnitQuaternion<f64>, D::Error> {
        Ok(attitude_from_wxyz(<[f64; 4]>::deserialize(deserializer)?))
    }
}

/// Serializes the content of an `Arc`. Every reference in a file has its own copy.
pub(crate) mod shared {
    use super::*;
    use std::borrow::ToOwned;
    use std::sync::Arc;

    pub(crate) fn serialize<T: Serialize + ?Sized, S: Serializer>(
        shared: &Arc<T>,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        shared.as_ref().serialize(serializer)
    }

    pub(crate) fn deserialize<'de, T, D>(deserializer: D) -> Result<Arc<T>, D::Error>
    where
        T: ToOwned + ?Sized,
        T::Owned: Deserialize<'de>,
        Arc<T>: From<T::Owned>,
        D: Deserializer<'de>,
    {
        Ok(T::Owned::deserialize(deserializer)?.into())
    }
}

/// A number that is serialized as `"inf"`, `"-inf"` or `"NaN"` if it is not finite, because JSON has no such numbers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Extended(pub f64);

#[derive(Serialize, Deserialize)]
#[serde(untagged)]
enum NumberOrName {
    Number(f64),
    Name(String),
}

impl Serialize for Extended {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let Self(x) = *self;
        let number = if x.is_finite() { NumberOrName::Number(x) } else { NumberOrName::Name(x.to_string()) };
        number.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Extended {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        match NumberOrName::deserialize(deserializer)? {
            NumberOrName::Number(x) => Ok(Self(x)),
            NumberOrName::Name(name) => name.parse().map(Self).map_err(serde::de::Error::custom),
        }
    }
}

/// Serializes an `f64` field as an [`Extended`] number.
pub(crate) mod extended {
    use super::*;

    pub(crate) fn serialize<S: Serializer>(x: &f64, serializer: S) -> Result<S::Ok, S::Error> {
        Extended(*x).serialize(serializer)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
        Ok(Extended::deserialize(deserializer)?.0)
    }
}

/// A hash of a configuration or of the content of a file (64-bit FNV-1a), serialized as 16 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Fingerprint(u64);

impl Fingerprint {
    /// Returns the hash of a text.
    pub(crate) fn of(text: impl fmt::Display) -> Self {
        let mut hash = Self(0xcbf2_9ce4_8422_2325);
        // writing to a hash cannot fail
        let _ = write!(hash, "{text}");
        hash
    }
}

impl fmt::Write for Fingerprint {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for byte in text.bytes() {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
        Ok(())
    }
}

impl fmt::Debug for Fingerprint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:016x}", self.0)
    }
}

impl Serialize for Fingerprint {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(&format_args!("{self:?}"))
    }
}

impl<'de> Deserialize<'de> for Fingerprint {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        u64::from_str_radix(&text, 16).map(Self).map_err(|_| {
            serde::de::Error::invalid_value(serde::de::Unexpected::Str(&text), &"up to 16 hexadecimal digits")
        })
    }
}
