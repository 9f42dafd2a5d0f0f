//! Checks a camera's description of itself (GenICam's XML) before it is used.
//!
//! `viva-genicam` follows references between features, and brackets in formulas, as deep as they
//! go. A description whose references form a cycle, as faulty firmware may send it, would take all
//! of the stack and end the process. What is refused here is that; a description that is wrong in
//! any other way is the library's to decide. Somebody hostile on the cameras' network can still
//! make the library work without an end (expressions that contain each other, chains of dependent
//! features).

use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

/// Most references from a feature's value to another's one after another: cameras have a dozen.
/// With half of it the same.
const MOST_REFERENCES: usize = 128;
/// Most brackets, signs, powers and conditions of a formula that may lie within each other:
/// vendors' have some tens. Each takes up to 5 kB (debug build) of the 2 MB of stack of the
/// camera's thread. With half of it a vendor's deepest formula might be refused, and its camera
/// with it; with four times as much a formula can take all of the stack.
const MOST_NESTED: usize = 120;
/// Most operators of a formula: a sum of as many terms is a tree of that depth. With half of it a
/// camera with a sum of more than 250 operators is refused.
const MOST_OPERATORS: usize = 500;
/// Elements within elements, at most: descriptions have five or so. With half of it the same.
const MOST_ELEMENTS: usize = 1000;
/// Names of the references that are followed when a value is read. Those to limits, and to what
/// else changes with a value, may form cycles.
const OF_VALUES: [&str; 7] =
    ["pValue", "pVariable", "pAddress", "pIndex", "pLength", "pValueIndexed", "pValueDefault"];
/// Names of the elements that hold formulas.
const FORMULAS: [&str; 5] = ["Formula", "FormulaTo", "FormulaFrom", "Expression", "Constant"];
/// The characters of a formula's operators.
const OPERATORS: &str = "+-*/%~!&|^<>=?:,";

/// An element that has begun and not ended.
struct Open {
    tag: String,
    /// Name of the feature that it is, or is a part of.
    feature: Option<Rc<str>>,
    /// Name of the formula's variable that it defines.
    variable: Option<String>,
    text: String,
}

impl Open {
    fn new(start: &BytesStart<'_>, within: Option<&Self>) -> Self {
        let tag = start.local_name().as_ref().to_owned();
        // What lies within a feature may have a name too, and is a part of it.
        let holds_features = within
            .is_none_or(|within| matches!(within.tag.as_str(), "RegisterDescription" | "Group"));
        let name = attribute(start, "Name");
        let feature = match &name {
            Some(name) if holds_features => Some(Rc::from(name.as_str())),
            _ => within.and_then(|within| within.feature.clone()),
        };
        let is_part = matches!(tag.as_str(), "pVariable" | "Constant" | "Expression");
        Self { tag, feature, variable: name.filter(|_| is_part), text: String::new() }
    }
}

fn attribute(start: &BytesStart<'_>, name: &str) -> Option<String> {
    let found = start.try_get_attribute(name).ok().flatten()?;
    let value = found.normalized_value(quick_xml::XmlVersion::Implicit1_0).ok()?;
    Some(value.trim().to_owned())
}

/// What is gathered of a description.
#[derive(Default)]
struct Gathered {
    open: Vec<Open>,
    /// Which features' values each feature's value is made of.
    references: BTreeMap<Rc<str>, BTreeSet<String>>,
}

/// Checks a description.
///
/// # Errors
/// What is wrong with it, in words.
pub(super) fn check(xml: &str) -> Result<(), String> {
    let mut reader = Reader::from_str(xml);
    // Tooltips have them.
    reader.config_mut().allow_dangling_amp = true;
    let mut gathered = Gathered::default();
    while let Ok(event) = reader.read_event() {
        match event {
            Event::Start(start) => gathered.begin(&start)?,
            Event::Empty(start) => {
                gathered.begin(&start)?;
                gathered.end()?;
            }
            Event::Text(text) => gathered.append(&text),
            Event::CData(text) => gathered.append(&text),
            // A bracket may be written as its number.
            Event::GeneralRef(number) => {
                if let Ok(Some(character)) = number.resolve_char_ref() {
                    gathered.append(character.encode_utf8(&mut [0; 4]));
                }
            }
            Event::End(_) => gathered.end()?,
            Event::Eof => break,
            _ => {}
        }
    }
    check_references(gathered.references)
}

impl Gathered {
    fn begin(&mut self, start: &BytesStart<'_>) -> Result<(), String> {
        if self.open.len() >= MOST_ELEMENTS {
            return Err(format!("its description has elements {MOST_ELEMENTS} deep"));
        }
        let mut element = Open::new(start, self.open.last());
        let tag = element.tag.as_str();
        if FORMULAS.contains(&tag) || OF_VALUES.contains(&tag) {
            element.text.extend(attribute(start, "Value"));
        }
        let by_attribute = match tag {
            "EnumEntry" => attribute(start, "pValue"),
            "pIndex" => attribute(start, "pOffset"),
            _ => None,
        };
        if let Some((feature, other)) = element.feature.clone().zip(by_attribute) {
            self.references.entry(feature).or_default().insert(other);
        }
        self.open.push(element);
        Ok(())
    }

    fn append(&mut self, text: &str) {
        if let Some(element) = self.open.last_mut() {
            element.text.push_str(text);
        }
    }

    fn end(&mut self) -> Result<(), String> {
        let Some(Open { tag, feature, variable, text }) = self.open.pop() else { return Ok(()) };
        if FORMULAS.contains(&tag.as_str()) {
            check_formula(&text)?;
        } else if OF_VALUES.contains(&tag.as_str()) {
            // A variable `Width.Max` is no part of the width's value.
            let is_value = variable.is_none_or(|variable| !variable.contains('.'));
            if let Some(feature) = feature.filter(|_| is_value) {
                self.references.entry(feature).or_default().insert(text.trim().to_owned());
            }
        } else {
            // Text of an element within a formula is the formula's.
            let within = self.open.last().map(|element| element.tag.as_str());
            if within.is_some_and(|tag| FORMULAS.contains(&tag) || OF_VALUES.contains(&tag)) {
                self.append(&text);
            }
        }
        Ok(())
    }
}

/// Checks how deep a formula's parts may lie within each other: brackets, and what binds to the
/// right without them (signs, powers, conditions); and how many there are.
fn check_formula(formula: &str) -> Result<(), String> {
    let (mut depth, mut deepest) = (0_usize, 0);
    let (mut to_the_right, mut operators) = (0, 0);
    let mut before = '(';
    for character in formula.chars().filter(|character| !character.is_whitespace()) {
        // A sign, and not a sum.
        let is_prefix = before == '(' || OPERATORS.contains(before);
        match character {
            '(' => depth += 1,
            ')' => depth = depth.saturating_sub(1),
            '?' | '~' | '!' => to_the_right += 1,
            '+' | '-' if is_prefix => to_the_right += 1,
            '*' if before == '*' => to_the_right += 1,
            _ => {}
        }
        operators += usize::from(OPERATORS.contains(character));
        deepest = deepest.max(depth);
        before = character;
    }
    let is_too_deep = deepest + to_the_right > MOST_NESTED || operators > MOST_OPERATORS;
    if is_too_deep { Err("a formula of its description is too deep".to_owned()) } else { Ok(()) }
}

/// Takes away, round by round, the features that refer to none that is left. What remains refers to
/// itself, or through too many others.
fn check_references(mut left: BTreeMap<Rc<str>, BTreeSet<String>>) -> Result<(), String> {
    for _ in 0..MOST_REFERENCES {
        let is_left = |other: &String| left.contains_key(other.as_str());
        let settled: Vec<Rc<str>> = left
            .iter()
            .filter(|(_, others)| !others.iter().any(is_left))
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

    #[test]
    fn limits_may_depend_on_each_other_and_values_may_not() {
        let each_by_the_other = |tag: &str| {
            described(&format!(
                "<Group><Integer Name=\"Width\"><Value>1</Value><{tag}>OffsetX</{tag}></Integer></Group>\
                 <Integer Name=\" Offset&#88; \"><Value>1</Value><{tag}><![CDATA[Width]]></{tag}></Integer>"
            ))
        };
        assert_eq!(each_by_the_other("pMax"), Ok(()));
        assert!(each_by_the_other("pValue").unwrap_err().contains("`OffsetX`"));
    }

    #[test]
    fn a_value_that_is_its_own_is_named_however_it_is_written() {
        for own in [
            "<IntSwissKnife Name=\"A\"><pVariable Name=\"B\">A</pVariable></IntSwissKnife>",
            "<IntSwissKnife Name=\"A\"><pVariable Name=\"B\" Value=\"A\"/></IntSwissKnife>",
            "<Enumeration Name=\"A\"><EnumEntry Name=\"B\" pValue=\"A\"/></Enumeration>",
            "<IntReg Name=\"A\"><pIndex pOffset=\"A\">B</pIndex></IntReg>",
            "<Integer Name=\"A\"><pValue><x>A</x></pValue></Integer>",
        ] {
            assert!(described(own).unwrap_err().contains("`A`"), "{own}");
        }
    }

    #[test]
    fn what_is_legal_is_left_to_the_library() {
        let legal = [
            // An entry may be named as a feature is, and a formula may ask for the feature's
            // limits.
            "<Enumeration Name=\"A\"><EnumEntry Name=\"B\"><Value>1</Value></EnumEntry><pValue>B</pValue>\
             </Enumeration><IntReg Name=\"B\"/>",
            "<IntSwissKnife Name=\"A\"><pVariable Name=\"A.Max\">A</pVariable></IntSwissKnife>",
            "<Integer Name=\"A\"><ToolTip>R&D of A & B</ToolTip></Integer>",
            "<Integer Name=\"A\"></Integr>",
        ];
        for legal in legal {
            assert_eq!(described(legal), Ok(()), "{legal}");
        }
    }

    #[test]
    fn a_chain_may_be_as_long_as_the_stack_bears() {
        let chain = |length: usize| -> String {
            let link = |k| format!("<Integer Name=\"N{k}\"><pValue>N{}</pValue></Integer>", k + 1);
            (0..length).map(link).collect()
        };
        assert_eq!(described(&chain(MOST_REFERENCES)), Ok(()));
        assert!(described(&chain(MOST_REFERENCES + 1)).is_err());
    }

    #[test]
    fn a_formula_may_be_long_and_not_deep() {
        let formula = |text: String| {
            described(&format!("<SwissKnife Name=\"A\"><Formula>{text}</Formula></SwissKnife>"))
        };
        assert_eq!(formula("(A+B)".to_owned() + &"+(A-1)*2".repeat(100)), Ok(()));
        assert_eq!(formula("(A&lt;B)?1:(A<![CDATA[>]]>2)".to_owned()), Ok(()));
        for deep in ["(", "&#40;", "-", "A?B:", "2**", "- ~", "(-"] {
            assert!(formula(deep.repeat(MOST_NESTED + 1) + "1").is_err(), "{deep}");
        }
        assert!(formula("1+".repeat(MOST_OPERATORS + 1) + "1").is_err());
        let constant = format!(
            "<Float Name=\"A\"><Constant Value=\"{}\"/></Float>",
            "(".repeat(MOST_NESTED + 1)
        );
        assert!(described(&constant).is_err());
    }

    #[test]
    fn elements_within_elements_are_refused_before_they_take_memory() {
        assert!(described(&"<a>".repeat(MOST_ELEMENTS)).unwrap_err().contains("deep"));
    }
}
