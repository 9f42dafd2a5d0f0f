//! Checks a camera's description of itself (GenICam's XML) before it is used.
//!
//! `viva-genicam` follows references between features, and brackets in formulas, as deep as they go.
//! A description whose references form a cycle, as wrong firmware or somebody hostile may send it,
//! would take all of the stack and end the process.

use std::collections::{BTreeMap, BTreeSet};

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

/// Most references from a feature's value to another's one after another, and most brackets within
/// brackets of a formula. Cameras have a dozen. Each takes about 5 kB of stack in a debug build, of
/// the 2 MB that a thread has.
const MOST_NESTED: usize = 128;
/// References that are followed when a value is read. Those to limits, and to what else changes with
/// a value, may form cycles.
const OF_VALUES: [&str; 7] =
    ["pValue", "pVariable", "pAddress", "pIndex", "pLength", "pValueIndexed", "pValueDefault"];
/// Elements that hold formulas.
const FORMULAS: [&str; 4] = ["Formula", "FormulaTo", "FormulaFrom", "Expression"];

/// An element that has begun and not ended.
struct Open {
    tag: String,
    /// Name of the feature that it is, or is a part of.
    feature: Option<String>,
    text: String,
}

impl Open {
    fn new(start: &BytesStart<'_>, within: Option<&Self>) -> Self {
        let tag = start.local_name().as_ref().to_owned();
        // A variable of a formula has a name too, and is a part of its feature.
        let own = if OF_VALUES.contains(&tag.as_str()) { None } else { name_of(start) };
        let feature = own.or_else(|| within.and_then(|within| within.feature.clone()));
        Self { tag, feature, text: String::new() }
    }
}

fn name_of(start: &BytesStart<'_>) -> Option<String> {
    let name = start.try_get_attribute("Name").ok().flatten()?;
    Some(name.value.into_owned())
}

/// Checks a description.
///
/// # Errors
/// What is wrong with it, in words.
pub(super) fn check(xml: &str) -> Result<(), String> {
    let mut reader = Reader::from_str(xml);
    let mut open: Vec<Open> = Vec::new();
    let mut references: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    loop {
        match reader.read_event() {
            Ok(Event::Start(start)) => {
                let element = Open::new(&start, open.last());
                open.push(element);
            }
            Ok(Event::Text(text)) => append(&mut open, &text),
            Ok(Event::CData(text)) => append(&mut open, &text),
            // A bracket may be written as its number.
            Ok(Event::GeneralRef(number)) => {
                if let Ok(Some(character)) = number.resolve_char_ref() {
                    append(&mut open, character.encode_utf8(&mut [0; 4]));
                }
            }
            Ok(Event::End(_)) => {
                let Some(Open { tag, feature, text }) = open.pop() else { continue };
                if FORMULAS.contains(&tag.as_str()) && nesting(&text) > MOST_NESTED {
                    return Err(format!(
                        "a formula of its description is nested more than {MOST_NESTED} deep"
                    ));
                }
                if let Some(feature) = feature.filter(|_| OF_VALUES.contains(&tag.as_str())) {
                    references.entry(feature).or_default().insert(text.trim().to_owned());
                }
            }
            Ok(Event::Eof) => break,
            Ok(_) => {}
            Err(error) => return Err(format!("its description is no XML: {error}")),
        }
    }
    check_references(references)
}

fn append(open: &mut [Open], text: &str) {
    if let Some(element) = open.last_mut() {
        element.text.push_str(text);
    }
}

/// Upper bound on how deep a formula's parts lie within each other: brackets, and what binds to the
/// right without them (signs, powers, conditions).
fn nesting(formula: &str) -> usize {
    let (mut depth, mut deepest) = (0_usize, 0);
    let (mut to_the_right, mut signs, mut most_signs) = (0, 0, 0);
    for character in formula.chars().filter(|character| !character.is_whitespace()) {
        signs = if "+-~!".contains(character) { signs + 1 } else { 0 };
        most_signs = most_signs.max(signs);
        match character {
            '(' => depth += 1,
            ')' => depth = depth.saturating_sub(1),
            '?' | '*' => to_the_right += 1,
            _ => {}
        }
        deepest = deepest.max(depth);
    }
    deepest + to_the_right + most_signs
}

/// Takes away, round by round, the features that refer to none that is left. What remains refers to
/// itself, or through too many others.
fn check_references(mut left: BTreeMap<String, BTreeSet<String>>) -> Result<(), String> {
    for _ in 0..MOST_NESTED {
        let waits = |others: &BTreeSet<String>| others.iter().any(|other| left.contains_key(other));
        let settled: Vec<String> = left
            .iter()
            .filter(|(_, others)| !waits(others))
            .map(|(feature, _)| feature.clone())
            .collect();
        settled.iter().for_each(|feature| _ = left.remove(feature));
    }
    match left.keys().next() {
        None => Ok(()),
        Some(feature) => Err(format!(
            "in its description `{feature}` refers to itself, or through too many others"
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn described(features: &str) -> Result<(), String> {
        check(&format!(
            "<?xml version=\"1.0\"?><RegisterDescription>{features}</RegisterDescription>"
        ))
    }

    fn integer(name: &str, by: &str) -> String {
        format!("<Integer Name=\"{name}\"><pValue>{by}</pValue></Integer>")
    }

    #[test]
    fn limits_may_depend_on_each_other_and_values_may_not() {
        let each_by_the_other = |tag: &str| {
            described(&format!(
                "<Integer Name=\"Width\"><Value>1</Value><{tag}>OffsetX</{tag}></Integer>\
                 <Integer Name=\"OffsetX\"><Value>1</Value><{tag}>Width</{tag}></Integer>"
            ))
        };
        assert_eq!(each_by_the_other("pMax"), Ok(()));
        assert!(each_by_the_other("pValue").unwrap_err().contains("`OffsetX`"));
        let knife = "<IntSwissKnife Name=\"A\"><pVariable Name=\"B\">A</pVariable>\
                     <Formula>B</Formula></IntSwissKnife>";
        assert!(described(knife).unwrap_err().contains("`A`"));
    }

    #[test]
    fn a_chain_may_be_as_long_as_the_stack_bears() {
        let chain = |length: usize| -> String {
            (0..length).map(|k| integer(&format!("N{k}"), &format!("N{}", k + 1))).collect()
        };
        assert_eq!(described(&chain(MOST_NESTED)), Ok(()));
        assert!(described(&chain(MOST_NESTED + 1)).is_err());
    }

    #[test]
    fn a_formula_may_be_long_and_not_deep() {
        let formula = |text: String| {
            described(&format!("<SwissKnife Name=\"A\"><Formula>{text}</Formula></SwissKnife>"))
        };
        assert_eq!(formula("(A+B)".to_owned() + &"+(A-1)".repeat(1000)), Ok(()));
        assert_eq!(formula("(A&lt;B)?1:(A<![CDATA[>]]>2)".to_owned()), Ok(()));
        for deep in ["(", "&#40;", "-", "A?B:", "2**", "- ~"] {
            assert!(formula(deep.repeat(MOST_NESTED + 1) + "1").is_err(), "{deep}");
        }
    }

    #[test]
    fn what_is_no_description_is_named() {
        assert!(described("<a></b>").unwrap_err().contains("no XML"));
    }
}
