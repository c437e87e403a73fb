use aviary::drone::{DerivedNumber, DroneModel};
use clap::{Args, ValueHint};
use serde_json::json;

use crate::failure::Failure;
use crate::options;
use crate::output;
use crate::parse::{self, NameOrFile};

/// Print derived numbers of an airframe and warn about implausible ones
///
/// A number outside its range is mostly a parameter in a wrong unit: a warning names the
/// parameters to check. The exit status is 0 with warnings, and 2 for an invalid file.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary airframe cf2x
  aviary airframe my_quad.toml
  aviary airframe my_quad.toml --json")]
pub struct Airframe {
    /// Airframe: cf2x, cf2p, race, cf21 or a TOML file
    #[arg(
        value_name = "AIRFRAME",
        value_hint = ValueHint::FilePath,
        value_parser = parse::airframe(),
        hide_possible_values = true
    )]
    airframe: NameOrFile<DroneModel>,
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
}

impl Airframe {
    pub fn run(&self) -> Result<(), Failure> {
        let params = options::params(&self.airframe)?;
        let numbers = params.derived();
        let warnings: Vec<_> = numbers.iter().filter_map(warning).collect();
        let slip = params.unit_slip();
        if self.json {
            let list: Vec<_> = numbers
                .iter()
                .map(|number| {
                    json!({
                        "name": number.name,
                        "value": number.value,
                        "unit": number.unit,
                        // JSON has no infinity: it is null
                        "plausible": number.plausible,
                        "is_plausible": number.is_plausible(),
                    })
                })
                .collect();
            return output::print_json(&json!({
                "name": params.name,
                "numbers": list,
                "plausible": warnings.is_empty(),
                "warnings": warnings,
                "suspected_unit": slip,
            }));
        }
        let width = |text: fn(&DerivedNumber) -> usize| numbers.iter().map(text).max().unwrap_or(0);
        let (label, value) =
            (width(|number| number.label.chars().count()), width(|number| number.text().chars().count()));
        let mut text = format!("{:label$}  {}\n", "airframe", params.name);
        for number in &numbers {
            let (name, got, range) = (number.label, number.text(), number.range());
            text += &match range {
                Some(range) => format!("{name:label$}  {got:value$}  plausible: {range}\n"),
                None => format!("{name:label$}  {got}\n"),
            };
        }
        for warning in &warnings {
            text += &format!("warning: {warning}\n");
        }
        if let Some(slip) = slip {
            text += &format!("every warning disappears with {slip}\n");
        }
        output::print(&text)
    }
}

/// Returns the warning about a number, if it is implausible.
pub fn warning(number: &DerivedNumber) -> Option<String> {
    let range = number.range().filter(|_| !number.is_plausible())?;
    Some(format!("{} is {}, plausible is {range}: check {}", number.label, number.text(), number.fields))
}
