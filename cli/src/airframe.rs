use aviary::drone::{DerivedNumber, DroneModel};
use clap::{Args, ValueHint};
use serde_json::json;

use crate::failure::Failure;
use crate::options;
use crate::output;
use crate::parse::{self, NameOrFile};

/// Derived numbers of an airframe, with warnings where one is implausible
///
/// A number outside its range is mostly a parameter in another unit: the parameters that it follows from are named. The exit status
/// is 0 all the same, 2 for a file that no airframe can be read from.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  aviary airframe cf2x
  aviary airframe my_quad.toml
  aviary airframe my_quad.toml --json")]
pub struct Airframe {
    /// Airframe: cf2x, cf2p, race, or a TOML file with one of your own
    #[arg(
        value_name = "FILE",
        value_hint = ValueHint::FilePath,
        value_parser = parse::airframe(),
        hide_possible_values = true
    )]
    airframe: NameOrFile<DroneModel>,
    /// Print JSON instead of a table
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
                        // infinity, which JSON does not have, is null
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

/// The warning about an implausible number.
pub fn warning(number: &DerivedNumber) -> Option<String> {
    let range = number.range().filter(|_| !number.is_plausible())?;
    Some(format!("{} is {}, plausible is {range}: check {}", number.label, number.text(), number.fields))
}
