use std::fmt;
use std::path::Path;

use anyhow::{Context, anyhow, bail};
use serde::de::DeserializeOwned;

/// Names more similar than this (Jaro-Winkler similarity, 0 to 1) count as a typing error.
/// With half of it a known name would be proposed for nearly every unknown one.
const SIMILAR: f64 = 0.6;

/// Reads a TOML file into a configuration; `sets` are `key=value` overrides with dotted keys.
///
/// The error names the file, the line, the key and, for an unknown key, the nearest known one. If
/// the file is of another kind than `wanted`, the error says which.
pub fn load<T: DeserializeOwned>(
    path: &Path,
    sets: &[String],
    wanted: FileKind,
) -> anyhow::Result<T> {
    let text = std::fs::read_to_string(path)
        .with_context(|| format!("cannot read the configuration file {}", path.display()))?;
    parse(&text, sets).map_err(|error| {
        let kind = toml::from_str(&text).ok().and_then(|keys| FileKind::of(&keys));
        match kind.filter(|kind| *kind != wanted) {
            Some(kind) => {
                anyhow!("{} is {kind}, and what is wanted here is {wanted}", path.display())
            }
            None => {
                error.context(format!("the configuration file {} has an error", path.display()))
            }
        }
    })
}

/// Kind of a configuration file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileKind {
    Camera,
    Fusion,
    Network,
    Scene,
    Tracker,
    Calibration,
}

impl FileKind {
    /// Kind of a file by its keys; `None` if they do not show it.
    pub fn of(keys: &toml::Table) -> Option<Self> {
        let has = |names: &[&str]| names.iter().any(|name| keys.contains_key(*name));
        if has(&["form"]) {
            Some(Self::Calibration)
        } else if has(&["name", "source", "pose", "intrinsics"]) {
            Some(Self::Camera)
        } else if has(&["targets"]) {
            Some(Self::Scene)
        } else if has(&["site", "routers", "security", "unsecured", "anchor"])
            || keys.get("cameras").is_some_and(toml::Value::is_table)
        {
            Some(Self::Network)
        } else if has(&["event_time", "bearings", "initiation", "tracking", "clocks", "network"]) {
            Some(Self::Fusion)
        } else {
            has(&["algorithm", "reference", "gate", "detector", "margin_px", "paper"])
                .then_some(Self::Tracker)
        }
    }
}

impl fmt::Display for FileKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Camera => "a camera's file",
            Self::Fusion => "a fusion centre's file",
            Self::Network => "a network file",
            Self::Scene => "a scene of the simulator",
            Self::Tracker => "an image tracker's file",
            Self::Calibration => "a site's calibration",
        })
    }
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
    // A value that is not valid TOML is read as text, so that nobody has to quote twice.
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

/// A parser's message, which shows the faulty line, without credentials: without all between `//`
/// and `@`, and without what is given as a password.
fn without_passwords(message: &str) -> String {
    message.lines().map(line_without_passwords).collect::<Vec<_>>().join("\n")
}

fn line_without_passwords(line: &str) -> String {
    let mut line = line.to_owned();
    if let Some(begin) = line.find("//").map(|at| at + 2)
        && let Some(end) = line.rfind('@').filter(|end| *end > begin)
    {
        line.replace_range(begin..end, "...");
    }
    let password = line.find("password").filter(|_| !line.contains("password_file"));
    if let Some(begin) = password.and_then(|at| Some(at + line[at..].find('=')? + 1)) {
        line.replace_range(begin.., " ...");
    }
    line
}

/// The parser's message; if it names an unknown key, with the nearest known one.
fn explain(error: &toml::de::Error) -> anyhow::Error {
    let message = without_passwords(&error.to_string());
    let quoted: Vec<&str> = error.message().split('`').skip(1).step_by(2).collect();
    if !error.message().starts_with("unknown field")
        && !error.message().starts_with("unknown variant")
    {
        return anyhow!("{}", message.trim_end());
    }
    let nearest = quoted.split_first().and_then(|(unknown, known)| {
        let likeness = |name: &&&str| strsim::jaro_winkler(unknown, name);
        let best = known.iter().max_by(|a, b| likeness(a).total_cmp(&likeness(b)))?;
        (likeness(&best) > SIMILAR).then(|| format!("\ndid you mean `{best}`?"))
    });
    anyhow!("{}{}", message.trim_end(), nearest.unwrap_or_default())
}

#[cfg(all(test, feature = "centre"))]
mod tests {
    use crossfix_fusion::FusionConfig;

    use super::*;

    #[test]
    fn an_unknown_key_names_the_line_and_the_nearest_known_one() {
        let error =
            parse::<FusionConfig>("[event_time]\nlatenes_s = 1.0\n", &[]).unwrap_err().to_string();
        assert!(error.contains("latenes_s"), "{error}");
        assert!(error.contains("line 2"), "{error}");
        assert!(error.contains("did you mean `lateness_s`?"), "{error}");
    }

    #[test]
    fn an_error_in_a_line_with_a_password_does_not_show_it() {
        let inline =
            "source = { kind = \"stream\", url = \"rtsp://eye:hunter2@h/\", transprt = \"udp\" }";
        let open = "url = \"rtsp://eye:hunter2@10.0.0.5/live";
        let key = "[source]\nkind = \"stream\"\nurl = \"rtsp://h/\"\npassword = \"hunter2\"";
        for text in [inline, open, key] {
            let text = format!("name = \"n\"\nnetwork = \"n.toml\"\n{text}");
            let error =
                format!("{:?}", parse::<crate::config::CameraFile>(&text, &[]).unwrap_err());
            assert!(!error.contains("hunter2"), "{error}");
        }
    }

    #[test]
    fn a_file_of_another_kind_is_named_as_what_it_is() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/");
        let kinds = [
            ("site/north.toml", FileKind::Camera),
            ("site/fusion.toml", FileKind::Fusion),
            ("site/network.toml", FileKind::Network),
            ("demo/scene.toml", FileKind::Scene),
            ("paper-tracker.toml", FileKind::Tracker),
        ];
        for (name, kind) in kinds {
            let path = Path::new(folder).join(name);
            let keys = toml::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
            assert_eq!(FileKind::of(&keys), Some(kind), "{name}");
            if kind != FileKind::Fusion {
                let error =
                    load::<crate::config::FusionFile>(&path, &[], FileKind::Fusion).unwrap_err();
                let says = format!("is {kind}, and what is wanted here is a fusion centre's file");
                assert!(error.to_string().contains(&says), "{error}");
            }
        }
    }

    #[test]
    fn an_override_replaces_a_value_and_makes_a_section() {
        let sets =
            ["tracking.acceleration_density=3.5".to_owned(), "initiation.solver=triple".to_owned()];
        let config: FusionConfig =
            parse("[tracking]\nacceleration_density = 1.0\n", &sets).unwrap();
        assert_eq!(config.tracking.acceleration_density, 3.5);
        assert_eq!(config.initiation.solver, crossfix_fusion::SpatialSolver::Triple);
    }

    #[test]
    fn an_override_of_an_unknown_key_is_refused() {
        let error = parse::<FusionConfig>("", &["tracking.speed=1".to_owned()]).unwrap_err();
        assert!(error.to_string().contains("unknown field `speed`"), "{error}");
    }
}
