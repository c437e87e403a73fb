//! Enums with named values for files, the command line and messages.

use std::fmt::Display;
use std::str::FromStr;

/// An enum whose values have names in lower snake case. `Display` and serde write the names, `FromStr` and serde read
/// them.
///
/// ```
/// use aviary::physics::Physics;
/// use aviary::{NamedEnum, UnknownName};
///
/// fn names<T: NamedEnum>() -> String {
///     format!("{}: {}", T::NOUN, T::NAMES.join(", "))
/// }
/// assert_eq!(names::<Physics>(), "physics mode: mjc, mjc_gnd, mjc_drag, mjc_dw, mjc_gnd_drag_dw, dyn");
/// let error = "mjc_ground".parse::<Physics>().unwrap_err();
/// assert!(error.to_string().ends_with("; did you mean `mjc_gnd`?"));
/// ```
pub trait NamedEnum: Copy + Display + FromStr<Err = UnknownName> + 'static {
    /// Noun for a value in messages, for example `physics mode`.
    const NOUN: &'static str;
    /// Names of all values, in the order of declaration.
    const NAMES: &'static [&'static str];
}

/// Error for an unknown name of a [`NamedEnum`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no {noun} `{name}`, expected {}{}", alternatives(names), crate::did_you_mean(name, names))]
pub struct UnknownName {
    /// Noun for a value in messages.
    pub noun: &'static str,
    /// Unknown name.
    pub name: String,
    /// Valid names.
    pub names: &'static [&'static str],
}

/// Joins names as `a, b or c`.
fn alternatives(names: &[&str]) -> String {
    match names {
        [rest @ .., last] if !rest.is_empty() => format!("{} or {last}", rest.join(", ")),
        _ => names.concat(),
    }
}

/// Defines an enum with a name for each value, and implements `ALL`, `name`, `Display`, `FromStr` with
/// [`UnknownName`], serde and [`NamedEnum`]. The first argument is the noun for error messages.
macro_rules! named_enum {
    (
        $noun:literal
        $(#[$attribute:meta])*
        pub enum $type:ident {
            $($(#[$of_value:meta])* $value:ident = $name:literal,)+
        }
    ) => {
        $(#[$attribute])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
        pub enum $type {
            $($(#[$of_value])* #[serde(rename = $name)] $value,)+
        }

        impl $type {
            /// All values, in the order of declaration.
            pub const ALL: [Self; [$($name),+].len()] = [$(Self::$value),+];

            /// Returns the name in lower snake case.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$value => $name,)+
                }
            }
        }

        impl $crate::NamedEnum for $type {
            const NOUN: &'static str = $noun;
            const NAMES: &'static [&'static str] = &[$($name),+];
        }

        impl std::fmt::Display for $type {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.pad(self.name())
            }
        }

        impl std::str::FromStr for $type {
            type Err = $crate::UnknownName;

            fn from_str(name: &str) -> Result<Self, $crate::UnknownName> {
                let (noun, names) = (<Self as $crate::NamedEnum>::NOUN, <Self as $crate::NamedEnum>::NAMES);
                let known = Self::ALL.into_iter().find(|value| value.name() == name);
                known.ok_or_else(|| $crate::UnknownName { noun, name: name.into(), names })
            }
        }
    };
}

pub(crate) use named_enum;

#[cfg(test)]
mod tests {
    use super::*;

    named_enum! {
        "fruit"
        #[derive(Default)]
        pub enum Fruit {
            #[default]
            Apple = "apple",
            BloodOrange = "blood_orange",
        }
    }

    #[test]
    fn display_from_str_and_serde_use_the_names() {
        assert_eq!(Fruit::default(), Fruit::Apple);
        for (fruit, &name) in Fruit::ALL.into_iter().zip(Fruit::NAMES) {
            assert_eq!((fruit.name(), &*fruit.to_string(), name.parse()), (name, name, Ok(fruit)));
            let text = serde_json::to_string(&fruit).unwrap();
            assert_eq!((&*text, serde_json::from_str::<Fruit>(&text).unwrap()), (&*format!("\"{name}\""), fruit));
        }
        assert_eq!(format!("{:>6}|", Fruit::Apple), " apple|");
    }

    #[test]
    fn errors_of_unknown_names_list_the_valid_ones() {
        let message = "blod_orange".parse::<Fruit>().unwrap_err().to_string();
        assert_eq!(message, "no fruit `blod_orange`, expected apple or blood_orange; did you mean `blood_orange`?");
        assert_eq!("Apple".parse::<Fruit>().unwrap_err().name, "Apple");
        let error = serde_json::from_str::<Fruit>("\"pear\"").unwrap_err().to_string();
        assert!(error.contains("unknown variant `pear`, expected `apple` or `blood_orange`"), "{error}");
    }

    #[test]
    fn lists_end_with_or() {
        let texts = [&[][..], &["a"], &["a", "b"], &["a", "b", "c"]].map(alternatives);
        assert_eq!(texts, ["", "a", "a or b", "a, b or c"]);
    }
}
