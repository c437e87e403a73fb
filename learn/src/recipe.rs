//! Recipes: the default training configuration of each task, `assets/recipes/TASK.toml` over
//! `assets/recipes/common.toml`.

use crate::TrainError;

/// Settings shared by all recipes.
const COMMON: &str = include_str!("../../assets/recipes/common.toml");

macro_rules! recipes {
    ($($task:literal)+) => {
        &[$(($task, include_str!(concat!("../../assets/recipes/", $task, ".toml")))),+]
    };
}

/// Recipes by task.
const RECIPES: &[(&str, &str)] = recipes!(
    "hover" "velocity" "multi_hover" "fly_through" "formation" "race" "multi_agent" "antipodal" "stabilize" "track"
);

/// Returns the complete recipe of a task as a configuration table.
///
/// # Errors
/// [`TrainError::Toml`] for a task without a recipe, or for invalid TOML; a test reads all recipes.
pub fn of_task(task: &str) -> Result<toml::Table, TrainError> {
    let Some((_, text)) = RECIPES.iter().find(|(name, _)| *name == task) else {
        return Err(TrainError::Toml { message: format!("{task} has no recipe") });
    };
    let read = |text: &str| {
        text.parse::<toml::Table>().map_err(|error| TrainError::Toml { message: aviary::toml_message(text, &error) })
    };
    let mut recipe = read(COMMON)?;
    merge(&mut recipe, read(text)?);
    Ok(recipe)
}

/// Overrides entries with those of another table, section by section.
fn merge(table: &mut toml::Table, other: toml::Table) {
    for (key, value) in other {
        match (table.get_mut(&key), value) {
            (Some(toml::Value::Table(section)), toml::Value::Table(other)) => merge(section, other),
            (_, value) => drop(table.insert(key, value)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TrainConfig;

    /// Recipes set every option, so that the configuration equals its recipe.
    #[test]
    fn every_task_has_a_complete_recipe() {
        assert!(RECIPES.iter().map(|(name, _)| *name).eq(aviary::tasks::NAMES));
        for task in aviary::tasks::NAMES {
            let config = TrainConfig::of_task(task).unwrap();
            config.validate().unwrap();
            let written: toml::Table = config.to_toml().unwrap().parse().unwrap();
            assert_eq!(written, of_task(task).unwrap(), "{task}");
        }
    }

    #[test]
    fn sections_are_merged_and_lists_replaced() {
        let table = |text: &str| text.parse::<toml::Table>().unwrap();
        let mut merged = table("a = 1\nb = [1, 2]\n[c]\nd = 1\ne = 2\n");
        merge(&mut merged, table("b = [3]\nf = 4\n[c]\ne = 3\n"));
        assert_eq!(merged, table("a = 1\nb = [3]\nf = 4\n[c]\nd = 1\ne = 3\n"));
    }
}
