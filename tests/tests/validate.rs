//! `crossfix validate`: what it prints, and the files that it leaves.

#![allow(clippy::unwrap_used, reason = "a test that cannot set itself up has failed")]

use std::collections::BTreeSet;

use crossfix_tests::{crossfix, succeed};

#[test]
fn the_fusions_figures_come_as_text_json_and_plots() {
    let folder = tempfile::tempdir().unwrap();
    let (json, plots) = (folder.path().join("fusion.json"), folder.path().join("plots"));
    let (to_json, to_plots) = (json.display().to_string(), plots.display().to_string());
    let runs = ["validate", "fusion", "--runs", "3", "--json", &to_json, "--plots", &to_plots];
    let text = succeed(&runs);
    assert!(text.contains(" figures are what they must be ("), "{text}");

    let tables: serde_json::Value = serde_json::from_slice(&std::fs::read(&json).unwrap()).unwrap();
    let tables = tables.as_array().unwrap();
    let names: BTreeSet<&str> =
        tables.iter().map(|table| table["name"].as_str().unwrap()).collect();
    assert_eq!(names.len(), tables.len(), "each table has a name of its own");
    let experiments = ["detection-distance", "degenerate-position", "fusion-bound", "batch-bound"];
    for name in experiments.into_iter().chain(["fusion-degenerate-diverged", "manoeuvre-error"]) {
        assert!(names.contains(name), "{name} is not among {names:?}");
    }
    for table in tables {
        let (name, title) = (table["name"].as_str().unwrap(), table["title"].as_str().unwrap());
        assert!(text.contains(title), "the text lacks `{title}`");
        let rows = table["rows"].as_array().unwrap();
        assert!(!rows.is_empty(), "{name} is empty");
        for row in rows {
            let series = row["series"].as_str().unwrap();
            assert!(text.contains(series), "the text lacks `{series}` of {name}");
        }
        let plot = std::fs::read_to_string(plots.join(format!("{name}.svg"))).unwrap();
        assert!(plot.starts_with("<svg") && plot.trim_end().ends_with("</svg>"), "{name}");
        assert!(plot.contains("<circle") && !plot.contains("NaN"), "{name} is not drawn");
    }
    let drawn = std::fs::read_dir(&plots).unwrap().count();
    assert_eq!(drawn, tables.len(), "a plot of each table and nothing else");
}

#[test]
fn an_experiment_that_is_not_there_is_an_error_and_not_an_empty_success() {
    let output = crossfix(&["validate", "fusion", "--runs", "2", "--only", "nothing of the kind"]);
    assert_eq!(output.status.code(), Some(1));
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert!(stderr.contains("no experiment has `nothing of the kind` in its name"), "{stderr}");
}
