//! The figures of the fusion, with few runs: what must be must be already with these.

use crossfix_evaluation::{Table, TableRow, ValidationOptions, Verdict, validate_fusion};

fn tables(only: &str, runs: usize) -> Vec<Table> {
    let tables = validate_fusion(ValidationOptions { runs, seed: 3 }, only, |_, _, _| {});
    assert!(!tables.is_empty(), "no experiment is called {only}");
    tables
}

/// The rows of a table that are not what they must be; that some are asked for is sure.
fn failures<'a>(tables: &'a [Table], name: &str) -> Vec<&'a TableRow> {
    let table = tables.iter().find(|table| table.name == name);
    let table = table.unwrap_or_else(|| panic!("there is no table {name}"));
    assert!(table.rows.iter().any(|row| row.limit.is_some()), "nothing is asked of {name}");
    table.rows.iter().filter(|row| row.verdict() == Verdict::Fail).collect()
}

const NONE: [&TableRow; 0] = [];

#[test]
fn both_algorithms_find_what_the_reference_finds() {
    let tables = tables("detection", 20);
    for name in ["detection-distance", "detection-deviation", "detection-probability"] {
        assert_eq!(failures(&tables, name), NONE);
    }
}

#[test]
fn the_delays_cost_two_receivers_metres_and_three_nothing() {
    let tables = tables("detection", 20);
    let rows = &tables[0].rows;
    let of = |series: &str, delay: f64| {
        let row = rows.iter().find(|row| row.series == series && row.x == delay);
        row.expect("the row is there").ours
    };
    assert!(of("two receivers, m = 1, noise on positions", 0.25) > 2.0);
    assert!(of("three receivers, m = 1, noise on positions", 0.3) < 0.2);
}

#[test]
fn degenerate_fixes_say_so_whatever_the_noise() {
    let tables = tables("one period", 20);
    assert_eq!(failures(&tables, "degenerate-condition"), NONE);
    assert_eq!(failures(&tables, "degenerate-said"), NONE);
    assert_eq!(failures(&tables, "degenerate-position"), NONE);
}

#[test]
fn all_bearings_at_once_reach_the_bound_in_every_geometry() {
    let tables = tables("batch", 300);
    assert_eq!(failures(&tables, "batch-bound"), NONE);
    assert_eq!(failures(&tables, "batch-diverged"), NONE);
}

#[test]
fn nothing_diverges_where_one_period_does_not_determine_position_and_velocity() {
    let tables = tables("degenerate geometries, whole", 60);
    for name in ["fusion-degenerate", "fusion-degenerate-diverged", "fusion-degenerate-confirmed"] {
        assert_eq!(failures(&tables, name), NONE);
    }
    // Equal delays, one delay of nothing, all at once; the cameras' plane, and 5 and 1 degrees
    // above it.
    let nees = &tables.iter().find(|table| table.name == "fusion-degenerate-nees").unwrap().rows;
    let asked = [
        "equal delays 0.2/0.2",
        "dt2 = 0, dt3 = 0.2",
        "synchronous",
        "90 degree arc, 5 degrees up",
        "90 degree arc, 1 degree up",
        "coplanar",
    ];
    for layout in asked {
        let row = nees.iter().find(|row| row.series == layout);
        let row = row.unwrap_or_else(|| panic!("there is no layout {layout}"));
        // Four standard deviations of the mean of 60 chi-squares of six degrees of freedom.
        assert!((row.ours - 6.0).abs() < 4.0 * (12.0_f64 / 60.0).sqrt(), "{row:?}");
    }
}

#[test]
fn the_whole_fusion_confirms_a_lone_target() {
    let tables = tables("bound of all periods, whole", 20);
    assert_eq!(failures(&tables, "fusion-confirmed"), NONE);
}

#[test]
fn after_sharp_turns_the_chi_square_test_is_best_in_little_noise_and_the_models_in_much() {
    assert_eq!(failures(&tables("manoeuvres", 40), "manoeuvre-ratio"), NONE);
}

#[test]
fn runs_are_repeatable() {
    assert_eq!(tables("batch", 5), tables("batch", 5));
}
