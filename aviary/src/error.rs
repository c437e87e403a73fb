//! Shared errors, and helpers for error messages and for reading input.

use std::fmt;
use std::io;
use std::sync::Arc;

use serde::{Deserialize, Deserializer};

/// Error for an option outside its range.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{option} is {got}, expected {expected}")]
pub struct OptionError {
    /// Name of the field, with its section if it has one, for example `wind.gust_force`.
    pub option: &'static str,
    /// Value of the option.
    pub got: String,
    /// Valid values.
    pub expected: &'static str,
}

impl OptionError {
    /// Returns an error unless the value of an option is in a range.
    pub(crate) fn check(
        option: &'static str,
        got: f64,
        range: std::ops::RangeInclusive<f64>,
        expected: &'static str,
    ) -> Result<(), Self> {
        if range.contains(&got) { Ok(()) } else { Err(Self { option, got: number(got), expected }) }
    }
}

/// An I/O error of the operating system that can be cloned and compared. Two errors are equal if their kinds and
/// messages are equal.
#[derive(Debug, Clone)]
pub struct SystemError(Arc<io::Error>);

impl SystemError {
    /// Returns the kind of the error.
    pub fn kind(&self) -> io::ErrorKind {
        self.0.kind()
    }
}

impl From<io::Error> for SystemError {
    fn from(error: io::Error) -> Self {
        Self(Arc::new(error))
    }
}

impl fmt::Display for SystemError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

impl std::error::Error for SystemError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.0.source()
    }
}

impl PartialEq for SystemError {
    fn eq(&self, other: &Self) -> bool {
        (self.kind(), self.to_string()) == (other.kind(), other.to_string())
    }
}

/// Formats a TOML error on one line, with line, column and expected value.
///
/// The message has no excerpt of the source, and describes numbers in words instead of naming Rust types.
pub fn toml_message(text: &str, error: &toml::de::Error) -> String {
    let mut message = error.message().split_whitespace().collect::<Vec<_>>().join(" ");
    if let Some((found, expected)) = message.split_once(", expected ") {
        let expected = match expected {
            "f64" | "f32" => "a number",
            "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number, zero or positive",
            "i8" | "i16" | "i32" | "i64" | "isize" => "a whole number",
            "a sequence" => "a list",
            other if other.starts_with("struct ") => "a section",
            other => other,
        };
        message = format!("{found}, expected {expected}");
    }
    message = with_short_numbers(message);
    if message.starts_with("unknown ") {
        message = with_suggestion(&message);
    }
    match error.span() {
        Some(span) => {
            let before = &text[..span.start.min(text.len())];
            let line = before.matches('\n').count() + 1;
            let column = before.rsplit('\n').next().map_or(0, |rest| without_byte_order_mark(rest).chars().count()) + 1;
            format!("line {line}, column {column}: {message}")
        }
        None => message,
    }
}

/// Returns a message of serde with its floating-point number in the form of [`number`] if that is an exponent form.
fn with_short_numbers(message: String) -> String {
    const BEFORE: &str = "floating point `";
    let number_text = || {
        let (before, rest) = message.split_once(BEFORE)?;
        let (digits, after) = rest.split_once('`')?;
        let short = digits.parse().ok().map(number).filter(|text| text.contains('e'))?;
        Some(format!("{before}{BEFORE}{short}`{after}"))
    };
    number_text().unwrap_or(message)
}

/// Returns the suggestion ``; did you mean `…`?`` with the most similar of several names, or an empty string if none
/// is similar.
pub fn did_you_mean(name: &str, names: &[&str]) -> String {
    // `rev`, because `max_by` returns the last of equal elements
    names
        .iter()
        .rev()
        .map(|candidate| (strsim::jaro_winkler(name, candidate), candidate))
        .filter(|(likeness, _)| *likeness > 0.7)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, candidate)| format!("; did you mean `{candidate}`?"))
        .unwrap_or_default()
}

/// Returns serde's message about an unknown name with a suggestion.
///
/// The message leaves a long list of names out if there is a suggestion, and cuts it otherwise.
fn with_suggestion(message: &str) -> String {
    /// Columns that the name of a short file, the line and the column leave of 120.
    const MAX: usize = 75;
    /// Columns of a space, two backquotes, a comma and the ellipsis.
    const AROUND: usize = 6;
    // serde quotes the unknown name and then every known one
    let quoted: Vec<_> = message.split('`').skip(1).step_by(2).collect();
    let [name, names @ ..] = &quoted[..] else { return message.to_string() };
    let near = did_you_mean(name, names);
    let wrong = message.split_once(", expected ").map_or(message, |(wrong, _)| wrong);
    if message.chars().count() + near.len() <= MAX {
        return format!("{message}{near}");
    }
    if !near.is_empty() {
        return format!("{wrong}{near}");
    }
    let mut cut = format!("{wrong}, expected one of");
    for (index, name) in names.iter().enumerate() {
        if index > 0 && cut.chars().count() + name.len() + AROUND > MAX {
            break;
        }
        cut += &format!(" `{name}`,");
    }
    format!("{cut} …")
}

/// Returns a number as error messages print it: in exponent form if it is below 1e-4 or at least 1e15 in magnitude.
///
/// ```
/// assert_eq!(aviary::number(-1.5), "-1.5");
/// assert_eq!(aviary::number(1e300), "1e300");
/// assert_eq!(aviary::number(f64::NAN), "NaN");
/// ```
pub fn number(x: f64) -> String {
    let is_short = x == 0.0 || !x.is_finite() || (1e-4..1e15).contains(&x.abs());
    if is_short { x.to_string() } else { format!("{x:e}") }
}

/// Returns a count with its noun: `1 drone`, `2 drones`, `3 entries`.
pub fn count(count: usize, noun: &str) -> String {
    match (count, noun.strip_suffix('y')) {
        (1, _) => format!("1 {noun}"),
        (_, Some(stem)) => format!("{count} {stem}ies"),
        (_, None) => format!("{count} {noun}s"),
    }
}

/// Returns a text without the byte-order mark (U+FEFF) that some editors write at the start of a file.
pub fn without_byte_order_mark(text: &str) -> &str {
    text.strip_prefix('\u{feff}').unwrap_or(text)
}

/// Reads exactly three numbers. The arrays of serde accept longer lists and ignore the rest.
pub(crate) fn triple<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[f64; 3], D::Error> {
    Ok(Triple::deserialize(deserializer)?.0)
}

/// Reads a list of triples.
pub(crate) fn triples<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<[f64; 3]>, D::Error> {
    Ok(Vec::<Triple>::deserialize(deserializer)?.into_iter().map(|triple| triple.0).collect())
}

/// Reads exactly two numbers. The arrays of serde accept longer lists and ignore the rest.
pub(crate) fn pair<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[f64; 2], D::Error> {
    let numbers = Vec::<f64>::deserialize(deserializer)?;
    let wrong = |numbers: Vec<f64>| serde::de::Error::custom(format!("{}, expected 2", count(numbers.len(), "number")));
    numbers.try_into().map_err(wrong)
}

/// Reads an optional list of triples.
pub(crate) fn optional_triples<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<Vec<[f64; 3]>>, D::Error> {
    triples(deserializer).map(Some)
}

#[derive(Deserialize)]
#[serde(try_from = "Vec<f64>")]
struct Triple([f64; 3]);

impl TryFrom<Vec<f64>> for Triple {
    type Error = String;

    fn try_from(numbers: Vec<f64>) -> Result<Self, String> {
        let count = numbers.len();
        numbers.try_into().map(Self).map_err(|_| format!("{}, expected 3", self::count(count, "number")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_most_similar_name_is_suggested() {
        let names = ["hover", "velocity", "multi_hover"];
        assert_eq!(did_you_mean("hovr", &names), "; did you mean `hover`?");
        assert_eq!(did_you_mean("mutli_hover", &names), "; did you mean `multi_hover`?");
        assert_eq!(did_you_mean("xyz", &names), "");
        assert_eq!(did_you_mean("hover", &[]), "");
    }

    #[test]
    fn file_errors_have_the_system_or_parser_error_as_their_source() {
        use std::error::Error as _;

        use crate::drone::{DroneError, DroneParams};
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("airframe.toml");
        let read = || DroneParams::from_file(&path).unwrap_err();
        let DroneError::File { error, .. } = read() else { panic!("{}", read()) };
        assert!(matches!(*error, DroneError::System(ref system) if system.kind() == io::ErrorKind::NotFound));
        let text = include_str!("../../assets/airframes/cf2x.toml").replace("mass = 0.027", "mass = -1.0");
        std::fs::write(&path, text).unwrap();
        let error = read();
        assert_eq!(error.source().unwrap().to_string(), "mass is -1, expected a positive number");
        assert!(error.to_string().ends_with("airframe.toml: mass is -1, expected a positive number"), "{error}");
    }

    #[test]
    fn lists_of_names_in_messages_are_short() {
        let names = |count: usize| (0..count).map(|index| format!("`name{index}`")).collect::<Vec<_>>().join(", ");
        let short = format!("unknown field `mass`, expected one of {}", names(3));
        assert_eq!(with_suggestion(&short), short);
        let long = with_suggestion(&format!("unknown field `mass`, expected one of {}", names(30)));
        assert!(long.starts_with("unknown field `mass`, expected one of `name0`, `name1`,"), "{long}");
        assert!(long.ends_with(", …") && long.chars().count() < 90, "{long}");
        let near = with_suggestion(&format!("unknown field `nam7`, expected one of {}", names(30)));
        assert_eq!(near, "unknown field `nam7`; did you mean `name7`?");
    }

    #[test]
    fn numbers_in_messages_are_short() {
        for (x, text) in
            [(0.027, "0.027"), (-0.0, "-0"), (1e14, "100000000000000"), (5e15, "5e15"), (-1e-300, "-1e-300")]
        {
            assert_eq!(number(x), text);
        }
        for x in [f64::MAX, f64::MIN_POSITIVE, -f64::EPSILON, f64::NAN, f64::NEG_INFINITY, 2.0 / 3.0] {
            assert!(number(x).len() < 25, "{x:e}");
            assert!(x.is_nan() || number(x).parse() == Ok(x), "{x:e}");
        }
        let text = "name = 1e300\n";
        let error = toml::from_str::<std::collections::BTreeMap<String, String>>(text).unwrap_err();
        assert!(toml_message(text, &error).contains("floating point `1e300`, expected a string"), "{error}");
    }

    #[test]
    fn unknown_keys_of_toml_get_a_suggestion() {
        #[derive(Debug, serde::Deserialize)]
        #[serde(deny_unknown_fields)]
        #[allow(dead_code)]
        struct Body {
            mass: f64,
            inertia: f64,
        }
        let text = "mass = 1.0\ninerta = 2.0\n";
        let message = toml_message(text, &toml::from_str::<Body>(text).unwrap_err());
        assert!(message.starts_with("line 2, column 1") && message.ends_with("did you mean `inertia`?"), "{message}");
    }
}
