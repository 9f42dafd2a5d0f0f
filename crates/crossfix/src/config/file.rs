use std::path::Path;

use anyhow::{Context, anyhow, bail};
use serde::de::DeserializeOwned;

/// Names within this edit distance, relative to their length, are taken for a slip of the finger.
const SIMILAR: f64 = 0.6;

/// Reads a TOML file into a configuration; `sets` are `key=value` overrides with dotted keys.
///
/// The error names the file, the line, the key and, for an unknown key, the nearest known one.
pub fn load<T: DeserializeOwned>(path: &Path, sets: &[String]) -> anyhow::Result<T> {
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("cannot read the configuration file {}", path.display()))?;
    parse(&text, sets).with_context(|| format!("the configuration file {} has an error", path.display()))
}

/// Reads TOML text, with overrides.
pub fn parse<T: DeserializeOwned>(text: &str, sets: &[String]) -> anyhow::Result<T> {
    if sets.is_empty() {
        return toml::from_str(text).map_err(|error| explain(&error));
    }
    let mut table: toml::Table = toml::from_str(text).map_err(|error| explain(&error))?;
    for set in sets {
        apply(&mut table, set)?;
    }
    table.try_into().map_err(|error| explain(&error))
}

fn apply(table: &mut toml::Table, set: &str) -> anyhow::Result<()> {
    let (key, value) =
        set.split_once('=').ok_or_else(|| anyhow!("`--set {set}` is not of the form key=value"))?;
    // A value that is no TOML is taken as text, so that nobody has to quote twice.
    let value = toml::from_str::<toml::Table>(&format!("value = {value}"))
        .ok()
        .and_then(|mut parsed| parsed.remove("value"))
        .unwrap_or_else(|| toml::Value::String(value.to_owned()));
    let mut parts: Vec<&str> = key.trim().split('.').collect();
    let last = parts.pop().unwrap_or_default();
    let mut here = table;
    for part in parts {
        let next = here.entry(part).or_insert_with(|| toml::Value::Table(toml::Table::new()));
        let Some(inner) = next.as_table_mut() else {
            bail!("`--set {set}`: `{part}` is not a section");
        };
        here = inner;
    }
    here.insert(last.to_owned(), value);
    Ok(())
}

/// The parser's message with the nearest known key, where it names an unknown one.
fn explain(error: &toml::de::Error) -> anyhow::Error {
    let message = error.to_string();
    let quoted: Vec<&str> = error.message().split('`').skip(1).step_by(2).collect();
    if !error.message().starts_with("unknown field") && !error.message().starts_with("unknown variant") {
        return anyhow!("{}", message.trim_end());
    }
    let nearest = quoted.split_first().and_then(|(unknown, known)| {
        let likeness = |name: &&&str| strsim::jaro_winkler(unknown, name);
        let best = known.iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)))?;
        (likeness(&best) > SIMILAR).then(|| format!("\ndid you mean `{best}`?"))
    });
    anyhow!("{}{}", message.trim_end(), nearest.unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use crossfix_fusion::FusionConfig;

    use super::*;

    #[test]
    fn an_unknown_key_names_the_line_and_the_nearest_known_one() {
        let error = parse::<FusionConfig>("[event_time]\nlatenes_s = 1.0\n", &[]).unwrap_err().to_string();
        assert!(error.contains("latenes_s"), "{error}");
        assert!(error.contains("line 2"), "{error}");
        assert!(error.contains("did you mean `lateness_s`?"), "{error}");
    }

    #[test]
    fn an_override_replaces_a_value_and_makes_a_section() {
        let sets = ["tracking.acceleration_density=3.5".to_owned(), "initiation.solver=triple".to_owned()];
        let config: FusionConfig = parse("[tracking]\nacceleration_density = 1.0\n", &sets).unwrap();
        assert_eq!(config.tracking.acceleration_density, 3.5);
        assert_eq!(config.initiation.solver, crossfix_fusion::SpatialSolver::Triple);
    }

    #[test]
    fn an_override_of_an_unknown_key_is_refused() {
        let error = parse::<FusionConfig>("", &["tracking.speed=1".to_owned()]).unwrap_err();
        assert!(error.to_string().contains("unknown field `speed`"), "{error}");
    }
}
