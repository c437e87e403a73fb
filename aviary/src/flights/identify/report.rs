//! The identified airframe as a file.

use super::{Estimate, FittedParameter, Identification, Status};

/// First lines of an airframe file.
const HEADER: [&str; 6] = [
    "# Identified by `aviary identify`. Comments have standard errors. The mass, the dimensions, thrust_coefficient",
    "# and every number without an error come from the command line and the base airframe.",
    "# The numbers are those that predict the flights best. The controller on board answered every disturbance in",
    "# these flights, and an error of the predicted torque is forgotten sooner with more damping: torque_coefficient,",
    "# rotational_damping, velocity_moment and the time constants contain a part of this closed loop. They are not",
    "# physical constants of the airframe alone.",
];

/// Returns the standard error of a parameter as text, with two significant digits.
fn error_text(error: f64) -> String {
    let digits = format!("{error:.1e}");
    // plain notation for numbers that are short in it
    match digits.parse::<f64>() {
        Ok(number) if (1e-3..1e5).contains(&number) => format!("{number}"),
        _ => digits,
    }
}

impl FittedParameter {
    /// Returns the standard error with its unit, and the reason for which the number is a default or equal to another.
    pub fn remark(&self) -> String {
        let error = || format!("± {} {}", error_text(self.estimate.error), self.unit);
        let reason = match &self.status {
            Status::Identified => return error(),
            Status::NotIdentifiable(reason) => format!("not identifiable: {reason}"),
            Status::Insignificant(Estimate { value, error }) => {
                let value = error_text(*value);
                format!("not significant: default + {value} ± {}", error_text(*error)).replace("+ -", "- ")
            }
            Status::AtBound => "at the smallest valid number".into(),
        };
        match self.like {
            Some(like) => format!("{}, as {like} ({reason})", error()),
            None => reason,
        }
    }
}

impl Identification {
    /// Returns the airframe file: TOML with a comment for every identified parameter. `sources` names the flights.
    pub fn toml(&self, sources: &[String]) -> String {
        let mut params = self.airframe.clone();
        params.provenance = format!("identified from {}", sources.join(", "));
        let text = toml::to_string(&params).expect("an airframe has a form in TOML");
        let mut lines: Vec<String> = HEADER.iter().map(ToString::to_string).collect();
        let mut section = String::new();
        for line in text.lines() {
            if let Some(name) = line.strip_prefix('[').and_then(|line| line.strip_suffix(']')) {
                section = format!("{name}.");
            }
            let key = line.split('=').next().unwrap_or_default().trim();
            let comment = self.comment(&format!("{section}{key}"));
            lines.push(if comment.is_empty() { line.to_string() } else { format!("{line} # {comment}") });
        }
        lines.join("\n") + "\n"
    }

    /// Returns the comment of a key, which may have several parameters.
    fn comment(&self, key: &str) -> String {
        let is_part = |name: &str| name.strip_prefix(key).is_some_and(|rest| rest.is_empty() || rest.starts_with('['));
        let parameters: Vec<_> = self.parameters.iter().filter(|parameter| is_part(parameter.name)).collect();
        if parameters.iter().all(|parameter| parameter.estimate.error.is_infinite()) {
            return parameters.first().map(|parameter| parameter.remark()).unwrap_or_default();
        }
        let errors: Vec<_> = parameters
            .iter()
            .map(|parameter| match (parameter.estimate.error.is_finite(), &parameter.status) {
                (true, _) => error_text(parameter.estimate.error),
                (false, Status::AtBound) => "at its bound".into(),
                (false, _) => "default".into(),
            })
            .collect();
        match (&errors[..], parameters[0].unit) {
            ([_], _) => parameters[0].remark(),
            (several, unit) => format!("± [{}] {unit}", several.join(", ")),
        }
    }
}
